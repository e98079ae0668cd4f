"""The divergence by cones that end early: nearly exact, for a fraction of an exact one's cost."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.divergence import cone, windows
from progden_jax.divergence._base import Evaluation, Function, Origin
from progden_jax.divergence.exact import (
    check_layered,
    cone_chunk,
    cone_cost,
    cone_primal,
    layers_of,
)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class TruncatedCone:
    """`Exact("cone")` without what a pixel sends itself through the network's coarse levels.

    In a network that pools, ∂f_p/∂x_p comes almost wholly from paths through its finest levels, and nearly
    all of the work of exact cones is in the coarse ones. Here pooling below `levels` counts as constant.
    There are no probes and no noise: the key is not used, and what is left out is a bias, of either sign,
    whose size f does not tell (standard error inf). What it costs with OIDN's base network: 3 forward passes
    with one level, 19 with two, 52 with three, and 189 times the share `whole`.

    Parameters
    ----------
    levels : resolutions that tangents go through, 1 the full one alone. As many as the network has, or more,
        with `radius` None: exact.
    radius : pixels that windows reach to either side, at least 1: of the coarsest level that is kept, in its
        own pixels, or a tuple of each level's from the finest on. None: as far as there is a path from a
        pixel to itself. In a network that doesn't pool this bounds all windows.
    whole : the share of pixels, those of the largest variance, that get the whole windows of `Exact("cone")`:
        a few hold most of σ²·∂f/∂x where there are fireflies. Of each position modulo the network's stride
        at least one; 0 for none.
    chunk : pixels at once; memory grows with it. None: as many as make efficient products.

    Raises
    ------
    ValueError
        If a setting is out of range, or, from what uses it, if f shows no layers (see `Exact`).

    Notes
    -----
    Passes through ``jit``, ``vmap`` and ``grad``, as `Exact` does. Measured in experiments/divergence.
    """

    levels: int = 2
    radius: int | tuple[int, ...] | None = 1
    whole: float = 1 / 16
    chunk: int | None = None

    def __post_init__(self) -> None:
        _checks.positive_int("levels", self.levels)
        each = self.radius if isinstance(self.radius, tuple) else (self.radius,)
        for radius in each:
            if radius is not None:
                _checks.positive_int("radius", radius)
        if isinstance(self.radius, tuple) and len(self.radius) != self.levels:
            raise ValueError(
                f"radius is {self.radius} and levels is {self.levels}: expected one number per level."
            )
        if not 0 <= self.whole <= 1:
            raise ValueError(f"whole is {self.whole}, expected a share of the pixels from 0 to 1.")
        if self.chunk is not None:
            _checks.positive_int("chunk", self.chunk)

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
        layered = layers_of(f, x)
        value, slope, kept = cone_primal(layered, x)
        size = layered.inputs.shape[0], layered.inputs.shape[1]
        how = {"chunk": self.chunk or cone_chunk(), "precision": lax.Precision.HIGHEST}
        network = layered.nodes, layered.params
        short = windows.plan(*network, levels=self.levels, radius=self.radius)
        diagonal = cone.jacobian_diagonal(short, layered.params, kept, size, **how)
        if self.whole:
            padding = [(0, whole - part) for whole, part in zip(size, x.shape, strict=False)]
            weight = jnp.pad(lax.stop_gradient(variance).max(-1), padding, constant_values=-1)
            diagonal = cone.replaced_where_largest(
                *(windows.plan(*network), layered.params, kept, diagonal, weight, self.whole), **how
            )
        diagonal = slope * diagonal[: x.shape[0], : x.shape[1]]
        return Evaluation(value, variance * diagonal, jnp.full_like(value, jnp.inf))

    def cost(self, f: Function, x: Float[Array, "h w 3"]) -> float:
        """Multiply-adds of the windows against the network's: forward passes beside the one for f(x)."""
        check_layered(f)
        nodes, params = f.layers  # pyright: ignore[reportFunctionMemberAccess]
        short = cone_cost(nodes, params, levels=self.levels, radius=self.radius)
        if not self.whole:
            return short
        plan = windows.plan(nodes, params)
        height, width = (-(-n // plan.period) * plan.period for n in x.shape[:2])
        chosen = cone.chosen_per_phase(plan, (height, width), self.whole)
        share = chosen / cone.cells_per_phase(plan, (height, width))
        return short + share * cone_cost(nodes, params)
