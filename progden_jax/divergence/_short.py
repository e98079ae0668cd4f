"""Convolutions of windows of a few pixels in fewer products than pixels times taps.

Along one axis, a convolution of a window x with a kernel w is

    y = combine · ((points · w) ∘ (spread · x))

with small constant matrices, see `progden_jax._points`: polynomials are multiplied by their values at a few
points, and outputs that all inputs around reach are the transpose of that. In two dimensions the matrices
act along both axes, and what remains between are products of channels, as many as the square of the points.
What moves, cuts or repeats the window on its way is part of the matrices too.
"""

import dataclasses
import math

import numpy as np

from progden_jax._points import MOST_POINTS, correlation, product


@dataclasses.dataclass(frozen=True)
class Axis:
    """How a window is convolved along one axis, at every phase: in tiles, where it is long."""

    spread: np.ndarray
    """From a tile's source pixels to points, (phases, points, pixels)."""
    points: np.ndarray
    """From the kernel's taps to points, (kinds, points, taps)."""
    combine: np.ndarray
    """From points to the tile of the target, (phases, width, points)."""
    kind: np.ndarray
    """Which of `points` a phase takes, (phases,)."""
    source: int
    target: int
    tiles: int
    start: np.ndarray
    """Where in the source the first tile begins, (phases,)."""
    stride: int
    """Source pixels from one tile to the next."""

    def multiply_adds(self, channels: int, features: int) -> float:
        """Of the convolution of one window along both axes."""
        points = self.tiles * self.spread.shape[1]
        spread, combine = (
            self.tiles * np.count_nonzero(m.any(0)) for m in (self.spread, self.combine)
        )
        return (
            points**2 * channels * features
            + spread * (self.source + points) * channels
            + combine * (self.target + points) * features
        )


def convolution(source: int, target: int, shift: np.ndarray, taps: int) -> Axis:
    """y_o = Σ_t w_t x_{o + t + shift}, o below `target` and x zero beyond `source`, shift per phase."""
    tiles, width = _tiling(target, taps - 1)
    reached, count = source + taps - 1, len(shift)
    if (source == 1 or reached <= MOST_POINTS) and reached < tiles * (width + taps - 1):
        spread, kernel, back = product(source, taps)
        rows = np.arange(target) + shift[:, None] + taps - 1
        inside = (rows >= 0) & (rows < reached)
        combine = np.where(inside[..., None], back[np.clip(rows, 0, reached - 1)], 0)
        spread, points = np.broadcast_to(spread, (count, *spread.shape)), kernel[:, ::-1]
        tiles, start = 1, np.zeros(count, int)
    else:
        gather, points, back = correlation(width, taps)
        combine = np.broadcast_to(back, (count, *back.shape))
        if tiles == 1:
            # The offset is part of the matrix.
            spread, start = _placed(gather, shift, source), np.zeros(count, int)
        else:
            spread, start = np.broadcast_to(gather, (count, *gather.shape)), shift
    kind = np.zeros(count, int)
    return Axis(spread, points[None], combine, kind, source, target, tiles, start, width)


def upsampled_convolution(
    source: int, target: int, first: np.ndarray, parent: np.ndarray, taps: int
) -> Axis:
    """y_o = Σ_t w_t x_{(first + o + t − taps // 2) // 2 − parent}: of a window whose pixels are repeated.

    `first` and `parent` are where the target and x begin, per phase. Every second pixel sees its parents
    through few taps, the sums of those that fall on one parent.
    """
    reach, fewer = taps // 2, (taps + 2) // 2
    tiles, width = _tiling(target, 2 * (fewer - 1), step=2)
    begin = (first - reach) // 2 - parent
    start, pixels = np.zeros(len(first), int), source
    if tiles > 1:
        start, pixels = begin, width // 2 + fewer
    kinds = np.unique(first % 2)
    points, spread, combine = [], [], []
    for second, size in enumerate(((width + 1) // 2, width // 2)):
        if not size:
            continue
        gather, kernel, back = correlation(size, fewer)
        folded = []
        for kind in kinds:
            seen = (kind + second - reach + np.arange(taps)) // 2
            folded.append(kernel @ (seen - seen[0] == np.arange(fewer)[:, None]))
        points.append(np.stack(folded))
        spread.append(_placed(gather, (first + second - reach) // 2 - parent - start, pixels))
        rows = np.zeros((width, len(gather)))
        rows[second::2] = back
        combine.append(rows)
    together = np.concatenate(combine, 1)
    return Axis(
        np.concatenate(spread, 1),
        np.concatenate(points, 1),
        np.broadcast_to(together, (len(first), *together.shape)),
        np.searchsorted(kinds, first % 2),
        *(source, target, tiles, start, width // 2),
    )


def _tiling(target: int, more: int, step: int = 1) -> tuple[int, int]:
    """The number and width of a target's tiles, each of which takes `more` points than it is wide."""
    widest = step * max(MOST_POINTS - more // step, 1)
    choices = [(1, target)] if target <= widest else []
    choices += [(math.ceil(target / width), width) for width in range(step, widest + 1, step)]
    return min(choices, key=lambda choice: choice[0] * (choice[1] + more))


def _placed(matrix: np.ndarray, starts: np.ndarray, width: int) -> np.ndarray:
    """The matrix with its columns from `starts` on, per phase, cut to a width."""
    columns = starts[:, None] + np.arange(matrix.shape[1])
    hits = columns[:, :, None] == np.arange(width)
    return np.einsum("pc,fcw->fpw", matrix, hits)
