"""Sums, maxima and Gaussians over square windows, separable and in few passes.

A row's pixels and channels are one axis inside, for loops over three channels are no vectors. What is called
many times in a program is compiled by itself, so that it is traced once.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@functools.partial(jax.jit, static_argnames="window")
def box_sum(values: Float[Array, "h w c"], window: int) -> Float[Array, "h w c"]:
    """Sum over window × window pixels (odd), with zeros outside the image."""
    flat, channels = values.reshape(len(values), -1), values.shape[-1]
    for axis, step in ((0, 1), (1, channels)):
        padded = _pad(flat, axis, window // 2 * step, 0)
        flat = _fold(padded, axis, window, step, flat.shape[axis])
    return flat.reshape(values.shape)


def _fold(padded: Array, axis: int, window: int, step: int, size: int) -> Array:
    """Sums of `window` entries that lie `step` apart, from powers of two: about 2·log2(window) additions."""
    power, width, total, offset = padded, 1, None, 0
    while True:
        if window & width:
            part = _slice(power, axis, offset * step, size)
            total = part if total is None else total + part
            offset += width
        width *= 2
        if width > window:
            assert total is not None
            return total
        shift = width // 2 * step
        length = power.shape[axis] - shift
        power = _slice(power, axis, 0, length) + _slice(power, axis, shift, length)


@functools.partial(jax.jit, static_argnames="window")
def argmax_payload(
    keys: Float[Array, "h w c"], payload: Float[Array, "h w c"], window: int
) -> tuple[Float[Array, "h w c"], Float[Array, "h w c"]]:
    """Per pixel and channel the largest key in the window, and the payload that stands beside it.

    On ties the first in raster order; never outside the image. Keys must be above -inf.
    """
    shape = keys.shape
    keys, payload = (a.reshape(len(a), -1) for a in (keys, payload))
    for axis, step in ((1, shape[-1]), (0, 1)):
        border = window // 2 * step
        best = (_pad(keys, axis, border, -jnp.inf), _pad(payload, axis, border, 0))
        width, size = 1, keys.shape[axis]
        while width < window:
            # Two windows that may overlap: the maximum is idempotent and the left one wins ties.
            shift = min(width, window - width)
            length = best[0].shape[axis] - shift * step
            left = [_slice(part, axis, 0, length) for part in best]
            right = [_slice(part, axis, shift * step, length) for part in best]
            later = right[0] > left[0]
            best = (jnp.where(later, right[0], left[0]), jnp.where(later, right[1], left[1]))
            width += shift
        keys, payload = (_slice(part, axis, 0, size) for part in best)
    return keys.reshape(shape), payload.reshape(shape)


@functools.partial(jax.jit, static_argnames="window")
def gaussian_sum(values: Float[Array, "h w"], window: int, precision: Array) -> Float[Array, "h w"]:
    """Σ exp(−|δ|²·precision)·values over the window, with zeros outside the image."""
    radius = window // 2
    for axis in (0, 1):
        padded, size = _pad(values, axis, radius, 0), values.shape[axis]
        values = _slice(padded, axis, radius, size)
        for offset in range(1, radius + 1):
            weight = jnp.exp(-(offset**2) * precision)
            before = _slice(padded, axis, radius - offset, size)
            values = values + weight * (before + _slice(padded, axis, radius + offset, size))
    return values


def _pad(values: Array, axis: int, radius: int, fill: float) -> Array:
    widths = [(radius, radius) if a == axis else (0, 0) for a in range(values.ndim)]
    return jnp.pad(values, widths, constant_values=fill)


def _slice(values: Array, axis: int, start: int, length: int) -> Array:
    return values[(slice(None),) * axis + (slice(start, start + length),)]
