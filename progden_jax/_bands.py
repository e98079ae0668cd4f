"""Images in bands of rows: what has many channels is never there as a whole."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

_ROWS, _BAND = 128, 1 << 18
"""Of a band, rows and pixels at least: fewer take less memory and repeat more around their edges."""

_PIXELS = 1 << 20
"""From which on bands of OIDN take no more time than the whole; below they take a few per cent more."""


def rows_of(height: int, width: int) -> int:
    """Rows that a band should have at least: all of them where bands do not pay. Untried on GPUs."""
    cut = height * width >= _PIXELS and jax.default_backend() == "cpu"
    return max(_ROWS, _BAND // width) if cut else height


def in_bands(
    f: Callable[..., Float[Array, "h2 w2 d"]],
    images: tuple[Float[Array, "_ _ _"], ...],
    height: int,
    *,
    rows: int,
    halo: int,
    multiple: int = 1,
) -> Float[Array, "h2 w2 d"]:
    """``f(*images)`` from bands of at least so many rows, of which each sees `halo` more on either side.

    The images, and what f gives, may have a half or a quarter of the rows `height`, or all of them; bands and
    halo are a `multiple` of rows. Where `height` does not divide so, f gets the whole.
    """
    halo = -(-halo // multiple) * multiple
    fitting = [
        n
        for n in range(2, height // rows + 1)
        if height % (multiple * n) == 0 and height // n + 2 * halo <= height
    ]
    count = max(fitting, default=1)
    if count == 1:
        return f(*images)
    own = height // count
    seen = own + 2 * halo

    def band(index: Array) -> Array:
        first = index * own
        # At an image's edge a band goes on inside, so that what is beyond is up to f.
        start = jnp.clip(first - halo, 0, height - seen)

        def taken(image: Array) -> Array:
            step = height // image.shape[0]
            return lax.dynamic_slice_in_dim(image, start // step, seen // step)

        found = f(*map(taken, images))
        step = seen // found.shape[0]
        return lax.dynamic_slice_in_dim(found, (first - start) // step, own // step)

    found = lax.map(band, jnp.arange(count))
    return found.reshape(-1, *found.shape[2:])
