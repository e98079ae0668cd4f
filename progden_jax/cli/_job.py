"""One file from input to output: read, denoise, mix, measure, write."""

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import jax
import numpy as np

import progden_jax as pd
from progden_jax import memory, mixers
from progden_jax.batch import Once, Size, canvas_of, shared_canvases
from progden_jax.cli._adaptation import (
    FITTED_SURE,
    AdaptOptions,
    Handed,
    adapted,
    described,
    read_parts,
)
from progden_jax.cli._compare import Scores, compare
from progden_jax.cli._options import (
    SAVE_ALWAYS,
    CostOptions,
    EstimateOptions,
    NetworkOptions,
    ReadOptions,
)
from progden_jax.cli._paths import Item
from progden_jax.cli._run import Failure, complain
from progden_jax.compilation import cache_folder
from progden_jax.divergence.running import ExactRun
from progden_jax.exr import ExrInfo, read_exr_with_info, write_exr
from progden_jax.exr._file import load
from progden_jax.frame import repaired
from progden_jax.pipeline import OUTPUTS


@dataclass(frozen=True)
class Settings:
    """All that holds for every file of a run."""

    read: ReadOptions
    network: NetworkOptions
    adaptation: AdaptOptions
    estimate: EstimateOptions
    cost: CostOptions
    save: tuple[str, ...] = ()
    half: bool = False
    force: bool = False
    shapes: Mapping[Size, Size] = field(default_factory=dict)
    """What images are computed at, by their own canvas."""
    first_of: Once = field(default_factory=Once)
    """So that a program is compiled by one thread."""
    handed: Handed = field(default_factory=Handed)
    """From one frame of a sequence to the next."""


@dataclass
class Outcome:
    """What became of one file; the fields are the keys of `--json`."""

    input: str
    output: str
    ok: bool = False
    error: str | None = None
    mode: str | None = None
    width: int | None = None
    height: int | None = None
    spp: float | None = None
    variance: str | None = None
    denoiser: str | None = None
    auxiliary: tuple[str, ...] = ()
    adaptation: dict[str, Any] | None = None
    method: str | None = None
    mixer: str | None = None
    mean_alpha: float | None = None
    mean_sure: float | None = None
    skipped: float | None = None
    skipped_why: str | None = None
    repairs: dict[str, int] = field(default_factory=dict)
    metrics: Scores | None = None
    seconds: float | None = None
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def line(self) -> str:
        """What was done, for people."""
        facts = [f"{self.width}×{self.height}"]
        if self.spp is not None:
            facts.append(f"{self.spp:g} spp")
        facts.append(f"{self.denoiser} ({' + '.join(('colour', *self.auxiliary))})")
        if self.adaptation is not None:
            facts.append(described(self.adaptation))
        if self.mean_alpha is None:
            facts.append("denoised plainly")
        else:
            facts.append(f"mean α {self.mean_alpha:.2f}")
        if self.skipped:
            facts.append(f"{self.skipped:.0%} skipped as right already")
        facts.append(f"{self.seconds:.1f} s")
        text = f"{self.input} → {self.output}: {', '.join(facts)}"
        bad = [f"{n} {_REPAIRS[name]}" for name, n in self.repairs.items() if n]
        return text + (f"; bad pixels: {', '.join(bad)}" if bad else "")


_REPAIRS = {
    "nonfinite_color": "with NaN or infinite colour (filled in)",
    "negative_color": "with negative colour (kept)",
    "nonfinite_variance": "with NaN or infinite variance (filled in)",
    "negative_variance": "with negative variance (set to 0)",
    "nonfinite_auxiliary": "with NaN or infinite albedo, normal or depth (set to 0)",
}


class _Images(NamedTuple):
    """The result, and other images of the run by name."""

    image: np.ndarray
    maps: dict[str, np.ndarray]


class Progress(Protocol):
    """Told how much of something long is done, of how much, and of what if not the exact divergence."""

    def __call__(self, done: int, total: int, of: str = ...) -> None: ...


def process(item: Item, settings: Settings, outcome: Outcome, progress: Progress) -> None:
    """Denoise one file, filling in `outcome` as things become known.

    `progress` follows an adaptation, and an exact divergence, which may take an hour.

    Raises
    ------
    ValueError
        What cannot be read, denoised or written; nothing is left at the output then.
    """
    start = time.perf_counter()
    read = settings.read.settings(item.variance_from, auxiliary=not settings.network.no_aux)
    frame, info = read_exr_with_info(item.input, **read)
    outcome.height, outcome.width = frame.size
    outcome.spp, outcome.variance = info.spp, info.variance
    outcome.warnings += info.warnings
    outcome.notes += info.notes
    parts = None
    if item.halves:
        parts = read_parts(item, frame, read, outcome)
        frame = parts.frame
    reference = None if item.reference is None else _reference(item, frame, outcome)
    frame = _with_usable_variance(frame, info, outcome)
    frame, denoiser = settings.network.load(frame)
    outcome.denoiser = denoiser.name
    outcome.auxiliary = tuple(n for n in denoiser.inputs if getattr(frame, n) is not None)
    # Other numbers than the probes of the divergence.
    key = jax.random.fold_in(jax.random.key(settings.estimate.seed), 1)
    denoiser = adapted(
        frame, denoiser, parts, settings.adaptation, key, settings.handed, outcome, progress
    )
    if settings.adaptation.fits and "sure" in settings.save:
        outcome.warnings.append(FITTED_SURE)
    images, checkpoint = _denoise(item, frame, denoiser, settings, outcome, progress)
    if reference is not None:
        outcome.metrics = _measure(images, frame, reference)
    picture, layers = _chosen(images, frame, settings.save, outcome)
    del images, frame  # while a huge image is written, no other is held
    memory.release()
    outcome.notes += write_exr(
        item.output,
        picture,
        layers=layers,
        like=info,
        spp=outcome.spp,
        overwrite=settings.force,
        half=settings.half,
    )
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    outcome.seconds = round(time.perf_counter() - start, 3)
    outcome.ok = True


def shared_shapes(items: Sequence[Item]) -> dict[Size, Size]:
    """Few shapes for all the images, from their headers; what cannot be read is told of in its turn."""
    if len(items) == 1:
        return {}
    sizes = []
    for item in items:
        with contextlib.suppress(ValueError, OSError):
            sizes += [part.size for part in load(item.input, header_only=True)]
    return shared_canvases(sizes)


def _with_usable_variance(frame: pd.Frame, info: ExrInfo, outcome: Outcome) -> pd.Frame:
    if frame.variance is None:
        outcome.warnings.append(
            f"denoised plainly; variance: {info.variance}. --variance-of says what channels that are no "
            "variance of the mean hold"
        )
    elif not (np.asarray(frame.variance) > 0).any():
        if info.spp == 1:
            outcome.warnings.append(
                "denoised plainly, for the variance is zero: 1 sample per pixel has no spread"
            )
            return frame.replace(variance=None)
        outcome.warnings.append(
            "the variance is zero in every pixel, so the render counts as converged and stays as it is; "
            "if that is for lack of samples, say --spp 1"
        )
    return frame


def _reference(item: Item, frame: pd.Frame, outcome: Outcome) -> np.ndarray:
    assert item.reference is not None
    found, _ = read_exr_with_info(item.reference, auxiliary=False)
    if found.size != frame.size:
        (h, w), (height, width) = found.size, frame.size
        raise Failure(
            f"{item.reference}: the reference is {w}×{h} pixels (width × height) but {item.input} "
            f"is {width}×{height}: they must show the same view."
        )
    color = np.asarray(found.color)
    if not np.isfinite(color).all():
        bad = int((~np.isfinite(color)).any(-1).sum())
        outcome.warnings.append(f"the reference has {bad} pixels of NaN or infinity, filled in")
        color = np.asarray(repaired(found).color)
    return color


def _denoise(
    item: Item,
    frame: pd.Frame,
    denoiser: pd.Denoiser,
    settings: Settings,
    outcome: Outcome,
    progress: Progress,
) -> tuple[_Images, Path | None]:
    """The images, and a file to be removed once they are written."""
    checkpoint = None
    estimate = settings.estimate
    max_memory = settings.cost.max_bytes()
    if max_memory is not None:
        frame_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(frame))
        max_memory -= max(memory.resident(), frame_bytes)
    if frame.variance is None:
        outcome.mode = "plain"
        denoised, repairs = pd.denoise(frame, denoiser, max_memory=max_memory)
        image = np.asarray(denoised)
        maps = {"denoised": image}
    else:
        method = estimate.build()
        outcome.mode, outcome.method = "progressive", repr(method)
        how: dict[str, Any] = {"method": method}
        if isinstance(method, pd.Exact):
            divergence, checkpoint = _exactly(frame, denoiser, method, outcome, progress)
            how = {"divergence": divergence}
        mixer = mixers.load(estimate.mixer) if estimate.mixer else mixers.default_for(denoiser)
        outcome.mixer = repr(mixer)
        compared = set() if item.reference is None else {"denoised"}
        names = [n for n in OUTPUTS if n in {"image", *settings.save, *compared}]
        own = canvas_of(frame.size)
        canvas = settings.shapes.get(own)
        result = settings.first_of(
            (canvas or own, outcome.denoiser, tuple(names)),
            lambda: pd.progressive_denoise(
                frame,
                denoiser,
                mixer=mixer,
                key=jax.random.key(estimate.seed),
                outputs=names,
                skip=settings.cost.rule(),
                max_memory=max_memory,
                canvas=canvas,
                **how,
            ),
        )
        repairs, image = result.repairs, np.asarray(result.image)
        maps = {name: np.asarray(getattr(result, name)) for name in names if name != "image"}
        outcome.mean_alpha = float(np.asarray(result.mean_alpha))
        outcome.mean_sure = float(np.asarray(result.mean_sure))
        if result.skipped is not None:
            outcome.skipped = result.skipped.pixels / (frame.size[0] * frame.size[1])
            outcome.skipped_why = result.skipped.reason or None
    outcome.repairs = {name: int(n) for name, n in repairs._asdict().items()}
    if not np.isfinite(image).all():
        raise Failure(f"{outcome.input}: the result is not finite; nothing was written.")
    return _Images(image, maps), checkpoint


def _exactly(
    frame: pd.Frame,
    denoiser: pd.Denoiser,
    method: pd.Exact,
    outcome: Outcome,
    progress: Progress,
) -> tuple[jax.Array, Path | None]:
    """The exact divergence, and the checkpoint that holds it."""
    frame = repaired(frame)
    variance = cast(jax.Array, frame.variance)
    run = ExactRun(denoiser.bind(frame), frame.color, variance, method=method)
    checkpoint: Path | None = cache_folder() / "exact" / f"{run.key}.npz"
    try:
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        checkpoint = None
    try:
        return run.finish(progress=progress, checkpoint=checkpoint).divergence, checkpoint
    except KeyboardInterrupt:
        if checkpoint is not None and checkpoint.exists():
            complain(
                f"{outcome.input}: {run.done / run.total:.0%} of the exact divergence are kept in "
                f"{checkpoint}; the same command goes on from there"
            )
        raise


def _measure(images: _Images, frame: pd.Frame, reference: np.ndarray) -> Scores:
    noisy = np.asarray(frame.color)
    if not np.isfinite(noisy).all():
        noisy = np.asarray(repaired(frame).color)
    compared = {"noisy": noisy, "denoised": images.maps["denoised"]}
    if frame.variance is not None:
        compared["mixed"] = images.image
    return compare(compared, reference)


_LAYERS = {"variance": "noisy_variance"}
"""Layers named otherwise than asked for: Variance would be read as that of the result."""


def _chosen(
    images: _Images, frame: pd.Frame, save: Sequence[str], outcome: Outcome
) -> tuple[Any, dict[str, Any]]:
    """What to write: the image, as a frame if buffers of the input go with it, and the layers."""
    inputs = {"noisy": frame.color, "variance": frame.variance}
    layers, buffers, missing = {}, {}, []
    for name in save:
        if name in ("albedo", "normal"):
            found = buffers[name] = getattr(frame, name)
        else:
            found = inputs[name] if name in inputs else images.maps.get(name)
            layers[_LAYERS.get(name, name)] = found
        if found is None:
            missing.append(name)
    if missing:
        lack = "the file has none" if set(missing) <= set(SAVE_ALWAYS) else "there is no variance"
        outcome.warnings.append(f"not saved: {', '.join(missing)}, for {lack}")
    picture = pd.Frame(images.image, None, **buffers) if buffers else images.image
    return picture, {name: layer for name, layer in layers.items() if layer is not None}
