"""A denoiser with a deep combiner behind it, as one denoiser."""

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.combiner.network import KernelNetwork, Params
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound, aligned_radius, call
from progden_jax.denoisers._network import Valid, inside_of
from progden_jax.frame import Frame


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
        return call(self, frame)

    def bind(self, frame: Frame, *, valid: Valid = None, exposure: Any = None) -> Bound:
        """f with y = f(x) for the frame's other buffers, constants; see `Network.bind`."""
        if self.network.buffers != 1:
            raise ValueError(
                f"the combiner takes {self.network.buffers} sub-averages of the samples, and a frame is one: "
                "make it with combiner.of_buffers."
            )
        inner = bound(self.denoiser, frame, valid, exposure)
        buffers = taken(self, frame)
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
    def aligned_radius(self) -> int:
        """The same for a tile that begins and ends at multiples of `alignment`."""
        return aligned_radius(self.denoiser) + self.network.receptive_radius

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
    y = applied(f, x[None], f.inner(x)[None], inside)
    return y if inside is None else jnp.where(inside, y, 0)


def applied(
    f: Any,
    noisy: Array,
    denoised: Array,
    inside: Array | None = None,
    shares: Array | None = None,
) -> Array:
    """The network on (B, H, W, 3) sub-averages."""
    buffers = {role: buffer[None] for role, buffer in f.buffers.items()}
    images = noisy[:, None], denoised[:, None]
    further = {"inside": inside, "shares": None if shares is None else shares[:, None]}
    # GPUs would else take TF32.
    with jax.default_matmul_precision("highest"):
        return f.network.apply(f.params, *images, buffers, **further)[0]


def bound(denoiser: Denoiser, frame: Frame, valid: Valid, exposure: Any) -> Bound:
    """The denoiser's function, told only what it takes."""
    told = {"valid": valid, "exposure": exposure}
    given = {name: value for name, value in told.items() if value is not None}
    return cast(Any, denoiser).bind(frame, **given)


def taken(combiner: DeepCombiner, frame: Frame) -> dict[str, Array]:
    """The buffers that the network takes; its weights are checked too."""
    combiner.network.check(combiner.params)
    buffers = {role: getattr(frame, role) for role in combiner.network.inputs}
    if missing := [role for role, buffer in buffers.items() if buffer is None]:
        raise ValueError(
            f"the combiner's weights take {', '.join(combiner.network.inputs)}, and this frame has no "
            f"{' and no '.join(missing)}: give the buffer, or weights that were trained without it."
        )
    return buffers
