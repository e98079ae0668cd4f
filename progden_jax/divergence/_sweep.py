"""The tangents of a batch of pixels through the windows that matter for the exact diagonal, see `cone`."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax.denoisers import graph as g
from progden_jax.divergence._short import Axis
from progden_jax.divergence.windows import Plan, Window, convolutions

WORTH_SLICES = 2e8
"""Multiply-adds with one small matrix in all from which on sums of slices, three times as quick as XLA's
products with such matrices, gain more than the quarter of a second that their compilation takes."""


class Prepared(NamedTuple):
    """What all sweeps over a frame share."""

    kept: dict[int, Any]
    """What the primal pass kept, by node, with a margin that lets no tangent through."""
    kernels: dict[int, list[Array]]
    """By convolution and source, at the points of `_short`: (kinds, kinds, points, points, in, out), the
    column's first; within a sweep those of its phase."""


class Sweep:
    """The tangents of one batch of cells: pixels of one phase, three unit directions each.

    `pixels` is how many the program will serve.
    """

    def __init__(
        self,
        plan: Plan,
        params: Any,
        prepared: Prepared,
        phase: tuple[Array, Array],
        cells: tuple[Array, Array],
        pixels: int,
        precision: Any,
    ) -> None:
        self.plan, self.params, self.pixels = plan, params, pixels
        self.kept, self.kernels = prepared
        self.phase, self.cells, self.precision = phase, cells, precision
        self.convolutions = convolutions(plan, params)

    def run(self) -> Float[Array, "cells 3 3"]:
        """∂output_c/∂input_d of each cell's pixel, (cells, d, c)."""
        plan = self.plan
        values: dict[int, Array] = {}
        for index, node in enumerate(plan.nodes):
            window = plan.windows[index]
            if window is None:
                continue
            read = functools.partial(self._read, values, window)
            match node:
                case g.Input():
                    number = self.cells[0].shape[0]
                    unit = jnp.eye(
                        3, g.input_channels(self.plan.nodes, self.params), dtype=self._dtype()
                    )
                    value = jnp.repeat(unit, number, axis=0)[None, None]
                case g.Conv():
                    value = self._convolve(index, values)
                    if index in self.kept:
                        value = self._scale(value, self._slope(index, window))
                case g.Relu():
                    value = self._scale(read(node.source), self._slope(index, window))
                case g.LeakyRelu():
                    slope = self.params[node.layer]["slope"]
                    slope = jnp.where(self._slope(index, window), 1, slope)
                    value = self._scale(read(node.source), slope)
                case g.Affine():
                    value = read(node.source) * self.params[node.layer]["scale"]
                case g.Pointwise():
                    value = read(node.source)[..., : node.channels]
                    value = self._scale(value, self._slope(index, window))
                case g.MaxPool():
                    value = self._pool(index, node, window, values[node.source])
                case g.Upsample():
                    value = values[node.source]  # Read by convolutions, which repeat it themselves.
                case g.Add():
                    parts = [read(s) for s in node.sources if s in values]
                    value = parts[0] if len(parts) == 1 else parts[0] + parts[1]
                case g.Filter():
                    value = self._filter(index, node, window, values)
                case g.BatchNorm():
                    raise ValueError(
                        f"layer {node.layer} is normalised over a batch, as in training only: save the "
                        "network, which folds that into its weights."
                    )
            values[index] = value
        last = values[len(plan.nodes) - 1]
        return last.reshape(3, -1, last.shape[-1]).swapaxes(0, 1)

    def _dtype(self) -> Any:
        return jax.tree.leaves(self.params)[0].dtype

    def _window(self, index: int) -> Window:
        window = self.plan.windows[index]
        assert window is not None
        return window

    def _read(self, values: dict[int, Array], window: Window, source: int) -> Array:
        """A node's tangents in the window of one that reads it, which may be narrower."""
        return self._move(values[source], self._window(source), window)

    def _convolve(self, index: int, values: dict[int, Array]) -> Array:
        total = None
        for part, kernel in zip(self.convolutions[index][1], self.kernels[index], strict=True):
            added = self._convolve_window(values[part.source], part.axis, kernel)
            total = added if total is None else total + added
        assert total is not None
        return total

    def _convolve_window(self, x: Array, axis: Axis, kernel: Array) -> Array:
        """A window, (rows, columns, n, c), along columns and rows as `_short.Axis` says."""
        points = kernel.shape[0]
        x = self._at_points(axis, 0, x, 0)
        x = self._at_points(axis, 1, x, 2).swapaxes(1, 2)
        # Tiles count among the windows of a batch: (points, points, tiles, tiles, n, c).
        shape = x.shape
        x = jnp.matmul(x.reshape(points, points, -1, shape[-1]), kernel, precision=self.precision)
        x = x.reshape(*shape[:-1], -1)
        x = self._together(self._combine(axis.combine, 1, x, 0), 2, axis)
        return self._together(self._combine(axis.combine, 0, x, 1), 2, axis)

    def _at_points(self, axis: Axis, which: int, x: Array, along: int) -> Array:
        """A window along an axis at a row's or a column's points, (points, tiles, ...)."""
        if axis.tiles == 1:
            return self._combine(axis.spread, which, x, along)[:, None]
        width = axis.spread.shape[2]
        x = self._cut(x, along, axis.start, (axis.tiles - 1) * axis.stride + width, which)
        starts = range(0, axis.tiles * axis.stride, axis.stride)
        tiles = [lax.slice_in_dim(x, start, start + width, axis=along) for start in starts]
        return self._combine(axis.spread, which, jnp.stack(tiles), along + 1)

    def _together(self, x: Array, tiles: int, axis: Axis) -> Array:
        """Tiles, which are at an axis of their own, after each other along the first."""
        x = jnp.moveaxis(x, tiles, 0)
        return x.reshape(-1, *x.shape[2:])[: axis.target]

    def _combine(self, matrices: np.ndarray, axis: int, x: Array, along: int) -> Array:
        """The phase's matrix times x along one of its axes, which then comes first."""
        phase, matrices = self.phase[axis], matrices.astype(x.dtype)
        others = x.size // x.shape[along] // x.shape[-2] * 3 * self.pixels
        if np.count_nonzero(matrices.any(0)) * others < WORTH_SLICES:
            alike = (matrices == matrices[0]).all()
            matrix = jnp.asarray(matrices[0]) if alike else jnp.asarray(matrices)[phase]
            # The matrix on the right: on the left Eigen sums differently with the number of windows.
            rows = jnp.tensordot(x, matrix, axes=(along, 1), precision=self.precision)
            return jnp.moveaxis(rows, -1, 0)
        slices = [lax.index_in_dim(x, i, along, keepdims=False) for i in range(x.shape[along])]
        rows = []
        for row in np.moveaxis(matrices, 0, -1):
            total = None
            for weights, piece in zip(row, slices, strict=True):
                if not weights.any():
                    continue
                if (weights != weights[0]).any():
                    piece = jnp.asarray(weights)[phase] * piece
                elif weights[0] != 1:
                    piece = weights[0] * piece
                total = piece if total is None else total + piece
            rows.append(jnp.zeros_like(slices[0]) if total is None else total)
        return jnp.stack(rows)

    def _move(self, x: Array, source: Window, target: Window) -> Array:
        """A window cut out of another, zero where they do not overlap."""
        for axis in (0, 1):
            x = self._cut(x, axis, target.origin - source.origin, target.size, axis)
        return x

    def _cut(self, x: Array, along: int, start: np.ndarray, length: int, axis: int) -> Array:
        """A part of x, from where the phase's row or column says, with zeros beyond x."""
        low = max(0, -int(start.min()))
        high = max(0, int(start.max()) + length - x.shape[along])
        widths = [(0, 0)] * x.ndim
        widths[along] = (low, high)
        x = jnp.pad(x, widths)
        if (start == start[0]).all():
            first = int(start[0]) + low
            return lax.slice_in_dim(x, first, first + length, axis=along)
        first = jnp.asarray(start + low)[self.phase[axis]]
        return lax.dynamic_slice_in_dim(x, first, length, along)

    def _pool(self, index: int, node: g.MaxPool, window: Window, x: Array) -> Array:
        """Each pooled tangent is that of the value that won."""
        level = self.plan.levels[index]
        grid = np.arange(len(window.origin))
        start = 2 * ((grid >> level) + window.origin) - (grid >> (level - 1))
        x = self._move(x, self._window(node.source), Window(start, 2 * window.size))
        s = window.size
        cells = x.reshape(s, 2, s, 2, *x.shape[2:])
        codes = self._around(self.kept[index], index, window)
        total = None
        for code in range(4):
            part = self._scale(cells[:, code // 2, :, code % 2], codes == code)
            total = part if total is None else total + part
        assert total is not None
        return total

    def _filter(
        self, index: int, node: g.Filter, window: Window, values: dict[int, Array]
    ) -> Array:
        """Σ_q w_q dx_q + w_q (x_q − y) dℓ_q over the taps q, w the softmax of the logits ℓ."""
        kept = self.kept[index]
        wide = filtered(window, node)
        weights = self._around(kept.weights, index, window)[..., None]
        around = self._patches(self._around(kept.image, index, wide), node.size)
        away = weights * (around - self._around(kept.result, index, window)[..., None, :])
        parts = []
        if node.image in values:
            image = self._per_cell(self._read(values, wide, node.image))
            parts.append((weights[:, :, None] * self._patches(image, node.size)).sum(-2))
        if node.logits in values:
            logits = self._per_cell(self._read(values, window, node.logits))
            product = jnp.einsum("hwntc,hwdnt->hwdnc", away, logits, precision=self.precision)
            parts.append(product)
        total = parts[0] if len(parts) == 1 else parts[0] + parts[1]
        return total.reshape(*total.shape[:2], -1, total.shape[-1])

    def _patches(self, x: Array, size: int) -> Array:
        """`graph.patches` of (rows, columns, ..., c): (rows, columns, ..., taps, c)."""
        taken = g.patches(jnp.moveaxis(x, (0, 1), (-3, -2)), size)
        return jnp.moveaxis(taken, (-4, -3), (0, 1))

    def _per_cell(self, x: Array) -> Array:
        """(..., 3·cells, c) as (..., 3, cells, c)."""
        return x.reshape(*x.shape[:-2], 3, -1, x.shape[-1])

    def _slope(self, index: int, window: Window) -> Array:
        """What the primal pass kept of a pointwise layer, 0 or False beyond the image."""
        return self._around(self.kept[index], index, window)

    def _around(self, kept: Array, index: int, window: Window) -> Array:
        """What the primal pass kept, with its surround, in every cell's window: (s, s, cells, C)."""
        level, s = self.plan.levels[index], window.size
        step = self.plan.period >> level
        corner = [
            (phase >> level) + jnp.asarray(window.origin)[phase] + margin(window) + step * cell
            for phase, cell in zip(self.phase, self.cells, strict=True)
        ]
        cut = functools.partial(lax.dynamic_slice, slice_sizes=(s, s, kept.shape[-1]))
        return jax.vmap(lambda row, column: cut(kept, (row, column, 0)), out_axes=2)(*corner)

    def _scale(self, x: Array, slope: Array) -> Array:
        """The tangents of every cell times a slope, or where it is a mask, kept."""
        split, slope = self._per_cell(x), slope[:, :, None]
        scaled = jnp.where(slope, split, 0) if slope.dtype == bool else slope * split
        return scaled.reshape(x.shape)


def margin(window: Window) -> int:
    """How far a cell's window can reach beyond the image."""
    return window.size + int(np.abs(window.origin).max())


def filtered(window: Window, node: g.Filter) -> Window:
    """The pixels whose values a filter's window reads."""
    return Window(window.origin - node.size // 2, window.size + node.size - 1)
