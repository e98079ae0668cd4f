"""The chain for a frame or a window of one, compiled: repair, denoise, divergence, SURE, mix, bound."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from progden_jax import _checks
from progden_jax._windowed import Place
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method
from progden_jax.frame import Frame, Repairs, repair
from progden_jax.mixing import Mixer
from progden_jax.skipping import Skipped
from progden_jax.sure import sure
from progden_jax.tstatistic import Bound

OUTPUTS = ("image", "alpha", "denoised", "sure", "divergence")
"""Images that a `Result` can have."""


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
        return progressive

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


@jax.jit
def progressive(
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
class PlainJob:
    denoiser: Denoiser
    outputs = ("image",)
    method = None

    @property
    def program(self) -> Any:
        return plain

    @staticmethod
    def result(images: Mapping[str, Any], *, repairs: Repairs, **_: Any) -> Denoised:
        return Denoised(images["image"], repairs)


@jax.jit
def plain(
    job: PlainJob,
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
