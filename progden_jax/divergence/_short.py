"""Convolutions of windows of a few pixels in fewer products than pixels times taps.

Along one axis, a convolution of a window x with a kernel w is

    y = combine · ((points · w) ∘ (spread · x))

with small constant matrices: polynomials are multiplied by their values at a few points (Toom and Cook), and
outputs that all inputs around reach are the transpose of that (Winograd; Lavin and Gray, "Fast
algorithms for convolutional neural networks", CVPR 2016). In two dimensions the matrices act along both
axes, and what remains between are products of channels, as many as the square of the points. What moves, cuts
or repeats the window on its way is part of the matrices too.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np

MOST_POINTS = 7
"""At more points rounding grows: 1.5e-6 relative at 7 in float32, 6e-7 at 6, 3e-7 by plain sums."""

# Of some 28,000 sets of simple fractions those that round among the least; one more point is at infinity.
_FINITE = {
    3: (0, 1),
    4: (0, 1, -1),
    5: (0, 1, -2, -1 / 2),
    6: (0, 3 / 2, -3 / 2, 2 / 3, -2 / 3),
    7: (0, 1, -1, 1 / 2, 3, -5 / 8),
}


@dataclasses.dataclass(frozen=True)
class Axis:
    """How a window is convolved along one axis, at every phase."""

    spread: np.ndarray
    """From source pixels to points, (phases, tiles · points, source)."""
    points: np.ndarray
    """From the kernel's taps to points, (kinds, points, taps): alike for all tiles."""
    combine: np.ndarray
    """From points to target pixels, (phases, target, tiles · points)."""
    kind: np.ndarray
    """Which of `points` a phase takes, (phases,)."""

    @property
    def tiles(self) -> int:
        return self.spread.shape[1] // self.points.shape[1]

    def multiply_adds(self, channels: int, features: int) -> float:
        """Of the convolution of one window along both axes."""
        points, source = self.spread.shape[1:]
        target = self.combine.shape[1]
        spread, combine = (np.count_nonzero(m.any(0)) for m in (self.spread, self.combine))
        return (
            points**2 * channels * features
            + spread * (source + points) * channels
            + combine * (target + points) * features
        )


def convolution(source: int, target: int, shift: np.ndarray, taps: int) -> Axis:
    """y_o = Σ_t w_t x_{o + t + shift}, o below `target` and x zero beyond `source`, shift per phase."""
    tiles, width = _tiling(target, taps - 1)
    reached = source + taps - 1
    if (source == 1 or reached <= MOST_POINTS) and reached < tiles * (width + taps - 1):
        values, kernel, back = _product(source, taps)
        rows = np.arange(target) + shift[:, None] + taps - 1
        inside = (rows >= 0) & (rows < len(back))
        combine = np.where(inside[..., None], back[np.clip(rows, 0, len(back) - 1)], 0)
        spread = np.broadcast_to(values, (len(shift), *values.shape))
        points = kernel[:, ::-1]
    else:
        spread, points, combine = _tiled(source, target, tiles, width, shift, taps)
    return Axis(spread, points[None], combine, np.zeros(len(shift), int))


def upsampled_convolution(
    source: int, target: int, first: np.ndarray, parent: np.ndarray, taps: int
) -> Axis:
    """y_o = Σ_t w_t x_{(first + o + t − taps // 2) // 2 − parent}: of a window whose pixels are repeated.

    `first` and `parent` are where the target and x begin, per phase. Every second pixel sees its parents
    through few taps, the sums of those that fall on one parent.
    """
    reach = taps // 2
    fewer = (taps + 2) // 2
    tiles, width = _tiling(target, 2 * (fewer - 1), step=2)
    sizes = [(width + 1) // 2, width // 2]
    kinds = np.unique(first % 2)
    points, spreads, combines = [], [], []
    for second, size in enumerate(sizes):
        if not size:
            continue
        begin = (first + second - reach) // 2 - parent
        gather, kernel, back = _correlation(size, fewer)
        folds = []
        for kind in kinds:
            seen = (kind + second - reach + np.arange(taps)) // 2
            folds.append(kernel @ (seen - seen[0] == np.arange(fewer)[:, None]))
        points.append(np.stack(folds))
        spread = np.zeros((len(first), tiles, len(gather), source))
        combine = np.zeros((target, tiles, len(gather)))
        for tile in range(tiles):
            starts = begin + tile * (width // 2)
            spread[:, tile] = _placed(gather, starts, source)
            rows = tile * width + second + 2 * np.arange(size)
            combine[rows[rows < target], tile] = back[rows < target]
        spreads.append(spread)
        combines.append(combine)
    spread = np.concatenate(spreads, 2).reshape(len(first), -1, source)
    combine = np.concatenate(combines, 2).reshape(target, -1)
    return Axis(
        spread,
        np.concatenate(points, 1),
        np.broadcast_to(combine, (len(first), *combine.shape)),
        np.searchsorted(kinds, first % 2),
    )


def _tiling(target: int, more: int, step: int = 1) -> tuple[int, int]:
    """The number and width of a target's tiles, each of which takes `more` points than it is wide."""
    widest = step * max(MOST_POINTS - more // step, 1)
    choices = [(1, target)] if target <= widest else []
    choices += [(math.ceil(target / width), width) for width in range(step, widest + 1, step)]
    return min(choices, key=lambda choice: choice[0] * (choice[1] + more))


def _tiled(
    source: int, target: int, tiles: int, width: int, shift: np.ndarray, taps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    gather, kernel, back = _correlation(width, taps)
    spread = [_placed(gather, shift + tile * width, source) for tile in range(tiles)]
    combine = np.zeros((target, tiles, len(gather)))
    for tile in range(tiles):
        end = min(target - tile * width, width)
        combine[tile * width : tile * width + end, tile] = back[:end]
    combine = combine.reshape(target, -1)
    return (
        np.concatenate(spread, 1),
        kernel,
        np.broadcast_to(combine, (len(shift), *combine.shape)),
    )


def _placed(matrix: np.ndarray, starts: np.ndarray, width: int) -> np.ndarray:
    """The matrix with its columns from `starts` on, per phase, cut to a width."""
    columns = starts[:, None] + np.arange(matrix.shape[1])
    hits = columns[:, :, None] == np.arange(width)
    return np.einsum("pc,fcw->fpw", matrix, hits)


@functools.cache
def _correlation(outputs: int, taps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """gather, kernel and back of y_o = Σ_t w_t x_{o+t}: the transpose of the product of polynomials."""
    if 1 in (outputs, taps):
        count = outputs + taps - 1
        alike = np.eye(count)
        return (
            alike,
            alike if outputs == 1 else np.ones((count, 1)),
            alike if taps == 1 else np.ones((1, count)),
        )
    values, kernel, back = _product(outputs, taps)
    return back.T, kernel, values.T


@functools.cache
def _product(n: int, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b, back: the product of polynomials of coefficients x and w has back · ((a x) ∘ (b w))."""
    if 1 in (n, m):
        alike = np.eye(n + m - 1)
        return (
            alike if m == 1 else np.ones((m, 1)),
            alike if n == 1 else np.ones((n, 1)),
            alike,
        )
    a, b, whole = (_values(_FINITE[n + m - 1], count) for count in (n, m, n + m - 1))
    return a, b, np.linalg.inv(whole)


def _values(finite: Sequence[float], count: int) -> np.ndarray:
    """What takes a polynomial's coefficients to its values at points, at infinity to the highest one."""
    highest = np.eye(count)[-1:]
    return np.concatenate([np.vander(finite, count, increasing=True), highest])
