"""Networks as lists of layers, for algorithms that must look inside: the exact divergence by cones.

A graph says what a convolutional network computes between its transferred input and its output: nodes in
order of evaluation, each naming those it reads. Strides are powers of two; a node at level n has one
value per 2^n × 2^n pixels.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


@dataclasses.dataclass(frozen=True)
class Input:
    """The network's input, all channels; only the first three are differentiated."""


@dataclasses.dataclass(frozen=True)
class Conv:
    """Convolution of odd size, zero padding, of one or several nodes side by side (a concatenation)."""

    sources: tuple[int, ...]
    layer: str
    """Name of the parameters {"kernel": (k, k, in, out), "bias": (out,)}."""


@dataclasses.dataclass(frozen=True)
class Relu:
    source: int


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


Node = Input | Conv | Relu | MaxPool | Upsample | Add


class Layered(NamedTuple):
    """A bound denoiser at one image, taken apart: y = decode(network(inputs)), inputs = encode(x)."""

    nodes: tuple[Node, ...]
    params: Any
    inputs: Float[Array, "h2 w2 c"]
    """Transferred colour first, then auxiliary channels, padded to the network's alignment."""
    inside: Array | None
    """(H2, W2, 1) False where the inputs are padding beyond a traced true size; None if none are."""
    encode_slope: Float[Array, "h w 3"]
    """Derivative of the transferred colour with respect to x, per pixel and channel."""
    decode: Callable[[Array], Array]
    """From the network's output (H, W, 3) to y, per pixel and channel."""


def sources(node: Node) -> tuple[int, ...]:
    """The nodes that a node reads."""
    match node:
        case Input():
            return ()
        case Conv() | Add():
            return node.sources
        case _:
            return (node.source,)


def levels(nodes: Sequence[Node]) -> list[int]:
    """Of each node, the logarithm to base 2 of its stride in pixels.

    Raises
    ------
    ValueError
        If a node joins others of different strides, or reads one that comes later.
    """
    found: list[int] = []
    for index, node in enumerate(nodes):
        read = {found[s] for s in sources(node) if s < index}
        if any(s >= index for s in sources(node)) or len(read) > 1:
            raise ValueError(
                f"node {index} of the graph, {node}, reads nodes that come later or have several "
                f"strides ({sorted(read)})."
            )
        level = read.pop() if read else 0
        level += {MaxPool: 1, Upsample: -1}.get(type(node), 0)
        found.append(level)
    return found


def multiply_adds(nodes: Sequence[Node], params: Any) -> float:
    """Of the convolutions of one forward pass, per pixel."""
    return sum(
        params[node.layer]["kernel"].size / 4**level
        for node, level in zip(nodes, levels(nodes), strict=True)
        if isinstance(node, Conv)
    )


def evaluate(
    nodes: Sequence[Node],
    params: Any,
    inputs: Float[Array, "h w c"],
    *,
    inside: Array | None = None,
    precision: Any = lax.Precision.HIGHEST,
) -> tuple[Float[Array, "h w c"], dict[int, Array]]:
    """The output, and what fixes the derivative: where each `Relu` passes (bool), which of four won each
    `MaxPool` (uint8), and the image's extent, (h, w, 1), for each `Conv` that no ReLU bounds to it.

    `inside` (H, W, 1) is False where the input is padding around the image that a traced size leaves.
    """
    masks = _mask_pyramid(inside, max(levels(nodes)))
    bare = _not_rectified(nodes)
    values: list[Array] = []
    kept: dict[int, Array] = {}
    for index, (node, level) in enumerate(zip(nodes, levels(nodes), strict=True)):
        match node:
            case Input():
                value = inputs
            case Conv():
                x = jnp.concatenate([values[s] for s in node.sources], axis=-1)
                layer = params[node.layer]
                value = lax.conv_general_dilated(
                    x[None],
                    layer["kernel"],
                    (1, 1),
                    "SAME",
                    dimension_numbers=("NHWC", "HWIO", "NHWC"),
                    precision=precision,
                )[0]
                value = value + layer["bias"]
                if index in bare:
                    kept[index] = jnp.ones((*value.shape[:2], 1), bool)
                    if masks is not None:
                        kept[index] = masks[level]
                        value = jnp.where(masks[level], value, 0)
            case Relu():
                passes = values[node.source] > 0
                if masks is not None:
                    passes &= masks[level]
                kept[index] = passes
                value = jnp.where(passes, values[node.source], 0)
            case MaxPool():
                candidates = jnp.stack(children(values[node.source]))
                kept[index] = jnp.argmax(candidates, axis=0).astype(jnp.uint8)
                value = candidates.max(0)
            case Upsample():
                value = jnp.repeat(jnp.repeat(values[node.source], 2, 0), 2, 1)
            case Add():
                value = values[node.sources[0]] + values[node.sources[1]]
        values.append(value)
    return values[-1], kept


def _not_rectified(nodes: Sequence[Node]) -> set[int]:
    """Convolutions read by other than a ReLU: padding beyond the image is not zero there by itself."""
    return {
        source
        for node in nodes
        if not isinstance(node, Relu)
        for source in sources(node)
        if isinstance(nodes[source], Conv)
    }


def children(x: Float[Array, "h w c"]) -> list[Float[Array, "h2 w2 c"]]:
    """The four values under each pixel of the next level, in raster order."""
    h, w, c = x.shape
    cells = x.reshape(h // 2, 2, w // 2, 2, c)
    return [cells[:, i, :, j] for i in (0, 1) for j in (0, 1)]


def _mask_pyramid(inside: Array | None, top: int) -> list[Array] | None:
    if inside is None:
        return None
    pyramid = [inside]
    for _ in range(top):
        pyramid.append(jax.tree.reduce(jnp.logical_or, children(pyramid[-1])))
    return pyramid
