"""Frames computed window by window, on the host's buffers, into images on the host."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array

from progden_jax import memory, skipping, tiling
from progden_jax._devices import on_each
from progden_jax.frame import Frame
from progden_jax.skipping import Skip, Skipped
from progden_jax.survey import BUFFERS, Survey, crop, exposure_of, frame_of, survey
from progden_jax.tiling import Window


class Place(NamedTuple):
    """Where a window lies in its frame, and what it must know of the whole; all may be traced.

    Attributes
    ----------
    origin : row and column of its first pixel.
    core : first row, end row, first column, end column of what counts in it.
    mean_variance, level : over the frame, level that of the radiance.
    exposure : of the frame, as the denoiser has it.
    """

    origin: tuple[Any, Any]
    core: tuple[Any, Any, Any, Any]
    mean_variance: Any
    level: Any
    exposure: Any


def fits(job: Any, frame: Frame, canvas: tuple[int, int], max_memory: int) -> bool:
    """Whether the frame can be computed at once, as far as can be told without compiling."""
    needed = _guess(job, canvas) + _pixel_bytes(frame) * len(job.outputs)
    return canvas[0] * canvas[1] * needed * memory.SLACK <= max_memory


def _guess(job: Any, size: tuple[int, int]) -> float:
    return memory.guess(job.denoiser, job.method, getattr(job, "mixer", None), size)


def _pixel_bytes(frame: Frame) -> int:
    return 3 * frame.color.dtype.itemsize


def within(
    job: Any,
    frame: Frame,
    divergence: Array | None,
    skip: Skip | None,
    max_memory: int | None,
    *,
    reach: int,
    devices: Sequence[Any] | None = None,
) -> Any:
    """The job on a frame of any size, in windows of one shape, as large as the memory of a device allows."""
    step = job.denoiser.alignment
    shape = None
    if devices is not None:
        shape = tiling.shape_of_parts(frame.size, len(devices), reach, step)
    if max_memory is not None and (shape is None or not fits(job, frame, shape, max_memory)):
        pixels = frame.size[0] * frame.size[1]
        kept = _pixel_bytes(frame) * pixels * len(job.outputs)
        edge = memory.window_edge(
            max_memory - kept,
            tiling.smallest_window(reach, step),
            step,
            lambda edge: _compiled(job, frame, divergence, edge),
            lambda pixels: _guess(job, (math.isqrt(pixels), math.isqrt(pixels))),
        )
        shape = (edge, edge)
    assert shape is not None
    windows = list(tiling.grid(frame.size, shape, reach, step))
    return assemble(job, frame, divergence, windows, skip, grid=True, devices=devices)


def assemble(
    job: Any,
    frame: Frame,
    divergence: Array | None,
    windows: list[Window],
    skip: Skip | None,
    *,
    grid: bool = False,
    devices: Sequence[Any] | None = None,
) -> Any:
    """The windows' cores; what none of them holds is right already.

    `grid`: they cover the whole frame, so that some may be right too, and its images stay on the host. With
    `devices` the windows, of one shape, are computed on all of them at once.
    """
    whole = survey(frame)
    color = whole.repaired("color")
    # What no window fills in is x and α = 0.
    images = {name: np.zeros_like(color) for name in job.outputs if name != "image"}
    if "image" in job.outputs:
        # Where it was repaired it is a copy already.
        images["image"] = color if "color" in whole.patches else color.copy()
    # Known before the image, which may be the same memory, is written to.
    exposure = jax.block_until_ready(exposure_of(color, job.denoiser)) if windows else None
    sums = dict.fromkeys(MEANS, 0.0)
    denoised, computed = 0, 0
    if grid and skip is not None:
        windows = [window for window in windows if _is_noisy(whole, window, skip)]
    calls = (_arguments(whole, divergence, exposure, window) for window in windows)
    if devices is None:
        results = (job.program(job, *call) for call in calls)
    else:
        results = on_each(job.program, job, calls, devices)
    for window, found in zip(windows, results, strict=True):
        for name, image in images.items():
            image[window.core] = np.asarray(getattr(found, name))[window.core_inside]
        denoised += window.core_pixels
        computed += window.area
        for name in sums:
            sums[name] += window.core_pixels * float(getattr(found, name, 0.0))
    pixels = color.shape[0] * color.shape[1]
    given = {n: cast(Any, i) if grid else jax.numpy.asarray(i) for n, i in images.items()}
    return job.result(
        given,
        repairs=whole.repairs,
        mean_alpha=np.float32(sums["mean_alpha"] / pixels),
        mean_sure=np.float32(sums["mean_sure"] / max(denoised, 1)),
        skipped=what_was_skipped(pixels, denoised, computed, skip),
    )


MEANS = ("mean_alpha", "mean_sure")


def _is_noisy(whole: Survey, window: Window, skip: Skip) -> bool:
    """Whether a pixel of the core, or beside it, is not right yet."""
    spans = [
        (max(begin - skipping.MARGIN, 0), min(end + skipping.MARGIN, n))
        for (begin, end), n in zip((window.rows, window.columns), whole.size, strict=True)
    ]
    origin, shape = zip(*((begin, end - begin) for begin, end in spans), strict=True)
    color, variance = (whole.window(name, origin, shape) for name in ("color", "variance"))
    return bool(skipping.noisy(cast(Any, color), cast(Any, variance), skip.tolerance, np).any())


def _arguments(
    whole: Survey, divergence: Array | None, exposure: Any, window: Window
) -> tuple[Any, ...]:
    buffers = {name: whole.window(name, window.origin, window.shape) for name in whole.buffers}
    if divergence is not None:
        divergence = cast(Any, crop(divergence, window.origin, window.shape))
    valid = tuple(
        np.int32(min(n - first, length))
        for n, first, length in zip(whole.size, window.origin, window.shape, strict=True)
    )
    rows, columns = window.core_inside
    core = tuple(np.int32(n) for n in (rows.start, rows.stop, columns.start, columns.stop))
    origin = tuple(np.int32(n) for n in window.origin)
    place = Place(cast(Any, origin), cast(Any, core), whole.mean_variance, whole.level, exposure)
    return frame_of(buffers), divergence, valid, place


def _compiled(job: Any, frame: Frame, divergence: Array | None, edge: int) -> Any:
    """The program for windows of that edge, which depends on nothing else."""
    dtype = np.dtype(frame.color.dtype)
    zeros = {
        name: np.zeros((edge, edge, getattr(frame, name).shape[-1]), dtype)
        for name in BUFFERS
        if getattr(frame, name) is not None
    }
    whole = Survey(zeros, {}, cast(Any, None), dtype.type(0), dtype.type(0))
    given = None if divergence is None else zeros["color"]
    window = Window((0, 0), (edge, edge), (0, edge), (0, edge))
    exposure = exposure_of(np.zeros((1, 1, 3), dtype), job.denoiser)
    arguments = _arguments(whole, cast(Any, given), exposure, window)
    return job.program.lower(job, *arguments).compile()


def what_was_skipped(pixels: int, denoised: int, computed: int, skip: Skip | None) -> Skipped:
    """In words, where of so many pixels so many were denoised."""
    left = pixels - denoised
    if not left or skip is None:
        return Skipped(0, computed)
    what = "every pixel" if left == pixels else f"{left / pixels:.0%} of the pixels, in whole tiles"
    reason = (
        f"{what}: the standard error is at most {skip.tolerance:g} of the radiance, there and "
        f"{skipping.MARGIN} pixels around"
    )
    return Skipped(left, computed, reason)
