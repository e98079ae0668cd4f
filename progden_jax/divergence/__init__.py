"""The divergence of a denoiser: σ²·∂f(x)/∂x at every pixel and channel.

One module per family of estimators; each is a frozen object of settings with ``evaluate``.
"""

import functools
from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from progden_jax.divergence._base import Evaluation, Function, Method, check_arguments
from progden_jax.divergence.exact import Exact
from progden_jax.divergence.monte_carlo import FiniteDifference, MonteCarlo
from progden_jax.divergence.probing import Probing
from progden_jax.divergence.running import exact_divergence
from progden_jax.divergence.truncated import TruncatedCone

__all__ = [
    "DivergenceEstimate",
    "Evaluation",
    "Exact",
    "FiniteDifference",
    "Function",
    "Method",
    "MonteCarlo",
    "Probing",
    "TruncatedCone",
    "divergence",
    "divergence_and_error",
    "evaluate",
    "exact_divergence",
]


class DivergenceEstimate(NamedTuple):
    """An estimate of σ²·∂f/∂x and its standard error, (H, W, 3) each."""

    divergence: Float[Array, "h w 3"]
    standard_error: Float[Array, "h w 3"]


def divergence(
    f: Function,
    x: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    *,
    method: Method,
    key: jax.Array | None = None,
) -> Float[Array, "h w 3"]:
    """An estimate of σ²_pc · ∂f(x)_pc / ∂x_pc at every pixel p and channel c.

    Parameters
    ----------
    f : any JAX function from (H, W, 3) to (H, W, 3). One that is a pytree (a denoiser's ``bind``, or a
        ``jax.tree_util.Partial``) is compiled once for all its values; for any other function, wrap the
        call in ``jax.jit`` yourself if it is to be compiled.
    x : (H, W, 3) where to differentiate, linear radiance.
    variance : (H, W, 3) of `x`, at least 0.
    method : `FiniteDifference`, `MonteCarlo`, ...
    key : of the random probes; None stands for ``jax.random.key(0)``, so results repeat.

    Raises
    ------
    ValueError
        If shapes or dtypes are wrong, or `method` is no method.

    Notes
    -----
    The trace term of Firmino et al. 2022, Eq. 1, per pixel.
    """
    return evaluate(f, x, variance, method=method, key=key).divergence


def divergence_and_error(
    f: Function,
    x: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    *,
    method: Method,
    key: jax.Array | None = None,
) -> DivergenceEstimate:
    """What `divergence` gives, and its standard error as the spread over probes tells it.

    The standard error is 0 for exact methods and inf for a single probe.
    """
    found = evaluate(f, x, variance, method=method, key=key)
    return DivergenceEstimate(found.divergence, found.standard_error)


def evaluate(
    f: Function,
    x: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    *,
    method: Method,
    key: jax.Array | None = None,
) -> Evaluation:
    """f(x) with its divergence and standard error, the pass through f shared; see `divergence`."""
    if not hasattr(method, "evaluate"):
        raise ValueError(
            f"method is {method!r}, expected an estimator such as MonteCarlo(probes=4)."
        )
    if key is None:
        key = jax.random.key(0)
    x, variance = check_arguments(f, x, variance)
    run = _evaluate if jax.tree_util.all_leaves([f]) else _compiled
    return run(f, x, variance, key, method)


def _evaluate(f: Function, x: Array, variance: Array, key: jax.Array, method: Method) -> Evaluation:
    return method.evaluate(f, x, variance, key)


_compiled = functools.partial(jax.jit, static_argnames="method")(_evaluate)
