"""The exact divergence: by unit vectors, by colouring, and by cones."""

import dataclasses
import logging
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.denoisers import graph
from progden_jax.divergence import cone
from progden_jax.divergence._base import Evaluation, Function

ALGORITHMS = ("auto", "basis", "coloring", "cone")

logger = logging.getLogger(__name__)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Exact:
    """σ²·∂f/∂x without error but rounding; the key is not used and the standard error is 0.

    Parameters
    ----------
    algorithm :
        "basis": one tangent per pixel and channel, 3HW in all; any f.
        "coloring": pixels further apart than f reaches share a tangent: 3(R + 1)² of them, more where
            pooling aligns f to blocks; any f whose `reach` is given or known.
        "cone": through windows of a few pixels in a network whose layers f shows (`f.layered`, as those of
            `progden_jax.denoisers` do): about 400 forward passes for OIDN's base network and 200 for
            the project's KPCN, at any size.
        "auto": the cheapest of those that apply; `cost` says what each would take.
    reach : (radius, alignment) in pixels for "coloring": f(x)_q depends on x_p only within `radius`, in a way
        that repeats every `alignment` pixels. None: as f says of itself.
    chunk : tangents at once ("basis", "coloring") or pixels at once ("cone"); memory grows with it.
        None: as many as make efficient products.
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
    ) -> Evaluation:
        del key
        algorithm = self.algorithm
        if algorithm == "auto":
            costs = self.cost(f, x)
            algorithm = min(costs, key=lambda name: costs[name])
            logger.info("exact divergence by %s; costs in forward passes: %s", algorithm, costs)
        if algorithm == "cone":
            value, diagonal = self._by_cone(f, x)
        else:
            value, tangent = jax.linearize(f, x)
            colors = np.arange(x.size).reshape(x.shape)
            if algorithm == "coloring":
                colors = _coloring(self._period(f), x.shape)
            diagonal = _diagonal_by_colors(tangent, colors, x, self.chunk or 4)
        return Evaluation(value, variance * diagonal, jnp.zeros_like(value))

    def cost(self, f: Function, x: Float[Array, "h w 3"]) -> dict[str, float]:
        """What each algorithm that applies to f would take at x's size, in forward passes of f.

        A tangent pass counts as one. "cone" counts multiply-adds of its products against the network's.
        """
        costs = {"basis": float(x.size)}
        if self.reach is not None or hasattr(f, "receptive_radius"):
            costs["coloring"] = float(_coloring(self._period(f), x.shape).max() + 1)
        if hasattr(f, "layered"):
            nodes, params = f.layers  # pyright: ignore[reportFunctionMemberAccess]
            plan = cone.plan(nodes, params)
            costs["cone"] = cone.multiply_adds(plan, params) / graph.multiply_adds(nodes, params)
        return costs

    def _period(self, f: Function) -> int:
        """Pixels apart that two share no output: the least multiple of the alignment beyond the reach."""
        if self.reach is not None:
            radius, alignment = self.reach
        elif hasattr(f, "receptive_radius"):
            radius, alignment = f.receptive_radius, f.alignment  # pyright: ignore[reportFunctionMemberAccess]
        else:
            raise ValueError(
                "algorithm is 'coloring' and nothing is known of how far f reaches: give "
                "Exact('coloring', reach=(radius, alignment)) in pixels, or use algorithm='basis'."
            )
        return -(-(radius + 1) // alignment) * alignment

    def _by_cone(self, f: Function, x: Array) -> tuple[Array, Array]:
        if not hasattr(f, "layered"):
            raise ValueError(
                f"algorithm is 'cone', which looks inside the network, and f, a {type(f).__name__}, does "
                "not show its layers: bind one of progden_jax's denoisers, give f `layers` and `layered` "
                "(see progden_jax.denoisers.graph), or use algorithm='basis' or 'coloring'."
            )
        layered: graph.Layered = f.layered(x)  # pyright: ignore[reportFunctionMemberAccess]
        height, width = x.shape[:2]
        output, kept = graph.evaluate(
            layered.nodes, layered.params, layered.inputs, inside=layered.inside
        )
        plan = cone.plan(layered.nodes, layered.params)
        diagonal = cone.jacobian_diagonal(
            plan,
            layered.params,
            kept,
            (layered.inputs.shape[0], layered.inputs.shape[1]),
            # Windows of 32 pixels stay in a core's cache; a GPU wants more to do at once.
            chunk=self.chunk or (32 if jax.default_backend() == "cpu" else 1024),
            precision=lax.Precision.HIGHEST,
        )
        inner = output[:height, :width]
        value, slope = jax.jvp(layered.decode, (inner,), (jnp.ones_like(inner),))
        return value, slope * diagonal[:height, :width] * layered.encode_slope


def _coloring(period: int, shape: tuple[int, ...]) -> np.ndarray:
    """Colours (H, W, 3) from 0 up, such that equal ones are `period` pixels apart in a row or column."""
    height, width, channels = shape
    rows, columns = (np.arange(n) % min(period, n) for n in (height, width))
    color = rows[:, None] * (columns.max() + 1) + columns[None, :]
    return color[..., None] * channels + np.arange(channels)


def _diagonal_by_colors(tangent: Any, colors: np.ndarray, x: Array, chunk: int) -> Array:
    """Σ over colours k of (1_k ⊙ J 1_k)."""
    count = int(colors.max()) + 1
    painted = jnp.asarray(colors)

    def add(total: Array, indices: Array) -> tuple[Array, None]:
        def one(index: Array) -> Array:
            lit = painted == index
            return jnp.where(lit, tangent(lit.astype(x.dtype)), 0)

        return total + jax.vmap(one)(indices).sum(0), None

    chunk = min(chunk, count)
    padded = jnp.arange(-(-count // chunk) * chunk).reshape(-1, chunk)
    return lax.scan(add, jnp.zeros_like(x), padded)[0]
