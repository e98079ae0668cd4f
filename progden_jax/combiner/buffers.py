"""Several sub-averages of one render's samples, combined behind a denoiser."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax.combiner.denoiser import BoundCombiner, DeepCombiner, applied, bound, taken
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound, call
from progden_jax.frame import Frame, share
from progden_jax.subaverages import SubAverages, averaged


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("combiner", "differences", "shares"),
    meta_fields=(),
)
@dataclasses.dataclass(frozen=True)
class BufferedCombiner:
    """The combination of several sub-averages of one render's samples; `of_buffers` makes it.

    y = f(x) with sub-averages x + d_b, where the differences d_b from their mean are constants: normal noise
    of the mean is independent of them, so that σ²·∂f/∂x at fixed d is what SURE needs.

    Parameters
    ----------
    combiner : with a network of as many buffers as there are differences.
    differences : (B, H, W, 3), weighted by the shares their sum is 0.
    shares : (B,) of the samples, see `progden_jax.subaverages.SubAverages`.

    Raises
    ------
    ValueError
        If they are not as many as the network takes.
    """

    combiner: DeepCombiner
    differences: Float[Array, "b h w 3"]
    shares: Float[Array, " b"]

    @classmethod
    def of(cls, combiner: DeepCombiner, found: SubAverages) -> "BufferedCombiner":
        """For the render that these make up."""
        count, expected = len(found.shares), combiner.network.buffers
        if count != expected:
            raise ValueError(
                f"there are {count} frames, and the combiner's network takes {expected} sub-averages."
            )
        return cls(combiner, found.differences["color"], found.shares)

    @property
    def name(self) -> str:
        """For messages."""
        return self.combiner.name

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The combined image, (H, W, 3) linear radiance."""
        return call(self, frame)

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x); `frame` must be the one that the sub-averages make up."""
        combiner = self.combiner
        inner = bound_parts(combiner.denoiser, frame, self.differences, self.shares)
        buffers = taken(combiner, frame)
        held = BoundCombiner(combiner.params, inner, buffers, None, combiner.network)
        return jax.tree_util.Partial(_run_buffers, held, self.shares)


@jax.jit
def _run_buffers(f: BoundCombiner, shares: Array, x: Array) -> Array:
    return applied(f, x + f.inner.differences, f.inner(x), shares=shares)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BoundParts:
    """The denoised sub-averages, (B, H, W, 3), of a render x: what `bound_parts` gives."""

    inner: list[Any]
    differences: Array

    def __call__(self, x: Float[Array, "h w 3"]) -> Float[Array, "b h w 3"]:
        """Each by the kernels for x, or by itself."""
        noisy = x + self.differences
        if len(self.inner) < len(noisy):
            return self.inner[0].filtered(x, noisy)
        return jnp.stack([f(part) for f, part in zip(self.inner, noisy, strict=True)])


def bound_parts(
    denoiser: Denoiser,
    frame: Frame,
    differences: Float[Array, "b h w 3"],
    shares: Float[Array, " b"],
) -> BoundParts:
    """The denoiser's function from a render to its denoised sub-averages.

    These are filtered by the kernels that the denoiser finds for the render where what it binds has
    ``filtered(x, images)``; else each is denoised by itself, as a render of its share of the samples.

    Raises
    ------
    ValueError
        If the differences are not of the frame's size.

    Notes
    -----
    Back et al. 2020, section 5, "Network Input".
    """
    if tuple(shape := differences.shape[1:]) != frame.color.shape:
        raise ValueError(
            f"the sub-averages are of shape {shape} and frame.color of {frame.color.shape}: they belong to "
            "the frame that they make up."
        )
    whole = bound(denoiser, frame, None, None)
    if hasattr(whole, "filtered"):
        return BoundParts([whole], differences)
    inner = [
        bound(denoiser, share(frame.replace(color=frame.color + d), 1 / p), None, None)
        for d, p in zip(differences, shares, strict=True)
    ]
    return BoundParts(inner, differences)


def of_buffers(combiner: DeepCombiner, frames: Sequence[Frame]) -> tuple[Frame, BufferedCombiner]:
    """The render that sub-averages of its samples make up, and a denoiser for it that combines them.

    The sub-averages are filtered by the kernels that the denoiser finds for their mean, where what it binds
    has ``filtered(x, images)``, as that of `progden_jax.denoisers.NFOR` has; else each is denoised by itself.

    Parameters
    ----------
    combiner : its network takes as many buffers as there are frames.
    frames : half or quarter buffers of one render, renders with several seeds, or what
        `progden_jax.subaverages.nested` finds in a series. They count by their samples per pixel.

    Returns
    -------
    Their mean, see `progden_jax.subaverages.averaged`, and the combiner; `progressive_denoise` takes both.

    Raises
    ------
    ValueError
        If the frames are not as many, no single images, or of several sizes.

    Notes
    -----
    Back et al. 2020, sections 4.4 and 5.
    """
    found = averaged(frames)
    return found.frame, BufferedCombiner.of(combiner, found)
