"""Random numbers that belong to pixels: one value per position, whatever the size of the array.

So an image, the same image on a padded canvas and a tile of it see the same probe.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def _rows(key: jax.Array, probe: Array | int, height: int) -> jax.Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(
        jax.random.fold_in(key, probe), jnp.arange(height)
    )


def normal(
    key: jax.Array, probe: Array | int, like: Float[Array, "h w c"]
) -> Float[Array, "h w c"]:
    """Standard normal values for the probe of this number."""
    height, width, channels = like.shape
    keys = _rows(key, probe, height)
    draw = jax.vmap(lambda k: jax.random.normal(k, (width * channels,), like.dtype))
    return draw(keys).reshape(like.shape)


def signs(key: jax.Array, probe: Array | int, like: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
    """Values ±1 with equal probability for the probe of this number."""
    height, width, channels = like.shape
    keys = _rows(key, probe, height)
    draw = jax.vmap(lambda k: jax.random.bits(k, (width * channels,), jnp.uint8))
    return 1 - 2 * (draw(keys).reshape(like.shape) & 1).astype(like.dtype)
