"""The buffers of one render, and the repair of values that no renderer should have written.

Layout everywhere: channels last, linear radiance, float32 (float64 under JAX's x64). Leading axes
are a batch, to be mapped over with ``jax.vmap``.
"""

from collections.abc import Hashable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from progden_jax import _checks

HALF_MAX = 65504.0
"""Largest finite half-precision value: what an overflowed half-float pixel stands for."""


@jax.tree_util.register_pytree_with_keys_class
class Frame:
    """One noisy render with what is known about it.

    Parameters
    ----------
    color : (..., H, W, 3) linear radiance, an unbiased estimate of the true image.
    variance : (..., H, W, 3) variance of `color`, that is of the sample MEAN, in squared radiance;
        None when it is unknown (the frame can then be denoised, but not progressively).
    albedo : (..., H, W, 3) in [0, 1], or None.
    normal : (..., H, W, 3) in [-1, 1], or None.
    depth : (..., H, W, 1) distance from the camera, or None.
    spp : samples per pixel (a number, or one per batch element), or None.

    Raises
    ------
    ValueError
        If a buffer is not a floating-point array of such a shape, or sizes differ.
    """

    __slots__ = ("albedo", "color", "depth", "normal", "spp", "variance")

    color: Float[Array, "*b h w 3"]
    variance: Float[Array, "*b h w 3"] | None
    albedo: Float[Array, "*b h w 3"] | None
    normal: Float[Array, "*b h w 3"] | None
    depth: Float[Array, "*b h w 1"] | None
    spp: Any

    def __init__(
        self,
        color: Any,
        variance: Any,
        albedo: Any = None,
        normal: Any = None,
        depth: Any = None,
        spp: Any = None,
    ) -> None:
        buffers = {
            "color": color,
            "variance": variance,
            "albedo": albedo,
            "normal": normal,
            "depth": depth,
        }
        _checks.images("color", color)
        for name, value in buffers.items():
            if value is None:
                continue
            _checks.images(name, value, channels=1 if name == "depth" else 3)
            if value.shape[:-1] != color.shape[:-1]:
                raise ValueError(
                    f"{name} covers {_size(value)} pixels but color covers {_size(color)}: "
                    "all buffers of a frame must come from the same render at the same size."
                )
        for name, value in buffers.items():
            setattr(self, name, None if value is None else _held(value))
        self.spp = None if spp is None else jnp.broadcast_to(spp, self.color.shape[:-3])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.color.shape[-3], self.color.shape[-2]

    def replace(self, **changes: Any) -> "Frame":
        """A copy with some buffers replaced."""
        return Frame(**({name: getattr(self, name) for name in _FIELDS} | changes))

    def __repr__(self) -> str:
        parts = []
        for name in _FIELDS:
            value = getattr(self, name)
            if value is not None:
                shape = getattr(value, "shape", None)
                parts.append(f"{name}={value if shape in (None, ()) else shape}")
        return f"Frame({', '.join(parts)})"

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Any, Any]], Hashable]:
        return [(jax.tree_util.GetAttrKey(n), getattr(self, n)) for n in _FIELDS], None

    def tree_flatten(self) -> tuple[list[Any], Hashable]:
        return [getattr(self, n) for n in _FIELDS], None

    @classmethod
    def tree_unflatten(cls, _: Hashable, children: Any) -> "Frame":
        # Not through __init__: JAX unflattens with placeholders that are no arrays.
        frame = object.__new__(cls)
        for name, value in zip(_FIELDS, children, strict=True):
            setattr(frame, name, value)
        return frame


_FIELDS = ("color", "variance", "albedo", "normal", "depth", "spp")


def _held(value: Any) -> jax.Array:
    """A copy on the device. `jnp.asarray` would compile a program for each new shape, for 25 ms."""
    return value if isinstance(value, jax.Array) else jax.device_put(np.array(value))


def _size(value: Any) -> str:
    return "×".join(str(n) for n in value.shape[:-1])


class Repairs(NamedTuple):
    """How many pixels of a frame held a bad value (a pixel counts once per row, int32 scalars).

    `negative_color` is a count only: filters with negative lobes write such pixels rightly, so
    they stay as they are, and the denoiser and the features clamp what they see at zero.
    """

    nonfinite_color: Int[Array, ""]
    negative_color: Int[Array, ""]
    nonfinite_variance: Int[Array, ""]
    negative_variance: Int[Array, ""]
    nonfinite_auxiliary: Int[Array, ""]


def share(frame: Frame, count: Any) -> Frame:
    """The frame with the variance and the samples of one part of its samples, of which it has `count`."""
    variance, spp = frame.variance, frame.spp
    return frame.replace(
        variance=None if variance is None else count * variance,
        spp=None if spp is None else spp / count,
    )


def centre(frame: Frame, size: int) -> Frame:
    """The middle size × size pixels of every buffer.

    Raises
    ------
    ValueError
        If the frame has less.
    """
    if size > min(frame.size):
        height, width = frame.size
        raise ValueError(f"the crop is {size} pixels wide, the frame {width}×{height}.")
    top, left = ((n - size) // 2 for n in frame.size)
    changed = {
        name: buffer[top : top + size, left : left + size]
        for name in ("color", "variance", "albedo", "normal", "depth")
        if (buffer := getattr(frame, name)) is not None
    }
    return frame.replace(**changed)


def repair(frame: Frame, *, inside: Bool[Array, "h w 1"] | None = None) -> tuple[Frame, Repairs]:
    """The frame with every value finite and every variance at least zero, and what that took.

    Colour that is +inf becomes 65504, where half floats overflow; NaN and -inf become the mean of
    the finite pixels among the 5×5 around (0 if there are none). Variance that is not finite is
    filled in the same way, and raised to the squared radiance where the colour itself was bad: such a
    pixel knows nothing. Negative variance, which second moments in half precision produce, becomes
    0. Auxiliary values that are not finite become 0. Finite frames pass through bit for bit.

    Parameters
    ----------
    frame : one frame, (H, W, 3) buffers; map over a batch with ``jax.vmap``.
    inside : (H, W, 1) False where the buffers are padding around the image, of which nothing is learned.
    """
    _checks.image("frame.color", frame.color)
    color, bad_color = _fill(frame.color, inside, overflow=HALF_MAX)
    none = jnp.zeros((), jnp.int32)
    variance, nonfinite_variance, negative_variance = frame.variance, none, none
    if variance is not None:
        nonfinite_variance = _count(~jnp.isfinite(variance))
        negative_variance = _count(variance < 0)
        variance = jnp.maximum(_fill(variance, inside, overflow=None)[0], 0)
        unknown = jnp.minimum(color**2, jnp.finfo(color.dtype).max)
        variance = jnp.where(bad_color, jnp.maximum(variance, unknown), variance)
    auxiliary = {}
    bad_auxiliary = jnp.zeros(frame.size, bool)
    for name in ("albedo", "normal", "depth"):
        value = getattr(frame, name)
        if value is not None:
            finite = jnp.isfinite(value)
            auxiliary[name] = jnp.where(finite, value, 0)
            bad_auxiliary |= ~finite.all(-1)
    repairs = Repairs(
        nonfinite_color=_count(bad_color),
        negative_color=_count(frame.color < 0),
        nonfinite_variance=nonfinite_variance,
        negative_variance=negative_variance,
        nonfinite_auxiliary=bad_auxiliary.sum(dtype=jnp.int32),
    )
    return frame.replace(color=color, variance=variance, **auxiliary), repairs


@jax.jit
def repaired(frame: Frame) -> Frame:
    """The frame alone of `repair`, compiled."""
    return repair(frame)[0]


def _count(bad: Array) -> Int[Array, ""]:
    return bad.any(-1).sum(dtype=jnp.int32)


def _fill(value: Array, inside: Array | None, *, overflow: float | None) -> tuple[Array, Array]:
    """`value` with non-finite entries filled from the finite ones of the 5×5 around, and their mask."""
    bad = ~jnp.isfinite(value)
    good = ~bad if inside is None else ~bad & inside

    def filled(value: Array) -> Array:
        known = jnp.where(good, value, 0)
        window = (5, 5, 1)
        total = lax.reduce_window(known, 0.0, lax.add, window, (1, 1, 1), "SAME")
        count = lax.reduce_window(good.astype(value.dtype), 0.0, lax.add, window, (1, 1, 1), "SAME")
        near = total / jnp.maximum(count, 1)
        if overflow is not None:
            near = jnp.where(value == jnp.inf, overflow, near)
        return jnp.where(bad, near, value)

    return lax.cond(bad.any(), filled, lambda value: value, value), bad
