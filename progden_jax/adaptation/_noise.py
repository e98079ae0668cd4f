"""Noise that a pixel's channels share, as they do where each light path has a colour of its own."""

import functools
from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax._numeric import safe_sqrt
from progden_jax.denoisers._base import Bound
from progden_jax.divergence import _random
from progden_jax.divergence._base import Evaluation, accumulate
from progden_jax.frame import Frame

_EDGE = 3.0
"""Standard deviations from which on a difference is one of the picture."""


def correlation(frame: Frame) -> Float[Array, ""]:
    """Of the noise of two channels of a pixel: the mean over pairs, pixels counting alike, in [0, 1].

    Taken from differences of neighbours that noise explains in every channel.
    """
    variance = cast(Array, frame.variance)
    both = variance[:, 1:] + variance[:, :-1]
    noisy = both > 0
    scale = jnp.where(noisy, jnp.sqrt(jnp.where(noisy, both, 1)), 1)
    difference = frame.color[:, 1:] - frame.color[:, :-1]
    parts = jnp.where(noisy, difference / scale, 0)
    parts = jnp.where((jnp.abs(parts) < _EDGE).all(-1, keepdims=True), parts, 0)
    squares = (parts**2).sum()
    # (r + g + b)² − r² − g² − b² is twice the sum over the three pairs.
    pairs = (parts.sum(-1) ** 2).sum() - squares
    return jnp.where(squares > 0, pairs / (2 * jnp.where(squares > 0, squares, 1)), 0).clip(0, 1)


def evaluate(
    f: Bound,
    x: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    shared: Float[Array, ""],
    key: jax.Array,
    *,
    probes: int,
) -> Evaluation:
    """y and the divergence Σ_c' ρ_cc' σ_c σ_c' ∂f_pc/∂x_pc', ρ being `shared` between two channels.

    Without the terms between channels Stein's estimate is blind to a denoiser that takes a channel's noise
    from the others. As `MonteCarlo`, but in a share of the pixels the channels have one sign.
    """
    value, tangent = jax.linearize(f, x)
    sigma = safe_sqrt(variance)
    own, common, which = jax.random.split(key, 3)
    one = functools.partial(_random.signs, like=x[..., :1])

    def sample(probe: Array) -> Array:
        together = _random.uniform(which, probe, x[..., :1]) < shared
        signs = jnp.where(together, one(common, probe), _random.signs(own, probe, x))
        b = sigma * signs
        return b * tangent(b)

    return Evaluation(value, *accumulate(sample, probes, 1, value))
