"""How alike the patches around pixels are: distances of non-local means, in blocks of pixels."""

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

BLOCK = 8
"""Edge in pixels of a block."""

_RELATIVE_NOISE = 1e-4
"""Differences of this share of the radiance count as noise, whatever the variance says."""

_LEAST = 1e-18
"""Squared radiance: keeps 0/0 out of distances between black pixels, and its square is no 0 in float32."""

_FAR = 1e4
"""A distance at which the weight is 0."""


@dataclasses.dataclass(frozen=True)
class Windows:
    """Which neighbours a pixel is compared to, and how.

    Attributes
    ----------
    radius : of the window, in pixels.
    patch : radius of the patches that are compared, in pixels.
    """

    radius: int
    patch: int

    @property
    def size(self) -> int:
        """Edge of a window."""
        return 2 * self.radius + 1

    @property
    def region(self) -> int:
        """Edge of what the windows of a block reach."""
        return BLOCK + 2 * self.radius

    @property
    def reach(self) -> int:
        """How far from a pixel a prediction for it can depend on the image."""
        return 2 * self.radius + self.patch


def patch_distances(
    guide: Float[Array, "g y x"], variance: Float[Array, "g y x"], windows: Windows
) -> Float[Array, "dy dx h w"]:
    """Distance between the patches around each pixel and around its neighbours, by offset.

    The first and last radius + patch rows and columns are neighbours only.
    """
    radius, size = windows.radius, windows.size
    rows, columns = (n - 2 * radius for n in guide.shape[1:])
    scale = variance + _RELATIVE_NOISE**2 * guide**2 + _LEAST

    def shifted(image: Array, dy: Any, dx: Any) -> Array:
        return lax.dynamic_slice(image, (0, dy, dx), (len(image), rows, columns))

    value, noise, own_scale = (shifted(a, radius, radius) for a in (guide, variance, scale))

    def at(offset: Array) -> Array:
        by = offset // size, offset % size
        other, its_noise, its_scale = (shifted(a, *by) for a in (guide, variance, scale))
        difference = (value - other) ** 2 - (noise + jnp.minimum(noise, its_noise))
        distance = (difference / (own_scale + its_scale)).mean(0)
        for axis in (0, 1):
            # Without a barrier the compiler computes sums of sums anew for every term.
            distance = lax.optimization_barrier(distance)
            distance = _running_mean(distance, axis, 2 * windows.patch + 1)
        return jnp.maximum(distance, 0)

    found = lax.map(at, jnp.arange(size**2))
    return found.reshape(size, size, *found.shape[1:])


def _running_mean(values: Array, axis: int, window: int) -> Array:
    length = values.shape[axis] - window + 1
    parts = (lax.slice_in_dim(values, n, n + length, axis=axis) for n in range(window))
    return functools.reduce(jnp.add, parts) / window


def matrices(distances: Float[Array, "dy dx h w"]) -> Float[Array, "b p q"]:
    """Distances from each pixel p of a block to each pixel q of its region, far outside the window."""
    size, blocks = len(distances), distances.shape[-1] // BLOCK
    d = distances.reshape(size, size, BLOCK, blocks, BLOCK).transpose(3, 2, 4, 0, 1)
    # Barriers, for indices through several steps at once cost more than the copies.
    d = _placed(_placed(lax.optimization_barrier(d), 2, 4), 1, 3)
    return d.reshape(blocks, BLOCK**2, -1)


def _placed(values: Array, axis: int, along: int) -> Array:
    """What lies at n on an axis moved by n along another, which grows by what that takes."""
    number = values.shape[axis]
    parts = []
    for n in range(number):
        widths = [(0, 0)] * values.ndim
        widths[along] = (n, number - 1 - n)
        part = lax.slice_in_dim(values, n, n + 1, axis=axis)
        parts.append(jnp.pad(part, widths, constant_values=_FAR))
    return lax.optimization_barrier(jnp.concatenate(parts, axis))
