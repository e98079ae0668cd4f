"""Elementwise functions that keep little for their derivatives: what ``jax.linearize`` holds in memory.

What a linearised function keeps is read again by every tangent pass, and of a large image it is most of the
memory that the divergence takes.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from progden_jax._numeric import own_zero


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def pointwise(
    function: Callable[..., Array], x: Float[Array, "*shape"], *constants: Any
) -> Float[Array, "*shape"]:
    """``function(x, *constants)``, of every value by itself: of its derivative only the slope is kept.

    The constants, of which each may be None, have no derivative.
    """
    return function(x, *constants)


@pointwise.defjvp
def _pointwise_jvp(
    function: Callable[..., Array], primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[Array, Array]:
    x, *constants = primals
    value, slope = jax.jvp(lambda x: function(x, *constants), (x,), (jnp.ones_like(x),))
    return value, slope * tangents[0]


@jax.custom_jvp
def where_passes(
    passes: Bool[Array, "h w c"], value: Float[Array, "h w c"]
) -> Float[Array, "h w c"]:
    """``value`` where it passes, else 0: a ReLU, say. A bit per value is kept for its derivative."""
    return jnp.where(passes, value, own_zero(value))


@where_passes.defjvp
def _where_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    passes, value = primals
    count = bits_for(passes.shape[0])
    return where_passes(passes, value), _selected(packed(passes, count), tangents[1], count)


# Checkpoints, so that linearising keeps what these are given, and not the masks that they make of it.


@functools.partial(jax.checkpoint, prevent_cse=False, static_argnums=2)
def _selected(passes: Array, tangent: Array, count: int) -> Array:
    return jnp.where(unpacked(passes, count), tangent, own_zero(tangent))


def bits_for(height: int) -> int:
    """How many rows go in a byte each."""
    return next(n for n in (8, 4, 2, 1) if height % n == 0)


def packed(mask: Bool[Array, "*n h w c"], count: int) -> UInt8[Array, "*n h2 w c"]:
    """So many rows in one byte: along rows, what is side by side stays so."""
    *n, height, width, channels = mask.shape
    rows = mask.astype(jnp.uint8).reshape(*n, height // count, count, width, channels)
    bits = [rows[..., bit, :, :] << bit for bit in range(count)]
    return functools.reduce(jnp.bitwise_or, bits)


def unpacked(mask: UInt8[Array, "*n h2 w c"], count: int) -> Bool[Array, "*n h w c"]:
    *n, height, width, channels = mask.shape
    shifts = jnp.arange(count, dtype=jnp.uint8)[:, None, None]
    rows = (mask[..., None, :, :] >> shifts) & 1
    return rows.reshape(*n, height * count, width, channels) != 0


@jax.custom_jvp
def largest(
    first: Float[Array, "*shape"], *others: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """The largest at each place, whose derivative goes to the first of them on ties: a byte is kept."""
    return _largest(first, *others)[0]


@largest.defjvp
def _largest_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    value, which = _largest(*primals)
    return value, _picked(which, *tangents)


def _largest(best: Array, *others: Array) -> tuple[Array, Array]:
    which = jnp.zeros(best.shape, jnp.uint8)
    for index, other in enumerate(others, 1):
        which = jnp.where(other > best, index, which)
        best = jnp.where(other > best, other, best)
    return best, which


@functools.partial(jax.checkpoint, prevent_cse=False)
def _picked(which: Array, first: Array, *others: Array) -> Array:
    for index, other in enumerate(others, 1):
        first = jnp.where(which == index, other, first)
    return first
