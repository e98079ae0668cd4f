"""Weighted SURE of some pixels as a function of some weights, and steps that lower it."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax.adaptation import _leaves, _noise
from progden_jax.adaptation._mixed import bind, exposure_of
from progden_jax.adaptation._running import OPTIMIZER, descended
from progden_jax.frame import Frame
from progden_jax.sure import sure

Weights = list[Any]
"""The leaves that are changed."""


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("denoiser", "frame", "exposure", "scale", "shared"),
    meta_fields=("chosen", "probes"),
)
@dataclasses.dataclass(frozen=True)
class Task:
    """Weights of a denoiser to be fitted to a frame.

    Parameters
    ----------
    denoiser, chosen : and which of its leaves are the weights.
    frame : without bad pixels.
    exposure : what the denoiser takes from the whole image.
    scale : (H, W, 3) by which SURE is multiplied, 0 where the loss is not taken.
    shared : correlation of the noise of a pixel's channels.
    probes : of the divergence.
    """

    denoiser: Any
    frame: Frame
    exposure: Any
    scale: Float[Array, "h w 3"]
    shared: Float[Array, ""]
    chosen: _leaves.Numbers
    probes: int

    @property
    def first(self) -> Weights:
        """The weights to start from."""
        return _leaves.taken(self.denoiser, self.chosen)

    def only_in(self, pixels: np.ndarray) -> "Task":
        """The same with no loss elsewhere; `pixels` is (H, W)."""
        scale = jnp.where(jnp.asarray(pixels)[..., None], self.scale, 0)
        return dataclasses.replace(self, scale=scale)

    def with_weights(self, weights: Weights) -> Any:
        """The denoiser that has them."""
        return _leaves.replaced(self.denoiser, self.chosen, weights)


def task_of(denoiser: Any, frame: Frame, chosen: _leaves.Numbers, probes: int) -> Task:
    """SURE over y² + 0.01 + σ² is to be lowered, y the denoised image as it is."""
    exposure, scale, shared = _before(denoiser, frame)
    return Task(denoiser, frame, exposure, scale, shared, chosen, probes)


@jax.jit
def _before(denoiser: Any, frame: Frame) -> tuple[Any, Array, Array]:
    exposure = exposure_of(denoiser, frame)
    y = bind(denoiser, frame, exposure)(frame.color)
    scale = 1 / (y**2 + 0.01 + cast(Array, frame.variance))
    return exposure, scale, _noise.correlation(frame)


@jax.jit
def risks(task: Task, weights: Weights, key: jax.Array) -> Float[Array, "h w 3"]:
    """Weighted SURE of every pixel, with the channels' covariance."""
    f = bind(task.with_weights(weights), task.frame, task.exposure)
    x, variance = task.frame.color, cast(Array, task.frame.variance)
    y, divergence, *_ = _noise.evaluate(f, x, variance, task.shared, key, probes=task.probes)
    return task.scale * sure(x, y, variance, divergence)


def descent(
    task: Task, crop: int, rate: float, key: jax.Array, host: np.random.Generator
) -> Iterator[Weights]:
    """The weights after each step of Adam on a random crop, with probes of its own; without end."""
    size = task.frame.size
    shape = (min(crop, size[0]), min(crop, size[1]))
    weights = task.first
    optimizer = OPTIMIZER.init(weights)
    number = 0
    while True:
        number += 1
        corner = [int(host.integers(n - c + 1)) for n, c in zip(size, shape, strict=True)]
        drawn = jax.random.fold_in(key, number)
        weights, optimizer = _step(
            task, weights, optimizer, drawn, np.asarray(corner), rate, crop=shape
        )
        # Steps are queued else, and who counts them would count what has not been done.
        yield jax.block_until_ready(weights)


@functools.partial(jax.jit, static_argnames="crop")
def _step(
    task: Task,
    weights: Weights,
    optimizer: Any,
    key: jax.Array,
    corner: Array,
    rate: Array,
    *,
    crop: tuple[int, int],
) -> tuple[Weights, Any]:
    def cut(array: Array) -> Array:
        if array.ndim < 3:
            return array
        return jax.lax.dynamic_slice(array, (*corner, 0), (*crop, array.shape[-1]))

    frame, scale = jax.tree.map(cut, (task.frame, task.scale))
    part = dataclasses.replace(task, frame=frame, scale=scale)

    def loss(weights: Weights) -> Array:
        return risks(part, weights, key).mean()

    return descended(weights, optimizer, jax.grad(loss)(weights), rate)
