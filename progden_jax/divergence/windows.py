"""Which pixels of every layer matter for ∂f_p/∂x_p, and how many products they take: see `cone`."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from progden_jax.denoisers import graph as g
from progden_jax.divergence import _short


@dataclasses.dataclass(frozen=True)
class Window:
    """Where along one axis a node's window begins, per phase, in the node's own pixels and relative
    to the one above p, and how many pixels it spans (the most over phases)."""

    origin: np.ndarray
    size: int


@dataclasses.dataclass(frozen=True)
class Plan:
    """The windows of a graph: what `jacobian_diagonal` runs and what its cost follows from."""

    nodes: tuple[g.Node, ...]
    levels: tuple[int, ...]
    windows: tuple[Window | None, ...]
    """None where no path from p to p leads through a node."""

    @property
    def period(self) -> int:
        """Pixels after which the windows repeat."""
        used = zip(self.levels, self.windows, strict=True)
        return 1 << max(level for level, window in used if window is not None)


def plan(
    nodes: Sequence[g.Node],
    params: Any,
    *,
    levels: int | None = None,
    radius: int | tuple[int, ...] | None = None,
) -> Plan:
    """The windows of every node: forward cone of one input pixel, met with its backward cone.

    Both are intervals per axis and phase. Convolutions widen them, pooling and upsampling halve
    and double the positions, rounding as the phase has it.

    Given `levels`, as many from the finest on have windows and the rest none. Given `radius`, windows end
    that many of their pixels from the one above p: of each level from the finest on, or, if it is one
    number, of the coarsest.
    """
    depths = g.levels(nodes)
    coarsest = max(depths) if levels is None else min(levels - 1, max(depths))
    phases = np.arange(1 << coarsest)
    ends = dict(enumerate(radius)) if isinstance(radius, tuple) else {coarsest: radius}
    # Absolute positions, for a pixel p equal to its phase plus a multiple of every stride.
    forward: list[np.ndarray | None] = []
    for level, node in zip(depths, nodes, strict=True):
        spans = [forward[s] for s in g.sources(node)]
        match node:
            case _ if level > coarsest:
                span = None
            case g.Input():
                span = np.stack([phases, phases])
            case g.Conv():
                r = _radius(params, node)
                span = _union([s if s is None else s + np.array([[-r], [r]]) for s in spans])
            case g.MaxPool():
                span = None if spans[0] is None else spans[0] >> 1
            case g.Upsample():
                span = None if spans[0] is None else 2 * spans[0] + np.array([[0], [1]])
            case g.Filter():
                image, r = forward[node.image], node.size // 2
                reached = None if image is None else image + np.array([[-r], [r]])
                span = _union([reached, forward[node.logits]])
            case _:
                span = _union(spans)
        end = ends.get(level)
        if span is not None and end is not None:
            above = phases >> level
            span = np.stack([np.maximum(span[0], above - end), np.minimum(span[1], above + end)])
        forward.append(span)

    backward: list[np.ndarray | None] = [None] * len(nodes)
    backward[-1] = np.stack([phases, phases])
    for index in reversed(range(len(nodes))):
        span, node = backward[index], nodes[index]
        if span is None:
            continue
        match node:
            case g.Conv():
                r = _radius(params, node)
                needed = span + np.array([[-r], [r]])
            case g.MaxPool():
                needed = 2 * span + np.array([[0], [1]])
            case g.Upsample():
                needed = span >> 1
            case g.Filter():
                needed, r = span, node.size // 2
                around = span + np.array([[-r], [r]])
                backward[node.image] = _union([backward[node.image], around])
            case _:
                needed = span
        for source in g.sources(node):
            backward[source] = _union([backward[source], needed])

    windows: list[Window | None] = []
    for level, ahead, behind in zip(depths, forward, backward, strict=True):
        if ahead is None or behind is None:
            windows.append(None)
            continue
        low, high = np.maximum(ahead[0], behind[0]), np.minimum(ahead[1], behind[1])
        size = int((high - low).max()) + 1
        low, high = low - (phases >> level), high - (phases >> level)
        # Where smaller windows leave room, one origin for all phases makes offsets static.
        if (high - size + 1).max() <= low.min():
            low = np.full_like(low, low.min())
        windows.append(Window(low, size) if size > 0 else None)
    return Plan(tuple(nodes), tuple(depths), tuple(windows))


def _radius(params: Any, node: g.Conv) -> int:
    return params[node.layer]["kernel"].shape[0] // 2


def _union(spans: Sequence[np.ndarray | None]) -> np.ndarray | None:
    known = [span for span in spans if span is not None]
    if not known:
        return None
    return np.stack([np.min([s[0] for s in known], 0), np.max([s[1] for s in known], 0)])


def multiply_adds(plan: Plan, params: Any) -> float:
    """Of the tangent pass's convolutions per pixel, all three channels: what `auto` compares."""
    total = 0.0
    for node, parts in convolutions(plan, params).values():
        features = params[node.layer]["kernel"].shape[3]
        for part in parts:
            channels = part.channels.stop - part.channels.start
            total += 3 * part.axis.multiply_adds(channels, features)
    return total


@dataclasses.dataclass(frozen=True)
class Part:
    """What a convolution takes from one of those of its sources that tangents come through."""

    source: int
    """The node whose window it reads: of an upsampled one the node below."""
    channels: slice
    """Of the kernel's inputs."""
    axis: _short.Axis


def convolutions(plan: Plan, params: Any) -> dict[int, tuple[g.Conv, list[Part]]]:
    """How each convolution with a window is computed, by its node's index."""
    found = {}
    for index, node in enumerate(plan.nodes):
        window = plan.windows[index]
        if isinstance(node, g.Conv) and window is not None:
            split = zip(node.sources, _split_channels(plan, params, node), strict=True)
            parts = [_part(plan, params, index, source, channels) for source, channels in split]
            found[index] = (node, [part for part in parts if part is not None])
    return found


def _part(plan: Plan, params: Any, index: int, source: int, channels: slice) -> Part | None:
    node, window = plan.nodes[index], plan.windows[index]
    assert isinstance(node, g.Conv)
    assert window is not None
    taps = params[node.layer]["kernel"].shape[0]
    above, level = plan.nodes[source], plan.levels[index]
    if isinstance(above, g.Upsample):
        source = above.source
    read = plan.windows[source]
    if read is None:
        return None
    if isinstance(above, g.Upsample):
        phases = np.arange(len(window.origin))
        first, parent = (phases >> level) + window.origin, (phases >> (level + 1)) + read.origin
        axis = _short.upsampled_convolution(read.size, window.size, first, parent, taps)
    else:
        shift = window.origin - read.origin - taps // 2
        axis = _short.convolution(read.size, window.size, shift, taps)
    return Part(source, channels, axis)


def _split_channels(plan: Plan, params: Any, node: g.Conv) -> list[slice]:
    """The input channels of a convolution that belong to each of its sources."""
    widths = g.channels(plan.nodes, params)
    ends = np.cumsum([widths[source] for source in node.sources])
    return [slice(int(e) - widths[s], int(e)) for e, s in zip(ends, node.sources, strict=True)]
