"""What a convolution becomes that reads each pixel repeated over 2×2."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def corners(
    low: Float[Array, "n h w ci"],
    weights: Float[Array, "2 2 ci 4*co"],
    precision: lax.PrecisionLike,
) -> Float[Array, "n 2h 2w co"]:
    """The four output pixels of each of `low`'s, by weights that are `folded`."""
    found = lax.conv_general_dilated(
        *(low, weights, (1, 1), ((1, 1), (1, 1))),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=precision,
    )
    return interleaved(found)


def repeated(low: Array) -> Array:
    n, h, w, c = low.shape
    wide = jnp.broadcast_to(low[:, :, None, :, None], (n, h, 2, w, 2, c))
    return wide.reshape(n, 2 * h, 2 * w, c)


def folded(kernel: Float[Array, "3 3 ci co"]) -> Float[Array, "2 2 ci 4*co"]:
    """The taps that meet one repeated pixel added, for the even and odd rows and columns of the output."""
    for axis in (0, 1):
        first, middle, last = (lax.index_in_dim(kernel, i, axis, keepdims=False) for i in range(3))
        even = jnp.stack([first, middle + last], axis)
        odd = jnp.stack([first + middle, last], axis)
        kernel = jnp.stack([even, odd], axis=-2)
    return kernel.reshape(*kernel.shape[:3], -1)


def of_cells(kernel: Float[Array, "3 3 cs co"]) -> Float[Array, "2 2 4*cs 4*co"]:
    """The kernel on cells of 2×2 pixels as channels, for the four pixels that `interleaved` joins."""
    ends = ((1, 0), (0, 1))
    parts = [jnp.pad(kernel, (i, j, (0, 0), (0, 0))) for i in ends for j in ends]
    cells = jnp.stack(parts, axis=-2)
    _, _, channels, _, width = cells.shape
    cells = jnp.moveaxis(cells.reshape(2, 2, 2, 2, channels, 4 * width), 2, 1)
    return cells.reshape(2, 2, 4 * channels, 4 * width)


def of_corners(weights: Float[Array, "2 2 ci 4*co"]) -> Float[Array, "3 3 ci 4*co"]:
    """Folded weights as a kernel around each of `low`'s pixels, for `shuffled`."""
    each = weights.reshape(*weights.shape[:3], 2, 2, -1)
    ends = ((0, 1), (1, 0))
    parts = [
        jnp.pad(each[..., i, j, :], (ends[i], ends[j], (0, 0), (0, 0)))
        for i in (0, 1)
        for j in (0, 1)
    ]
    return jnp.concatenate(parts, axis=-1)


def shuffled(cells: Float[Array, "n h w 4*co"]) -> Float[Array, "n 2h 2w co"]:
    """Each pixel's four in raster order, over 2×2."""
    n, h, w, _ = cells.shape
    split = cells.reshape(n, h, w, 2, 2, -1)
    return jnp.swapaxes(split, 2, 3).reshape(n, 2 * h, 2 * w, -1)


def interleaved(corners: Float[Array, "n h+1 w+1 4*co"]) -> Float[Array, "n 2h 2w co"]:
    """The output pixel of odd row is of the cell below and right of the corner, and so on."""
    n, h, w, _ = corners.shape
    h, w = h - 1, w - 1
    split = corners.reshape(n, h + 1, w + 1, 2, 2, -1)
    rows = [
        jnp.stack([split[:, i : i + h, j : j + w, i, j] for j in (0, 1)], axis=3) for i in (0, 1)
    ]
    return jnp.stack(rows, axis=2).reshape(n, 2 * h, 2 * w, -1)
