"""Functions whose derivatives stay finite."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """sqrt(max(value, 0)), whose derivative at 0 is 0 instead of infinite."""
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1)), 0)
