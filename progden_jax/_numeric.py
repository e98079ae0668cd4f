"""Functions whose derivatives stay finite, or stay cheap; arrays that need no copy."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
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


_ALIGNMENT = 64
"""Bytes; XLA on CPUs takes NumPy arrays that begin at a multiple as they are."""


def aligned_empty(shape: tuple[int, ...]) -> np.ndarray:
    """Uninitialised float32 that `adopted` need not copy."""
    size = 4 * math.prod(shape)
    memory = np.empty(size + _ALIGNMENT, np.uint8)
    begin = -memory.ctypes.data % _ALIGNMENT
    return memory[begin : begin + size].view(np.float32).reshape(shape)


def adopted(array: np.ndarray, device: Any = None) -> Array:
    """As a JAX array, in the same memory where that can be; nobody may write to `array` any more."""
    return jax.device_put(array, device, may_alias=True)
