"""Checks of what users pass in, made on static facts only (shape, dtype, names) so that they hold
under ``jit`` and ``vmap``. Every message says what came, what was expected and what to do."""

from collections.abc import Collection
from typing import Any

import jax.numpy as jnp

RGB = 3


def image(name: str, value: Any, *, channels: int = RGB) -> None:
    """Raise unless `value` is one floating-point image (H, W, channels)."""
    shape = _shape(name, value)
    _floating(name, value)
    if len(shape) != 3 or shape[-1] != channels:
        raise ValueError(
            f"{name} has shape {shape}, expected (height, width, {channels})"
            f"{_shape_hint(shape, channels)}."
        )
    if 0 in shape:
        raise ValueError(f"{name} has shape {shape}: an image needs at least one pixel.")


def images(name: str, value: Any, *, channels: int = RGB) -> None:
    """Raise unless `value` is an image (..., H, W, channels), leading axes being a batch."""
    shape = _shape(name, value)
    _floating(name, value)
    if len(shape) < 3 or shape[-1] != channels or 0 in shape:
        raise ValueError(
            f"{name} has shape {shape}, expected (..., height, width, {channels}) with at least "
            f"one pixel{_shape_hint(shape, channels)}."
        )


def same_shape(name: str, value: Any, other_name: str, other: Any) -> None:
    """Raise unless both arrays have one shape (the last axis may differ for unlike channels)."""
    if tuple(value.shape) != tuple(other.shape):
        raise ValueError(
            f"{name} has shape {tuple(value.shape)} but {other_name} has {tuple(other.shape)}: "
            "they must be equal, pixel for pixel."
        )


def choice(name: str, value: Any, allowed: Collection[str]) -> None:
    """Raise unless `value` is one of the names in `allowed`."""
    if value not in allowed:
        names = ", ".join(repr(a) for a in allowed)
        raise ValueError(f"{name} is {value!r}, expected one of {names}.")


def positive_int(name: str, value: Any, *, at_most: int | None = None) -> None:
    """Raise unless `value` is an int of at least 1 (and at most `at_most`)."""
    limit = "" if at_most is None else f" and at most {at_most}"
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} is {value!r}, expected a whole number of at least 1{limit}.")
    if at_most is not None and value > at_most:
        raise ValueError(f"{name} is {value!r}, expected a whole number of at least 1{limit}.")


def odd_int(name: str, value: Any) -> None:
    """Raise unless `value` is an odd int of at least 1, as the width of a centred window."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1 or value % 2 == 0:
        raise ValueError(
            f"{name} is {value!r}, expected an odd whole number of pixels, such as 11."
        )


def _shape(name: str, value: Any) -> tuple[int, ...]:
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise ValueError(f"{name} is a {type(value).__name__}, expected a floating-point array.")
    return tuple(value.shape)


def _floating(name: str, value: Any) -> None:
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(
            f"{name} has dtype {value.dtype}, expected a floating-point type: "
            f"convert it to linear radiance first, for instance with {name}.astype('float32')."
        )


def _shape_hint(shape: tuple[int, ...], channels: int) -> str:
    if len(shape) == 2:
        return "; add the channel axis with [..., None] or repeat it over three channels"
    if len(shape) == 3 and shape[0] == channels:
        return "; the channels come last here: transpose(1, 2, 0)"
    if len(shape) == 3 and shape[-1] == 4 and channels == RGB:
        return "; drop the alpha channel with [..., :3]"
    if len(shape) == 4 and shape[-1] == channels:
        return "; map over a batch with jax.vmap"
    return ""
