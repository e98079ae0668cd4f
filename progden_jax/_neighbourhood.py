"""Weighted sums over windows whose weights, many per pixel, never all exist at once."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax._convolution import same_convolution

Shifted = Callable[[Array], Float[Array, "c *b h w"]]
"""From an offset's number, in raster order, to the planes as seen from there."""

Weigh = Callable[[Array, Shifted], Float[Array, "k *b h w"]]
"""From the first of k consecutive offsets to their weights."""


def weighted_sums(
    planes: Float[Array, "c *b h w"],
    weigh: Weigh,
    *,
    window: int,
    summed: int | None = None,
    at_once: int = 1,
) -> Float[Array, "s *b h w"]:
    """Σ_i w_i v_i over window × window pixels around each (odd), zeros outside the image.

    Parameters
    ----------
    planes : what is summed and what weights are made from, one image each: loops over few channels are no
        vectors.
    weigh : gives the weights of `at_once` offsets.
    summed : so many of the planes, the first ones; None: all. The others are for `weigh` alone.
    at_once : offsets whose weights exist at a time: 1, or whole rows of the window that divide it.

    Notes
    -----
    In the derivative, too: what an offset took is computed again there.
    """
    width, border = planes.shape[-1], window // 2
    padded = jnp.pad(planes, [(0, 0)] * (planes.ndim - 2) + [(border, border)] * 2)
    columns = min(at_once, window)
    nothing = jnp.zeros(planes[:summed].shape, planes.dtype)

    def row(first: Array, count: int) -> Array:
        start = (*[0] * (planes.ndim - 2), first // window, first % window)
        return jax.lax.dynamic_slice(padded, start, (*planes.shape[:-1], width + count - 1))

    @jax.checkpoint  # else shifted planes are kept beside their weights
    def row_sums(first: Array, weights: Array) -> Array:
        there = row(first, columns)[:summed]
        # By split, for its transpose joins the slopes: indexing would add them, padded, one by one.
        apart = jax.lax.split(weights, [1] * columns)
        parts = [w * there[..., k : k + width] for k, w in enumerate(apart)]
        return sum(parts[1:], start=parts[0])

    def add_row(total: Array, given: tuple[Array, Array]) -> tuple[Array, None]:
        return total + row_sums(*given), None

    @jax.checkpoint
    def part(first: Array) -> Array:
        weights = weigh(first, lambda offset: row(offset, 1))
        rows = weights.reshape(-1, columns, *weights.shape[1:])
        return jax.lax.scan(add_row, nothing, (first + columns * jnp.arange(len(rows)), rows))[0]

    def add(total: Array, first: Array) -> tuple[Array, None]:
        return total + part(first), None

    return jax.lax.scan(add, nothing, jnp.arange(0, window**2, at_once))[0]


def some_outputs(
    features: Float[Array, "n h w c"],
    kernel: Float[Array, "k k c o"],
    bias: Float[Array, " o"],
    first: Array | int,
    count: int,
) -> Float[Array, "count n h w"]:
    """A convolution's outputs from `first` on, so many, as planes."""
    some = jax.lax.dynamic_slice_in_dim(kernel, first, count, axis=-1)
    shift = jax.lax.dynamic_slice_in_dim(bias, first, count)
    return jnp.moveaxis(same_convolution(features, some) + shift, -1, 0)
