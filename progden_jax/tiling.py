"""Windows of an image that are computed one by one: where they lie, how large they may be."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any, Protocol, cast

import numpy as np

from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import aligned_radius
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer
from progden_jax.tstatistic import Bound

SHARES = 128
"""A window's edge is so many parts of its canvas's, or fewer: the more, the less is wasted, but the fewer
frames share a program."""

_WORTH_SPLITTING = 0.9

_AUTHORS_BOUND = Bound()


class Tileable(Protocol):
    """A denoiser that can work on tiles of an image; all that are convolutional networks here can."""

    receptive_radius: int
    """How many pixels away an output pixel can depend on the input."""

    alignment: int
    """Pixels after which the way that outputs depend on inputs repeats; tiles begin and end at multiples.

    Where an output pixel of such a tile depends on less, ``aligned_radius`` may say so, in pixels.
    """

    def exposure_of(self, frame: Frame, valid: Any) -> Any:
        """What depends on the whole image, taken as ``bind(tile, valid=..., exposure=...)``."""
        ...


@dataclasses.dataclass(frozen=True)
class Window:
    """A part of an image that is computed at once, and the part of it that is then right.

    Attributes
    ----------
    origin : row and column of its first pixel, multiples of the denoiser's alignment.
    shape : in pixels; it may reach beyond the image at the right and below.
    rows, columns : its core, half-open ranges in the whole image.
    """

    origin: tuple[int, int]
    shape: tuple[int, int]
    rows: tuple[int, int]
    columns: tuple[int, int]

    @property
    def core(self) -> tuple[slice, slice]:
        """Of the whole image."""
        return slice(*self.rows), slice(*self.columns)

    @property
    def core_inside(self) -> tuple[slice, slice]:
        """The same pixels as seen from the window."""
        return (
            slice(self.rows[0] - self.origin[0], self.rows[1] - self.origin[0]),
            slice(self.columns[0] - self.origin[1], self.columns[1] - self.origin[1]),
        )

    @property
    def core_pixels(self) -> int:
        """Pixels of the core."""
        return (self.rows[1] - self.rows[0]) * (self.columns[1] - self.columns[0])

    @property
    def area(self) -> int:
        """Pixels of the window."""
        return self.shape[0] * self.shape[1]


def can_tile(denoiser: Denoiser, mixer: Mixer | None = None) -> bool:
    """Whether both tell how far they look."""
    radius = 0 if mixer is None else getattr(mixer, "receptive_radius", None)
    return _tells_reach(denoiser) and radius is not None


def _tells_reach(denoiser: Denoiser) -> bool:
    # Not isinstance, which from Python 3.12 on does not see what a wrapper passes on.
    return all(hasattr(denoiser, name) for name in ("receptive_radius", "alignment", "exposure_of"))


def margin(
    denoiser: Denoiser, mixer: Mixer | None = None, bound: Bound | None = _AUTHORS_BOUND
) -> int:
    """How far beyond a core a window must reach: all that the result there depends on.

    Without a mixer, all that the denoised image depends on.

    Raises
    ------
    ValueError
        If denoiser or mixer do not tell how far they look.
    """
    if not _tells_reach(denoiser):
        raise ValueError(
            f"the denoiser {denoiser!r} cannot work on tiles: it has no receptive_radius, alignment and "
            "exposure_of, so leave max_memory out."
        )
    tileable = cast(Tileable, denoiser)
    if mixer is None:
        return aligned_radius(tileable)
    if not can_tile(denoiser, mixer):
        raise ValueError(
            f"the mixer {mixer!r} cannot work on tiles: give it a receptive_radius in pixels, "
            "or leave max_memory out."
        )
    bounded = 0 if bound is None else bound.radius
    return aligned_radius(tileable) + cast(Any, mixer).receptive_radius + bounded


@dataclasses.dataclass(frozen=True)
class Cover:
    """How to cover parts of an image by windows.

    Parameters
    ----------
    size : of the image.
    canvas : the shape that it would be computed at as a whole.
    tile : edge in pixels of the tiles that parts are made of.
    reach : of the margin, see `margin`.
    step : multiples that windows begin at.
    shares : see `SHARES`.
    lengths : that windows may have, by axis, instead of multiples of a share.
    """

    size: tuple[int, int]
    canvas: tuple[int, int]
    tile: int
    reach: int
    step: int
    shares: int = SHARES
    lengths: tuple[tuple[int, ...], tuple[int, ...]] | None = None

    def windows(self, active: np.ndarray) -> list[Window]:
        """Windows whose cores hold all active tiles, (rows, columns) bool; disjoint.

        One for the whole image where several are not cheaper.
        """
        found = self._split(active, (0, 0))
        whole = Window((0, 0), self.canvas, (0, self.size[0]), (0, self.size[1]))
        cheap = sum(w.area for w in found) <= _WORTH_SPLITTING * whole.area
        return found if cheap else [whole]

    def _split(self, active: np.ndarray, first: tuple[int, int]) -> list[Window]:
        """Guillotine cuts of the active tiles' bounding box, while they pay."""
        if not active.any():
            return []
        active, first = _trimmed(active, first)
        whole = self._window(active, first)
        best, cut = _WORTH_SPLITTING * whole.area, None
        for axis in (0, 1):
            for at in range(1, active.shape[axis]):
                beside = (first[0] + at, first[1]) if axis == 0 else (first[0], first[1] + at)
                parts = list(zip(np.split(active, [at], axis), (first, beside), strict=True))
                area = sum(self._window(*_trimmed(*p)).area for p in parts if p[0].any())
                if area < best:
                    best, cut = area, parts
        if cut is None:
            return [whole]
        return [window for part in cut for window in self._split(*part)]

    def _window(self, active: np.ndarray, first: tuple[int, int]) -> Window:
        """The one whose core is all these tiles, the active and the others."""
        cores, places = [], []
        for axis in (0, 1):
            begin = first[axis] * self.tile
            end = min(begin + active.shape[axis] * self.tile, self.size[axis])
            cores.append((begin, end))
            places.append(self._place(begin, end, axis))
        (row, height), (column, width) = places
        return Window((row, column), (height, width), cores[0], cores[1])

    def _place(self, begin: int, end: int, axis: int) -> tuple[int, int]:
        """Where a window for a core starts along an axis, and its length: a share of the canvas."""
        size, canvas, step = self.size[axis], self.canvas[axis], self.step
        start = max(begin - self.reach, 0) // step * step
        needed = min(end + self.reach, size) - start
        if self.lengths is None:
            length = _up(needed, _up(math.ceil(canvas / self.shares), step))
        else:
            length = min((n for n in self.lengths[axis] if n >= needed), default=canvas)
        if length >= canvas:
            return 0, canvas
        return max(min(start, _up(size, step) - length), 0), length


def _trimmed(active: np.ndarray, first: tuple[int, int]) -> tuple[np.ndarray, tuple[int, int]]:
    """The bounding box of what is active, and its first tile."""
    rows, columns = (np.flatnonzero(active.any(axis)) for axis in (1, 0))
    box = active[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return box, (first[0] + int(rows[0]), first[1] + int(columns[0]))


def grid(size: tuple[int, int], shape: tuple[int, int], reach: int, step: int) -> Iterator[Window]:
    """Windows of one shape whose cores make up the image, row by row."""
    axes = [list(_along(n, w, reach, step)) for n, w in zip(size, shape, strict=True)]
    for row, rows in axes[0]:
        for column, columns in axes[1]:
            yield Window((row, column), shape, rows, columns)


def _along(size: int, window: int, reach: int, step: int) -> Iterator[tuple[int, tuple[int, int]]]:
    begin, last = 0, max(_up(size, step) - window, 0)
    while begin < size:
        start = min(max(begin - reach, 0) // step * step, last)
        end = size if start == last else start + window - reach
        yield start, (begin, end)
        begin = end


def shape_of_parts(size: tuple[int, int], count: int, reach: int, step: int) -> tuple[int, int]:
    """The least window of which a `grid` has at most so many, for as many devices."""

    def length(n: int, parts: int) -> int:
        # Each loses a margin at either end, but for the outer ones, and what aligning its start takes.
        slack = step if parts > 1 else 0
        return _up(math.ceil((n + 2 * (parts - 1) * reach) / parts) + slack, step)

    shapes = [
        (length(size[0], rows), length(size[1], count // rows)) for rows in range(1, count + 1)
    ]
    return min(shapes, key=lambda shape: shape[0] * shape[1])


_COARSE = (2, 4)
_WORTH_CUTTING = 0.8


def few_lengths(
    canvas: tuple[int, int], reach: int, step: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """For `Cover` where programs are to be shared: a half and a quarter of the canvas, and margins."""

    def lengths(n: int) -> tuple[int, ...]:
        some = (_up(math.ceil(n / share) + 2 * reach, step) for share in _COARSE)
        return tuple(length for length in some if length <= _WORTH_CUTTING * n)

    return lengths(canvas[0]), lengths(canvas[1])


def smallest_window(reach: int, step: int) -> int:
    """The least edge that leaves a window a core."""
    return _up(2 * reach + 2 * step, step)


def _up(n: int, step: int) -> int:
    return -(-n // step) * step


@functools.cache
def window_edges(smallest: int, step: int) -> tuple[int, ...]:
    """Edges to choose from, multiples of `step`, so that programs are shared between budgets."""
    edges = {smallest}
    n = 64
    while n <= 8192:
        edges |= {_up(k * n // 4, step) for k in (4, 5, 6, 7)}
        n *= 2
    return tuple(sorted(n for n in edges if n >= smallest))
