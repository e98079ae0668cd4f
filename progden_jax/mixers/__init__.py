"""Mixers: α in closed form or from a network, found by name or read from a file."""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Bool, Float

from progden_jax import _safetensors
from progden_jax._amx import ALIGNED
from progden_jax._bands import in_bands, rows_of
from progden_jax.mixers.architectures import ARCHITECTURES, Architecture, Params, build, name_of
from progden_jax.mixing import ClosedForm, Mixer, level_of

__all__ = [
    "ANY",
    "ARCHITECTURES",
    "CLOSED_FORM",
    "Architecture",
    "NetworkMixer",
    "build",
    "default_for",
    "load",
    "name_of",
    "names",
    "save_mixer",
]

CLOSED_FORM = "closed-form"
"""The name of the mixer that needs no weights."""

ANY = "any"
"""The name of the network for all others: trained behind several, better than the closed form behind any."""

_ALSO_FOR = {"nfor+combiner": "nfor"}
"""Denoisers whose mixer was trained for more than that of its name."""

_FOLDER = Path(__file__).parents[1] / "weights"
_PREFIX = "mixer-"


@jax.tree_util.register_pytree_node_class
class NetworkMixer:
    """A learned mixer: a pytree with its weights as leaves.

    Parameters
    ----------
    params : nested names -> arrays.
    architecture : what to do with them, see `ARCHITECTURES`.
    metadata : where they come from, for people; not carried through ``jit``.
    """

    def __init__(
        self,
        params: Params,
        architecture: Architecture,
        *,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        self.params = params
        self.architecture = architecture
        self.metadata = dict(metadata or {})

    def __call__(
        self,
        x: Float[Array, "h w 3"],
        y: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        divergence: Float[Array, "h w 3"],
        sure: Float[Array, "h w 3"],
        *,
        inside: Bool[Array, "h w 1"] | None = None,
        level: Float[Array, ""] | None = None,
    ) -> Float[Array, "h w 3"]:
        """α in [0, 1], (H, W, 3); see `Mixer`."""
        if level is None and _rows(x.shape[0], x.shape[1], self.receptive_radius) < x.shape[0]:
            level = level_of(x, inside)
        known = (x, y, variance, divergence, sure, *(() if inside is None else (inside,)))

        def applied(*known: Array) -> Array:
            *images, there = (*known, None) if inside is None else known
            return self.architecture.apply(self.params, *images, inside=there, level=level)

        # GPUs would else take TF32.
        with jax.default_matmul_precision("highest"):
            return banded(applied, known, self.receptive_radius)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away α can depend on the images."""
        return self.architecture.receptive_radius

    def __repr__(self) -> str:
        return f"NetworkMixer({self.architecture})"

    def tree_flatten(self) -> tuple[tuple[Params], Architecture]:
        return (self.params,), self.architecture

    @classmethod
    def tree_unflatten(cls, architecture: Architecture, children: tuple[Params]) -> "NetworkMixer":
        return cls(children[0], architecture)


def names() -> tuple[str, ...]:
    """The names that `load` knows: the closed form, "any", and the denoisers that a mixer is shipped for."""
    return (CLOSED_FORM, *_safetensors.shipped(_FOLDER, _PREFIX))


def load(name: str | os.PathLike[str]) -> Mixer:
    """The mixer of that name, or of the weights file (.safetensors) at that path.

    Parameters
    ----------
    name : one of `names()`, such as "closed-form" or "oidn-hdr", or a path that ends in .safetensors.

    Raises
    ------
    ValueError
        If there is no such name or file, or the file holds no mixer.
    """
    text = os.fspath(name)
    if text.endswith(_safetensors.ENDING):
        return _read(Path(text))
    if text == CLOSED_FORM:
        return ClosedForm()
    if text in names():
        return _shipped(text)
    raise ValueError(
        f"mixer is {text!r}, expected one of {', '.join(names())}, or a path that ends in "
        f"{_safetensors.ENDING}."
    )


def default_for(denoiser: Any) -> Mixer:
    """The mixer that is shipped for this denoiser, or the one for any where none is."""
    name = str(getattr(denoiser, "name", ""))
    name = _ALSO_FOR.get(name, name)
    return load(name if name in names() else ANY)


def save_mixer(
    path: str | os.PathLike[str],
    mixer: NetworkMixer,
    *,
    dtype: str = "float32",
    **metadata: str,
) -> None:
    """Write a mixer's weights and settings so that `load` gives it back; whole or not at all.

    Parameters
    ----------
    path : ends in .safetensors.
    dtype : "float16" halves the file, at about three digits.
    metadata : what more to say of it, such as the denoiser it was trained for, added to the mixer's own.

    Raises
    ------
    ValueError
        If the path ends otherwise, or a weight is not finite in `dtype`.
    """
    said = {
        **mixer.metadata,
        **metadata,
        "kind": "mixer",
        "architecture": name_of(mixer.architecture),
        "options": json.dumps(dataclasses.asdict(cast(Any, mixer.architecture))),
    }
    _safetensors.write(path, mixer.params, said, dtype=dtype)


def banded(
    f: Callable[..., Float[Array, "h w d"]], images: tuple[Array, ...], radius: int
) -> Float[Array, "h w d"]:
    """``f(*images)``, which sees so far: large images in bands of rows."""
    height, width = images[0].shape[:2]
    multiple = 1 if height % ALIGNED else ALIGNED
    rows = _rows(height, width, radius)
    return in_bands(f, images, height, rows=rows, halo=radius, multiple=multiple)


def _rows(height: int, width: int, radius: int) -> int:
    """Twice a denoiser's, which takes no more memory: what is linearised is no longer there."""
    return max(2 * rows_of(height, width), 16 * radius)


@functools.lru_cache(maxsize=8)
def _shipped(name: str) -> NetworkMixer:
    return _read(_safetensors.shipped(_FOLDER, _PREFIX)[name])


def _read(path: Path) -> NetworkMixer:
    params, metadata = _safetensors.read(path)
    if metadata.get("kind") != "mixer":
        raise ValueError(
            f"{path} holds no mixer (its metadata says {metadata.get('kind', 'nothing')!r}): "
            "give a file from `progden train mixer` or progden_jax.mixers.save_mixer."
        )
    try:
        architecture = build(metadata["architecture"], json.loads(metadata["options"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    expected = jax.eval_shape(architecture.init, jax.random.key(0))
    if _shapes(expected) != _shapes(params):
        raise ValueError(f"{path}: its tensors are not those of the architecture {architecture}.")
    return NetworkMixer(params, architecture, metadata=metadata)


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
    return {n: jnp.shape(cast(Any, a)) for n, a in flatten_dict(params, sep=".").items()}
