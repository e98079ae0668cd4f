"""Denoiser and mixer as one denoiser, so that the error of the mix can be estimated and made small."""

import dataclasses
from typing import Any

import jax
from jaxtyping import Array, Float

from progden_jax._program import checked_variance
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound
from progden_jax.divergence import MonteCarlo
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer
from progden_jax.sure import sure


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mixed:
    """The mix z = x + α(y − x) as a function of x; the divergence that α rests on is a constant.

    It is estimated at the frame's colour with one probe, and α is not bounded: the t-bound is for
    inference only.
    """

    denoiser: Denoiser
    mixer: Mixer
    key: jax.Array

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The mix, (H, W, 3) linear radiance."""
        return self.bind(frame)(frame.color)

    def exposure_of(self, frame: Frame, valid: None) -> tuple[Any, Array]:
        """What depends on the whole image: the denoiser's exposure, if it has one, and the mean radiance."""
        return exposure_of(self.denoiser, frame), frame.color.clip(0).mean()

    def bind(self, frame: Frame, *, exposure: tuple[Any, Array] | None = None) -> Bound:
        """z as a function of the colour."""
        inner, level = (None, None) if exposure is None else exposure
        f = bind(self.denoiser, frame, inner)
        variance = checked_variance(frame)
        divergence = MonteCarlo(1).evaluate(f, frame.color, variance, self.key).divergence
        divergence = jax.lax.stop_gradient(divergence)
        told = {"level": level} if hasattr(self.mixer, "receptive_radius") else {}

        def mix(x: Array) -> Array:
            y = f(x)
            risk = sure(x, y, variance, divergence)
            return x + self.mixer(x, y, variance, divergence, risk, **told) * (y - x)

        return mix


def exposure_of(denoiser: Any, frame: Frame) -> Any:
    """What the denoiser takes from the whole image where it sees a part; None if nothing."""
    return denoiser.exposure_of(frame, None) if hasattr(denoiser, "exposure_of") else None


def bind(denoiser: Any, frame: Frame, exposure: Any) -> Bound:
    """Its function for a frame, or for a part of one whose `exposure_of` is known."""
    return denoiser.bind(frame) if exposure is None else denoiser.bind(frame, exposure=exposure)
