"""A convolution whose derivative by the kernel is a few large matrix products, for CPUs."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

_STRIP = 256
"""Pixels whose taps are gathered at once: few enough for them to stay in a core's cache."""

_WIDE = 128
"""Channels from which XLA copies part by part what is joined; below, it asks for each value whose it is."""

_NEARLY_WIDE = 96
"""Channels on one side that do beside `_WIDE` on the other: faster than all taps on one side."""


def by_products(inputs: Array, kernel: Array, precision: Any) -> Array:
    """The convolution again, in a form whose transpose by the kernel is one product per strip of rows.

    For that the taps of rows are gathered on one side of the product and those of columns on the other or,
    where channels are few, all taps on the side that has fewer.
    """
    (kh, kw, ci, co), (_, h, width, _) = kernel.shape, inputs.shape
    if (kh, kw) == (1, 1):
        return jnp.matmul(inputs, kernel[0, 0], precision=precision)
    height = max(d for d in range(1, h + 1) if h % d == 0 and d * width <= max(width, _STRIP))
    if kh * ci >= _WIDE and kw * co >= _NEARLY_WIDE:
        return _by_rows_and_columns(inputs, kernel, height, precision)
    if kw == 3 and width % 2 == 0 and 2 * kh * ci >= _WIDE and 4 * co >= _WIDE:
        return _by_cells(inputs, kernel, height, precision)
    by_taps = _by_output_taps if co < ci else _by_input_taps
    return by_taps(inputs, kernel, height, precision)


def _by_strips(one: Any, kernel: Array, images: int, strips: int) -> Array:
    """What `one` makes of each image's strips, (images, strips, ...)."""
    # Without a checkpoint all strips' gathered taps are kept.
    found = lax.map(
        lambda n: jax.checkpoint(one)(n // strips, n % strips, kernel), jnp.arange(images * strips)
    )
    return found.reshape(images, strips, *found.shape[1:])


def _rows_of(padded: Array, image: Array, start: Array, height: int) -> Array:
    """So many rows of an image."""
    _, _, width, channels = padded.shape
    return lax.dynamic_slice(padded, (image, start, 0, 0), (1, height, width, channels))[0]


def _tall(padded: Array, image: Array, strip: Array, height: int, taps: int) -> Array:
    """Of each pixel of the strip those above and below it side by side, (height, w, taps · channels)."""
    rows = _rows_of(padded, image, strip * height, height + taps - 1)
    return jnp.concatenate([rows[i : i + height] for i in range(taps)], axis=-1)


def _by_rows_and_columns(inputs: Array, kernel: Array, height: int, precision: Any) -> Array:
    (kh, kw, ci, co), (n, h, w, _) = kernel.shape, inputs.shape
    padded = jnp.pad(inputs, ((0, 0), (kh // 2,) * 2, (0, 0), (0, 0)))
    matrix = jnp.moveaxis(kernel, 2, 1).reshape(kh * ci, kw * co)

    def one(image: Array, strip: Array, matrix: Array) -> Array:
        tall = _tall(padded, image, strip, height, kh)
        columns = lax.split(jnp.matmul(tall, matrix, precision=precision), (co,) * kw, axis=2)
        moved = (_moved(c, 0, kw // 2 - j) for j, c in enumerate(columns))
        return functools.reduce(jnp.add, moved)

    return _by_strips(one, matrix, n, h // height).reshape(n, h, w, co)


def _by_cells(inputs: Array, kernel: Array, height: int, precision: Any) -> Array:
    """As `_by_rows_and_columns` where channels are too few for it, on cells of two pixels of a row.

    A cell meets itself, the first pixel of the next cell and the last of the one before; a quarter of the
    products are zeros.
    """
    (kh, _, ci, co), (n, h, w, _) = kernel.shape, inputs.shape
    cells = inputs.reshape(n, h, w // 2, 2 * ci)
    padded = jnp.pad(cells, ((0, 0), (kh // 2,) * 2, (0, 0), (0, 0)))
    zero = jnp.zeros((kh, ci, co), kernel.dtype)
    left, middle, right = (kernel[:, j] for j in range(3))
    # From each pixel of the cell: to its two, to the next one's first, to the last one's second.
    first = jnp.concatenate([middle, left, zero, right], axis=-1)
    second = jnp.concatenate([right, middle, left, zero], axis=-1)
    matrix = jnp.stack([first, second], axis=1).reshape(2 * kh * ci, 4 * co)

    def one(image: Array, strip: Array, matrix: Array) -> Array:
        tall = _tall(padded, image, strip, height, kh)
        products = jnp.matmul(tall, matrix, precision=precision)
        own, after, before = lax.split(products, (2 * co, co, co), axis=2)
        return own + jnp.concatenate([_moved(after, 0, 1), _moved(before, 0, -1)], axis=-1)

    return _by_strips(one, matrix, n, h // height).reshape(n, h, w, co)


def _by_input_taps(inputs: Array, kernel: Array, height: int, precision: Any) -> Array:
    (kh, kw, _, co), (n, h, w, _) = kernel.shape, inputs.shape
    padded = jnp.pad(inputs, ((0, 0), (kh // 2,) * 2, (kw // 2,) * 2, (0, 0)))

    def one(image: Array, strip: Array, matrix: Array) -> Array:
        rows = _rows_of(padded, image, strip * height, height + kh - 1)
        taps = [rows[i : i + height, j : j + w] for i in range(kh) for j in range(kw)]
        columns = jnp.concatenate(taps, axis=-1).reshape(height * w, -1)
        return jnp.matmul(columns, matrix, precision=precision).reshape(height, w, co)

    return _by_strips(one, kernel.reshape(-1, co), n, h // height).reshape(n, h, w, co)


def _by_output_taps(inputs: Array, kernel: Array, height: int, precision: Any) -> Array:
    (kh, kw, ci, co), (n, h, w, _) = kernel.shape, inputs.shape
    matrix = jnp.moveaxis(kernel, 2, 0).reshape(ci, kh * kw * co)

    def one(image: Array, strip: Array, matrix: Array) -> Array:
        rows = _rows_of(inputs, image, strip * height, height).reshape(height * w, ci)
        products = jnp.matmul(rows, matrix, precision=precision).reshape(height, w, -1)
        taps = lax.split(products, (co,) * (kh * kw), axis=2)
        # Into the rows above and below, too.
        tall = [jnp.pad(tap, ((kh // 2,) * 2, (0, 0), (0, 0))) for tap in taps]
        moved = (_moved(t, kh // 2 - k // kw, kw // 2 - k % kw) for k, t in enumerate(tall))
        return functools.reduce(jnp.add, moved)

    found = _by_strips(one, matrix, n, h // height)
    rows = jnp.arange(h // height)[:, None] * height + jnp.arange(height + kh - 1)
    out = jnp.zeros((n, h + kh - 1, w, co), found.dtype).at[:, rows].add(found)
    return out[:, kh // 2 : kh // 2 + h]


def _moved(x: Array, rows: int, columns: int) -> Array:
    """The image moved down and right, zeros coming in."""
    zero = jnp.zeros((), x.dtype)
    return lax.pad(x, zero, ((rows, -rows, 0), (columns, -columns, 0), (0, 0, 0)))
