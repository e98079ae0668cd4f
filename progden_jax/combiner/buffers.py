"""Several sub-averages of one render's samples, combined behind a denoiser."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.combiner.denoiser import BoundCombiner, DeepCombiner, applied, bound, taken
from progden_jax.denoisers._base import Bound, call
from progden_jax.frame import Frame, repaired, share


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("combiner", "differences"), meta_fields=()
)
@dataclasses.dataclass(frozen=True)
class BufferedCombiner:
    """The combination of several sub-averages of one render's samples; `of_buffers` makes it.

    y = f(x) with sub-averages x + d_b, where the differences d_b from their mean are constants: normal noise
    of the mean is independent of them, so that σ²·∂f/∂x at fixed d is what SURE needs.

    Parameters
    ----------
    combiner : with a network of as many buffers as there are differences.
    differences : (B, H, W, 3), their sum is 0.
    """

    combiner: DeepCombiner
    differences: Float[Array, "b h w 3"]

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The combined image, (H, W, 3) linear radiance."""
        return call(self, frame)

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x); `frame` must be the one that the sub-averages make up."""
        count, *shape = self.differences.shape
        if tuple(shape) != frame.color.shape:
            raise ValueError(
                f"the sub-averages are of shape {tuple(shape)} and frame.color of {frame.color.shape}: they "
                "belong to the frame that they make up."
            )
        denoiser = self.combiner.denoiser
        whole = bound(denoiser, frame, None, None)
        if hasattr(whole, "filtered"):
            inner = [whole]
        else:
            part = share(frame, count)
            inner = [
                bound(denoiser, part.replace(color=frame.color + d), None, None)
                for d in self.differences
            ]
        buffers = taken(self.combiner, frame)
        held = BoundCombiner(self.combiner.params, inner, buffers, None, self.combiner.network)
        return jax.tree_util.Partial(_run_buffers, held, self.differences)


@jax.jit
def _run_buffers(f: BoundCombiner, differences: Array, x: Array) -> Array:
    noisy = x + differences
    if len(f.inner) < len(differences):
        denoised = f.inner[0].filtered(x, noisy)
    else:
        denoised = jnp.stack([g(part) for g, part in zip(f.inner, noisy, strict=True)])
    return applied(f, noisy, denoised)


def of_buffers(combiner: DeepCombiner, frames: Sequence[Frame]) -> tuple[Frame, BufferedCombiner]:
    """The render that sub-averages of its samples make up, and a denoiser for it that combines them.

    The sub-averages are filtered by the kernels that the denoiser finds for their mean, where what it binds
    has ``filtered(x, images)``, as that of `progden_jax.denoisers.NFOR` has; else each is denoised by itself.

    Parameters
    ----------
    combiner : its network takes as many buffers as there are frames.
    frames : of equal samples per pixel: half or quarter buffers of one render, or renders with several
        seeds. Bad pixels are repaired. Albedo, normal and depth are averaged, where all have them.

    Returns
    -------
    The mean, whose variance is Σ σ_b²/B², or the sub-averages' own where one of them has none, and the
    combiner; `progressive_denoise` takes both.

    Raises
    ------
    ValueError
        If the frames are not as many, no single images, or of several sizes.

    Notes
    -----
    Back et al. 2020, sections 4.4 and 5.
    """
    expected = combiner.network.buffers
    if len(frames) != expected:
        raise ValueError(
            f"there are {len(frames)} frames, and the combiner's network takes {expected} sub-averages."
        )
    for number, frame in enumerate(frames):
        _checks.image(f"frames[{number}].color", frame.color)
        _checks.same_shape(
            f"frames[{number}].color", frame.color, "frames[0].color", frames[0].color
        )
    sound = [repaired(frame) for frame in frames]
    means: dict[str, Any] = {}
    for name in ("color", "albedo", "normal", "depth", "variance", "spp"):
        found = [getattr(frame, name) for frame in sound]
        if all(buffer is not None for buffer in found):
            means[name] = sum(found) / len(found)
    colors = jnp.stack([frame.color for frame in sound])
    spread = colors.var(0, ddof=1) if expected > 1 else None
    means["variance"] = means.get("variance", spread)
    if means["variance"] is not None:
        means["variance"] = means["variance"] / len(frames)
    if "spp" in means:
        means["spp"] = means["spp"] * len(frames)
    frame = Frame(**means)
    return frame, BufferedCombiner(combiner, colors - frame.color)
