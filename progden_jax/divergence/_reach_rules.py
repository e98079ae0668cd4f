"""Which positions of an operand the outputs of a linear primitive read, axis by axis."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Reads = tuple[int, np.ndarray, np.ndarray] | None
"""Where an input axis goes: output axis, and the range (start, stop) of input indices read by each output
index. None: every output depends on all of the axis."""

POINTWISE = frozenset(
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


def _same(axis: int, size: int) -> Reads:
    return axis, np.arange(size), np.arange(size) + 1


def _broadcast(equation: Any, index: int, axis: int) -> Reads:
    size, to = _shape(equation, index)[axis], equation.params["broadcast_dimensions"][axis]
    wide = _out_shape(equation)[to]
    return _same(to, size) if size == wide else (to, np.zeros(wide, int), np.ones(wide, int))


def _stack(equation: Any, index: int, axis: int) -> Reads:
    return _same(axis + (axis >= equation.params["axis"]), _shape(equation, index)[axis])


def _fourier(equation: Any, index: int, axis: int) -> Reads:
    shape = _shape(equation, index)
    near = axis < len(shape) - len(equation.params["fft_lengths"])
    return _same(axis, shape[axis]) if near else None


def _squeeze(equation: Any, index: int, axis: int) -> Reads:
    return _without(equation.params["dimensions"], _shape(equation, index), axis)


def _reduce(equation: Any, index: int, axis: int) -> Reads:
    return _without(equation.params["axes"], _shape(equation, index), axis)


def _without(gone: Sequence[int], shape: tuple[int, ...], axis: int) -> Reads:
    return None if axis in gone else _same(axis - sum(g < axis for g in gone), shape[axis])


def _cumulate(equation: Any, index: int, axis: int) -> Reads:
    size = _shape(equation, index)[axis]
    return None if axis == equation.params["axis"] else _same(axis, size)


def _transpose(equation: Any, index: int, axis: int) -> Reads:
    return _same(equation.params["permutation"].index(axis), _shape(equation, index)[axis])


def _reverse(equation: Any, index: int, axis: int) -> Reads:
    start = np.arange(_shape(equation, index)[axis])
    if axis in equation.params["dimensions"]:
        start = start[::-1]
    return axis, start, start + 1


def _slice(equation: Any, index: int, axis: int) -> Reads:
    strides = equation.params["strides"]
    step = 1 if strides is None else strides[axis]
    start = equation.params["start_indices"][axis] + step * np.arange(_out_shape(equation)[axis])
    return axis, start, start + 1


def _dynamic_slice(equation: Any, index: int, axis: int) -> Reads:
    size, taken = _shape(equation, index)[axis], _out_shape(equation)[axis]
    start = np.arange(taken)
    return axis, start, start + size - taken + 1


def _pad(equation: Any, index: int, axis: int) -> Reads:
    low, _, interior = equation.params["padding_config"][axis]
    return axis, *_window(_out_shape(equation)[axis], 1, 1, low, 1, interior + 1)


def _window(
    count: int, size: int, stride: int, low: int, dilation: int, base: int
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges that windows read, over values that lie `base` apart."""
    first = stride * np.arange(count) - low
    last = first + (size - 1) * dilation
    return -(-first // base), last // base + 1


def _reduce_window(equation: Any, index: int, axis: int) -> Reads:
    p = equation.params
    return axis, *_window(
        _out_shape(equation)[axis],
        p["window_dimensions"][axis],
        p["window_strides"][axis],
        p["padding"][axis][0],
        p["window_dilation"][axis],
        p["base_dilation"][axis],
    )


def _convolve(equation: Any, index: int, axis: int) -> Reads:
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


def _convolve_by_amx(equation: Any, index: int, axis: int) -> Reads:
    """Of `_amx_convolution.convolution`: of half the size the first operand, of the output's the third."""
    if axis == 0:
        return _same(0, _shape(equation, index)[0])
    if axis == 3:
        return None
    out = np.arange(_out_shape(equation)[axis])
    if index == 0:
        first = out // 2 + out % 2 - 1
        return axis, first, first + 2
    size = _shape(equation, 3)[axis - 1]
    return axis, *_window(len(out), size, 1, size // 2, 1, 1)


def _dot(equation: Any, index: int, axis: int) -> Reads:
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


def _concatenate(equation: Any, index: int, axis: int) -> Reads:
    size = _shape(equation, index)[axis]
    if axis != equation.params["dimension"]:
        return _same(axis, size)
    before = sum(_shape(equation, i)[axis] for i in range(index))
    start = np.arange(_out_shape(equation)[axis]) - before
    return axis, start, np.where(start >= 0, start + 1, 0)


def _gather(equation: Any, index: int, axis: int) -> Reads:
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


def _reshape(equation: Any, index: int, axis: int) -> Reads:
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
class Rule:
    reads: Callable[[Any, int, int], Reads]
    operands: tuple[int, ...] | None = (0,)
    """Those that the tangent may enter by; None for any."""


RULES = {
    "broadcast_in_dim": Rule(_broadcast),
    "squeeze": Rule(_squeeze),
    "reduce_sum": Rule(_reduce),
    "cumsum": Rule(_cumulate),
    "transpose": Rule(_transpose),
    "rev": Rule(_reverse),
    "slice": Rule(_slice),
    "dynamic_slice": Rule(_dynamic_slice),
    "pad": Rule(_pad),
    "reduce_window_sum": Rule(_reduce_window),
    "select_and_gather_add": Rule(_reduce_window),
    "conv_general_dilated": Rule(_convolve),
    "amx_convolution": Rule(_convolve_by_amx, (0, 2)),
    "dot_general": Rule(_dot, (0, 1)),
    "concatenate": Rule(_concatenate, None),
    "stack": Rule(_stack, None),
    "fft": Rule(_fourier),
    "gather": Rule(_gather),
    "reshape": Rule(_reshape),
}
