"""A method's image of one render, and what is known of it beside the image."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array, Float

import progden_jax as pd
from progden_jax.combiner import BufferedCombiner, DeepCombiner
from progden_jax.denoisers import Denoiser, Network
from progden_jax.evaluation import parts
from progden_jax.evaluation.cost import Cost, metered
from progden_jax.evaluation.risk import risk_of_held, risk_of_mix
from progden_jax.evaluation.settings import NONE, Settings
from progden_jax.subaverages import SubAverages
from progden_jax.survey import frame_of
from progden_jax.training.evaluation import oracle_alpha

Image = Float[np.ndarray, "h w 3"]


class Estimate(NamedTuple):
    """The denoised image and what is known of it; only the image without an estimator.

    `denoiser` is as it was before an adaptation, for its mixer is found by it; `fitted` is what came of that.
    `frame` has the buffers that the denoiser takes and no more, which would make other programs of the same.
    """

    frame: pd.Frame
    denoiser: Denoiser
    fitted: Denoiser
    denoised: Image
    divergence: Image | None
    sure: Image | None
    cost: Cost


class Shown(NamedTuple):
    """A method's image, the estimate of its mean squared error, α where it mixes, and what it took."""

    image: Any
    risk: float | None = None
    alpha: Any = None
    cost: Cost = Cost()


def estimate(
    frame: pd.Frame,
    settings: Settings,
    max_memory: int | None,
    divided: SubAverages | None = None,
) -> Estimate:
    """The denoised image as the settings say, the denoiser fitted to the frame first if they do.

    `divided` are the frame's sub-averages, for a combiner of such.
    """
    denoiser = parts.denoiser_for(frame, settings)
    if isinstance(denoiser, Network) and settings.fit()[1] is None:
        taken = {n: getattr(frame, n) for n in ("color", "variance", *denoiser.inputs)}
        frame = frame_of({name: buffer for name, buffer in taken.items() if buffer is not None})
    fitted: Any = denoiser
    fitting = Cost(0.0)
    if divided is not None:
        fitted = BufferedCombiner.of(cast(DeepCombiner, denoiser), divided)
    if settings.adaptation != NONE:
        fitted, fitting = metered(lambda: parts.adapted(frame, denoiser, settings))
    made = functools.partial(Estimate, frame, denoiser, fitted)
    method = settings.method()
    if method is None:
        plain, cost = metered(lambda: pd.denoise(frame, fitted, max_memory=max_memory))
        return made(np.asarray(plain.image), None, None, fitting.then(cost))
    found, cost = metered(
        lambda: pd.progressive_denoise(
            frame,
            fitted,
            mixer=_Nothing(),
            bound=False,
            method=method,
            key=jax.random.key(settings.seed),
            outputs=("denoised", "sure", "divergence"),
            max_memory=max_memory,
        )
    )
    images = map(np.asarray, (found.denoised, found.divergence, found.sure))
    return made(*images, fitting.then(cost))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Known:
    """A denoiser whose output is there already."""

    image: Any

    def __call__(self, frame: pd.Frame) -> Array:
        return self.image

    def bind(self, frame: pd.Frame) -> Callable[[Array], Array]:
        return lambda x: self.image


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class _Nothing:
    """A mixer for where no mix is asked for: it costs least."""

    receptive_radius: int = 0

    def __call__(self, x: Array, *_: Any, **__: Any) -> Array:
        return jax.numpy.zeros_like(x)


def show(settings: Settings, frame: pd.Frame, made: Estimate | None, reference: Image) -> Shown:
    """What the settings make of the estimate, which only the render needs not; see `Shown`."""
    if made is None or settings.image == "render":
        return Shown(frame.color, None if frame.variance is None else mean_of(frame.variance))
    if settings.image == "denoised":
        risk = None if made.sure is None else mean_of(made.sure)
        return Shown(made.denoised, risk, cost=made.cost)
    if settings.image == "oracle":
        best, alpha = _oracle(frame.color, made.denoised, reference)
        return Shown(best, None, alpha)
    mixer = parts.mixer_for(made.denoiser, settings)
    found, cost = metered(
        lambda: pd.progressive_denoise(
            pd.Frame(frame.color, frame.variance),
            _Known(made.denoised),
            mixer=mixer,
            bound=settings.limits if settings.bound else False,
            divergence=cast(Any, made.divergence),
            outputs=("image", "alpha"),
            skip=False,
        )
    )
    if settings.risk_probes:
        risk = risk_of_mix(
            made.frame,
            made.fitted,
            mixer,
            settings.limits if settings.bound else None,
            method=cast(pd.Method, settings.method()),
            probes=settings.risk_probes,
            seed=settings.seed,
        )
    else:
        known: Any = (frame.color, made.denoised, frame.variance, made.divergence)
        risk = float(risk_of_held(found.alpha, *known))
    return Shown(found.image, risk, found.alpha, made.cost.then(cost))


@jax.jit
def _oracle(x: Array, y: Array, reference: Array) -> tuple[Array, Array]:
    alpha = oracle_alpha(x, y, reference)
    return x + alpha * (y - x), alpha


def mean_of(values: Any) -> float:
    """Over pixels and channels, in float64."""
    return float(np.asarray(values).mean(dtype=np.float64))
