"""Random numbers that belong to pixels: one value per position, whatever the size of the array.

So an image, the same image on a padded canvas and a tile of it see the same probe. They come from a
hash of row, column, channel, probe and key: JAX's own generator took 19 times as long and most of the time
that a program with probes needed to compile.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, UInt32

Words = tuple[Array, Array, Array, Array]

Origin = tuple[Array | int, Array | int]
"""Row and column, in the whole image, of an array's first pixel."""


def _hash(x: Array, y: Array, z: Array, w: Array) -> Words:
    """pcg4d of Jarzynski and Olano 2020: four words that depend on all of four words."""
    x, y, z, w = (v * jnp.uint32(1664525) + jnp.uint32(1013904223) for v in (x, y, z, w))
    x, y, z, w = _stir(x, y, z, w)
    return _stir(*(v ^ (v >> 16) for v in (x, y, z, w)))


def _stir(x: Array, y: Array, z: Array, w: Array) -> Words:
    x = x + y * w
    y = y + z * x
    z = z + x * y
    w = w + y * z
    return x, y, z, w


def _bits(
    key: jax.Array, probe: Array | int, like: Float[Array, "h w c"], origin: Origin
) -> UInt32[Array, "h w c"]:
    height, width, channels = like.shape
    state: Words = (jnp.asarray(probe).astype(jnp.uint32), *[jnp.uint32(0)] * 3)
    for word in jax.random.key_data(key):
        state = _hash(state[0], state[1], state[2], state[3] ^ word)
    # Twice, for neighbouring seeds and probes differ in a bit or two.
    a, b, c, d = _hash(*state)
    first, left = (jnp.asarray(n).astype(jnp.uint32) for n in origin)
    row = (jnp.arange(height, dtype=jnp.uint32) + first)[:, None, None] ^ a
    column = (jnp.arange(width, dtype=jnp.uint32) + left)[:, None] ^ b
    channel = jnp.arange(channels, dtype=jnp.uint32) ^ c
    return _hash(row, column, channel, d)[3]


@jax.jit
def normal(
    key: jax.Array, probe: Array | int, like: Float[Array, "h w c"], origin: Origin = (0, 0)
) -> Float[Array, "h w c"]:
    """Standard normal values for the probe of this number, at most 5.3 in magnitude."""
    return 2**0.5 * lax.erf_inv(2 * uniform(key, probe, like, origin) - 1)


@jax.jit
def uniform(
    key: jax.Array, probe: Array | int, like: Float[Array, "h w c"], origin: Origin = (0, 0)
) -> Float[Array, "h w c"]:
    """Uniform values for the probe of this number: the middles of 2^23 equal parts of (0, 1)."""
    return ((_bits(key, probe, like, origin) >> 9).astype(like.dtype) + 0.5) * 2.0**-23


@jax.jit
def signs(
    key: jax.Array, probe: Array | int, like: Float[Array, "h w c"], origin: Origin = (0, 0)
) -> Float[Array, "h w c"]:
    """Values ±1 with equal probability for the probe of this number."""
    return 1 - 2 * (_bits(key, probe, like, origin) >> 31).astype(like.dtype)
