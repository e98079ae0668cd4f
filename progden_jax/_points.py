"""Products of short polynomials, and correlations of short windows, by values at a few points.

Toom and Cook; the transpose is Winograd's (Lavin and Gray, "Fast algorithms for convolutional neural
networks", CVPR 2016).
"""

import functools
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

_NOTHING = 1e-12
"""What rounding makes of zeros."""


@functools.cache
def correlation(outputs: int, taps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """gather, kernel and back of y_o = Σ_t w_t x_{o+t}: the transpose of the product of polynomials."""
    if 1 in (outputs, taps):
        count = outputs + taps - 1
        alike = np.eye(count)
        return (
            alike,
            alike if outputs == 1 else np.ones((count, 1)),
            alike if taps == 1 else np.ones((1, count)),
        )
    values, kernel, back = product(outputs, taps)
    return back.T, kernel, values.T


@functools.cache
def product(n: int, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b, back: the product of polynomials of coefficients x and w has back · ((a x) ∘ (b w))."""
    if 1 in (n, m):
        alike = np.eye(n + m - 1)
        return (
            alike if m == 1 else np.ones((m, 1)),
            alike if n == 1 else np.ones((n, 1)),
            alike,
        )
    a, b, whole = (_values(_FINITE[n + m - 1], count) for count in (n, m, n + m - 1))
    back = np.linalg.inv(whole)
    return a, b, np.where(np.abs(back) > _NOTHING, back, 0)


def _values(finite: Sequence[float], count: int) -> np.ndarray:
    """What takes a polynomial's coefficients to its values at points, at infinity to the highest one."""
    highest = np.eye(count)[-1:]
    return np.concatenate([np.vander(finite, count, increasing=True), highest])
