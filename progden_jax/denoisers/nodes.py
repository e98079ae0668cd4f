"""The layers of which `progden_jax.denoisers.graph` knows what they compute.

A network is a tuple of them in order of evaluation, each naming the nodes that it reads by their index.
"""

import dataclasses
from collections.abc import Callable, Sequence

from jaxtyping import Array


@dataclasses.dataclass(frozen=True)
class Input:
    """The network's input, all channels; only the first three are differentiated."""


@dataclasses.dataclass(frozen=True)
class Conv:
    """Convolution of odd size, zero padding, of one or several nodes side by side (a concatenation)."""

    sources: tuple[int, ...]
    layer: str
    """Name of the parameters {"kernel": (k, k, in, out), "bias": (out,)}; the bias may be missing."""


@dataclasses.dataclass(frozen=True)
class Relu:
    source: int


@dataclasses.dataclass(frozen=True)
class LeakyRelu:
    """max(v, 0) + slope · min(v, 0); parametric (PReLU) where the slope is trained."""

    source: int
    layer: str
    """Name of the parameters {"slope": (channels,) or ()}."""


@dataclasses.dataclass(frozen=True)
class Affine:
    """Scale and shift per channel: batch normalisation once its statistics are fixed."""

    source: int
    layer: str
    """Name of the parameters {"scale": (channels,), "shift": (channels,)}."""


@dataclasses.dataclass(frozen=True)
class BatchNorm:
    """Normalisation of each channel by its mean and variance over a batch of images, then scale and shift.

    For training; the batch is the mapped axis `BATCH` (``jax.vmap(..., axis_name=BATCH)``), and none of its
    images is padded.
    """

    source: int
    layer: str
    """Name of the parameters {"scale": (channels,), "shift": (channels,)}."""


BATCH = "batch of images"

BATCH_EPSILON = 1e-5
"""Added to the variance, so that a channel that is the same everywhere stays finite."""


@dataclasses.dataclass(frozen=True)
class Pointwise:
    """A function of every value by itself, such as ``jax.numpy.tanh``."""

    source: int
    function: Callable[[Array], Array]
    channels: int | None = None
    """Only the first so many channels of the source; None: all."""


@dataclasses.dataclass(frozen=True)
class MaxPool:
    """Largest of each 2×2, the first in raster order on ties."""

    source: int


@dataclasses.dataclass(frozen=True)
class Upsample:
    """Each value repeated over 2×2. Read by convolutions only."""

    source: int


@dataclasses.dataclass(frozen=True)
class Add:
    """The sum of two nodes of one shape: a residual connection."""

    sources: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Filter:
    """Each pixel the mean over size×size around it, weighted by the softmax of its own size² logits.

    The pixels around come in raster order; those beyond the image have no weight.
    """

    image: int
    logits: int
    size: int


Node = (
    Input
    | Conv
    | Relu
    | LeakyRelu
    | Affine
    | BatchNorm
    | Pointwise
    | MaxPool
    | Upsample
    | Add
    | Filter
)


def sources(node: Node) -> tuple[int, ...]:
    """The nodes that a node reads."""
    match node:
        case Input():
            return ()
        case Conv() | Add():
            return node.sources
        case Filter():
            return (node.image, node.logits)
        case _:
            return (node.source,)


def moved(node: Node, places: Sequence[int]) -> Node:
    """The node in a graph where the nodes that it reads are at these places."""
    match node:
        case Input():
            return node
        case Conv(sources=read):
            return dataclasses.replace(node, sources=tuple(places[s] for s in read))
        case Add(sources=(first, second)):
            return dataclasses.replace(node, sources=(places[first], places[second]))
        case Filter(image=image, logits=logits):
            return dataclasses.replace(node, image=places[image], logits=places[logits])
        case _:
            return dataclasses.replace(node, source=places[node.source])
