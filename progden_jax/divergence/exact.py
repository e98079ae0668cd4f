"""The exact divergence: by unit vectors, by colouring, and by cones."""

import contextlib
import dataclasses
import logging
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.denoisers import graph
from progden_jax.divergence import _reach, cone, windows
from progden_jax.divergence._base import Evaluation, Function, Origin

ALGORITHMS = ("auto", "basis", "coloring", "cone")

COLORS_AT_ONCE = 4
"""Tangents at once, by unit vectors and colours, unless `chunk` says otherwise."""

TIME_PER_PASS = {"basis": 1.0, "coloring": 1.0, "cone": 2.5}
"""Time of one pass by `Exact.cost`, in forward passes. Products of small windows and the sums around them
are slower than whole images' convolutions, and leave cores idle: with OIDN's base network at 256×256 189
passes take as long as 481 forward passes, 283 by `exact_divergence`, which runs steps side by side
(experiments/divergence, two cores of a CPU; not measured on GPUs)."""

logger = logging.getLogger(__name__)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Exact:
    """σ²·∂f/∂x without error but rounding; the key is not used and the standard error is 0.

    Where it takes minutes, `exact_divergence` shows progress and can be interrupted and resumed.

    Parameters
    ----------
    algorithm :
        "basis": one tangent per pixel and channel, 3HW in all; any f.
        "coloring": pixels further apart than f reaches share a tangent: 3(R + 1)² of them. How far that is is
            found from f's jaxpr, along rows and columns apart, at x's size; strides, pooling,
            upsampling and all that does not depend on x are followed. Where it cannot be found, an error
            names the primitive that hinders it: give `reach`, or use "basis".
        "cone": through windows of a few pixels in a network whose layers f shows (``f.layered``, as those of
            `progden_jax.denoisers` do): the operations of about 190 forward passes for OIDN's base network
            and 90 for the project's KPCN, at any size.
        "auto": the quickest of those that apply, as `time` expects it; `cost` counts operations.
    reach : (radius, alignment) in pixels for "coloring": f(x)_q depends on x_p only within that radius, in
        a way that repeats at the alignment. None: as f says of itself (``f.receptive_radius``), or found.
    chunk : tangents at once ("basis", "coloring") or pixels at once ("cone"); memory grows with it.
        None: as many as make efficient products. In trials it changed no bits, but for "cone" with
        chunks under 5, where matrix products of few rows round differently (2e-7 relative).

    Notes
    -----
    Passes through ``jit``, ``vmap`` and ``grad``. Reverse-mode gradients in f's parameters keep the
    residuals of every tangent: memory grows with the cost in passes, so train on small crops. Through ReLUs
    and max pooling J is piecewise constant in x and in biases: its gradient has only what weights and
    smooth parts (transfer functions) give, and misses what kinks that move would add.

    The reach comes from an analysis of our own: that of the asdex library (0.5) lists every entry of the
    Jacobian (10 s for three layers at 64×64), lacks reduce_window and colours for the whole Jacobian
    (147 colours where the diagonal takes 48).
    """

    algorithm: str = "auto"
    reach: tuple[int, int] | None = None
    chunk: int | None = None

    def __post_init__(self) -> None:
        _checks.choice("algorithm", self.algorithm, ALGORITHMS)
        if self.chunk is not None:
            _checks.positive_int("chunk", self.chunk)
        if self.reach is not None:
            _checks.positive_int("reach[1]", self.reach[1])
            if self.reach[0] < 0:
                raise ValueError(f"reach is {self.reach}, expected a radius of at least 0 pixels.")

    def evaluate(
        self,
        f: Function,
        x: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        key: jax.Array,
        *,
        origin: Origin = (0, 0),
    ) -> Evaluation:
        del key, origin
        algorithm = self.choose(f, x)
        if algorithm == "cone":
            value, diagonal = by_cone(f, x, self.chunk)
        else:
            value, tangent = jax.linearize(f, x)
            colors = self.colors(f, x, algorithm)
            diagonal = _diagonal_by_colors(tangent, colors, x, self.chunk or COLORS_AT_ONCE)
        return Evaluation(value, variance * diagonal, jnp.zeros_like(value))

    def choose(self, f: Function, x: Float[Array, "h w 3"]) -> str:
        """The algorithm itself, or in place of "auto" the quickest."""
        if self.algorithm != "auto":
            return self.algorithm
        times = self.time(f, x)
        algorithm = min(times, key=lambda name: times[name])
        logger.info("exact divergence by %s; times in forward passes: %s", algorithm, times)
        return algorithm

    def time(self, f: Function, x: Float[Array, "h w 3"]) -> dict[str, float]:
        """How long each algorithm that applies to f is expected to take, in the time of a forward pass of f.

        What `cost` counts, times the measured `TIME_PER_PASS`; without compilation.
        """
        return {name: TIME_PER_PASS[name] * cost for name, cost in self.cost(f, x).items()}

    def cost(self, f: Function, x: Float[Array, "h w 3"]) -> dict[str, float]:
        """What each algorithm that applies to f would compute at x's size, in forward passes of f.

        A tangent pass counts as one. "cone" counts multiply-adds of its products against the network's.
        """
        costs = {"basis": float(x.size)}
        with contextlib.suppress(_reach.UnknownReachError):
            costs["coloring"] = float(self.colors(f, x, "coloring").max() + 1)
        if hasattr(f, "layered"):
            nodes, params = f.layers  # pyright: ignore[reportFunctionMemberAccess]
            costs["cone"] = cone_cost(nodes, params)
        return costs

    def colors(self, f: Function, x: Float[Array, "h w 3"], algorithm: str) -> np.ndarray:
        """Colours (H, W, 3) from 0 up: those of one colour share a tangent."""
        if algorithm == "basis":
            return np.arange(x.size).reshape(x.shape)
        return _coloring(self._periods(f, x), x.shape)

    def _periods(self, f: Function, x: Array) -> tuple[int, int]:
        """Rows and columns apart that two pixels share no output."""
        if self.reach is not None:
            radius, alignment = self.reach
        elif hasattr(f, "receptive_radius"):
            radius, alignment = f.receptive_radius, f.alignment  # pyright: ignore[reportFunctionMemberAccess]
        else:
            try:
                rows, columns = _reach.radii(f, x)
            except _reach.UnknownReachError as error:
                raise _reach.UnknownReachError(
                    f"algorithm is 'coloring', and how far f reaches cannot be found: {error}. Give "
                    "Exact('coloring', reach=(radius, alignment)) in pixels, or use algorithm='basis'."
                ) from None
            return rows + 1, columns + 1
        period = -(-(radius + 1) // alignment) * alignment
        return period, period


def check_layered(f: Function) -> None:
    """Raise unless f shows its layers."""
    if not hasattr(f, "layered"):
        raise ValueError(
            f"cones look inside the network, and f, a {type(f).__name__}, does not show its layers: bind one "
            "of progden_jax's denoisers, give f `layers` and `layered` (see progden_jax.denoisers.graph), "
            "or use Exact('basis') or Exact('coloring')."
        )


def by_cone(f: Function, x: Array, chunk: int | None = None) -> tuple[Array, Array]:
    """f(x) and ∂f/∂x at every pixel and channel, by windows; ValueError if f shows no layers."""
    layered = layers_of(f, x)
    value, slope, kept = cone_primal(layered, x)
    diagonal = cone.jacobian_diagonal(
        windows.plan(layered.nodes, layered.params),
        layered.params,
        kept,
        (layered.inputs.shape[0], layered.inputs.shape[1]),
        chunk=chunk or cone_chunk(),
        precision=lax.Precision.HIGHEST,
    )
    return value, slope * diagonal[: x.shape[0], : x.shape[1]]


def layers_of(f: Function, x: Array) -> graph.Layered:
    """What f shows of itself at x; ValueError if it shows nothing."""
    check_layered(f)
    return f.layered(x)  # pyright: ignore[reportFunctionMemberAccess]


def cone_cost(nodes: Sequence[graph.Node], params: Any, **limits: Any) -> float:
    """Multiply-adds of the windows within the `limits` of `windows.plan`, in forward passes."""
    plan = windows.plan(nodes, params, **limits)
    return windows.multiply_adds(plan, params) / graph.multiply_adds(nodes, params)


def cone_chunk() -> int:
    """Windows of 16 pixels stay in a core's cache; a GPU wants more to do at once."""
    return 16 if jax.default_backend() == "cpu" else 1024


def cone_primal(layered: graph.Layered, x: Array) -> tuple[Array, Array, dict[int, Array]]:
    """f(x), what the network's diagonal is to be multiplied by, and what the sweeps need."""
    output, kept = graph.evaluate(
        layered.nodes, layered.params, layered.inputs, inside=layered.inside
    )
    inner = output[: x.shape[0], : x.shape[1]]
    value, slope = jax.jvp(layered.decode, (inner,), (jnp.ones_like(inner),))
    return value, slope * layered.encode_slope, kept


def _coloring(periods: tuple[int, int], shape: tuple[int, ...]) -> np.ndarray:
    """Colours such that equal ones are a period or more apart in a row or column."""
    rows, columns = (np.arange(n) % p for n, p in zip(shape[:2], periods, strict=True))
    color = rows[:, None] * (columns.max() + 1) + columns[None, :]
    return color[..., None] * shape[2] + np.arange(shape[2])


def some_colors(tangent: Any, painted: Array, numbers: Array, dtype: Any) -> Array:
    """Σ over colours k of 1_k ⊙ J 1_k."""

    def one(number: Array) -> Array:
        lit = painted == number
        return jnp.where(lit, tangent(lit.astype(dtype)), 0)

    return jax.vmap(one)(numbers).sum(0)


def _diagonal_by_colors(tangent: Any, colors: np.ndarray, x: Array, chunk: int) -> Array:
    count = int(colors.max()) + 1
    chunk = min(chunk, count)
    painted = jnp.asarray(colors)
    numbers = jnp.arange(-(-count // chunk) * chunk).reshape(-1, chunk)

    def add(total: Array, some: Array) -> tuple[Array, None]:
        return total + some_colors(tangent, painted, some, x.dtype), None

    return lax.scan(add, jnp.zeros_like(x), numbers)[0]
