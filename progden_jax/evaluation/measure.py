"""One render by some methods: their images, how far they are from the reference, and the rows that say so."""

import functools
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array

import progden_jax as pd
from progden_jax import metrics
from progden_jax.evaluation import parts
from progden_jax.evaluation.database import IMAGES, Row
from progden_jax.evaluation.images import Estimate, Image, Shown, estimate, mean_of, show
from progden_jax.evaluation.plan import Cell
from progden_jax.evaluation.settings import Settings
from progden_jax.exr import write_exr
from progden_jax.frame import centre
from progden_jax.subaverages import SubAverages
from progden_jax.survey import frame_of, survey
from progden_jax.training.config import Meaning
from progden_jax.training.data import sub_averages
from progden_jax.training.index import Item, earlier


class Job(NamedTuple):
    """What one process does at a time: the methods that share an estimate, on one render.

    Attributes
    ----------
    cells : of one item, and of one `Settings.estimate` but for those that show the render.
    variance_of : what the files' variance channels hold.
    crop : side of the centre square that is looked at; 0: the whole images.
    run : folder to keep images in; None: they are not kept.
    max_memory : see `progden_jax.progressive_denoise`.
    """

    cells: tuple[Cell, ...]
    variance_of: Meaning = "mean"
    crop: int = 0
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
    """What is looked at of a render and its reference, repaired; `noise` is the reference's mean variance.

    `divided` are the render's sub-averages, where there is use for them.
    """

    frame: pd.Frame
    reference: Image
    noise: float
    divided: SubAverages | None


def measure(job: Job) -> list[Row]:
    """The rows of a job, in its order; images are written first.

    Raises
    ------
    ValueError
        If a file cannot be read, sizes differ, or the render lacks what a method takes.
    """
    count = 1 if job.shown is None else parts.sub_averages(job.shown)
    pair = _read(job.item, job.variance_of, job.crop, count)
    made = None
    if job.shown is not None:
        made = estimate(pair.frame, job.shown, job.max_memory, pair.divided)
    return [_row(cell, pair, made, job) for cell in job.cells]


def _read(item: Item, variance_of: Meaning, crop: int, count: int) -> _Pair:
    given = None if variance_of == "mean" else variance_of
    files = {item.spp: item.path, **earlier(item, count)}
    frame, *before = (_sound(pd.read_exr(path, variance_of=given)) for path in files.values())
    reference = _reference(item.reference, given)
    if frame.size != reference.size:
        (height, width), (high, wide) = frame.size, reference.size
        raise ValueError(
            f"{item.path} is {width}×{height} pixels but its reference {item.reference} is {wide}×{high}."
        )
    try:
        frame, truth, *before = (
            centre(f, crop) if crop else f for f in (frame, reference, *before)
        )
    except ValueError as error:
        raise ValueError(f"{item.path}: {error}") from None
    noise = 0.0 if truth.variance is None else mean_of(truth.variance)
    series = dict(zip(files, (frame, *before), strict=True))
    divided = sub_averages(item, series) if before else None
    return _Pair(frame, np.asarray(truth.color), noise, divided)


@functools.lru_cache(maxsize=2)
def _reference(path: Path, variance_of: Any) -> pd.Frame:
    return _sound(pd.read_exr(path, variance_of=variance_of, auxiliary=False))


def _sound(frame: pd.Frame) -> pd.Frame:
    found = survey(frame)
    return frame_of({name: found.repaired(name) for name in found.buffers})


@jax.jit
def _scores(image: Array, reference: Array) -> dict[str, Array]:
    names = ("rmse", "smape", "relmse", "ssim")
    return {name: getattr(metrics, name)(image, reference) for name in names}


def _row(cell: Cell, pair: _Pair, made: Estimate | None, job: Job) -> Row:
    settings, frame = cell.method.settings, pair.frame
    shown = show(settings, frame, made, pair.reference)
    image = np.asarray(shown.image)
    if not np.isfinite(image).all():
        raise ValueError(f"{cell.item.path}: the result of {cell.method.label!r} is not finite.")
    scores = {name: float(v) for name, v in _scores(image, pair.reference).items()}
    scores["flip"] = metrics.flip(cast(Any, image), cast(Any, pair.reference))
    of = made if settings.image != "render" else None
    kept = None
    if job.run is not None:
        kept = f"{IMAGES}/{cell.key}.exr"
        _keep(job.run / kept, image, shown, of)
    return Row(
        key=cell.key,
        scene=cell.item.scene,
        spp=cell.item.spp,
        method=cell.method.label,
        settings={**settings.flat(), **parts.trained_as(settings)},
        **scores,
        mse=_squared_error(image, pair),
        sure=None if of is None or of.sure is None else mean_of(of.sure),
        denoised_mse=None if of is None else _squared_error(of.denoised, pair),
        seconds=shown.cost.seconds,
        render=str(cell.item.path),
        reference=str(cell.item.reference),
        image=kept,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        risk=shown.risk,
        sure_error=None if of is None or of.sure is None else _standard_error(of.sure),
        alpha=None if shown.alpha is None else mean_of(shown.alpha),
        memory=shown.cost.memory,
        crop=job.crop or None,
    )


def _keep(path: Path, image: Image, shown: Shown, made: Estimate | None) -> None:
    layers = {"alpha": shown.alpha}
    if made is not None:
        layers |= {"sure": made.sure, "denoised": made.denoised}
    path.parent.mkdir(exist_ok=True)
    present = {name: layer for name, layer in layers.items() if layer is not None}
    write_exr(path, image, layers=present, overwrite=True)


def _squared_error(image: Image, pair: _Pair) -> float:
    difference = np.asarray(image, np.float64) - pair.reference
    return float(np.mean(difference**2)) - pair.noise


def _standard_error(values: Image) -> float:
    """Of the mean over pixels, whose channels go together."""
    pixels = np.asarray(values, np.float64).mean(-1)
    return float(pixels.std() / np.sqrt(pixels.size))
