"""Functions whose derivatives stay finite, or stay cheap."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """sqrt(max(value, 0)), whose derivative at 0 is 0 instead of infinite."""
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1)), 0)


def own_zero(value: Float[Array, "*shape"]) -> Float[Array, ""]:
    """0, with a derivative of 0 that is computed from `value`'s own tangent instead of stored.

    For ``where(mask, value, 0)`` ``jax.linearize`` keeps the constant's tangent beside the mask, a full array
    of zeros that every tangent pass reads again. The compiler knows that this sum of nothing is 0.
    """
    return value[:0].sum()
