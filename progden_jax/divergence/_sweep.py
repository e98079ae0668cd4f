"""The tangents of a batch of pixels through the windows that matter for the exact diagonal, see `cone`."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax.denoisers import graph as g
from progden_jax.divergence.windows import Plan, Window, shifting, split_channels


class Sweep:
    """The tangents of one batch of cells: pixels of one phase, three unit directions each."""

    def __init__(
        self,
        plan: Plan,
        params: Any,
        kept: dict[int, Any],
        phase: tuple[Array, Array],
        cells: tuple[Array, Array],
        precision: Any,
    ) -> None:
        self.plan, self.params, self.kept = plan, params, kept
        self.phase, self.cells, self.precision = phase, cells, precision

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
                    value = jnp.broadcast_to(
                        unit[None, :, None, None], (number, 3, 1, 1, unit.shape[1])
                    )
                    value = value.reshape(3 * number, 1, 1, -1)
                case g.Conv():
                    value = self._convolve(node, window, values)
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
        return last.reshape(-1, 3, last.shape[-1])

    def _dtype(self) -> Any:
        return jax.tree.leaves(self.params)[0].dtype

    def _window(self, index: int) -> Window:
        window = self.plan.windows[index]
        assert window is not None
        return window

    def _read(self, values: dict[int, Array], window: Window, source: int) -> Array:
        """A node's tangents in the window of one that reads it, which may be narrower."""
        return self._move(values[source], self._window(source), window)

    def _convolve(self, node: g.Conv, window: Window, values: dict[int, Array]) -> Array:
        kernel = self.params[node.layer]["kernel"]
        total = None
        for source, part in zip(
            node.sources, split_channels(self.plan, self.params, node), strict=True
        ):
            if source not in values:
                continue
            weights = kernel[:, :, part]
            if isinstance(self.plan.nodes[source], g.Upsample):
                below = self.plan.nodes[source]
                assert isinstance(below, g.Upsample)
                added = self._convolve_upsampled(
                    values[source],
                    self._window(below.source),
                    self.plan.levels[source],
                    weights,
                    window,
                )
            else:
                added = self._convolve_window(values[source], self._window(source), weights, window)
            total = added if total is None else total + added
        assert total is not None
        return total

    def _convolve_window(self, x: Array, source: Window, weights: Array, target: Window) -> Array:
        """The convolution of a window, zero around it, as far as the target window goes."""
        r = weights.shape[0] // 2
        if shifting(source, target):
            if source.size < target.size:
                wide = Window(source.origin - r, source.size + 2 * r)
                return self._move(self._convolve_window(x, source, weights, wide), wide, target)
            wide = Window(target.origin - r, target.size + 2 * r)
            x, source = self._move(x, source, wide), wide
        before = r - int(target.origin[0] - source.origin[0])
        padding = (before, target.size - source.size - before + 2 * r)
        return lax.conv_general_dilated(
            x,
            weights,
            (1, 1),
            (padding, padding),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=self.precision,
        )

    def _product(self, x: Array, weights: Array) -> Array:
        flat = jnp.matmul(x.reshape(-1, x.shape[-1]), weights, precision=self.precision)
        return flat.reshape(*x.shape[:-1], weights.shape[-1])

    def _convolve_upsampled(
        self, x: Array, source: Window, level: int, weights: Array, target: Window
    ) -> Array:
        """3×3 after nearest upsampling, as 2×2 on what was upsampled: 4 products for 9.

        Of an upsampled position v, odd ones see their parent with weights 0 + 1 and the next with 2; even
        ones the parent before with 0 and their own with 1 + 2. Which target positions are odd
        depends on the phase, so weights and starts are chosen by it.
        """
        folded = []
        for even in (False, True):
            rows = (
                (weights[0], weights[1] + weights[2])
                if even
                else (weights[0] + weights[1], weights[2])
            )
            folded.append(
                [
                    [
                        (row[0], row[1] + row[2]) if e else (row[0] + row[1], row[2])
                        for e in (False, True)
                    ]
                    for row in rows
                ]
            )
        # (row parity, column parity, tap row, tap column, in, out)
        kernels = jnp.stack(
            [
                jnp.stack(
                    [jnp.stack([jnp.stack(folded[er][tr][ec]) for tr in (0, 1)]) for ec in (0, 1)]
                )
                for er in (0, 1)
            ]
        )
        grid = np.arange(len(target.origin))
        # Absolute upsampled positions of the targets, and the parents they begin at.
        first = (grid >> level) + target.origin
        parent_origin = (grid >> (level + 1)) + source.origin
        blocks = []
        for row_class in (0, 1):
            row_count = (target.size - row_class + 1) // 2
            rows, row_even = self._parents(
                first + row_class, parent_origin, source.size, row_count, 0
            )
            line = []
            for column_class in (0, 1):
                count = (target.size - column_class + 1) // 2
                columns, even = self._parents(
                    first + column_class, parent_origin, source.size, count, 1
                )
                taken = self._take(x, rows, columns, row_count + 1, count + 1, source.size)
                # The four taps side by side make one product: (4 in, out).
                corners = [
                    taken[:, i : i + row_count, j : j + count] for i in (0, 1) for j in (0, 1)
                ]
                kernel = kernels[row_even, even].reshape(-1, weights.shape[-1])
                line.append(self._product(jnp.concatenate(corners, axis=-1), kernel))
            blocks.append(_interleave(line[0], line[1], 2, target.size))
        return _interleave(blocks[0], blocks[1], 1, target.size)

    def _parents(
        self, positions: np.ndarray, origin: np.ndarray, size: int, count: int, axis: int
    ) -> tuple[Array, Array]:
        """Where in the parents' window the pairs of every second position begin, and its parity."""
        starts = ((positions - 1) >> 1) - origin
        phase = self.phase[axis]
        return jnp.asarray(starts)[phase], jnp.asarray(1 - (positions & 1))[phase]

    def _take(
        self, x: Array, row: Array, column: Array, rows: int, columns: int, size: int
    ) -> Array:
        """A part of a window that may begin before it or end after it, where it is zero."""
        pad = max(rows, columns)
        x = jnp.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
        return lax.dynamic_slice(
            x, (0, row + pad, column + pad, 0), (x.shape[0], rows, columns, x.shape[3])
        )

    def _move(self, x: Array, source: Window, target: Window) -> Array:
        """A window cut out of another, zero where they do not overlap."""
        for axis in (0, 1):
            shift = target.origin - source.origin
            low = max(0, -int(shift.min()))
            high = max(0, int(shift.max()) + target.size - source.size)
            widths = [(0, 0)] * x.ndim
            widths[axis + 1] = (low, high)
            x = jnp.pad(x, widths)
            start = jnp.asarray(shift + low)[self.phase[axis]]
            if (shift == shift[0]).all():
                x = lax.slice_in_dim(
                    x, int(shift[0]) + low, int(shift[0]) + low + target.size, axis=axis + 1
                )
            else:
                x = lax.dynamic_slice_in_dim(x, start, target.size, axis + 1)
        return x

    def _pool(self, index: int, node: g.MaxPool, window: Window, x: Array) -> Array:
        """Each pooled tangent is that of the value that won."""
        level = self.plan.levels[index]
        grid = np.arange(len(window.origin))
        start = 2 * ((grid >> level) + window.origin) - (grid >> (level - 1))
        x = self._move(x, self._window(node.source), Window(start, 2 * window.size))
        batch, _, _, channels = x.shape
        s = window.size
        cells = x.reshape(batch, s, 2, s, 2, channels)
        codes = self._around(self.kept[index], index, window)
        total = None
        for code in range(4):
            part = self._scale(cells[:, :, code // 2, :, code % 2], codes == code)
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
        around = g.patches(self._around(kept.image, index, wide), node.size)
        away = weights * (around - self._around(kept.result, index, window)[..., None, :])
        parts = []
        if node.image in values:
            image = self._per_cell(self._read(values, wide, node.image))
            parts.append((weights[:, None] * g.patches(image, node.size)).sum(-2))
        if node.logits in values:
            logits = self._per_cell(self._read(values, window, node.logits))
            product = jnp.einsum("nhwtc,ndhwt->ndhwc", away, logits, precision=self.precision)
            parts.append(product)
        total = parts[0] if len(parts) == 1 else parts[0] + parts[1]
        return total.reshape(-1, *total.shape[2:])

    def _per_cell(self, x: Array) -> Array:
        """(cells·3, ...) as (cells, 3, ...)."""
        return x.reshape(self.cells[0].shape[0], -1, *x.shape[1:])

    def _slope(self, index: int, window: Window) -> Array:
        """What the primal pass kept of a pointwise layer, 0 or False beyond the image."""
        return self._around(self.kept[index], index, window)

    def _around(self, kept: Array, index: int, window: Window) -> Array:
        """What the primal pass kept, with its `surround`, in every cell's window: (cells, s, s, C)."""
        level, s = self.plan.levels[index], window.size
        step = self.plan.period >> level
        corner = [
            (phase >> level) + jnp.asarray(window.origin)[phase] + margin(window) + step * cell
            for phase, cell in zip(self.phase, self.cells, strict=True)
        ]
        cut = functools.partial(lax.dynamic_slice, slice_sizes=(s, s, kept.shape[-1]))
        return jax.vmap(lambda row, column: cut(kept, (row, column, 0)))(*corner)

    def _scale(self, x: Array, slope: Array) -> Array:
        """The tangents of every cell times a slope, or where it is a mask, kept."""
        split, slope = self._per_cell(x), slope[:, None]
        scaled = jnp.where(slope, split, 0) if slope.dtype == bool else slope * split
        return scaled.reshape(x.shape)


def _interleave(first: Any, second: Any, axis: int, size: int) -> Array:
    """first[0], second[0], first[1], ...: `size` of them."""
    if first.shape[axis] > second.shape[axis]:
        widths = [(0, 0)] * second.ndim
        widths[axis] = (0, 1)
        second = jnp.pad(second, widths)
    stacked = jnp.stack([first, second], axis=axis + 1)
    shape = list(first.shape)
    shape[axis] *= 2
    return lax.slice_in_dim(stacked.reshape(shape), 0, size, axis=axis)


def margin(window: Window) -> int:
    """How far a cell's window can reach beyond the image."""
    return window.size + int(np.abs(window.origin).max())


def filtered(window: Window, node: g.Filter) -> Window:
    """The pixels whose values a filter's window reads."""
    return Window(window.origin - node.size // 2, window.size + node.size - 1)
