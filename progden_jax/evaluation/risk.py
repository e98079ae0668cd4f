"""SURE of a mix, which is a denoiser of the render as any other: the estimate of its mean squared error."""

import functools
from typing import cast

import jax
from jaxtyping import Array, Float

from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import passable
from progden_jax.divergence import Method, MonteCarlo
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer
from progden_jax.pipeline import progressive_denoise
from progden_jax.sure import sure
from progden_jax.training.losses import mix_risk
from progden_jax.tstatistic import Bound


@jax.jit
def risk_of_held(
    alpha: Float[Array, "h w 3"],
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    divergence: Float[Array, "h w 3"],
) -> Float[Array, ""]:
    """The mean of SURE of the mix as if α did not depend on the render, which makes it a little too low."""
    return mix_risk(alpha, x, y, variance, divergence).mean()


def risk_of_mix(
    frame: Frame,
    denoiser: Denoiser,
    mixer: Mixer,
    bound: Bound | None,
    *,
    method: Method,
    probes: int,
    seed: int,
) -> float:
    """The mean of SURE of the mix, by derivatives through denoiser, divergence, mixer and bound.

    Parameters
    ----------
    frame : with a variance, and repaired.
    bound : on α; None: there is none.
    method : of the divergence that the mixer is told, by the probes that `seed` gives.
    probes : along which the whole is differentiated; others than these.

    Notes
    -----
    Cost: a mix and its derivative per probe, of the whole frame at once, whatever its size.
    """
    key = jax.random.key(seed)
    return float(_risk(frame, passable(denoiser), mixer, bound, key, method=method, probes=probes))


@functools.partial(jax.jit, static_argnames=("method", "probes"))
def _risk(
    frame: Frame,
    denoiser: Denoiser,
    mixer: Mixer,
    bound: Bound | None,
    key: jax.Array,
    *,
    method: Method,
    probes: int,
) -> Float[Array, ""]:
    def mix(color: Array) -> Array:
        return progressive_denoise(
            frame.replace(color=color),
            denoiser,
            mixer=mixer,
            method=method,
            bound=False if bound is None else bound,
            key=key,
            outputs=("image",),
        ).image

    x, variance = frame.color, cast(Array, frame.variance)
    own = jax.random.fold_in(key, 1)
    z, divergence, *_ = MonteCarlo(probes=probes).evaluate(mix, x, variance, own)
    return sure(x, z, variance, divergence).mean()
