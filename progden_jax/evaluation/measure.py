"""One render by some methods: their images, how far they are from the reference, and the rows that say so."""

import dataclasses
import functools
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array, Float

import progden_jax as pd
from progden_jax import metrics
from progden_jax.compilation import count_compilations
from progden_jax.denoisers import Denoiser, Network
from progden_jax.evaluation import parts
from progden_jax.evaluation.database import IMAGES, Row
from progden_jax.evaluation.plan import Cell
from progden_jax.evaluation.settings import Settings
from progden_jax.exr import write_exr
from progden_jax.survey import frame_of, survey
from progden_jax.training.config import Meaning
from progden_jax.training.evaluation import oracle_alpha
from progden_jax.training.index import Item

Image = Float[np.ndarray, "h w 3"]


class Job(NamedTuple):
    """What one process does at a time: the methods that share an estimate, on one render.

    Attributes
    ----------
    cells : of one item, and of one `Settings.estimate` but for those that show the render.
    variance_of : what the files' variance channels hold.
    run : folder to keep images in; None: they are not kept.
    max_memory : see `progden_jax.progressive_denoise`.
    """

    cells: tuple[Cell, ...]
    variance_of: Meaning = "mean"
    run: Path | None = None
    max_memory: int | None = None

    @property
    def item(self) -> Item:
        """The render."""
        return self.cells[0].item

    @property
    def shown(self) -> Settings | None:
        """Settings that have the estimate; None where only the render is shown."""
        return next((c.method.settings for c in self.cells if _estimates(c)), None)


def jobs(cells: list[Cell], **rest: Any) -> list[Job]:
    """The cells in jobs; the render goes with the first estimate of its item."""
    by_item: dict[tuple[str, int], dict[tuple[Any, ...] | None, list[Cell]]] = {}
    for cell in cells:
        groups = by_item.setdefault((cell.item.scene, cell.item.spp), {})
        same = cell.method.settings.estimate() if _estimates(cell) else None
        groups.setdefault(same, []).append(cell)
    found = []
    for groups in by_item.values():
        renders = groups.pop(None, [])
        for group in groups.values() or [[]]:
            found.append(Job((*renders, *group), **rest))
            renders = []
    return found


def _estimates(cell: Cell) -> bool:
    return cell.method.settings.image != "render"


class _Pair(NamedTuple):
    """A render and its reference, bad pixels repaired; `noise` is the reference's mean variance."""

    frame: pd.Frame
    reference: Image
    noise: float


class _Estimate(NamedTuple):
    """The denoised image and what is known of it; only the image without an estimator.

    `denoiser` is as it was before an adaptation: its mixer is found by it.
    """

    denoiser: Denoiser
    denoised: Image
    divergence: Image | None
    sure: Image | None
    seconds: float | None


class _Shown(NamedTuple):
    """A method's image, α where it mixes, and what it took."""

    image: Any
    alpha: Any = None
    seconds: float | None = None


def measure(job: Job) -> list[Row]:
    """The rows of a job, in its order; images are written first.

    Raises
    ------
    ValueError
        If a file cannot be read, sizes differ, or the render lacks what a method takes.
    """
    pair = _read(job.item, job.variance_of)
    estimate = None if job.shown is None else _estimate(pair.frame, job.shown, job.max_memory)
    return [_row(cell, pair, estimate, job.run) for cell in job.cells]


def _read(item: Item, variance_of: Meaning) -> _Pair:
    given = None if variance_of == "mean" else variance_of
    frame = pd.read_exr(item.path, variance_of=given)
    reference = _reference(item.reference, given)
    if frame.size != reference.frame.size:
        (height, width), (high, wide) = frame.size, reference.frame.size
        raise ValueError(
            f"{item.path} is {width}×{height} pixels but its reference {item.reference} is {wide}×{high}."
        )
    return reference._replace(frame=_sound(frame))


@functools.lru_cache(maxsize=2)
def _reference(path: Path, variance_of: Any) -> _Pair:
    frame = _sound(pd.read_exr(path, variance_of=variance_of, auxiliary=False))
    noise = 0.0 if frame.variance is None else _mean(frame.variance)
    return _Pair(frame, np.asarray(frame.color), noise)


def _sound(frame: pd.Frame) -> pd.Frame:
    return frame_of(survey(frame).buffers)


def _estimate(frame: pd.Frame, settings: Settings, max_memory: int | None) -> _Estimate:
    denoiser = parts.denoiser_for(frame, settings)
    if isinstance(denoiser, Network) and settings.adaptation != "post-correct":
        # Buffers that it does not look at would make other programs of the same.
        taken = {n: getattr(frame, n) for n in ("color", "variance", *denoiser.inputs)}
        frame = frame_of({name: buffer for name, buffer in taken.items() if buffer is not None})
    fitted = functools.partial(parts.adapted, frame, denoiser, settings)
    method = settings.method()
    if method is None:
        plain, seconds = _timed(lambda: pd.denoise(frame, fitted(), max_memory=max_memory))
        return _Estimate(denoiser, np.asarray(plain.image), None, None, seconds)
    found, seconds = _timed(
        lambda: pd.progressive_denoise(
            frame,
            fitted(),
            mixer=_Nothing(),
            bound=False,
            method=method,
            key=jax.random.key(settings.seed),
            outputs=("denoised", "sure", "divergence"),
            max_memory=max_memory,
        )
    )
    denoised, divergence, risk = map(np.asarray, (found.denoised, found.divergence, found.sure))
    return _Estimate(denoiser, denoised, divergence, risk, seconds)


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


def _show(settings: Settings, frame: pd.Frame, estimate: _Estimate | None) -> _Shown:
    if estimate is None or settings.image == "render":
        return _Shown(frame.color)
    if settings.image == "denoised":
        return _Shown(estimate.denoised, None, estimate.seconds)
    found, seconds = _timed(
        lambda: pd.progressive_denoise(
            pd.Frame(frame.color, frame.variance),
            _Known(estimate.denoised),
            mixer=parts.mixer_for(estimate.denoiser, settings),
            bound=settings.limits if settings.bound else False,
            divergence=cast(Any, estimate.divergence),
            outputs=("image", "alpha"),
            skip=False,
        )
    )
    both = None if seconds is None or estimate.seconds is None else estimate.seconds + seconds
    return _Shown(found.image, found.alpha, both)


@jax.jit
def _oracle(x: Array, y: Array, reference: Array) -> tuple[Array, Array]:
    alpha = oracle_alpha(x, y, reference)
    return x + alpha * (y - x), alpha


@jax.jit
def _scores(image: Array, reference: Array) -> dict[str, Array]:
    names = ("rmse", "smape", "relmse", "ssim")
    return {name: getattr(metrics, name)(image, reference) for name in names}


def _row(cell: Cell, pair: _Pair, estimate: _Estimate | None, run: Path | None) -> Row:
    settings, frame = cell.method.settings, pair.frame
    if settings.image == "oracle" and estimate is not None:
        shown = _Shown(*_oracle(frame.color, estimate.denoised, pair.reference))
    else:
        shown = _show(settings, frame, estimate)
    image = np.asarray(shown.image)
    if not np.isfinite(image).all():
        raise ValueError(f"{cell.item.path}: the result of {cell.method.label!r} is not finite.")
    scores = {name: float(v) for name, v in _scores(image, pair.reference).items()}
    scores["flip"] = metrics.flip(cast(Any, image), cast(Any, pair.reference))
    of = estimate if settings.image != "render" else None
    kept = None
    if run is not None:
        kept = f"{IMAGES}/{cell.key}.exr"
        _keep(run / kept, image, shown, of)
    return Row(
        key=cell.key,
        scene=cell.item.scene,
        spp=cell.item.spp,
        method=cell.method.label,
        settings={**settings.flat(), **parts.trained_as(settings)},
        **scores,
        mse=_squared_error(image, pair),
        sure=None if of is None or of.sure is None else _mean(of.sure),
        denoised_mse=None if of is None else _squared_error(of.denoised, pair),
        seconds=shown.seconds,
        render=str(cell.item.path),
        reference=str(cell.item.reference),
        image=kept,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _keep(path: Path, image: Image, shown: _Shown, estimate: _Estimate | None) -> None:
    layers = {"alpha": shown.alpha}
    if estimate is not None:
        layers |= {"sure": estimate.sure, "denoised": estimate.denoised}
    path.parent.mkdir(exist_ok=True)
    present = {name: layer for name, layer in layers.items() if layer is not None}
    write_exr(path, image, layers=present, overwrite=True)


def _squared_error(image: Image, pair: _Pair) -> float:
    difference = np.asarray(image, np.float64) - pair.reference
    return float(np.mean(difference**2)) - pair.noise


def _mean(values: Any) -> float:
    return float(np.asarray(values).mean(dtype=np.float64))


def _timed(call: Callable[[], Any]) -> tuple[Any, float | None]:
    """What it gives, and the seconds it took; None where a program was compiled, which takes longer."""
    compiled = count_compilations()
    start = time.perf_counter()
    found = jax.block_until_ready(call())
    seconds = time.perf_counter() - start
    return found, seconds if count_compilations() == compiled else None
