"""Random crops, mirrorings, quarter turns, orders of colour, exposures and units of length of one example.

All buffers of an example are changed alike, so that what is computed from them afterwards (SURE, features)
belongs to the changed example. Three things are worth knowing:

- A denoised image in the data was made from the whole, unchanged render. Mirrored or recoloured it is what
  another denoiser (the first between the change and its inverse) makes of the changed render, with that
  denoiser's divergence: as good to learn mixing from.
- That holds for a change of exposure only if the denoiser itself follows it, f(s·x) = s·f(x). OIDN does
  as long as it chooses its own exposure; `MixerTask` refuses others.
- Normals are in world space, so that neither mirroring nor turning the picture changes them.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax.training.config import RunConfig

Example = dict[str, Array]
"""Buffer name -> (H, W, C)."""

_RADIANCE_POWER = {
    "color": 1,
    "variance": 2,
    "denoised": 1,
    "divergence": 2,
    "probe": 1,
    "tangent": 1,
    "reference": 1,
    "mean_variance": 2,
}
"""By what power of s a buffer grows when radiance grows by s; buffers not listed do not."""

_LENGTHS = ("depth",)

_UNCOLORED = ("normal", "depth", "mean_variance")
ORDERS = np.asarray([(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
"""Orders of the colour channels, the unchanged one first."""


class Change(NamedTuple):
    """One augmentation, scalars that may be traced; the default values change nothing."""

    row: Array | int = 0
    column: Array | int = 0
    transpose: Array | bool = False
    flip_rows: Array | bool = False
    flip_columns: Array | bool = False
    order: Array | int = 0
    stops: Array | float = 0.0
    depth_stops: Array | float = 0.0


def draw(key: jax.Array, size: tuple[int, int], config: RunConfig) -> Change:
    """A random change for images of this (height, width), as the configuration allows."""
    keys = jax.random.split(key, 7)
    row, column = (
        jax.random.randint(k, (), 0, n - config.crop + 1)
        for k, n in zip(keys[:2], size, strict=True)
    )
    coins = [jax.random.bernoulli(k) for k in keys[2:5]]
    none = jnp.asarray(False)
    transpose = coins[0] if config.turns else none
    flip_rows = coins[1] if config.flips or config.turns else none
    # Without mirroring the eight symmetries of the square are cut to the four turns.
    turned = jnp.logical_xor(flip_rows, transpose)
    flip_columns = coins[2] if config.flips else turned if config.turns else none
    order = jax.random.randint(keys[5], (), 0, len(ORDERS)) if config.permute_colors else 0
    stops = config.exposure_stops * jax.random.uniform(keys[6], minval=-1, maxval=1)
    # By a key of its own: the others' draws stay as they were.
    unit = jax.random.uniform(jax.random.fold_in(key, 7), minval=-1, maxval=1)
    depth_stops = config.depth_stops * unit
    return Change(
        row, column, transpose, flip_rows, flip_columns, jnp.asarray(order), stops, depth_stops
    )


def apply(
    change: Change, example: Mapping[str, Float[Array, "..."]], *, crop: int
) -> dict[str, Float[Array, "..."]]:
    """The changed buffers: (H, W, C) become (crop, crop, C), scalars stay scalars."""
    images = {name: buffer for name, buffer in example.items() if buffer.ndim}
    # As one array, for each step is compiled, and run, once.
    stacked = jnp.concatenate(list(images.values()), axis=-1)
    start, size = (change.row, change.column, 0), (crop, crop, stacked.shape[-1])
    stacked = jax.lax.dynamic_slice(stacked, start, size)
    stacked = jnp.where(change.transpose, stacked.swapaxes(0, 1), stacked)
    stacked = jnp.where(change.flip_rows, stacked[::-1], stacked)
    stacked = jnp.where(change.flip_columns, stacked[:, ::-1], stacked)
    ends = np.cumsum([image.shape[-1] for image in images.values()])
    moved = dict(zip(images, jnp.split(stacked, ends[:-1], axis=-1), strict=True))
    return {
        name: _recolored(change, name, moved.get(name, buffer)) for name, buffer in example.items()
    }


def _recolored(change: Change, name: str, buffer: Array) -> Array:
    if name not in _UNCOLORED:
        buffer = jnp.take(buffer, jnp.asarray(ORDERS)[change.order], axis=-1)
    if name in _LENGTHS:
        return buffer * jnp.exp2(change.depth_stops)
    power = _RADIANCE_POWER.get(name, 0)
    return buffer * jnp.exp2(power * change.stops) if power else buffer
