"""What a frame does not need: which of its tiles are right already."""

import dataclasses
import functools
import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from progden_jax._numeric import adopted

MARGIN = 5
"""Pixels around a tile that must be right too: the reach of the t-bound's window."""

_MOST_TILES = 128
"""Along an edge, for finding the cheapest windows takes time too."""

_PART = 1 << 18
"""Pixels that a compiled program looks at together, one for all larger images."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Skip:
    """When a tile of a render counts as right already, so that it is given back as it is.

    That is where every pixel of it, and of the 5 around it, has a standard error of at most `tolerance` times
    its radiance, in each channel. At the default the answer without skipping is the same to 1e-5 of the
    image's size (RMS): the t-bound lets a mix depart from the render by a few standard errors only, but on
    thin lines where the differences in its window happen to cancel.

    Parameters
    ----------
    tolerance : relative standard error; 0 leaves only pixels without any variance.
    tile : edge in pixels, at least 16.
    """

    tolerance: float = 1e-6
    tile: int = 16

    def for_size(self, size: tuple[int, int]) -> "Skip":
        """The same with tiles large enough for an image of that size."""
        tile = max(self.tile, math.ceil(max(size) / _MOST_TILES))
        return dataclasses.replace(self, tile=tile)

    def __post_init__(self) -> None:
        if not 0 <= self.tolerance < float("inf"):
            raise ValueError(
                f"tolerance is {self.tolerance}, expected a relative error from 0 up, such as 0.01."
            )
        if not isinstance(self.tile, int) or self.tile < 16:
            raise ValueError(f"tile is {self.tile!r}, expected at least 16 pixels.")


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Skipped:
    """What was left out of a frame's computation.

    Attributes
    ----------
    pixels : of the frame that were right already and stayed as they are.
    computed : pixels that the networks ran on, margins and padding included.
    reason : why, for people; "" where nothing was skipped.
    """

    pixels: int
    computed: int
    reason: str = ""


def noisy(
    color: Float[Array | np.ndarray, "*pixels 3"],
    variance: Float[Array | np.ndarray, "*pixels 3"],
    tolerance: float | Array,
    numpy: Any = jnp,
) -> Bool[Array | np.ndarray, "*pixels"]:
    """Pixels that are not right yet, bad values among them; by `jax.numpy`, or NumPy if told."""
    right = (variance <= (tolerance * color) ** 2) & numpy.isfinite(color)
    # Not all(-1), which takes NumPy as long as everything else here.
    red, green, blue = (right[..., channel] for channel in range(3))
    return ~(red & green & blue)


def noisy_tiles(
    color: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    skip: Skip,
    canvas: tuple[int, int] | None = None,
) -> Bool[np.ndarray, "rows columns"]:
    """Tiles with a pixel that is not right yet, in them or within `MARGIN` of them.

    Of `canvas` (height, width) where that is given; what it has beyond the image is right.
    """
    height, width = color.shape[:2]
    # On the host, where what follows is.
    images = [np.asarray(image).reshape(-1, 3) for image in (color, variance)]
    found = np.empty(height * width, bool)
    if len(found) < _PART:
        with np.errstate(all="ignore"):
            found[:] = noisy(cast(Any, images[0]), cast(Any, images[1]), skip.tolerance, np)
    else:
        for begin in range(0, len(found), _PART):
            part = slice(min(begin, len(found) - _PART), begin + _PART)
            found[part] = _noisy(
                *(adopted(image[part], _host()) for image in images), skip.tolerance
            )
    on = np.zeros(canvas or (height, width), bool)
    on[:height, :width] = found.reshape(height, width)
    return np.asarray(_tiles(on, skip.tile))


@jax.jit
def _noisy(color: Array, variance: Array, tolerance: Array) -> Array:
    return cast(Array, noisy(color, variance, tolerance))


@functools.cache
def _host() -> Any:
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS leaves it out
        return None


@functools.partial(jax.jit, static_argnames="tile")
def _tiles(found: Array, tile: int) -> Array:
    for axis in (0, 1):
        length = found.shape[axis]
        tiles = math.ceil(length / tile)
        widths = [(0, 0), (0, 0)]
        widths[axis] = (MARGIN, tiles * tile - length + MARGIN)
        padded = jnp.moveaxis(jnp.pad(found, widths), axis, 0)
        # A tile is at least twice the margin wide, so that three shifts of it cover it and its margin.
        parts = [padded[s : s + tiles * tile] for s in (0, MARGIN, 2 * MARGIN)]
        blocks = [p.reshape(tiles, tile, -1).any(1) for p in parts]
        found = jnp.moveaxis(blocks[0] | blocks[1] | blocks[2], 0, axis)
    return found
