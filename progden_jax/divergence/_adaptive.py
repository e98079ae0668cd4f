"""Probing that stops, tile by tile, once it knows enough."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax._numeric import safe_sqrt
from progden_jax.divergence._base import Evaluation


def evaluate(
    sample: Callable[[Array, Array], Float[Array, "h w 3"]],
    each: int,
    replicates: int,
    *,
    value: Float[Array, "h w 3"],
    sure_without: Float[Array, "h w 3"],
    tolerance: float,
    tile: int,
    chunk: int,
) -> Evaluation:
    """The mean of ``sample(probe, replicate)`` over at most `each` probes of every replicate.

    A tile's estimate is frozen at the first check where the standard error of its mean SURE is at most
    `tolerance` times that mean; once all tiles are frozen nothing more is computed. `sure_without` is
    SURE less its divergence term, 2·divergence.

    The errors of two pixels are correlated only through the one product of their own two signs, so the
    variance of a sum over pixels is at most twice the sum of variances (Cauchy-Schwarz). This bound stands
    for the tile's standard error: it pools the squared spread of all its pixels, so that two replicates
    suffice and a chance agreement of their means stops nothing.
    """
    tiles = _Tiles(value.shape, tile, value.dtype)
    base = tiles.mean(sure_without)

    def check(totals: Array, count: Array) -> tuple[Array, Array, Array]:
        means = totals / count.astype(totals.dtype)
        mean = means.mean(0)
        spread = ((means - mean) ** 2).sum(0) / (replicates * (replicates - 1))
        error = 2 * jnp.sqrt(2 * lax.stop_gradient(tiles.mean(spread)) / tiles.numbers)
        passed = error <= tolerance * jnp.abs(base + 2 * tiles.mean(mean))
        return mean, spread, passed

    def advance(state: _State, probe: Array) -> _State:
        totals, mean, spread, spent = state
        new = lax.map(lambda r: sample(probe, r), jnp.arange(replicates), batch_size=chunk)
        totals, count = totals + new, probe + 1
        due = ((count & probe) == 0) | (count == each)

        def look(_: None) -> _State:
            found, found_spread, passed = check(totals, count)
            active = spent < 0
            inside = tiles.spread(active)
            stopped = active & (passed | (count == each))
            return (
                totals,
                jnp.where(inside, found, mean),
                jnp.where(inside, found_spread, spread),
                jnp.where(stopped, replicates * count, spent),
            )

        return lax.cond(due, look, lambda _: (totals, mean, spread, spent), None)

    def step(state: _State, probe: Array) -> tuple[_State, None]:
        # A scan, for unlike a while loop it has gradients; steps that do nothing cost nothing.
        return lax.cond((state[3] < 0).any(), advance, lambda s, _: s, state, probe), None

    zero = jnp.zeros_like(value)
    start = (
        jnp.zeros((replicates, *value.shape), value.dtype),
        zero,
        zero,
        jnp.full(tiles.numbers.shape, -1, jnp.int32),
    )
    (_, mean, spread, spent), _ = lax.scan(step, start, jnp.arange(each, dtype=jnp.int32))
    return Evaluation(value, mean, safe_sqrt(spread), spent)


_State = tuple[Array, Array, Array, Array]


class _Tiles:
    """Squares of pixels and their means; those at the right and lower border may be smaller."""

    def __init__(self, shape: tuple[int, ...], edge: int, dtype: jnp.dtype) -> None:
        self.shape = shape
        self.edge = edge
        self.grid = tuple(math.ceil(n / edge) for n in shape[:2])
        self.numbers = jnp.ones((), dtype)
        self.numbers = self._sum(jnp.ones(shape, dtype))

    def _sum(self, image: Array) -> Array:
        rows, columns = self.grid
        padding = [(0, g * self.edge - n) for g, n in zip(self.grid, self.shape[:2], strict=True)]
        padded = jnp.pad(image, [*padding, (0, 0)])
        return padded.reshape(rows, self.edge, columns, self.edge, -1).sum((1, 3, 4))

    def mean(self, image: Array) -> Array:
        return self._sum(image) / self.numbers

    def spread(self, per_tile: Array) -> Array:
        """The value of each pixel's tile, (H, W, 1)."""
        height, width = self.shape[:2]
        wide = jnp.repeat(jnp.repeat(per_tile, self.edge, 0), self.edge, 1)
        return wide[:height, :width, None]
