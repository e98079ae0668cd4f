"""A network in stages of bands of rows: the many channels of fine levels are never there as a whole."""

from collections.abc import Sequence
from typing import Any

from jax import lax
from jaxtyping import Array, Float

from progden_jax._bands import in_bands, rows_of
from progden_jax.denoisers import graph
from progden_jax.denoisers.layers import rows_together
from progden_jax.denoisers.nodes import BatchNorm, Conv, Filter, MaxPool, Node, Upsample, sources

_LEVELS = 2
"""So many of the finest go in bands, together where they follow one another upwards."""


def evaluate(
    nodes: Sequence[Node],
    params: Any,
    inputs: Float[Array, "h w c"],
    *,
    inside: Array | None = None,
    precision: Any = lax.Precision.HIGHEST,
    rows: int | None = None,
) -> Float[Array, "h w c"]:
    """The output of `graph.evaluate`, the same to rounding, with bands' temporaries for the whole's.

    Networks that carry fine levels past the pooling, and small images, go as a whole.

    Parameters
    ----------
    nodes, params, inputs, inside, precision : see `graph.evaluate`.
    rows : of a band, at least; by default what is quick.
    """
    stages, rows = _stages(nodes), rows or rows_of(*inputs.shape[:2])
    if len(stages) == 1 or 2 * rows > inputs.shape[0]:
        return graph.evaluate(nodes, params, inputs, inside=inside, precision=precision)[0]
    strides = graph.levels(nodes)
    masks = graph.mask_pyramid(inside, max(strides))
    values = {0: inputs}
    for which in stages:
        reads = sorted({s for i in which for s in sources(nodes[i])}.difference(which))
        levels = [strides[i] for i in (*reads, *which)]
        finest, coarsest = min(levels), max(levels)

        def part(*given: Array, stage: Any = (which, reads, finest, coarsest)) -> Array:
            which, reads, finest, coarsest = stage
            images, mask = given[: len(reads)], given[len(reads) :]
            own = graph.mask_pyramid(mask[0], coarsest - finest) if mask else None
            # Of finer levels there is nothing here, nor anything that asks for it.
            masks = own and [mask[0]] * finest + own
            known = dict(zip(reads, images, strict=True))
            found, _ = graph.evaluate_part(
                *(nodes, params, known, which), masks=masks, precision=precision, lean=True
            )
            return found[which[-1]]

        images = (*(values[s] for s in reads), *(() if masks is None else (masks[finest],)))
        values[which[-1]] = in_bands(
            part,
            images,
            inputs.shape[0] >> finest,
            rows=rows >> finest if finest < _LEVELS else inputs.shape[0],
            halo=sum(_radius(nodes[i], params) << (strides[i] - finest) for i in which),
            # Masks are kept as bits, of four or eight rows side by side.
            multiple=max(4, rows_together(finest), 1 << (coarsest - finest)),
        )
    return values[len(nodes) - 1]


def are_several(nodes: Sequence[Node], height: int, width: int) -> bool:
    """Whether `evaluate` cuts an image of that size."""
    return len(_stages(nodes)) > 1 and 2 * rows_of(height, width) <= height


def _stages(nodes: Sequence[Node]) -> list[range]:
    """Of nodes that follow one another; each reads the input and the ends of others at most."""
    whole = [range(1, len(nodes))]
    pools, ups = (
        [i for i, node in enumerate(nodes) if isinstance(node, kind)]
        for kind in (MaxPool, Upsample)
    )
    if any(isinstance(node, BatchNorm) for node in nodes) or not pools or not ups:
        return whole
    ends = [*(i + 1 for i in pools[:_LEVELS]), ups[-_LEVELS:][0], len(nodes)]
    bounds = [1, *ends]
    stages = [range(*pair) for pair in zip(bounds, ends, strict=False)]
    known = {0, *(end - 1 for end in ends)}
    reads = {s for which in stages for i in which for s in sources(nodes[i]) if s not in which}
    return stages if reads <= known and all(stages) else whole


def _radius(node: Node, params: Any) -> int:
    match node:
        case Conv(layer=layer):
            return params[layer]["kernel"].shape[0] // 2
        case Filter(size=size):
            return size // 2
        case _:
            return 0
