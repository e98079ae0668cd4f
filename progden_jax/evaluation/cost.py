"""What it took to compute something: time and memory."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from progden_jax.compilation import count_compilations
from progden_jax.memory import Peak


class Cost(NamedTuple):
    """Seconds, and bytes at most; None where a program was compiled meanwhile, which takes more of both.

    The bytes are None, too, where the system does not tell: see `Peak`.
    """

    seconds: float | None = None
    memory: int | None = None

    def then(self, other: "Cost") -> "Cost":
        """Of both, one after the other."""
        if self.seconds is None or other.seconds is None:
            return Cost()
        told = [memory for _, memory in (self, other) if memory is not None]
        return Cost(self.seconds + other.seconds, max(told, default=None))


def metered(call: Callable[[], Any]) -> tuple[Any, Cost]:
    """What it gives, when that is there, and what it took."""
    compiled, taken = count_compilations(), Peak()
    start = time.perf_counter()
    found = jax.block_until_ready(call())
    seconds = time.perf_counter() - start
    return found, Cost(seconds, taken.read()) if count_compilations() == compiled else Cost()
