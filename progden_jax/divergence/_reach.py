"""How far a function reaches, from its jaxpr: which input rows and columns an output pixel can depend on.

What is followed is the derivative's program, linear in the tangent: whatever is not computed from the
tangent (masks, exposures, weights) may be of any kind, and only linear primitives have to be known. Of every
intermediate array it is tracked, per spatial dimension, along which of its axes positions run and the first
and last input position that each index depends on. Anything else along that dimension counts as depending on
the whole range, so the answer may be too large and is never too small.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

_NOTHING_LOW, _NOTHING_HIGH = np.int64(2**40), np.int64(-(2**40))


class UnknownReachError(ValueError):
    """The derivative uses a primitive that is not followed."""


@dataclasses.dataclass(frozen=True)
class _Span:
    """The first and last input position that each index along `axis` depends on; one for all if None."""

    axis: int | None
    low: np.ndarray
    high: np.ndarray


_Spans = tuple[_Span, _Span]
"""Of rows and of columns."""

_Reads = tuple[int, np.ndarray, np.ndarray] | None
"""Where an input axis goes: output axis, and the range (start, stop) of input indices read by each output
index. None: every output depends on all of the axis."""


def tangent_jaxpr(f: Callable[[Any], Any], x: Any) -> core.ClosedJaxpr:
    """The program from (x, tangent) to the tangent of f(x)."""
    like = jax.ShapeDtypeStruct(x.shape, x.dtype)
    return jax.make_jaxpr(lambda x, t: jax.linearize(f, x)[1](t))(like, like)


def radii(f: Callable[[Any], Any], x: Any) -> tuple[int, int]:
    """The rows and the columns further than which f(x)_p depends on no x_q.

    Raises
    ------
    UnknownReachError
        Naming the first primitive that is not followed.
    """
    jaxpr = tangent_jaxpr(f, x).jaxpr
    spans: _Spans = tuple(  # pyright: ignore[reportAssignmentType]
        _Span(axis, np.arange(x.shape[axis]), np.arange(x.shape[axis])) for axis in (0, 1)
    )
    (out,) = _follow(jaxpr, [None, spans])
    if out is None:
        return 0, 0
    return _radius(out[0], 0, x.shape[0]), _radius(out[1], 1, x.shape[1])


def _radius(span: _Span, axis: int, size: int) -> int:
    here = np.arange(size)
    if span.axis != axis:
        span = _whole(span)
    distances = np.maximum(here - span.low, span.high - here)
    return max(0, int(np.where(span.low <= span.high, distances, 0).max()))


def _follow(jaxpr: core.Jaxpr, arguments: Sequence[_Spans | None]) -> list[_Spans | None]:
    """The spans of a jaxpr's outputs; None where the tangent does not enter."""
    known: dict[Any, _Spans] = {}

    def bind(variables: Sequence[Any], spans: Sequence[_Spans | None]) -> None:
        known.update((v, s) for v, s in zip(variables, spans, strict=True) if s is not None)

    def of(variable: Any) -> _Spans | None:
        return None if isinstance(variable, core.Literal) else known.get(variable)

    bind(jaxpr.invars, arguments)
    for equation in _needed(jaxpr):
        inputs = [of(v) for v in equation.invars]
        if all(v.aval.size == 0 for v in equation.outvars):
            continue  # Nothing carries no tangent.
        if any(s is not None for s in inputs):
            bind(equation.outvars, _apply(equation, inputs))
    return [of(v) for v in jaxpr.outvars]


def _needed(jaxpr: core.Jaxpr) -> list[Any]:
    """The equations that outputs are computed from: tangents that are stopped later are not followed."""
    wanted = {v for v in jaxpr.outvars if not isinstance(v, core.Literal)}
    kept = []
    for equation in reversed(jaxpr.eqns):
        if not wanted.isdisjoint(equation.outvars):
            kept.append(equation)
            wanted.update(v for v in equation.invars if not isinstance(v, core.Literal))
    return kept[::-1]


def _apply(equation: Any, inputs: list[_Spans | None]) -> Sequence[_Spans | None]:
    name = equation.primitive.name
    if name == "cond":
        found = [_follow(b.jaxpr, inputs[1:]) for b in equation.params["branches"]]
        return [_union_of([s for s in outs if s is not None]) for outs in zip(*found, strict=True)]
    if name in _CALLS:
        inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
        return _follow(getattr(inner, "jaxpr", inner), inputs)
    if name == "optimization_barrier":
        return inputs
    if name == "split":
        return _split(equation, inputs[0])
    pieces = []
    for index, spans in enumerate(inputs):
        if spans is None:
            continue
        if name in _POINTWISE:
            pieces.append(spans)
            continue
        rule = _RULES.get(name)
        if rule is None or index not in (rule.operands or (index,)):
            what = f"'{name}'" if rule is None else f"'{name}' with operand {index} computed from x"
            raise UnknownReachError(
                f"its derivative uses the primitive {what}, which is not followed"
            )
        pieces.append(tuple(_moved(span, equation, index, rule.reads) for span in spans))
    return [_union_of(pieces)]


def _split(equation: Any, spans: _Spans | None) -> list[_Spans | None]:
    assert spans is not None
    ends = np.cumsum(equation.params["sizes"])[:-1]

    def pieces(span: _Span) -> list[_Span]:
        if span.axis != equation.params["axis"]:
            return [span] * (len(ends) + 1)
        parts = zip(np.split(span.low, ends), np.split(span.high, ends), strict=True)
        return [_Span(span.axis, low, high) for low, high in parts]

    return list(zip(*map(pieces, spans), strict=True))


def _moved(span: _Span, equation: Any, index: int, rule: Callable[..., _Reads]) -> _Span:
    if span.axis is None:
        return span
    reads = rule(equation, index, span.axis)
    if reads is None:
        return _whole(span)
    axis, start, stop = reads
    size = len(span.low)
    start, stop = np.clip(start, 0, size), np.clip(stop, 0, size)
    low = [span.low[a:b].min(initial=_NOTHING_LOW) for a, b in zip(start, stop, strict=True)]
    high = [span.high[a:b].max(initial=_NOTHING_HIGH) for a, b in zip(start, stop, strict=True)]
    return _Span(axis, np.array(low), np.array(high))


def _whole(span: _Span) -> _Span:
    low, high = span.low.min(initial=_NOTHING_LOW), span.high.max(initial=_NOTHING_HIGH)
    return _Span(None, low, high)


def _union_of(pieces: Sequence[_Spans]) -> _Spans | None:
    if not pieces:
        return None
    spans = []
    for parts in zip(*pieces, strict=True):
        if len({part.axis for part in parts}) > 1:
            parts = [_whole(part) for part in parts]
        low = np.min([part.low for part in parts], axis=0)
        spans.append(_Span(parts[0].axis, low, np.max([part.high for part in parts], axis=0)))
    return spans[0], spans[1]


_CALLS = (
    *("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint"),
    *("custom_jvp_call", "custom_vjp_call"),
)

_POINTWISE = frozenset(
    {
        "add",
        "add_any",
        "sub",
        "mul",
        "div",
        "neg",
        "select_n",
        "convert_element_type",
        "copy",
        "conj",
    }
    | {"reduce_precision", "real", "imag", "complex", "sharding_constraint"}
)


def _shape(equation: Any, index: int) -> tuple[int, ...]:
    return equation.invars[index].aval.shape


def _out_shape(equation: Any) -> tuple[int, ...]:
    return equation.outvars[0].aval.shape


def _same(axis: int, size: int) -> _Reads:
    return axis, np.arange(size), np.arange(size) + 1


def _broadcast(equation: Any, index: int, axis: int) -> _Reads:
    size, to = _shape(equation, index)[axis], equation.params["broadcast_dimensions"][axis]
    wide = _out_shape(equation)[to]
    return _same(to, size) if size == wide else (to, np.zeros(wide, int), np.ones(wide, int))


def _stack(equation: Any, index: int, axis: int) -> _Reads:
    return _same(axis + (axis >= equation.params["axis"]), _shape(equation, index)[axis])


def _fourier(equation: Any, index: int, axis: int) -> _Reads:
    shape = _shape(equation, index)
    near = axis < len(shape) - len(equation.params["fft_lengths"])
    return _same(axis, shape[axis]) if near else None


def _squeeze(equation: Any, index: int, axis: int) -> _Reads:
    return _without(equation.params["dimensions"], _shape(equation, index), axis)


def _reduce(equation: Any, index: int, axis: int) -> _Reads:
    return _without(equation.params["axes"], _shape(equation, index), axis)


def _without(gone: Sequence[int], shape: tuple[int, ...], axis: int) -> _Reads:
    return None if axis in gone else _same(axis - sum(g < axis for g in gone), shape[axis])


def _cumulate(equation: Any, index: int, axis: int) -> _Reads:
    size = _shape(equation, index)[axis]
    return None if axis == equation.params["axis"] else _same(axis, size)


def _transpose(equation: Any, index: int, axis: int) -> _Reads:
    return _same(equation.params["permutation"].index(axis), _shape(equation, index)[axis])


def _reverse(equation: Any, index: int, axis: int) -> _Reads:
    start = np.arange(_shape(equation, index)[axis])
    if axis in equation.params["dimensions"]:
        start = start[::-1]
    return axis, start, start + 1


def _slice(equation: Any, index: int, axis: int) -> _Reads:
    strides = equation.params["strides"]
    step = 1 if strides is None else strides[axis]
    start = equation.params["start_indices"][axis] + step * np.arange(_out_shape(equation)[axis])
    return axis, start, start + 1


def _dynamic_slice(equation: Any, index: int, axis: int) -> _Reads:
    size, taken = _shape(equation, index)[axis], _out_shape(equation)[axis]
    start = np.arange(taken)
    return axis, start, start + size - taken + 1


def _pad(equation: Any, index: int, axis: int) -> _Reads:
    low, _, interior = equation.params["padding_config"][axis]
    return axis, *_window(_out_shape(equation)[axis], 1, 1, low, 1, interior + 1)


def _window(
    count: int, size: int, stride: int, low: int, dilation: int, base: int
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges that windows read, over values that lie `base` apart."""
    first = stride * np.arange(count) - low
    last = first + (size - 1) * dilation
    return -(-first // base), last // base + 1


def _reduce_window(equation: Any, index: int, axis: int) -> _Reads:
    p = equation.params
    return axis, *_window(
        _out_shape(equation)[axis],
        p["window_dimensions"][axis],
        p["window_strides"][axis],
        p["padding"][axis][0],
        p["window_dilation"][axis],
        p["base_dilation"][axis],
    )


def _convolve(equation: Any, index: int, axis: int) -> _Reads:
    p = equation.params
    numbers = p["dimension_numbers"]
    place = numbers.lhs_spec.index(axis)
    to = numbers.out_spec[place]
    if place == 0 and p["batch_group_count"] == 1:
        return _same(to, _shape(equation, index)[axis])
    if place < 2:
        return None
    n = place - 2
    return to, *_window(
        _out_shape(equation)[to],
        _shape(equation, 1)[numbers.rhs_spec[place]],
        p["window_strides"][n],
        p["padding"][n][0],
        p["rhs_dilation"][n],
        p["lhs_dilation"][n],
    )


def _dot(equation: Any, index: int, axis: int) -> _Reads:
    contracted, batch = equation.params["dimension_numbers"]
    shape = _shape(equation, index)
    if axis in contracted[index]:
        return None
    if axis in batch[index]:
        return _same(batch[index].index(axis), shape[axis])
    free = [a for a in range(len(shape)) if a not in (*contracted[index], *batch[index])]
    before = len(batch[0])
    if index == 1:
        before += len(_shape(equation, 0)) - len(contracted[0]) - len(batch[0])
    return _same(before + free.index(axis), shape[axis])


def _concatenate(equation: Any, index: int, axis: int) -> _Reads:
    size = _shape(equation, index)[axis]
    if axis != equation.params["dimension"]:
        return _same(axis, size)
    before = sum(_shape(equation, i)[axis] for i in range(index))
    start = np.arange(_out_shape(equation)[axis]) - before
    return axis, start, np.where(start >= 0, start + 1, 0)


def _gather(equation: Any, index: int, axis: int) -> _Reads:
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    size, rank = _shape(equation, index)[axis], len(_out_shape(equation))
    if axis in numbers.operand_batching_dims:
        place = numbers.start_indices_batching_dims[numbers.operand_batching_dims.index(axis)]
        outer = [a for a in range(rank) if a not in numbers.offset_dims]
        return _same(outer[place], size)
    if axis in numbers.collapsed_slice_dims:
        return None
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    to = numbers.offset_dims[axis - sum(g < axis for g in gone)]
    # Where the slice begins is not known.
    start = np.arange(sizes[axis])
    return to, start, start + size - sizes[axis] + 1


def _reshape(equation: Any, index: int, axis: int) -> _Reads:
    """An axis goes to the one that, with all axes within it, has as many elements: H to H/2 of (H/2, 2)."""
    shape, out = _shape(equation, index), _out_shape(equation)
    if equation.params.get("dimensions") is not None or 0 in shape:
        return None
    inner = math.prod(shape[axis + 1 :])
    for to in range(len(out)):
        step = math.prod(out[to + 1 :])
        if out[to] > 1 and step * out[to] == inner * shape[axis]:
            first = step * np.arange(out[to])
            return to, first // inner, (first + step - 1) // inner + 1
    return None


@dataclasses.dataclass(frozen=True)
class _Rule:
    reads: Callable[[Any, int, int], _Reads]
    operands: tuple[int, ...] | None = (0,)
    """Those that the tangent may enter by; None for any."""


_RULES = {
    "broadcast_in_dim": _Rule(_broadcast),
    "squeeze": _Rule(_squeeze),
    "reduce_sum": _Rule(_reduce),
    "cumsum": _Rule(_cumulate),
    "transpose": _Rule(_transpose),
    "rev": _Rule(_reverse),
    "slice": _Rule(_slice),
    "dynamic_slice": _Rule(_dynamic_slice),
    "pad": _Rule(_pad),
    "reduce_window_sum": _Rule(_reduce_window),
    "select_and_gather_add": _Rule(_reduce_window),
    "conv_general_dilated": _Rule(_convolve),
    "dot_general": _Rule(_dot, (0, 1)),
    "concatenate": _Rule(_concatenate, None),
    "stack": _Rule(_stack, None),
    "fft": _Rule(_fourier),
    "gather": _Rule(_gather),
    "reshape": _Rule(_reshape),
}
