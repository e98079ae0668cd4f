"""A denoiser with a deep combiner behind it, as one denoiser."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.combiner.network import KernelNetwork, Params
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound
from progden_jax.denoisers._network import Valid, inside_of
from progden_jax.frame import Frame, repaired


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("params", "denoiser"),
    meta_fields=("network",),
)
@dataclasses.dataclass(frozen=True)
class DeepCombiner:
    """y = f(x): the combination of the render x and the denoiser's image of it, see `combine`.

    It works on canvases and tiles as far as the denoiser does. Like the denoiser's own error, what it leaves
    does not tend to 0 as samples grow: mix it progressively.

    Parameters
    ----------
    params : the network's weights, see `KernelNetwork.init`.
    denoiser : what gives the correlated pixels, a pytree (`load` sees to that); the weights may have been
        trained for another.
    network : the settings that the weights belong to; of several buffers, see `of_buffers`.

    References
    ----------
    Back et al. 2020, "Deep Combiner for Independent and Correlated Pixel Estimates".
    """

    params: Params
    denoiser: Any
    network: KernelNetwork

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The combined image, (H, W, 3) linear radiance.

        Raises
        ------
        ValueError
            If the frame is no single image, lacks a buffer that denoiser or network take, or the weights
            are not the network's.
        """
        return _call(self, frame)

    def bind(self, frame: Frame, *, valid: Valid = None, exposure: Any = None) -> Bound:
        """f with y = f(x) for the frame's other buffers, constants; see `Network.bind`."""
        if self.network.buffers != 1:
            raise ValueError(
                f"the combiner takes {self.network.buffers} sub-averages of the samples, and a frame is one: "
                "make it with combiner.of_buffers."
            )
        inner = _bound(self.denoiser, frame, valid, exposure)
        buffers = _taken(self, frame)
        return BoundCombiner(self.params, inner, buffers, valid, self.network)

    def exposure_of(self, frame: Frame, valid: Valid) -> Any:
        """What the denoiser takes from the whole image; the network takes nothing."""
        find = getattr(self.denoiser, "exposure_of", None)
        return None if find is None else find(frame, valid)

    @property
    def canvas(self) -> bool:
        """Whether the denoiser takes padded frames."""
        return getattr(self.denoiser, "canvas", False)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input; as far as the denoiser tells."""
        return self.denoiser.receptive_radius + self.network.receptive_radius

    @property
    def alignment(self) -> int:
        """Pixels after which the way that outputs depend on inputs repeats."""
        return self.denoiser.alignment

    @property
    def inputs(self) -> tuple[str, ...]:
        """Buffers taken besides the colour."""
        return tuple(dict.fromkeys((*getattr(self.denoiser, "inputs", ()), *self.network.inputs)))

    @property
    def name(self) -> str:
        """For messages."""
        return f"{getattr(self.denoiser, 'name', type(self.denoiser).__name__)}+combiner"


@jax.jit
def _call(denoiser: Any, frame: Frame) -> Array:
    return denoiser.bind(frame)(frame.color)


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("params", "inner", "buffers", "valid"),
    meta_fields=("network",),
)
@dataclasses.dataclass(frozen=True)
class BoundCombiner:
    """y = f(x) for one frame: what `DeepCombiner.bind` gives."""

    params: Params
    inner: Any
    buffers: dict[str, Array]
    valid: Valid
    network: KernelNetwork

    def __call__(self, x: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """The combined image, (H, W, 3) linear radiance."""
        _checks.image("x", x)
        return _run(self, x)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input; as far as the denoiser tells."""
        return self.inner.receptive_radius + self.network.receptive_radius

    @property
    def alignment(self) -> int:
        """Pixels after which the way that outputs depend on inputs repeats."""
        return self.inner.alignment


@jax.jit
def _run(f: BoundCombiner, x: Array) -> Array:
    inside = inside_of(x.shape[:2], f.valid)
    y = _applied(f, x[None], f.inner(x)[None], inside)
    return y if inside is None else jnp.where(inside, y, 0)


def _applied(f: Any, noisy: Array, denoised: Array, inside: Array | None = None) -> Array:
    """The network on (B, H, W, 3) sub-averages."""
    buffers = {role: buffer[None] for role, buffer in f.buffers.items()}
    # GPUs would else take TF32.
    with jax.default_matmul_precision("highest"):
        return f.network.apply(f.params, noisy[:, None], denoised[:, None], buffers, inside=inside)[
            0
        ]


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
        return _call(self, frame)

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x); `frame` must be the one that the sub-averages make up."""
        count, *shape = self.differences.shape
        if tuple(shape) != frame.color.shape:
            raise ValueError(
                f"the sub-averages are of shape {tuple(shape)} and frame.color of {frame.color.shape}: they "
                "belong to the frame that they make up."
            )
        denoiser = self.combiner.denoiser
        whole = _bound(denoiser, frame, None, None)
        if hasattr(whole, "filtered"):
            inner = [whole]
        else:
            part = _share(frame, count)
            inner = [
                _bound(denoiser, part.replace(color=frame.color + d), None, None)
                for d in self.differences
            ]
        buffers = _taken(self.combiner, frame)
        held = BoundCombiner(self.combiner.params, inner, buffers, None, self.combiner.network)
        return jax.tree_util.Partial(_run_buffers, held, self.differences)


@jax.jit
def _run_buffers(f: BoundCombiner, differences: Array, x: Array) -> Array:
    noisy = x + differences
    if len(f.inner) < len(differences):
        denoised = f.inner[0].filtered(x, noisy)
    else:
        denoised = jnp.stack([g(part) for g, part in zip(f.inner, noisy, strict=True)])
    return _applied(f, noisy, denoised)


def _share(frame: Frame, count: int) -> Frame:
    """The frame with the variance and the samples of one of so many equal parts of it."""
    variance, spp = frame.variance, frame.spp
    return frame.replace(
        variance=None if variance is None else count * variance,
        spp=None if spp is None else spp / count,
    )


def of_buffers(combiner: DeepCombiner, frames: Sequence[Frame]) -> tuple[Frame, BufferedCombiner]:
    """The render that sub-averages of its samples make up, and a denoiser for it that combines them.

    The sub-averages are filtered by the kernels that the denoiser finds for their mean, where what it binds
    has ``filtered(x, images)``, as that of `NFOR` has; else each is denoised by itself.

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


def _bound(denoiser: Denoiser, frame: Frame, valid: Valid, exposure: Any) -> Bound:
    """The denoiser's function, told only what it takes."""
    told = {"valid": valid, "exposure": exposure}
    given = {name: value for name, value in told.items() if value is not None}
    return cast(Any, denoiser).bind(frame, **given)


def _taken(combiner: DeepCombiner, frame: Frame) -> dict[str, Array]:
    """The buffers that the network takes; its weights are checked too."""
    combiner.network.check(combiner.params)
    buffers = {role: getattr(frame, role) for role in combiner.network.inputs}
    if missing := [role for role, buffer in buffers.items() if buffer is None]:
        raise ValueError(
            f"the combiner's weights take {', '.join(combiner.network.inputs)}, and this frame has no "
            f"{' and no '.join(missing)}: give the buffer, or weights that were trained without it."
        )
    return buffers
