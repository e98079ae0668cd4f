"""Variances shared between neighbours."""

import functools

import jax
import jax.numpy as jnp

from progden_jax._program import checked_variance
from progden_jax._windows import box_sum
from progden_jax.frame import Frame


@functools.partial(jax.jit, static_argnames="window")
def pooled(frame: Frame, window: int) -> Frame:
    """The frame with its variance averaged over window × window pixels (odd), as far as they are inside.

    Where noise is skewed, a pixel's own variance is too small where it is too dark, and too large where it is
    too bright; that of its neighbours knows nothing of its noise.

    Raises
    ------
    ValueError
        If the frame is no single image, or has no variance.
    """
    variance = checked_variance(frame)
    inside = jnp.ones_like(variance[..., :1])
    return frame.replace(variance=box_sum(variance, window) / box_sum(inside, window))
