"""The whole chain for one frame: repair, denoise, divergence, SURE, mix, bound; whole or window by window."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from progden_jax import _checks, _windowed, skipping, tiling
from progden_jax._devices import Device
from progden_jax._windowed import Place
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import passable
from progden_jax.divergence import Method, MonteCarlo
from progden_jax.frame import Frame, Repairs, repair
from progden_jax.mixers import default_for
from progden_jax.mixing import Mixer
from progden_jax.skipping import Skip, Skipped
from progden_jax.sure import sure
from progden_jax.survey import BUFFERS, crop, frame_of
from progden_jax.tstatistic import Bound

DEFAULT_METHOD = MonteCarlo(probes=1)
"""One probe: averaging windows remove its noise, see experiments/main_job."""

OUTPUTS = ("image", "alpha", "denoised", "sure", "divergence")
"""Images that a `Result` can have."""

_WORTH_COMPILING = 1e6
"""Pixels of a frame whose windows get programs of their own among many frames."""

_SKIPPABLE = frozenset({"image", "alpha"})
"""Outputs that are known, x and 0, where a tile is right already."""


class Result(NamedTuple):
    """A progressively denoised frame and what led to it; images are (H, W, 3), linear radiance.

    Attributes
    ----------
    image : the mix z = x + α(y − x).
    alpha : weight of the denoised image per pixel and channel after the t-bound, in [0, 1].
    denoised : y, the denoiser's output.
    sure : risk estimate of y per pixel, squared radiance, may be negative.
    divergence : the estimate of σ²·∂f/∂x that it rests on.
    repairs : counts of bad pixels, see `progden_jax.repair`.
    mean_alpha : over pixels and channels.
    mean_sure : the estimate of the denoised image's mean squared error, over the pixels that were denoised; 0
        if none was.
    skipped : what was left out and why; None inside ``jit``, where nothing can be.

    Images that were not asked for are None.
    """

    image: Float[Array, "h w 3"]
    alpha: Float[Array, "h w 3"]
    denoised: Float[Array, "h w 3"]
    sure: Float[Array, "h w 3"]
    divergence: Float[Array, "h w 3"]
    repairs: Repairs
    mean_alpha: Float[Array, ""] | None = None
    mean_sure: Float[Array, ""] | None = None
    skipped: Skipped | None = None


class Denoised(NamedTuple):
    """A plainly denoised frame: the image (H, W, 3), and counts of bad pixels."""

    image: Float[Array, "h w 3"]
    repairs: Repairs


def progressive_denoise(
    frame: Frame,
    denoiser: Denoiser,
    *,
    mixer: Mixer | None = None,
    method: Method | None = None,
    bound: Bound | bool = True,
    key: jax.Array | None = None,
    divergence: Float[Array, "h w 3"] | None = None,
    outputs: Sequence[str] | None = None,
    skip: Skip | bool = True,
    max_memory: int | None = None,
    canvas: tuple[int, int] | None = None,
    devices: Sequence[Device] | None = None,
) -> Result:
    """The mix of render and denoised image that converges to the truth as samples grow.

    Compiled once per denoiser and size; sizes are rounded up to a canvas, so that images of nearby sizes
    share a program. Differentiable in the denoiser's weights and in the colour. Inside ``jit``, ``vmap``
    or ``grad`` the sizes are taken as they are, and nothing is skipped.

    Parameters
    ----------
    frame : one frame with a variance; map over a batch with ``jax.vmap``.
    denoiser : see `progden_jax.denoisers.load`, or any `Denoiser`.
    mixer : gives α; by default what `mixers.default_for` has for the denoiser: a network shipped for
        it, else the closed form over 15×15 windows.
    method : estimator of the divergence; by default `MonteCarlo` with one probe.
    bound : on α, without which the mix need not converge. True stands for ``Bound()``, the authors' settings;
        False leaves α as the mixer gives it.
    key : of the random probes; None stands for ``jax.random.key(0)``.
    divergence : σ²·∂f/∂x where it is known already, as from `exact_divergence`, of
        ``denoiser.bind(frame)`` for a frame whose bad pixels are repaired (`progden_jax.repair`); then there
        is no method to choose.
    outputs : images to return, of `OUTPUTS`; None: all. What is not asked for is not kept.
    skip : leave out tiles that are right already, see `Skip`, where no more than the image and α are asked
        for: of the other outputs nothing is known there. True stands for ``Skip()``.
    max_memory : bytes that the call may take beyond the frame itself. A frame that needs more is computed in
        windows that overlap by what the networks look at, one program for all sizes, and its images come
        as NumPy arrays. The result is the same to 1e-5, but for methods that weigh the whole frame (`Probing`
        ranks its variances): these look at each window alone.
    canvas : height and width to compute at, at least the frame's, so that frames of several sizes share a
        program; by default both rounded up, see `canvas_size`.
    devices : to compute on, each a window of the frame at a time, as with `max_memory`, which is then that
        of one device. With those of several processes (``jax.devices()`` under ``jax.distributed``) every
        process must make the same call, and gets the whole result. None: JAX's default device.

    Raises
    ------
    ValueError
        If the frame has no variance, is no single image, or lacks what the denoiser takes; if the
        divergence is no image of its size, or comes with a method; if an output has an unknown name; if
        max_memory is too little for the least window; if the frame is to be cut, and the denoiser or mixer
        cannot work on tiles.

    Notes
    -----
    Firmino et al. 2022. Cost: one denoiser pass and one tangent pass per probe, and little else.
    """
    checked_variance(frame)
    if divergence is not None:
        _checks.same_shape("divergence", divergence, "frame.color", frame.color)
        if method is not None:
            raise ValueError(
                f"a divergence is given and a method, {method!r}, to find it: give one of them."
            )
    job = job_of(denoiser, mixer, method, key, outputs, bound)
    rule = rule_of(skip, job)
    denoiser = job.denoiser
    shared, canvas = canvas is not None, _canvas(frame, canvas)
    if _is_cut(job, frame, canvas, max_memory, devices):
        _no_tracers((frame, denoiser, divergence))
        reach = tiling.margin(denoiser, job.mixer, job.bound)
        return _windowed.within(
            job, frame, divergence, rule, max_memory, reach=reach, devices=devices
        )
    if _traced((frame, job, divergence)):
        return job.program(job, frame, divergence)
    if rule is not None:
        return _where_needed(job, frame, divergence, rule, canvas, shared=shared)
    return _whole(job, frame, divergence, canvas)


def denoise(
    frame: Frame,
    denoiser: Denoiser,
    *,
    max_memory: int | None = None,
    devices: Sequence[Device] | None = None,
) -> Denoised:
    """The denoiser alone, with bad pixels repaired: what remains to be had without a variance.

    `max_memory` and `devices` are as for `progressive_denoise`.
    """
    _checks.image("frame.color", frame.color)
    denoiser = passable(denoiser)
    job = _PlainJob(denoiser)
    if _is_cut(job, frame, _canvas(frame), max_memory, devices):
        _no_tracers((frame, denoiser))
        reach = tiling.margin(denoiser)
        return _windowed.within(job, frame, None, None, max_memory, reach=reach, devices=devices)
    if _traced((frame, denoiser)):
        return job.program(job, frame, None)
    return _at_once(job, frame, None, _canvas(frame))


Valid = tuple[Int[Array, ""], Int[Array, ""]]


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("denoiser", "mixer", "key", "bound"),
    meta_fields=("method", "outputs"),
)
@dataclasses.dataclass(frozen=True)
class Job:
    """What holds for every window of a frame, and for every frame of a batch: a pytree."""

    denoiser: Denoiser
    mixer: Mixer
    key: jax.Array
    method: Method
    outputs: tuple[str, ...]
    bound: Bound | None = None

    @property
    def program(self) -> Any:
        """The compiled function of (job, frame, divergence, valid, place) to a `Result`."""
        return _progressive

    @staticmethod
    def result(images: Mapping[str, Any], **rest: Any) -> Result:
        """From the images that were asked for, and the other fields."""
        return Result(**{name: images.get(name) for name in OUTPUTS}, **rest)


def checked_variance(frame: Frame) -> Array:
    """That of the frame, which must be a single image that has one."""
    _checks.image("frame.color", frame.color)
    if frame.variance is None:
        raise ValueError(
            "the frame has no variance, and progressive denoising needs that of the sample mean: give one, "
            "make one from half-buffers or several seeds (read_exr's variance_from), or denoise "
            "plainly with `denoise(frame, denoiser)`."
        )
    return frame.variance


def job_of(
    denoiser: Denoiser,
    mixer: Mixer | None,
    method: Method | None,
    key: jax.Array | None,
    outputs: Sequence[str] | None,
    bound: Bound | bool = True,
) -> Job:
    """What the arguments of `progressive_denoise` stand for, checked."""
    return Job(
        passable(denoiser),
        default_for(denoiser) if mixer is None else mixer,
        jax.random.key(0) if key is None else key,
        DEFAULT_METHOD if method is None else method,
        _asked(outputs),
        Bound() if bound is True else bound or None,
    )


def rule_of(skip: Skip | bool, job: Job) -> Skip | None:
    """Which tiles may be left out, if any: only where no output is unknown, and the bound keeps them."""
    rule = Skip() if skip is True else skip or None
    kept = job.bound is not None and job.bound.radius <= skipping.MARGIN
    return rule if kept and _SKIPPABLE.issuperset(job.outputs) else None


@jax.jit
def _progressive(
    job: Job,
    frame: Frame,
    divergence: Array | None,
    valid: Valid | None = None,
    place: Place | None = None,
) -> Result:
    frame, inside, repairs = prepare(frame, valid, place)
    x, variance = frame.color, cast(Array, frame.variance)
    f = _bind(job.denoiser, frame, valid, place)
    if divergence is None:
        origin = {} if place is None else {"origin": place.origin}
        y, divergence, *_ = job.method.evaluate(f, x, variance, job.key, **origin)
    else:
        y = f(x)
    # Barriers: else XLA works each stage's last operations into every use of them, and compiles longer.
    found = y, divergence
    y, divergence = cast(tuple[Array, Array], lax.optimization_barrier(found))
    risk = sure(x, y, variance, divergence)
    told = {} if place is None else {"level": place.level}
    alpha = job.mixer(x, y, variance, divergence, risk, inside=inside, **told)
    alpha = lax.optimization_barrier(alpha)
    mean_variance = None if place is None else place.mean_variance
    if job.bound is not None:
        alpha = job.bound(alpha, x, y, variance, mean_variance=mean_variance, inside=inside)
    images = {
        "image": x + alpha * (y - x),
        "alpha": alpha,
        "denoised": y,
        "sure": risk,
        "divergence": divergence,
    }
    counted = inside if place is None else core_mask(frame.size, place)
    return job.result(
        {name: images[name] for name in job.outputs},
        repairs=repairs,
        mean_alpha=_mean(alpha, counted),
        mean_sure=_mean(risk, counted),
    )


@functools.partial(jax.tree_util.register_dataclass, data_fields=("denoiser",), meta_fields=())
@dataclasses.dataclass(frozen=True)
class _PlainJob:
    denoiser: Denoiser
    outputs = ("image",)
    method = None

    @property
    def program(self) -> Any:
        return _plain

    @staticmethod
    def result(images: Mapping[str, Any], *, repairs: Repairs, **_: Any) -> Denoised:
        return Denoised(images["image"], repairs)


@jax.jit
def _plain(
    job: _PlainJob,
    frame: Frame,
    divergence: None,
    valid: Valid | None = None,
    place: Place | None = None,
) -> Denoised:
    del divergence
    frame, _, repairs = prepare(frame, valid, place)
    image = _bind(job.denoiser, frame, valid, place)(frame.color)
    return Denoised(image, cast(Repairs, repairs))


def prepare(
    frame: Frame, valid: Valid | None, place: Place | None
) -> tuple[Frame, Array | None, Repairs | None]:
    """The frame repaired, where it is no padding, and the repairs; a window's frame is repaired already."""
    inside = None
    if valid is not None:
        rows, columns = (jnp.arange(n) < v for n, v in zip(frame.size, valid, strict=True))
        inside = (rows[:, None] & columns[None, :])[..., None]
    if place is not None:
        return frame, inside, None
    repaired, repairs = repair(frame, inside=inside)
    return repaired, inside, repairs


def _bind(
    denoiser: Denoiser, frame: Frame, valid: Valid | None, place: Place | None
) -> Callable[[Array], Array]:
    known = {} if valid is None else {"valid": valid}
    if place is not None:
        known["exposure"] = place.exposure
    return denoiser.bind(frame, **known)


def core_mask(size: tuple[int, int], place: Place) -> Array:
    """(h, w, 1), true in what counts of a window of that size."""
    top, bottom, left, right = place.core
    rows, columns = (jnp.arange(n) for n in size)
    return (((rows >= top) & (rows < bottom))[:, None] & ((columns >= left) & (columns < right)))[
        ..., None
    ]


def _mean(image: Array, counted: Array | None) -> Array:
    """Over the pixels that count; a huge frame's sum would have no digits left."""
    if counted is None:
        return image.mean()
    return jnp.where(counted, image, 0).sum() / (image.shape[-1] * jnp.maximum(counted.sum(), 1))


def canvas_size(n: int) -> int:
    """`n` pixels rounded up so that there are eight sizes per doubling, multiples of 16."""
    step = max(16, 1 << max(n.bit_length() - 4, 0))
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


def _at_once(job: Any, frame: Frame, divergence: Array | None, canvas: tuple[int, int]) -> Any:
    return cropped(job.program(job, *call_of(job, frame, canvas, divergence)), frame.size)


def _where_needed(
    job: Job,
    frame: Frame,
    divergence: Array | None,
    skip: Skip,
    canvas: tuple[int, int],
    *,
    shared: bool,
) -> Result:
    """The frame but for the tiles that are right already.

    Where the canvas is shared between frames, so are the windows' programs: they have few sizes, and of small
    frames, whose windows would cost more to compile than they save, only whole ones are left out.
    """
    variance = cast(Array, frame.variance)
    skip = skip.for_size(canvas)
    active = skipping.noisy_tiles(
        crop(frame.color, (0, 0), canvas), crop(variance, (0, 0), canvas), skip
    )
    windows = None
    if not active.any():
        windows = []
    elif shared and canvas[0] * canvas[1] < _WORTH_COMPILING:
        windows = None
    elif has_canvas(job.denoiser) and tiling.can_tile(job.denoiser, job.mixer):
        reach = tiling.margin(job.denoiser, job.mixer, job.bound)
        step = cast(Any, job.denoiser).alignment
        lengths = tiling.few_lengths(canvas, reach, step) if shared else None
        cover = tiling.Cover(frame.size, canvas, skip.tile, reach, step, lengths=lengths)
        windows = cover.windows(active)
    if windows is None or any(w.shape == canvas for w in windows):
        return _whole(job, frame, divergence, canvas)
    return _windowed.assemble(job, frame, divergence, windows, skip)


def _whole(job: Job, frame: Frame, divergence: Array | None, canvas: tuple[int, int]) -> Result:
    result = _at_once(job, frame, divergence, canvas)
    return result._replace(skipped=Skipped(0, frame.size[0] * frame.size[1]))


def _canvas(frame: Frame, asked: tuple[int, int] | None = None) -> tuple[int, int]:
    height, width = frame.size
    if asked is None:
        return canvas_size(height), canvas_size(width)
    if len(asked) != 2 or asked[0] < height or asked[1] < width:
        raise ValueError(
            f"canvas is {asked}, expected (height, width) of at least {frame.size}, the frame's."
        )
    return asked[0], asked[1]


def has_canvas(denoiser: Denoiser) -> bool:
    """Whether it takes frames padded beyond their true size."""
    return getattr(denoiser, "canvas", False)


def _traced(values: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def _is_cut(
    job: Any,
    frame: Frame,
    canvas: tuple[int, int],
    max_memory: int | None,
    devices: Sequence[Any] | None,
) -> bool:
    """Whether the frame is computed window by window."""
    if devices is not None:
        if not devices:
            raise ValueError("devices is empty, expected some of jax.devices(), or None.")
        return True
    return max_memory is not None and not _windowed.fits(job, frame, canvas, max_memory)


def _no_tracers(values: Any) -> None:
    if _traced(values):
        raise ValueError(
            "max_memory or devices is given inside jit, vmap or grad, where a frame cannot be cut into "
            "windows: leave it out, or call from outside."
        )


def _asked(outputs: Sequence[str] | None) -> tuple[str, ...]:
    if outputs is None:
        return OUTPUTS
    if isinstance(outputs, str):
        raise ValueError(
            f"outputs is {outputs!r}, expected a sequence of names, such as ('image',)."
        )
    for name in outputs:
        _checks.choice("outputs", name, OUTPUTS)
    return tuple(name for name in OUTPUTS if name in outputs)
