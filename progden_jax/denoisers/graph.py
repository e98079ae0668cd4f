"""Networks as lists of layers, for algorithms that must look inside: the exact divergence by cones.

A graph says what a convolutional network computes between its transferred input and its output: nodes in
order of evaluation, each naming those it reads. Strides are powers of two; a node at level n has one
value per 2^n × 2^n pixels.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax._numeric import own_zero
from progden_jax._slopes import largest, where_passes
from progden_jax.denoisers.layers import (
    Moments,
    Weighted,
    children,
    convolve,
    convolve_rectified,
    convolve_upsampled,
    filtered,
    folds,
    max_pool,
    normalized,
    patches,
    rectifies,
    upsample,
)
from progden_jax.denoisers.nodes import (
    Add,
    Affine,
    BatchNorm,
    Conv,
    Filter,
    Input,
    LeakyRelu,
    MaxPool,
    Node,
    Pointwise,
    Relu,
    Upsample,
    sources,
)

__all__ = [
    "Add",
    "Affine",
    "BatchNorm",
    "Conv",
    "Filter",
    "Input",
    "Layered",
    "LeakyRelu",
    "MaxPool",
    "Moments",
    "Node",
    "Pointwise",
    "Relu",
    "Upsample",
    "Weighted",
    "aligned_radius",
    "alignment",
    "channels",
    "children",
    "evaluate",
    "input_channels",
    "levels",
    "max_pool",
    "multiply_adds",
    "patches",
    "receptive_radius",
    "sources",
]


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


def alignment(nodes: Sequence[Node]) -> int:
    """The largest stride in pixels: images are padded to multiples of it."""
    return 1 << max(levels(nodes))


def receptive_radius(nodes: Sequence[Node], params: Any) -> int:
    """How many pixels away the input can be that an output pixel depends on."""
    reach: list[int] = []
    for node, level in zip(nodes, levels(nodes), strict=True):
        match node:
            case Input():
                radius = 0
            case Conv():
                radius = max(reach[s] for s in node.sources)
                radius += (params[node.layer]["kernel"].shape[0] // 2) << level
            case MaxPool():
                # The blocks that pooling fixes in place reach one pixel of its source further.
                radius = reach[node.source] + (1 << (level - 1))
            case Filter():
                radius = max(reach[node.logits], reach[node.image] + (node.size // 2 << level))
            case _:
                radius = max(reach[s] for s in sources(node))
        reach.append(radius)
    return reach[-1]


def aligned_radius(nodes: Sequence[Node], params: Any) -> int:
    """How far beyond a core tiles must reach that begin and end at multiples of the alignment.

    At most the `receptive_radius`, which also covers how pooled blocks lie to a tile that begins anywhere.
    """
    step = alignment(nodes)
    # From the right of a core it is the same mirrored, for all layers are.
    short = [begin - _first_read(nodes, params, begin) // step * step for begin in range(step)]
    # A tile may begin at any multiple up to the one before what is read first.
    return max(0, *(n - step + 1 for n in short))


def _first_read(nodes: Sequence[Node], params: Any, begin: int) -> int:
    """The first pixel along an axis of what outputs from `begin` on depend on."""
    first: dict[int, int] = {len(nodes) - 1: begin}

    def read(source: int, at: int) -> None:
        first[source] = min(first.get(source, at), at)

    for index in reversed(range(len(nodes))):
        if index not in first:
            continue
        node, at = nodes[index], first[index]
        match node:
            case Conv():
                for source in node.sources:
                    read(source, at - params[node.layer]["kernel"].shape[0] // 2)
            case MaxPool():
                read(node.source, 2 * at)
            case Upsample():
                read(node.source, at // 2)
            case Filter():
                read(node.logits, at)
                read(node.image, at - node.size // 2)
            case _:
                for source in sources(node):
                    read(source, at)
    return first[0]


def channels(nodes: Sequence[Node], params: Any) -> list[int]:
    """Of each node, its channels; the input has as many as the first convolution of it alone takes.

    Raises
    ------
    ValueError
        If the weights of a layer do not fit its place, or no convolution reads the input alone.
    """
    widths: list[int] = []
    for node in nodes:
        match node:
            case Input():
                width = input_channels(nodes, params)
            case Conv():
                kernel = params[node.layer]["kernel"].shape
                width, taken = kernel[-1], sum(widths[s] for s in node.sources)
                expected = (kernel[0], kernel[0], taken, width)
                bias = params[node.layer].get("bias")
                bias_fits = bias is None or bias.shape == (width,)
                if kernel != expected or kernel[0] % 2 == 0 or not bias_fits:
                    raise ValueError(
                        f"layer {node.layer} has a kernel of shape {kernel} and a bias of shape "
                        f"{getattr(bias, 'shape', None)}; at its place a kernel takes {taken} channels, "
                        "is square with an odd edge, and has one bias per output channel."
                    )
            case Pointwise(channels=int(first)):
                width = first
            case _:
                width = widths[sources(node)[0]]
        widths.append(width)
    return widths


def input_channels(nodes: Sequence[Node], params: Any) -> int:
    """As many as the first convolution takes that reads the input alone."""
    for node in nodes:
        if isinstance(node, Conv) and node.sources == (0,):
            return params[node.layer]["kernel"].shape[2]
    raise ValueError("no convolution of the graph reads the input alone.")


def multiply_adds(nodes: Sequence[Node], params: Any, *, plain: bool = False) -> float:
    """Of the convolutions of one forward pass, per pixel.

    As `evaluate` runs them; `plain`: as the network is written, nine products where 3×3 follow upsampling and
    CPUs do with four.
    """
    widths, total = channels(nodes, params), 0.0
    for node, level in zip(nodes, levels(nodes), strict=True):
        if not isinstance(node, Conv):
            continue
        kernel, first = params[node.layer]["kernel"], node.sources[0]
        products = kernel.size
        if not plain and isinstance(nodes[first], Upsample) and folds(params[node.layer], None):
            products -= (9 - 4) * widths[first] * kernel.shape[3]
        total += products / 4**level
    return total


def evaluate(
    nodes: Sequence[Node],
    params: Any,
    inputs: Float[Array, "h w c"],
    *,
    inside: Array | None = None,
    precision: Any = lax.Precision.HIGHEST,
) -> tuple[Float[Array, "h w c"], dict[int, Any]]:
    """The output, and what fixes the derivative, per node that has more to it than its parameters.

    Of each `Relu` where it passes and of each `LeakyRelu` where its input is positive (bool), of each
    `Pointwise` its slope, of each `MaxPool` which of four won (uint8), of each `Filter` a `Weighted`, of each
    `BatchNorm` the `Moments`, and the image's extent, (h, w, 1), for each `Conv` that nothing read from it
    bounds to that.

    `inside` (H, W, 1) is False where the input is padding around the image that a traced size leaves.
    `precision` is that of the convolutions: JAX's, or "bfloat16", which rounds their inputs and kernels to
    that and sums in float32, tangents likewise.
    """
    masks = mask_pyramid(inside, max(levels(nodes)))
    given, rest = {0: inputs}, range(1, len(nodes))
    values, kept = evaluate_part(nodes, params, given, rest, masks=masks, precision=precision)
    return values[len(nodes) - 1], kept


def evaluate_part(
    nodes: Sequence[Node],
    params: Any,
    given: Mapping[int, Float[Array, "h w c"]],
    which: range,
    *,
    masks: Sequence[Array] | None = None,
    precision: Any = lax.Precision.HIGHEST,
    lean: bool = False,
) -> tuple[dict[int, Float[Array, "h w c"]], dict[int, Any]]:
    """The values of some nodes from those of the nodes that they read; for the rest see `evaluate`.

    `masks` are a `mask_pyramid` of at least the levels that occur. `lean`: what is linearised keeps a bit for
    each ReLU and a byte for each pool, which takes a little longer to compile and to run.
    """
    strides = levels(nodes)
    bare = _not_bounded(nodes)
    values = dict(given)
    kept: dict[int, Any] = {}
    like = next(iter(given.values()))
    joined = {
        i
        for i, conv in _rectified(nodes, which).items()
        if rectifies(params[conv.layer], precision, like)
    }

    def bounded(value: Array, level: int) -> Array:
        return value if masks is None else jnp.where(masks[level], value, 0)

    def read(conv: Any) -> tuple[Array | None, list[Array]]:
        """What comes upsampled, where that joins the convolution, and the rest."""
        first, *others = conv.sources
        if isinstance(nodes[first], Upsample) and folds(params[conv.layer], precision):
            return values[sources(nodes[first])[0]], [values[s] for s in others]
        return None, [values[s] for s in conv.sources]

    for index in which:
        node, level = nodes[index], strides[index]
        match node:
            case Input():
                raise ValueError(f"node {index} is the input, and its value is not given.")
            case Conv() if index in joined:
                continue
            case Conv():
                layer = params[node.layer]
                low, others = read(node)
                if low is None:
                    value = convolve(layer, jnp.concatenate(others, axis=-1), precision, level)
                else:
                    value = convolve_upsampled(layer, low, others, precision, level)
                if index in bare:
                    extent = jnp.ones((*value.shape[:2], 1), bool)
                    kept[index] = extent if masks is None else masks[level]
                    value = bounded(value, level)
            case Relu() if node.source in joined:
                before: Any = nodes[node.source]
                mask = None if masks is None else masks[level]
                value = convolve_rectified(
                    params[before.layer], *read(before), mask, precision, level
                )
                kept[index] = value > 0
            case Relu():
                passes = values[node.source] > 0
                if masks is not None:
                    passes &= masks[level]
                kept[index] = passes
                x = values[node.source]
                value = where_passes(passes, x) if lean else jnp.where(passes, x, own_zero(x))
            case LeakyRelu():
                x = values[node.source]
                kept[index] = x > 0
                value = jnp.where(kept[index], x, params[node.layer]["slope"] * x)
            case Affine():
                layer = params[node.layer]
                value = bounded(values[node.source] * layer["scale"] + layer["shift"], level)
            case BatchNorm():
                value, kept[index] = normalized(params[node.layer], values[node.source])
            case Pointwise():
                x = values[node.source][..., : node.channels]
                value, slope = jax.jvp(node.function, (x,), (jnp.ones_like(x),))
                value, kept[index] = bounded(value, level), bounded(slope, level)
            case MaxPool():
                four = children(values[node.source])
                kept[index] = jnp.argmax(jnp.stack(four), axis=0).astype(jnp.uint8)
                value = largest(*four) if lean else max_pool(values[node.source])
            case Upsample():
                value = upsample(values[node.source])
            case Add():
                value = values[node.sources[0]] + values[node.sources[1]]
            case Filter():
                mask = None if masks is None else masks[level]
                kept[index] = filtered(values[node.image], values[node.logits], node.size, mask)
                value = kept[index].result
        values[index] = value
    return values, kept


def _rectified(nodes: Sequence[Node], which: range) -> dict[int, Any]:
    """Of these nodes, convolutions that a ReLU of these reads and nothing else."""
    readers: dict[int, list[int]] = {}
    for index, node in enumerate(nodes):
        for source in sources(node):
            readers.setdefault(source, []).append(index)
    return {
        i: nodes[i]
        for i in which
        if isinstance(nodes[i], Conv)
        and len(by := readers.get(i, [])) == 1
        and by[0] in which
        and isinstance(nodes[by[0]], Relu)
    }


def _not_bounded(nodes: Sequence[Node]) -> set[int]:
    """Convolutions read by what does not zero padding beyond the image, where they are not zero."""
    return {
        source
        for node in nodes
        if not isinstance(node, Relu | Pointwise)
        for source in sources(node)
        if isinstance(nodes[source], Conv)
    }


def mask_pyramid(inside: Array | None, top: int) -> list[Array] | None:
    """At each level up to the top, where there is any of the image."""
    if inside is None:
        return None
    pyramid = [inside]
    for _ in range(top):
        pyramid.append(jax.tree.reduce(jnp.logical_or, children(pyramid[-1])))
    return pyramid
