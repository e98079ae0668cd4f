"""What all denoisers that are convolutional networks share: binding, padding, canvases, layers."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._numeric import own_zero
from progden_jax._slopes import pointwise
from progden_jax.denoisers import _stages, graph
from progden_jax.denoisers._base import Bound, Bounded, call
from progden_jax.denoisers.graph import Layered, Node
from progden_jax.frame import Frame

Params = Mapping[str, Mapping[str, Any]]
"""Layer name -> {"kernel": (k, k, in, out), "bias": (out,)}, and what else `graph`'s layers take."""

Valid = tuple[Array | int, Array | int] | None
"""The true (height, width), may be traced, of images padded beyond it; None: all is true."""

PRECISIONS = ("highest", "high", "default", "tensorfloat32", "bfloat16")


class Network:
    """A denoiser that is a graph of layers between transfer functions: a pytree of its weights.

    A subclass gives `nodes` and the transfer functions `encode`, `decode` and `transferred`, and registers
    itself as a pytree class with keys.
    """

    canvas = True
    leaves: ClassVar[tuple[str, ...]] = ("params",)
    statics: ClassVar[tuple[str, ...]] = ("inputs", "name", "precision")

    params: Params
    inputs: tuple[str, ...]
    name: str
    precision: str

    def __init__(
        self, params: Params, inputs: tuple[str, ...], *, name: str, precision: str
    ) -> None:
        _checks.choice("precision", precision, PRECISIONS)
        self.params = params
        self.inputs = inputs
        self.name = name
        self.precision = precision
        widths = graph.channels(self.nodes, params)
        expected = sum(channels_of(role) for role in ("color", *inputs))
        if widths[0] != expected:
            raise ValueError(
                f"the weights of {name} take {widths[0]} input channels; radiance with "
                f"{' and '.join(inputs) or 'nothing else'} makes {expected}."
            )
        if widths[-1] != 3:
            raise ValueError(f"the weights of {name} give {widths[-1]} channels, expected 3.")

    @property
    def nodes(self) -> tuple[Node, ...]:
        """The layers between transferred input and transferred output."""
        raise NotImplementedError

    def encode(self, x: Float[Array, "h w 3"], exposure: Any) -> Float[Array, "h w 3"]:
        """The colour as the network sees it."""
        raise NotImplementedError

    def decode(self, y: Float[Array, "h w 3"], exposure: Any) -> Float[Array, "h w 3"]:
        """Radiance from the network's output."""
        raise NotImplementedError

    def transferred(self, role: str, buffer: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
        """An auxiliary buffer as the network sees it."""
        raise NotImplementedError

    def exposure_of(self, frame: Frame, valid: Valid) -> Any:
        """What `encode` and `decode` take besides, a constant in derivatives."""
        del frame, valid

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance, at least 0.

        Raises
        ------
        ValueError
            If the frame is no single image, or lacks a buffer that the network takes.
        """
        return call(self, frame)

    def bind(self, frame: Frame, *, valid: Valid = None, exposure: Any = None) -> Bound:
        """f with y = f(x) for the frame's other buffers, constants; a pytree, so it passes through jit.

        `valid` is the true (height, width), may be traced, of a frame padded beyond it with zeros.
        `exposure` is what `exposure_of` says of the whole image, where the frame is a tile of it.
        """
        _checks.image("frame.color", frame.color)
        auxiliary = []
        for role in self.inputs:
            buffer = getattr(frame, role)
            if buffer is None:
                raise ValueError(
                    f"{self.name} takes {' and '.join(self.inputs)}, and this frame has no {role}: "
                    "choose a network with fewer inputs, such as 'oidn-hdr', or give the buffer."
                )
            auxiliary.append(self.transferred(role, jnp.nan_to_num(buffer, nan=0.0)))
        if exposure is None:
            exposure = self.exposure_of(frame, valid)
        return BoundNetwork(self, tuple(auxiliary), exposure, valid)

    @property
    def normalized(self) -> tuple[str, ...]:
        """Layers whose outputs are normalised over batches while they are trained."""
        return ()

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input."""
        return graph.receptive_radius(self.nodes, self.params)

    @property
    def aligned_radius(self) -> int:
        """The same for a tile that begins and ends at multiples of `alignment`."""
        return graph.aligned_radius(self.nodes, self.params)

    @property
    def alignment(self) -> int:
        """Pixels after which the way that outputs depend on inputs repeats."""
        return graph.alignment(self.nodes)

    def in_bands(self, height: int, width: int) -> bool:
        """Whether an image of that size goes in bands of rows, which take a part of the whole's memory."""
        return _stages.are_several(self.nodes, height, width)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, inputs={self.inputs})"

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Any, Any]], Any]:
        children, static = self.tree_flatten()
        keys = map(jax.tree_util.GetAttrKey, self.leaves)
        return list(zip(keys, children, strict=True)), static

    def tree_flatten(self) -> tuple[tuple[Any, ...], Any]:
        children = tuple(getattr(self, name) for name in self.leaves)
        return children, tuple(getattr(self, name) for name in self.statics)

    @classmethod
    def tree_unflatten(cls, static: Any, children: Any) -> Self:
        # Not through __init__: JAX unflattens with placeholders that are no arrays.
        denoiser = object.__new__(cls)
        names, values = (*cls.leaves, *cls.statics), (*children, *static)
        for name, value in zip(names, values, strict=True):
            setattr(denoiser, name, value)
        return denoiser


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BoundNetwork(Bounded):
    """y = f(x) for one frame: what `Network.bind` gives."""

    denoiser: Network
    auxiliary: tuple[Array, ...]
    exposure: Any
    valid: Valid

    def __call__(self, x: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance."""
        _checks.image("x", x)
        return _run_bound(self, x)

    @property
    def layers(self) -> tuple[tuple[Node, ...], Params]:
        """The network's graph and parameters."""
        return self.denoiser.nodes, self.denoiser.params

    def layered(self, x: Float[Array, "h w 3"]) -> Layered:
        """f taken apart at x, for algorithms that look inside the network."""
        encoded, slope = jax.jvp(self._encode, (x,), (jnp.ones_like(x),))
        inputs = jnp.concatenate((encoded, *self.auxiliary), axis=-1)
        inside = inside_of(x.shape[:2], self.valid)
        if inside is not None:
            inputs, slope = jnp.where(inside, inputs, 0), jnp.where(inside, slope, 0)
        inputs, aligned = _padded(inputs, self.valid, self.alignment)
        nodes, params = self.layers
        return Layered(nodes, params, inputs, aligned, slope, self._decode)

    def _encode(self, x: Array) -> Array:
        return self.denoiser.encode(x, self.exposure)

    def _decode(self, y: Array) -> Array:
        return self.denoiser.decode(y, self.exposure)


@jax.jit
def _run_bound(f: BoundNetwork, x: Array) -> Array:
    # Of small images keeping slopes alone saves nothing.
    lean = f.denoiser.in_bands(*x.shape[:2])
    transferred = pointwise if lean else lambda function, *given: function(*given)
    nodes, params = f.layers
    y = run(
        nodes,
        params,
        (transferred(f.denoiser.encode, x, f.exposure), *f.auxiliary),
        valid=f.valid,
        precision=f.denoiser.precision,
    )
    y = transferred(f.denoiser.decode, y, f.exposure)
    inside = inside_of(x.shape[:2], f.valid)
    return y if inside is None else jnp.where(inside, y, own_zero(y))


def run(
    nodes: Sequence[Node],
    params: Params,
    channels: tuple[Float[Array, "h w _"], ...],
    *,
    valid: Valid = None,
    precision: str = "highest",
) -> Float[Array, "h w 3"]:
    """The network on transferred channels of any size, padded with zeros to its alignment, cropped again."""
    x = jnp.concatenate(channels, axis=-1)
    inside = inside_of(x.shape[:2], valid)
    if inside is not None:
        x = jnp.where(inside, x, own_zero(x))
    height, width = x.shape[:2]
    x, aligned = _padded(x, valid, graph.alignment(nodes))
    y = _stages.evaluate(
        nodes,
        params,
        x,
        inside=aligned,
        precision=lax.Precision.HIGHEST if precision == "highest" else cast(Any, precision),
    )
    return y[:height, :width]


def channels_of(role: str) -> int:
    """How many channels that buffer of a frame has."""
    return 1 if role == "depth" else 3


def lit(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Radiance with NaN and negative values at 0, where the derivative is the one from the right: black
    pixels respond to light."""
    return jnp.where((x < 0) | jnp.isnan(x), 0, x)


def normal_to_unit(normal: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Normals in [-1, 1] moved to [0, 1]."""
    return jnp.clip(normal, -1, 1) * 0.5 + 0.5


def inside_of(shape: tuple[int, ...], valid: Valid) -> Array | None:
    """Where the image is, (h, w, 1), not its padding; None: everywhere."""
    if valid is None:
        return None
    rows, columns = (jnp.arange(n) < v for n, v in zip(shape, valid, strict=True))
    return (rows[:, None] & columns[None, :])[..., None]


def _padded(x: Array, valid: Valid, size: int) -> tuple[Array, Array | None]:
    """Zeros up to multiples of `size`, and where the true image is, so padded itself."""
    x = jnp.pad(x, ((0, -x.shape[0] % size), (0, -x.shape[1] % size), (0, 0)))
    if valid is None:
        return x, None
    height, width = ((n + size - 1) // size * size for n in valid)
    return x, inside_of(x.shape[:2], (height, width))


def he_params(
    key: jax.Array,
    nodes: Sequence[Node],
    shapes: Mapping[str, tuple[int, int]],
    gains: Sequence[float],
) -> dict[str, dict[str, Array]]:
    """Random weights that keep the size of signals from layer to layer (He et al. 2015), zero biases.

    Parameters
    ----------
    key : of the random numbers.
    nodes : convolutions with kernels of `shapes`: edge in pixels and output channels by layer.
    gains : per input channel, what brings it to about 1: kernels that read the input alone are scaled by it.
    """
    widths: list[int] = []
    kernels: dict[str, tuple[int, ...]] = {}
    scales: dict[str, np.ndarray] = {}
    for node in nodes:
        match node:
            case graph.Input():
                width = len(gains)
            case graph.Conv():
                size, width = shapes[node.layer]
                taken = sum(widths[s] for s in node.sources)
                kernels[node.layer] = (size, size, taken, width)
                gain = np.asarray(gains if node.sources == (0,) else np.ones(taken))
                scales[node.layer] = np.sqrt(2 / (size**2 * taken)) * gain[:, None]
            case graph.Pointwise(channels=int(first)):
                width = first
            case _:
                width = widths[graph.sources(node)[0]]
        widths.append(width)

    # One draw for all layers compiles in a fraction of the time of one per shape.
    @jax.jit
    def draw(key: jax.Array) -> dict[str, dict[str, Array]]:
        ends = np.cumsum([math.prod(shape) for shape in kernels.values()])
        parts = jnp.split(jax.random.normal(key, (ends[-1],)), ends[:-1])
        return {
            layer: {
                "kernel": (part.reshape(shape) * scales[layer]).astype(part.dtype),
                "bias": jnp.zeros(shape[-1], part.dtype),
            }
            for part, (layer, shape) in zip(parts, kernels.items(), strict=True)
        }

    return draw(key)
