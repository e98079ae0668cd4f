"""The exact diagonal of a network's Jacobian from windows of a few pixels.

For ∂f_p/∂x_p only what lies both in the forward cone of input pixel p and in the backward cone of output
pixel p matters: at every layer a window of a few pixels around p. A primal pass keeps which ReLUs pass
and which of four values won each pooling; then the unit tangents of the three channels at p go
through the windows alone. Pixels of equal phase (position modulo the largest stride) see equal
windows and form one batch; offsets that differ between phases are traced, so one program serves all.
"""

import math
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from progden_jax.denoisers import graph as g
from progden_jax.divergence._sweep import Prepared, Sweep, filtered, margin
from progden_jax.divergence.windows import Part, Plan, Window, convolutions


def prepare(plan: Plan, params: Any, kept: dict[int, Any]) -> Prepared:
    """What sweeps need: made once, not per chunk, for at 1080p OIDN's masks are half a GiB.

    `kept` is what `graph.evaluate` gives.
    """
    found = {}
    for index, arrays in kept.items():
        window, node = plan.windows[index], plan.nodes[index]
        if window is None:
            continue
        if isinstance(node, g.Filter):
            found[index] = g.Weighted(
                _surround(arrays.weights, window, 0),
                _surround(arrays.image, filtered(window, node), 0),
                _surround(arrays.result, window, 0),
            )
        else:
            # A pooling's codes are 0 to 3: with 4 none of four has won.
            found[index] = _surround(arrays, window, 4 if isinstance(node, g.MaxPool) else 0)
    kernels = {
        index: [_at_points(part, jnp.asarray(params[node.layer]["kernel"])) for part in parts]
        for index, (node, parts) in convolutions(plan, params).items()
    }
    return Prepared(found, kernels)


def _at_points(part: Part, kernel: Array) -> Array:
    points = jnp.asarray(part.axis.points, kernel.dtype)
    exactly = lax.Precision.HIGHEST
    return jnp.einsum(
        "apj,bqi,ijcf->abpqcf", points, points, kernel[:, :, part.channels], precision=exactly
    )


def _of_phase(plan: Plan, params: Any, prepared: Prepared, place: tuple[Array, Array]) -> Prepared:
    def taken(part: Part, kernel: Array) -> Array:
        row, column = (jnp.asarray(part.axis.kind)[phase] for phase in place)
        return kernel[column, row]

    kernels = {
        index: [taken(*both) for both in zip(parts, prepared.kernels[index], strict=True)]
        for index, (_, parts) in convolutions(plan, params).items()
    }
    return prepared._replace(kernels=kernels)


def _surround(array: Array, window: Window, outside: int) -> Array:
    widths = [(margin(window), margin(window))] * 2 + [(0, 0)]
    return jnp.pad(array, widths, constant_values=outside)


def jacobian_diagonal(
    plan: Plan,
    params: Any,
    kept: dict[int, Any],
    size: tuple[int, int],
    *,
    chunk: int,
    precision: Any,
) -> Float[Array, "h w 3"]:
    """∂output_pc/∂input_pc of a network at every pixel and channel, (H, W, 3), over all phases.

    `kept` is what `graph.evaluate` gives.
    """
    prepared = prepare(plan, params, kept)
    count = cells_per_phase(plan, size)
    rows = lax.map(
        lambda phase: some_cells(
            plan, params, prepared, size, phase, 0, count, chunk=chunk, precision=precision
        ),
        jnp.arange(plan.period**2),
    )
    return assemble(rows, size, plan.period)


def assemble(rows: Any, size: tuple[int, int], period: int) -> Any:
    """The image (H, W, 3) from its phases' cells, (period², cells, 3), of JAX or NumPy."""
    height, width = size
    split = rows.reshape(period, period, height // period, width // period, 3)
    return split.transpose(2, 0, 3, 1, 4).reshape(height, width, 3)


def cells_per_phase(plan: Plan, size: tuple[int, int]) -> int:
    """Pixels of each phase in a padded image of this size."""
    return (size[0] // plan.period) * (size[1] // plan.period)


def some_cells(
    plan: Plan,
    params: Any,
    prepared: Prepared,
    size: tuple[int, int],
    phase: Array,
    first: Array | int,
    number: int,
    *,
    chunk: int,
    precision: Any,
) -> Float[Array, "cells 3"]:
    """The diagonal at `number` pixels of a phase from the `first` on, `chunk` of them at once.

    `phase` and `first` may be traced. Beyond the last pixel of the phase the last one is repeated.
    """
    chunk, last = min(chunk, number), cells_per_phase(plan, size) - 1
    numbers = first + jnp.arange(-(-number // chunk) * chunk)
    cells = jnp.minimum(numbers, last).reshape(-1, chunk)
    found = these_cells(
        *(plan, params, prepared, size, phase, cells), pixels=math.prod(size), precision=precision
    )
    return found[:number]


def these_cells(
    plan: Plan,
    params: Any,
    prepared: Prepared,
    size: tuple[int, int],
    phase: Array,
    cells: Int[Array, "chunks chunk"],
    *,
    pixels: int,
    precision: Any,
) -> Float[Array, "cells 3"]:
    """The diagonal at the pixels of a phase with these numbers, a chunk of them at once.

    `pixels` is how many the program will serve in all phases.
    """
    across, place = size[1] // plan.period, (phase // plan.period, phase % plan.period)
    prepared = _of_phase(plan, params, prepared, place)

    def some(cells: Array) -> Array:
        split = (cells // across, cells % across)
        sweep = Sweep(plan, params, prepared, place, split, pixels, precision)
        return jnp.diagonal(sweep.run(), axis1=1, axis2=2)

    return lax.map(some, cells).reshape(-1, 3)


def replaced_where_largest(
    plan: Plan,
    params: Any,
    kept: dict[int, Any],
    diagonal: Float[Array, "h w 3"],
    weight: Float[Array, "h w"],
    share: float,
    *,
    chunk: int,
    precision: Any,
) -> Float[Array, "h w 3"]:
    """The diagonal with this plan's at a share of the pixels: of each phase those of the largest weight."""
    prepared, period = prepare(plan, params, kept), plan.period
    size = weight.shape[0], weight.shape[1]
    rows, columns = size[0] // period, size[1] // period
    count = chosen_per_phase(plan, size, share)
    chunk = min(chunk, count)
    by_phase = weight.reshape(rows, period, columns, period).transpose(1, 3, 0, 2)
    # The barrier keeps XLA from sorting a constant while it compiles, which takes minutes.
    by_phase = lax.optimization_barrier(by_phase.reshape(period**2, rows * columns))

    def of_phase(phase: Array) -> tuple[Array, Array]:
        cells = lax.top_k(by_phase[phase], count)[1]
        padded = jnp.pad(cells, (0, -count % chunk), mode="edge").reshape(-1, chunk)
        found = these_cells(
            *(plan, params, prepared, size, phase, padded),
            pixels=count * period**2,
            precision=precision,
        )
        return cells, found[:count]

    phases = jnp.arange(period**2)
    cells, found = lax.map(of_phase, phases)
    row = period * (cells // columns) + (phases // period)[:, None]
    column = period * (cells % columns) + (phases % period)[:, None]
    return diagonal.at[row, column].set(found)


def chosen_per_phase(plan: Plan, size: tuple[int, int], share: float) -> int:
    """Pixels of each phase that a share of all of them comes to, at least one."""
    return math.ceil(share * cells_per_phase(plan, size))
