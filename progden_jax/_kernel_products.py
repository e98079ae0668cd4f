"""A convolution whose derivative by the kernel is a few large matrix products, for CPUs."""

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from progden_jax import _points

_STRIP = 256
"""Rows of a product, pixels or cells of them, that are gathered at once: few enough for a core's cache."""

_WIDE = 128
"""Channels from which XLA copies part by part what is joined; below, it asks for each value whose it is."""

_LEAST = 24
"""Outputs that these must have to be worth their sums."""


def by_products(inputs: Array, kernel: Array, precision: Any) -> Array:
    """The convolution again, in a form whose transpose by the kernel is a few products per strip of rows.

    Where channels are many, taps of rows are gathered and those of columns met at points; where they are
    few, all taps are gathered: of the inputs only if these are clearly fewer.
    """
    (kh, kw, ci, co), (n, h, width, _) = kernel.shape, inputs.shape
    if (kh, kw) == (1, 1):
        # A product over several axes at once would first be transposed.
        flat = jnp.matmul(inputs.reshape(-1, ci), kernel[0, 0], precision=precision)
        return flat.reshape(n, h, width, co)
    if kw < _points.MOST_POINTS and 2 * kh * ci >= _WIDE and co >= _LEAST:
        return _by_points(inputs, kernel, precision)
    by_taps = _by_output_taps if 2 * co <= 3 * ci else _by_input_taps
    return by_taps(inputs, kernel, _height(h, width), precision)


def _height(rows: int, width: int) -> int:
    """Rows of a strip."""
    return max(d for d in range(1, rows + 1) if rows % d == 0 and d * width <= max(width, _STRIP))


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


def _by_points(inputs: Array, kernel: Array, precision: Any) -> Array:
    """A cell of pixels of a row is a short correlation, see `_points.correlation`: fewer products."""
    (kh, kw, ci, co), (n, h, w, _) = kernel.shape, inputs.shape
    sizes = range(2, _points.MOST_POINTS + 2 - kw)
    cell = min(sizes, key=lambda size: -(-w // size) * (size + kw - 1))
    spread, values, back = _points.correlation(cell, kw)
    # Taps of zeros fill up what is joined.
    taps = max(kh, -(-_WIDE // ci))
    cells = -(-w // cell)
    height = _height(h, cells)
    rows, columns = (kh // 2, kh // 2 + taps - kh), (kw // 2, kw // 2 + cells * cell - w)
    padded = jnp.pad(inputs, ((0, 0), rows, columns, (0, 0)))
    filled = jnp.pad(kernel, ((0, taps - kh), (0, 0), (0, 0), (0, 0)))
    at_points = jnp.einsum(
        "pj,ijco->poic", jnp.asarray(values, kernel.dtype), filled, precision="highest"
    ).reshape(len(values), co, taps * ci)

    def one(image: Array, strip: Array, at_points: Array) -> Array:
        found = _rows_of(padded, image, strip * height, height + taps - 1)
        tall = jnp.concatenate([found[i : i + height] for i in range(taps)], axis=-1)
        pixels = [tall[:, i : i + cell * cells : cell] for i in range(cell + kw - 1)]
        pixels = [p.reshape(height * cells, taps * ci) for p in pixels]
        # The kernel's channels last: else its derivative would have the larger side first, which is slower.
        products = [
            lax.dot_general(_sum(s, pixels), m, (((1,), (1,)), ((), ())), precision=precision)
            for s, m in zip(spread, at_points, strict=True)
        ]
        made = [_sum(s, products).reshape(height, cells, co) for s in back]
        return jnp.stack(made, axis=2).reshape(height, cells * cell, co)[:, :w]

    return _by_strips(one, at_points, n, h // height).reshape(n, h, w, co)


def _sum(weights: Iterable[float], parts: Sequence[Array]) -> Array:
    """The weighted sum of those that count."""
    terms = (float(a) * p for a, p in zip(weights, parts, strict=True) if a)
    return functools.reduce(jnp.add, terms)


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
