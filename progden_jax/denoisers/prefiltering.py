"""Noisy features smoothed, each guided by itself, before `progden_jax.denoisers.nfor` models by them."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.denoisers._patches import Windows
from progden_jax.denoisers._regression import regress
from progden_jax.denoisers.nfor import FEATURES
from progden_jax.frame import Frame

_WINDOWS = Windows(radius=5, patch=3)
_BANDWIDTH = 0.5


def prefiltered(frame: Frame, variances: Mapping[str, Float[Array, "h w c"]]) -> Frame:
    """The frame with its noisy features smoothed by non-local means, each guided by itself.

    Parameters
    ----------
    frame : one frame; features that no variance is given for stay as they are.
    variances : of the mean, by feature ("albedo", "normal", "depth"), in its shape.

    Raises
    ------
    ValueError
        If a name is no feature, the frame lacks it, or shapes differ.

    Notes
    -----
    Bitterli et al. 2016, section 5.1.
    """
    filtered = {}
    for role, variance in variances.items():
        _checks.choice("variances", role, FEATURES)
        buffer = getattr(frame, role)
        if buffer is None:
            raise ValueError(f"a variance of the {role} is given, and this frame has none.")
        _checks.same_shape(f"variances[{role!r}]", variance, f"frame.{role}", buffer)
        filtered[role] = _prefilter(buffer, variance)
    return frame.replace(**filtered)


@jax.jit
def _prefilter(buffer: Array, variance: Array) -> Array:
    found = regress(
        buffer,
        buffer[..., :0],
        buffer,
        variance,
        jnp.ones(buffer.shape[:2], bool),
        windows=_WINDOWS,
        bandwidths=(_BANDWIDTH,),
        ridge=1.0,  # of no slopes
    )
    return found.image[0]
