"""What every estimator of the divergence shares."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from progden_jax import _checks
from progden_jax._numeric import safe_sqrt
from progden_jax.divergence._random import Origin

Function = Callable[[Float[Array, "h w 3"]], Float[Array, "h w 3"]]
"""A denoiser bound to everything but the colour."""


class Evaluation(NamedTuple):
    """y = f(x), the estimate of σ²·∂f/∂x and the estimate's standard error, (H, W, 3) each.

    The standard error is 0 where the estimate is exact and inf where one probe cannot tell. `probes` is
    how many were spent on each tile, from methods that decide it on the way.
    """

    value: Float[Array, "h w 3"]
    divergence: Float[Array, "h w 3"]
    standard_error: Float[Array, "h w 3"]
    probes: Int[Array, "rows columns"] | None = None


def check_arguments(
    f: Function, x: Float[Array, "h w 3"], variance: Float[Array, "h w 3"]
) -> tuple[Array, Array]:
    """x and its variance as JAX arrays; raises ValueError unless f makes one image of another."""
    _checks.image("x", x)
    _checks.same_shape("variance", variance, "x", x)
    if not callable(f):
        raise ValueError(
            f"f is a {type(f).__name__}, expected a function from x to the denoised image."
        )
    x, variance = jnp.asarray(x), jnp.asarray(variance)
    out = jax.eval_shape(f, x)
    if getattr(out, "shape", None) != x.shape:
        raise ValueError(
            f"f gives {getattr(out, 'shape', type(out).__name__)} for x of shape {x.shape}; "
            "it must give one image of the same shape."
        )
    return x, variance


class Method(Protocol):
    """An estimator: a frozen object of its settings, hashable, without state."""

    def evaluate(
        self,
        f: Function,
        x: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        key: jax.Array,
        *,
        origin: Origin = (0, 0),
    ) -> Evaluation:
        """f at `x`, the divergence there and its standard error; arguments are checked already.

        `origin` is where x lies in the whole image, if it is a tile of one: random numbers belong to
        positions there.
        """
        ...


def accumulate(
    sample: Callable[[Array], Float[Array, "h w 3"]], count: int, chunk: int, like: Array
) -> tuple[Array, Array]:
    """Mean over `count` samples, `sample(index)` each, and that mean's standard error.

    `chunk` samples are in flight at once, so memory does not grow with `count`. Mean and spread are
    updated as by Chan et al. 1983, which loses no digits when the spread is small.
    """
    chunk = min(chunk, count)
    rest = count % chunk

    def merge(state: tuple[Array, Array, Array], indices: Array) -> tuple[Array, Array, Array]:
        number, mean, squares = state
        values = jax.vmap(sample)(indices)
        new = jnp.asarray(len(indices), like.dtype)
        new_mean = values.mean(0)
        new_squares = ((values - new_mean) ** 2).sum(0)
        step = new_mean - mean
        total = number + new
        return (
            total,
            mean + step * (new / total),
            squares + new_squares + step**2 * (number * new / total),
        )

    zero = jnp.zeros_like(like)
    state = (jnp.zeros((), like.dtype), zero, zero)
    full = jnp.arange(count - rest).reshape(-1, chunk)
    if len(full) == 1:
        state = merge(state, full[0])
    else:
        state, _ = jax.lax.scan(lambda s, i: (merge(s, i), None), state, full)
    if rest:
        state = merge(state, jnp.arange(count - rest, count))
    _, mean, squares = state
    if count == 1:
        return mean, jnp.full_like(mean, jnp.inf)
    return mean, safe_sqrt(squares / (count * (count - 1)))
