"""Weighted sums over windows whose weights, many per pixel, never all exist at once."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax._convolution import same_convolution

Weigh = Callable[[Array], Float[Array, "k *b h w"]]
"""From the first of k consecutive offsets, in raster order, to their weights."""


def weighted_sums(
    planes: Float[Array, "c *b h w"],
    weigh: Weigh,
    *,
    window: int,
    at_once: int,
) -> Float[Array, "c *b h w"]:
    """Σ_i w_i v_i over window × window pixels around each (odd), zeros outside the image.

    Parameters
    ----------
    planes : what is summed, one image each: loops over few channels are no vectors.
    weigh : gives the weights of `at_once` offsets.
    at_once : offsets whose weights exist at a time: whole rows of the window that divide it.

    Notes
    -----
    In the derivative, too: what an offset took is computed again there.
    """
    width, border = planes.shape[-1], window // 2
    padded = jnp.pad(planes, [(0, 0)] * (planes.ndim - 2) + [(border, border)] * 2)
    nothing = jnp.zeros_like(planes)

    def row(first: Array) -> Array:
        start = (*[0] * (planes.ndim - 2), first // window, first % window)
        return jax.lax.dynamic_slice(padded, start, (*planes.shape[:-1], width + window - 1))

    @jax.checkpoint  # else shifted planes are kept beside their weights
    def row_sums(first: Array, weights: Array) -> Array:
        there = row(first)
        # By split, for its transpose joins the slopes: indexing would add them, padded, one by one.
        apart = jax.lax.split(weights, [1] * window)
        parts = [w * there[..., k : k + width] for k, w in enumerate(apart)]
        return sum(parts[1:], start=parts[0])

    def add_row(total: Array, given: tuple[Array, Array]) -> tuple[Array, None]:
        return total + row_sums(*given), None

    @jax.checkpoint
    def part(first: Array) -> Array:
        weights = weigh(first)
        rows = weights.reshape(-1, window, *weights.shape[1:])
        return jax.lax.scan(add_row, nothing, (first + window * jnp.arange(len(rows)), rows))[0]

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
