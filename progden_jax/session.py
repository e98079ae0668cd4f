"""Denoising beside a render that goes on: the growing frame in, the current best image out."""

import functools
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks, skipping, tiling
from progden_jax._canvas import canvas_size
from progden_jax._program import Job, Valid, core_mask, prepare
from progden_jax._windowed import MEANS, Place, what_was_skipped
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method
from progden_jax.frame import Frame, Repairs
from progden_jax.mixing import Mixer
from progden_jax.pipeline import Result, job_of, rule_of
from progden_jax.skipping import Skip, Skipped
from progden_jax.survey import BUFFERS, frame_of
from progden_jax.tiling import Window

Images = dict[str, Array]


class Session:
    """Progressive denoising of one render while its samples grow.

    Every `update` gives what `progressive_denoise` would, to rounding, and compiles nothing in the caller's
    time but the first program, which is begun as the session is. Programs for windows around what is
    still noisy are compiled on a thread once they would pay; until then the whole frame is computed.
    Frames stay on the device. Not for use from several threads at once.

    Parameters
    ----------
    denoiser, mixer, method, key, skip : as for `progressive_denoise`. With one key for all updates the
        probes' noise does not flicker.
    size : (height, width) of the frames.
    outputs : images to return.

    Raises
    ------
    ValueError
        If size or outputs are none.

    Examples
    --------
    ::

        session = pd.Session(denoiser, (1080, 1920))
        for frame in growing_frames:
            show(session.update(frame).image)
    """

    def __init__(
        self,
        denoiser: Denoiser,
        size: tuple[int, int],
        *,
        mixer: Mixer | None = None,
        method: Method | None = None,
        key: jax.Array | None = None,
        outputs: Sequence[str] = ("image",),
        skip: Skip | bool = True,
    ) -> None:
        if len(size) != 2:
            raise ValueError(f"size is {size}, expected (height, width) in pixels.")
        for n in size:
            _checks.positive_int("size", n)
        self.size = (size[0], size[1])
        self._job = cast(Job, jax.device_put(job_of(denoiser, mixer, method, key, outputs)))
        self._rule = rule_of(skip, self._job)
        padded = getattr(denoiser, "canvas", False)
        self._canvas = (canvas_size(size[0]), canvas_size(size[1])) if padded else self.size
        self._valid: Any = tuple(np.int32(n) for n in size) if padded else None
        self._cut = padded and tiling.can_tile(denoiser, self._job.mixer)
        self._programs: dict[Hashable, Future[Callable[..., Any]]] = {}
        self._compiler = ThreadPoolExecutor(1, thread_name_prefix="progden-session")
        self._names: tuple[str, ...] = ()
        self._dtype = jnp.result_type(float)
        inputs = getattr(denoiser, "inputs", None)
        if inputs is not None:
            self._expect({"color", "variance", *inputs})

    def update(self, frame: Frame, *, donate: bool = False) -> Result:
        """The progressively denoised frame, its images (H, W, 3) on the device.

        Parameters
        ----------
        frame : with a variance; of the session's size, and of the same buffers every time.
        donate : the frame's arrays may be overwritten, so that the result needs no memory of its own; they
            cannot be used any more.

        Raises
        ------
        ValueError
            If the frame has another size, or lacks a buffer.
        """
        buffers = self._owned(frame, donate)
        if self._rule is not None:
            rule = self._rule.for_size(self._canvas)
            active = skipping.noisy_tiles(buffers["color"], buffers["variance"], rule)
            windows = self._windows(active, rule.tile)
            if windows is not None and self._ready(windows):
                return self._pieces(buffers, windows, rule)
        arguments = (self._job, *self._split(buffers), self._valid)
        result = self._programs["whole"].result()(*arguments)
        area = self._canvas[0] * self._canvas[1]
        return _cropped(result, self.size)._replace(skipped=Skipped(0, area))

    def wait(self) -> None:
        """Until all programs are compiled that were found to pay so far."""
        for program in list(self._programs.values()):
            program.result()

    def _expect(self, names: set[str]) -> None:
        """From now on frames have these buffers; compiling begins."""
        self._names = tuple(name for name in BUFFERS if name in names)
        self._compile("whole", _whole, self._job, *self._split(self._forms()), self._valid)

    def _forms(self) -> dict[str, Any]:
        return {
            name: jax.ShapeDtypeStruct((*self._canvas, 1 if name == "depth" else 3), self._dtype)
            for name in self._names
        }

    def _owned(self, frame: Frame, donate: bool) -> Images:
        """The frame's buffers on the canvas, in arrays that nobody else has."""
        _checks.image("frame.color", frame.color)
        if frame.size != self.size:
            (h, w), (height, width) = frame.size, self.size
            raise ValueError(
                f"the frame is {w}×{h} pixels (width × height) and this session's are {width}×{height}: "
                "begin another Session for it."
            )
        present = {name for name in BUFFERS if getattr(frame, name) is not None}
        if not self._names:
            self._expect({"color", "variance", *present})
        for name in self._names:
            if name not in present:
                raise ValueError(
                    f"the frame has no {name}, expected {', '.join(self._names)}: the variance of the sample "
                    "mean, what the denoiser takes, and of other buffers those that the first frame had."
                )
        buffers = {name: getattr(frame, name).astype(self._dtype) for name in self._names}
        if self._canvas != self.size:
            return _padded(buffers, self._canvas)
        return buffers if donate else jax.tree.map(jnp.copy, buffers)

    def _split(self, buffers: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Buffers whose memory becomes the outputs', and the others."""
        # In the order of names, for jit gives dictionaries back sorted.
        given = [name for name in self._names if name != "depth"][: len(self._job.outputs)]
        kept = [name for name in self._names if name not in given]
        return {n: buffers[n] for n in given}, {n: buffers[n] for n in kept}

    def _windows(self, active: np.ndarray, tile: int) -> list[Window] | None:
        """Around what is noisy; None: the whole frame."""
        if not active.any():
            return []
        if not self._cut:
            return None
        job = self._job
        reach = tiling.margin(job.denoiser, job.mixer, job.bound)
        step = cast(Any, job.denoiser).alignment
        # Few, for each is a program.
        lengths = tiling.few_lengths(self._canvas, reach, step)
        cover = tiling.Cover(self.size, self._canvas, tile, reach, step, lengths=lengths)
        windows = cover.windows(active)
        return None if any(w.shape == self._canvas for w in windows) else windows

    def _ready(self, windows: list[Window]) -> bool:
        """Whether the programs for these windows are there; if not, they are asked for."""
        arguments = (self._job, self._forms(), self._valid)
        forms, so_far = jax.eval_shape(_surveyed, *arguments)
        self._compile("survey", _surveyed, *arguments)
        for window in windows:
            part = (_place(window, forms), self._shares(window, windows))
            arguments = (self._job, forms.frame, so_far, self._valid, *part)
            self._compile(window.shape, _window, *arguments, shape=window.shape)
        wanted = ["survey", *(window.shape for window in windows)]
        return all(self._programs[kind].done() for kind in wanted)

    def _compile(self, kind: Hashable, function: Any, *forms: Any, **static: Any) -> None:
        if kind not in self._programs:
            self._programs[kind] = self._compiler.submit(_compiled, function, forms, static)

    def _pieces(self, buffers: Images, windows: list[Window], rule: Skip) -> Result:
        """x, and in the windows' cores the mix."""
        survey, so_far = self._programs["survey"].result()(self._job, buffers, self._valid)
        for window in windows:
            program = self._programs[window.shape].result()
            part = (_place(window, survey), self._shares(window, windows))
            so_far = program(self._job, survey.frame, so_far, self._valid, *part)
        images, means = so_far
        result = self._job.result(images, repairs=survey.repairs, **means)
        computed = sum(window.area for window in windows)
        denoised = sum(window.core_pixels for window in windows)
        skipped = what_was_skipped(self.size[0] * self.size[1], denoised, computed, rule)
        return _cropped(result, self.size)._replace(skipped=skipped)

    def _shares(self, window: Window, windows: list[Window]) -> dict[str, Any]:
        """What its core counts for in the whole frame's means."""
        denoised = sum(w.core_pixels for w in windows)
        pixels = {"mean_alpha": self.size[0] * self.size[1], "mean_sure": denoised}
        return {name: self._dtype.type(window.core_pixels / n) for name, n in pixels.items()}


class _Survey(NamedTuple):
    """The frame on its canvas with bad pixels repaired, and what windows must know of all of it."""

    frame: Frame
    repairs: Repairs | None
    mean_variance: Float[Array, ""]
    level: Float[Array, ""]
    exposure: Any


_SoFar = tuple[Images, dict[str, Array]]
"""The images that were asked for, and means, of the windows up to now."""


@jax.jit
def _surveyed(job: Job, buffers: Images, valid: Valid | None) -> tuple[_Survey, _SoFar]:
    """Also x and α = 0 everywhere, where windows are filled in."""
    frame, _, repairs = prepare(frame_of(buffers), valid, None)
    height, width = frame.size if valid is None else valid
    values = 3.0 * height * width
    find = getattr(job.denoiser, "exposure_of", None)
    color = frame.color
    found = _Survey(
        frame,
        repairs,
        cast(Array, frame.variance).sum() / values,
        jnp.maximum(color, 0).sum() / values,
        None if find is None else find(frame, valid),
    )
    images = {n: color if n == "image" else jnp.zeros_like(color) for n in job.outputs}
    return found, (images, dict.fromkeys(MEANS, jnp.zeros((), color.dtype)))


@functools.partial(jax.jit, donate_argnames="given")
def _whole(job: Job, given: Images, kept: Images, valid: Valid | None) -> Result:
    return job.program(job, frame_of(given | kept), None, valid)


@functools.partial(jax.jit, static_argnames="shape", donate_argnames="so_far")
def _window(
    job: Job,
    frame: Frame,
    so_far: _SoFar,
    valid: Valid,
    place: Place,
    shares: dict[str, Array],
    shape: tuple[int, int],
) -> _SoFar:
    """The images with this window's core filled in, and the means with what is there."""
    images, means = so_far

    def cut(image: Array) -> Array:
        return lax.dynamic_slice(image, (*place.origin, 0), (*shape, image.shape[-1]))

    inside = tuple(
        jnp.minimum(n - first, length)
        for n, first, length in zip(valid, place.origin, shape, strict=True)
    )
    found = job.program(job, jax.tree.map(cut, frame), None, inside, place)
    core = core_mask(shape, place)
    filled = {
        name: lax.dynamic_update_slice(
            image, jnp.where(core, getattr(found, name), cut(image)), (*place.origin, 0)
        )
        for name, image in images.items()
    }
    return filled, {n: mean + shares[n] * getattr(found, n) for n, mean in means.items()}


@functools.partial(jax.jit, static_argnames="canvas")
def _padded(buffers: Images, canvas: tuple[int, int]) -> Images:
    def pad(buffer: Array) -> Array:
        widths = [(0, n - m) for n, m in zip(canvas, buffer.shape, strict=False)]
        return jnp.pad(buffer, [*widths, (0, 0)])

    return jax.tree.map(pad, buffers)


@functools.partial(jax.jit, static_argnames="size")
def _cropped(result: Result, size: tuple[int, int]) -> Result:
    return jax.tree.map(lambda a: a[: size[0], : size[1]] if a.ndim else a, result)


def _place(window: Window, survey: _Survey) -> Place:
    rows, columns = window.core_inside
    core = (rows.start, rows.stop, columns.start, columns.stop)
    return Place(
        cast(Any, tuple(np.int32(n) for n in window.origin)),
        cast(Any, tuple(np.int32(n) for n in core)),
        survey.mean_variance,
        survey.level,
        survey.exposure,
    )


def _compiled(function: Any, forms: tuple[Any, ...], static: dict[str, Any]) -> Callable[..., Any]:
    return function.lower(*forms, **static).compile()
