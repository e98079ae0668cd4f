"""What every architecture of a learned mixer has."""

from collections.abc import Mapping
from typing import Any, Protocol

import jax
from jaxtyping import Array, Bool, Float

Params = Mapping[str, Any]
"""Nested names -> arrays."""


class Architecture(Protocol):
    """A frozen, hashable dataclass of settings that turns weights and what is known of an image into α.

    Training calls it with (x, σ²) and (y, SURE) swapped in half of the cases (paper, section 4.3): it must
    then give the weight of x in a mix that starts from y. The closed form has that property, for its
    numerator becomes SURE − divergence; so anything built on the same quantities has it.
    Leading axes of the images are a batch.
    """

    @property
    def receptive_radius(self) -> int:
        """How many pixels away α can depend on the images."""
        ...

    def init(self, key: jax.Array) -> Params:
        """Weights to start training from."""
        ...

    def apply(
        self,
        params: Params,
        x: Float[Array, "*b h w 3"],
        y: Float[Array, "*b h w 3"],
        variance: Float[Array, "*b h w 3"],
        divergence: Float[Array, "*b h w 3"],
        sure: Float[Array, "*b h w 3"],
        *,
        inside: Bool[Array, "h w 1"] | None = None,
        level: Float[Array, ""] | None = None,
    ) -> Float[Array, "*b h w 3"]:
        """α in [0, 1]; as if the image ended where `inside` is False."""
        ...
