"""How far a function reaches, from its jaxpr: which input rows and columns an output pixel can depend on.

What is followed is the derivative's program, linear in the tangent: whatever is not computed from the
tangent (masks, exposures, weights) may be of any kind, and only linear primitives have to be known. Of every
intermediate array it is tracked, per spatial dimension, along which of its axes positions run and the first
and last input position that each index depends on. Anything else along that dimension counts as depending on
the whole range, so the answer may be too large and is never too small.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from progden_jax.divergence._reach_rules import POINTWISE, RULES, Reads

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
        if name in POINTWISE:
            pieces.append(spans)
            continue
        rule = RULES.get(name)
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


def _moved(span: _Span, equation: Any, index: int, rule: Callable[..., Reads]) -> _Span:
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
