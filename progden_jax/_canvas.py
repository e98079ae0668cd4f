"""Canvases: sizes rounded up, so that images of nearby sizes share compiled programs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from progden_jax.denoisers import Denoiser
from progden_jax.frame import Frame
from progden_jax.survey import BUFFERS, crop, frame_of


def canvas_size(n: int) -> int:
    """`n` pixels rounded up to a multiple of 16: eight sizes per doubling, sixteen from 1024 on.

    The larger an image, the less its program's compilation matters beside what is computed for nothing.
    """
    length = n.bit_length()
    step = max(16, 1 << max(length - (5 if n > 1024 else 4), 0))
    return -(-n // step) * step


def call_of(
    job: Any, frame: Frame, canvas: tuple[int, int], divergence: Array | None = None
) -> tuple[Any, ...]:
    """The arguments of the job's program for a whole frame, padded to its canvas where that may be."""
    if not has_canvas(job.denoiser):
        return frame, divergence
    buffers = {n: getattr(frame, n) for n in BUFFERS if getattr(frame, n) is not None}
    if canvas != frame.size:
        buffers = {name: crop(buffer, (0, 0), canvas) for name, buffer in buffers.items()}
        divergence = None if divergence is None else crop(divergence, (0, 0), canvas)
    return frame_of(buffers), divergence, tuple(np.int32(n) for n in frame.size)


def cropped(result: Any, size: tuple[int, int]) -> Any:
    """A result with the padding around its images taken off."""
    height, width = size

    def crop(image: Any) -> Any:
        if image.ndim < 2 or image.shape[:2] == size:
            return image
        return jnp.asarray(np.asarray(image)[:height, :width])

    return jax.tree.map(crop, result)


def has_canvas(denoiser: Denoiser) -> bool:
    """Whether it takes frames padded beyond their true size."""
    return getattr(denoiser, "canvas", False)
