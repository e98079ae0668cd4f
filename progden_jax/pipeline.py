"""One frame from render to result: whole, window by window, or only where there is noise."""

from collections.abc import Sequence
from typing import Any, cast

import jax
from jax.core import Tracer
from jaxtyping import Array, Float

from progden_jax import _checks, _windowed, memory, skipping, tiling
from progden_jax._canvas import call_of, canvas_size, cropped, has_canvas
from progden_jax._devices import Device
from progden_jax._program import OUTPUTS, Denoised, Job, PlainJob, Result, checked_variance
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import passable
from progden_jax.divergence import Method, MonteCarlo
from progden_jax.frame import Frame
from progden_jax.mixers import default_for
from progden_jax.mixing import Mixer
from progden_jax.skipping import Skip, Skipped
from progden_jax.tstatistic import Bound

__all__ = ["DEFAULT_METHOD", "OUTPUTS", "Denoised", "Result", "denoise", "progressive_denoise"]

DEFAULT_METHOD = MonteCarlo(probes=1)
"""One probe: averaging windows remove its noise, see experiments/main_job."""

_WORTH_COMPILING = 1e6
"""Pixels of a frame whose windows get programs of their own among many frames."""

_SKIPPABLE = frozenset({"image", "alpha"})
"""Outputs that are known, x and 0, where a tile is right already."""


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
        it, else the one for any.
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
        as NumPy arrays. The result is the same to 1e-5, but for methods that rank the frame's variances
        (`Probing`, `TruncatedCone`): these look at each window alone.
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
    job = PlainJob(denoiser)
    if _is_cut(job, frame, _canvas(frame), max_memory, devices):
        _no_tracers((frame, denoiser))
        reach = tiling.margin(denoiser)
        return _windowed.within(job, frame, None, None, max_memory, reach=reach, devices=devices)
    if _traced((frame, denoiser)):
        return job.program(job, frame, None)
    return _at_once(job, frame, None, _canvas(frame))


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


def _at_once(job: Any, frame: Frame, divergence: Array | None, canvas: tuple[int, int]) -> Any:
    memory.trim_for(canvas[0] * canvas[1])
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
    active = skipping.noisy_tiles(frame.color, variance, skip, canvas)
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
