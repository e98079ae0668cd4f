"""What both kinds of adaptation share: progress, random numbers of the host, steps of Adam."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import optax
from jaxtyping import Array

Progress = Callable[[int, int], bool | None]
"""Called with (done, total) steps; what returns False ends the work there, with what there is."""

OPTIMIZER = optax.flatten(optax.scale_by_adam())
"""Adam without its rate, which is an argument of the compiled step."""


def descended(weights: Any, state: Any, gradient: Any, rate: Array | float) -> tuple[Any, Any]:
    """The weights and the optimiser's state after a step."""
    updates, state = OPTIMIZER.update(gradient, state)
    return jax.tree.map(lambda w, u: w - rate * u, weights, updates), state


def generator(key: jax.Array) -> np.random.Generator:
    """NumPy's, seeded by the key: shuffles on the host need no compiled program."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
