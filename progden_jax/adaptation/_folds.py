"""Denoisers fitted to parts of an image, each applied where it was not fitted."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound
from progden_jax.frame import Frame


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CrossFitted:
    """One denoiser with several sets of weights, each for its own pixels; `adapt` makes it.

    y = Σ_k m_k f(x; θ_k), where θ_k was fitted to blocks outside of m_k. At a pixel the weights then know
    next to nothing of its noise, so that ∂y/∂x at constant weights is what Stein's estimate needs.

    Parameters
    ----------
    stacked : the denoiser, its leaves with an axis in front, of one entry per fold.
    masks : (K, H, W, 1), 1 in each fold's pixels.
    """

    stacked: Any
    masks: Float[Array, "k h w 1"]

    @property
    def name(self) -> str | None:
        """The denoiser's, by which its mixer is found."""
        return getattr(self.stacked, "name", None)

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance."""
        return self.bind(frame)(frame.color)

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x); `frame` must be of the size of the one that it was fitted to."""
        _checks.image("frame.color", frame.color)
        if frame.size != self.masks.shape[1:3]:
            (h, w), (height, width) = frame.size, self.masks.shape[1:3]
            raise ValueError(
                f"the frame is {w}×{h} pixels (width × height) and the denoiser was fitted in blocks to one "
                f"of {width}×{height}: adapt with folds=1 for weights that serve other frames."
            )

        def f(x: Array) -> Array:
            def one(fold: tuple[Denoiser, Array]) -> Array:
                denoiser, mask = fold
                return mask * denoiser.bind(frame)(x)

            return lax.map(one, (self.stacked, self.masks)).sum(0)

        return f


def cross_fitted(denoisers: Sequence[Any], masks: Sequence[np.ndarray]) -> CrossFitted:
    """From one denoiser per fold, and the (H, W) pixels that each is for."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *denoisers)
    return CrossFitted(stacked, jnp.stack([jnp.asarray(m, jnp.float32) for m in masks])[..., None])
