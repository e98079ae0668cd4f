"""The exact diagonal of a network's Jacobian from windows of a few pixels.

For ∂f_p/∂x_p only what lies both in the forward cone of input pixel p and in the backward cone of output
pixel p matters: at every layer a window of a few pixels around p. A primal pass keeps which ReLUs pass
and which of four values won each pooling; then the unit tangents of the three channels at p go
through the windows alone. Pixels of equal phase (position modulo the largest stride) see equal
windows and form one batch; offsets that differ between phases are traced, so one program serves all.
"""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax.denoisers import graph as g
from progden_jax.divergence._sweep import Sweep, filtered, margin
from progden_jax.divergence.windows import Plan, Window


def surround(plan: Plan, kept: dict[int, Any]) -> dict[int, Any]:
    """What the primal pass kept, wherever windows are, with a margin that lets no tangent through.

    Made once, not per chunk: at 1080p OIDN's masks are half a GiB.
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
    return found


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
    kept = surround(plan, kept)
    count = cells_per_phase(plan, size)
    rows = lax.map(
        lambda phase: some_cells(
            plan, params, kept, size, phase, 0, count, chunk=chunk, precision=precision
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
    surrounded: dict[int, Any],
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
    period = plan.period
    across, last = size[1] // period, cells_per_phase(plan, size) - 1
    chunk = min(chunk, number)
    place = (phase // period, phase % period)

    def some(start: Array) -> Array:
        cells = jnp.minimum(start + jnp.arange(chunk), last)
        split = (cells // across, cells % across)
        sweep = Sweep(plan, params, surrounded, place, split, precision)
        return jnp.diagonal(sweep.run(), axis1=1, axis2=2)

    found = lax.map(some, first + jnp.arange(0, number, chunk))
    return found.reshape(-1, 3)[:number]
