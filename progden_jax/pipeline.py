"""The whole chain for one frame: repair, denoise, divergence, SURE, mix, bound."""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from progden_jax import _checks
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method, MonteCarlo
from progden_jax.frame import Frame, Repairs, repair
from progden_jax.mixers import default_for
from progden_jax.mixing import Mixer
from progden_jax.sure import sure
from progden_jax.tstatistic import t_bound

DEFAULT_METHOD = MonteCarlo(probes=1)
"""One probe: averaging windows remove its noise, see experiments/main_job."""


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
    """

    image: Float[Array, "h w 3"]
    alpha: Float[Array, "h w 3"]
    denoised: Float[Array, "h w 3"]
    sure: Float[Array, "h w 3"]
    divergence: Float[Array, "h w 3"]
    repairs: Repairs


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
    key: jax.Array | None = None,
    divergence: Float[Array, "h w 3"] | None = None,
) -> Result:
    """The mix of render and denoised image that converges to the truth as samples grow.

    Compiled once per denoiser and size; sizes are rounded up to a canvas, so that images of nearby sizes
    share a program. Differentiable in the denoiser's weights and in the colour. Inside ``jit``, ``vmap``
    or ``grad`` the sizes are taken as they are.

    Parameters
    ----------
    frame : one frame with a variance; map over a batch with ``jax.vmap``.
    denoiser : see `progden_jax.denoisers.load`, or any `Denoiser`.
    mixer : gives α; by default what `mixers.default_for` has for the denoiser: a network shipped for
        it, else the closed form over 15×15 windows.
    method : estimator of the divergence; by default `MonteCarlo` with one probe.
    key : of the random probes; None stands for ``jax.random.key(0)``.
    divergence : σ²·∂f/∂x where it is known already, as from `exact_divergence`, of
        ``denoiser.bind(frame)`` for a frame whose bad pixels are repaired (`progden_jax.repair`); then there
        is no method to choose.

    Raises
    ------
    ValueError
        If the frame has no variance, is no single image, or lacks what the denoiser takes; if the
        divergence is no image of its size, or comes with a method.

    Notes
    -----
    Firmino et al. 2022. Cost: one denoiser pass and one tangent pass per probe, and little else.
    """
    _checks.image("frame.color", frame.color)
    if frame.variance is None:
        raise ValueError(
            "the frame has no variance, and progressive denoising needs that of the sample mean: give one, "
            "make one from half-buffers or several seeds (read_exr's variance_from), or denoise "
            "plainly with `denoise(frame, denoiser)`."
        )
    if divergence is not None:
        _checks.same_shape("divergence", divergence, "frame.color", frame.color)
        if method is not None:
            raise ValueError(
                f"a divergence is given and a method, {method!r}, to find it: give one of them."
            )
    mixer = default_for(denoiser) if mixer is None else mixer
    method = DEFAULT_METHOD if method is None else method
    key = jax.random.key(0) if key is None else key
    return _on_canvas(
        _progressive, frame, denoiser, mixer, key, images=(divergence,), method=method
    )


def denoise(frame: Frame, denoiser: Denoiser) -> Denoised:
    """The denoiser alone, with bad pixels repaired: what remains to be had without a variance."""
    _checks.image("frame.color", frame.color)
    return _on_canvas(_plain, frame, denoiser)


Valid = tuple[Int[Array, ""], Int[Array, ""]]


@functools.partial(jax.jit, static_argnames="method")
def _progressive(
    frame: Frame,
    denoiser: Denoiser,
    divergence: Array | None,
    mixer: Mixer,
    key: jax.Array,
    valid: Valid | None = None,
    *,
    method: Method,
) -> Result:
    frame, inside, repairs = _prepare(frame, valid)
    x, variance = frame.color, cast(Array, frame.variance)
    f = _bind(denoiser, frame, valid)
    if divergence is None:
        y, divergence, *_ = method.evaluate(f, x, variance, key)
    else:
        y = f(x)
    risk = sure(x, y, variance, divergence)
    alpha = mixer(x, y, variance, divergence, risk, inside=inside)
    alpha = t_bound(alpha, x, y, variance, inside=inside)
    return Result(x + alpha * (y - x), alpha, y, risk, divergence, repairs)


@jax.jit
def _plain(frame: Frame, denoiser: Denoiser, valid: Valid | None = None) -> Denoised:
    frame, _, repairs = _prepare(frame, valid)
    return Denoised(_bind(denoiser, frame, valid)(frame.color), repairs)


def _prepare(frame: Frame, valid: Valid | None) -> tuple[Frame, Array | None, Repairs]:
    inside = None
    if valid is not None:
        rows, columns = (jnp.arange(n) < v for n, v in zip(frame.size, valid, strict=True))
        inside = (rows[:, None] & columns[None, :])[..., None]
    repaired, repairs = repair(frame, inside=inside)
    return repaired, inside, repairs


def _bind(denoiser: Denoiser, frame: Frame, valid: Valid | None) -> Any:
    return denoiser.bind(frame) if valid is None else denoiser.bind(frame, valid=valid)  # pyright: ignore[reportCallIssue]


def canvas_size(n: int) -> int:
    """`n` pixels rounded up so that there are eight sizes per doubling, multiples of 16."""
    step = max(16, 1 << max(n.bit_length() - 4, 0))
    return -(-n // step) * step


def _on_canvas(
    run: Any,
    frame: Frame,
    denoiser: Denoiser,
    *arguments: Any,
    images: tuple[Array | None, ...] = (),
    **static: Any,
) -> Any:
    """`run` on the frame and images padded to its canvas, cropped again, unless tracing or the
    denoiser forbids it."""
    size = frame.size
    canvas = tuple(canvas_size(n) for n in size)
    leaves = jax.tree.leaves((frame, denoiser, images))
    traced = any(isinstance(leaf, Tracer) for leaf in leaves)
    if traced or not getattr(denoiser, "canvas", False):
        return run(frame, denoiser, *images, *arguments, **static)
    padding = [(0, big - small) for big, small in zip(canvas, size, strict=True)] + [(0, 0)]

    def pad(buffer: Array) -> Any:
        return np.pad(np.asarray(buffer), padding) if canvas != size else buffer

    padded = {}
    for name in ("color", "variance", "albedo", "normal", "depth"):
        buffer = getattr(frame, name)
        if buffer is not None:
            padded[name] = pad(buffer)
    valid = tuple(np.int32(n) for n in size)
    result = run(
        Frame(padded.pop("color"), padded.pop("variance", None), **padded),
        denoiser,
        *(None if image is None else pad(image) for image in images),
        *arguments,
        valid,
        **static,
    )
    if canvas == size:
        return result
    height, width = size
    return jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a)[:height, :width]) if a.ndim else a, result
    )
