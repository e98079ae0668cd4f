"""A series and its reference as files, complete or going on where they stopped."""

import contextlib
import hashlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from progden_jax import __version__, _checkpoint
from progden_jax.exr import ExrError, write_exr
from progden_jax.exr._file import load
from progden_jax.rendering import _mitsuba
from progden_jax.rendering.loading import load_scene, loaded
from progden_jax.rendering.moments import AUXILIARY, Moments, none
from progden_jax.rendering.sampling import Samples
from progden_jax.rendering.scenes import DEPTH
from progden_jax.rendering.scenes import scene as drawn
from progden_jax.rendering.series import frame, grow

ATTRIBUTE = "progdenRender"
"""In every file: all that determines its pixels, in words."""

SAVE_SECONDS, SAVE_RATIO = 20.0, 20.0
"""A checkpoint is written after this time, and this many times what writing the last one took."""

_log = logging.getLogger(__name__)

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Sampling:
    """How scenes are sampled.

    Parameters
    ----------
    spp, reference_spp : samples per pixel of the series, increasing from 2 up, and of the reference, 0
        for none; it must not be among `spp`.
    size : height and width in pixels; None: 128×128, or what an XML scene's film has.
    max_depth : longest path in segments; None: 9, or what an XML scene's integrator does.
    """

    spp: tuple[int, ...]
    reference_spp: int
    size: tuple[int, int] | None = None
    max_depth: int | None = None


@dataclass(frozen=True)
class Job:
    """One scene's files.

    Parameters
    ----------
    name : files are NAME_SSSSSSspp.exr.
    made_of : what scene it is and how it is sampled, in words: files of other words are not taken for
        this job's.
    spp, reference_spp : as of `Sampling`.
    load : the ``mitsuba.Scene``; called only if a file is missing.
    options : keyword arguments of `Samples`.
    """

    name: str
    made_of: str
    spp: tuple[int, ...]
    reference_spp: int
    load: Callable[[], Any]
    options: Mapping[str, Any]

    @property
    def counts(self) -> tuple[int, ...]:
        """Of all files."""
        return (*self.spp, self.reference_spp) if self.reference_spp else self.spp

    def path(self, folder: Path, spp: int) -> Path:
        return folder / f"{self.name}_{spp:06d}spp.exr"

    def missing(self, folder: Path, *, force: bool = False) -> tuple[int, ...]:
        """The counts that are still to be rendered, all of them if forced.

        Raises
        ------
        ValueError
            If a file is there that was made in another way.
        """
        if force:
            return self.counts
        found = [spp for spp in self.counts if self.path(folder, spp).exists()]
        for spp in found:
            path = self.path(folder, spp)
            made_of = load(path, header_only=True)[0].header.get(ATTRIBUTE)
            if made_of != self.made_of:
                was = f"made of {made_of!r}" if made_of else "not written by progden render"
                raise ExrError(
                    f"{path} is {was}, this run's files of {self.made_of!r}: pass --force to replace it, "
                    "or another -o."
                )
        return tuple(spp for spp in self.counts if spp not in found)

    def paths_left(self, folder: Path, *, force: bool = False) -> int:
        """How many paths per pixel that takes, checkpoints left aside."""
        missing = self.missing(folder, force=force)
        series = [spp for spp in missing if spp != self.reference_spp]
        return (series[-1] if series else 0) + self.reference_spp * (self.reference_spp in missing)


def procedural(seed: int, kind: str | None, sampling: Sampling) -> Job:
    """The job of the scene `scene(seed, kind)`, named KINDSEED or, where the seed chose, sceneSEED."""
    size, depth = sampling.size or (128, 128), sampling.max_depth or DEPTH

    def load() -> Any:
        return loaded(drawn(seed, kind, size=size, max_depth=depth))

    name = f"{kind or 'scene'}{seed:04d}"
    return _job(name, f"{kind or 'any'} scene {seed}, depth {depth}", load, seed, 0, sampling)


def of_xml(
    path: Path, parameters: Mapping[str, str], sensor: int, seed: int, sampling: Sampling
) -> Job:
    """The job of a Mitsuba XML scene, named like the file; for sensors but the first NAME-sensorN.

    Other files that the scene names count as unchanged when rendering is resumed.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    text = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    given = "".join(f" {name}={value}" for name, value in sorted(parameters.items()))
    depth = f", depth {sampling.max_depth}" if sampling.max_depth else ""
    made_of = f"{path.name} {text}{given}, sensor {sensor}{depth}"
    name = path.stem + (f"-sensor{sensor}" if sensor else "")
    return _job(name, made_of, lambda: load_scene(path, parameters), seed, sensor, sampling)


def _job(
    name: str, made_of: str, load: Callable[[], Any], seed: int, sensor: int, sampling: Sampling
) -> Job:
    mi = _mitsuba.load()

    options = {
        "size": sampling.size,
        "seed": seed,
        "sensor": sensor,
        "max_depth": sampling.max_depth,
    }
    size = "own size" if sampling.size is None else "×".join(map(str, reversed(sampling.size)))
    by = f"{mi.variant()} of Mitsuba {mi.__version__}, progden_jax {__version__}"
    made_of = f"{made_of}; {size}, seed {seed}; {by}"
    return Job(name, made_of, sampling.spp, sampling.reference_spp, load, options)


def render(
    job: Job, folder: Path, *, force: bool = False, progress: Progress = lambda paths: None
) -> list[Path]:
    """Write what is missing of the job's files; returns their paths.

    Killed at any moment it leaves whole files only, and goes on at the last checkpoint; the files come
    out the same to the bit.

    Parameters
    ----------
    job : what to render.
    folder : where to, must exist.
    force : whether to replace files that exist.
    progress : called with the number of samples per pixel that have been taken since the last call.

    Raises
    ------
    ExrError
        If a file exists that was made in another way, or cannot be written.
    ValueError
        If the scene cannot be loaded or rendered.
    """
    missing = job.missing(folder, force=force)
    written: list[Path] = []
    scene = job.load() if missing else None
    for reference in (False, True):
        counts = tuple(n for n in missing if (n == job.reference_spp) == reference)
        if not counts:
            continue
        samples = Samples(scene, reference=reference, auxiliary=not reference, **job.options)
        partial = folder / f".{job.name}_{'reference' if reference else 'series'}.partial"
        discarded = 0
        for moments in _resumed(samples, partial, job.made_of, counts, progress):
            if moments.spp in counts:
                path = job.path(folder, moments.spp)
                _write(path, moments, job.made_of, auxiliary=not reference)
                written.append(path)
            discarded = moments.discarded
        if discarded:
            _log.warning(
                "%s: %d samples were NaN or infinite and count as black.", job.name, discarded
            )
        partial.unlink(missing_ok=True)
    return written


def _write(path: Path, moments: Moments, made_of: str, *, auxiliary: bool) -> None:
    write_exr(
        path,
        frame(moments, auxiliary=auxiliary),
        half=("Albedo", "Normal"),
        attributes={ATTRIBUTE: made_of},
        overwrite=True,
    )


def _resumed(
    samples: Samples, partial: Path, made_of: str, counts: tuple[int, ...], progress: Progress
) -> Iterator[Moments]:
    """`grow` from the checkpoint, if there is one that is not past the first count, with checkpoints."""
    moments = none(*samples.size)
    packed = _pack(moments)
    with contextlib.suppress(ValueError):  # of another render: of no use here
        if 0 < (count := _checkpoint.load(partial, made_of, packed)) < counts[0]:
            moments = _unpack(packed, count, samples.size)
    progress(moments.spp)
    saved, last, cost = moments.spp, time.monotonic(), 0.0
    try:
        for grown in grow(samples, moments, counts):
            progress(grown.spp - moments.spp)
            moments = grown
            yield moments
            if time.monotonic() - last > max(SAVE_SECONDS, SAVE_RATIO * cost):
                begin = time.monotonic()
                _save(partial, made_of, moments)
                saved, last = moments.spp, time.monotonic()
                cost = last - begin
    except BaseException:
        if moments.spp > saved:
            _save(partial, made_of, moments)
        raise


def _save(partial: Path, made_of: str, moments: Moments) -> None:
    try:
        _checkpoint.save(partial, made_of, _pack(moments), moments.spp)
    except OSError as error:
        # What was rendered so far is worth more than its checkpoint.
        _log.warning("cannot write the checkpoint %s: %s", partial, error)


def _pack(moments: Moments) -> np.ndarray:
    planes = [moments.mean, moments.squares, moments.auxiliary]
    return np.concatenate([*(plane.ravel() for plane in planes), [moments.discarded]])


def _unpack(packed: np.ndarray, count: int, size: tuple[int, int]) -> Moments:
    pixels = size[0] * size[1]
    planes: list[Any] = np.split(packed[:-1], [3 * pixels, 6 * pixels])
    mean, squares, auxiliary = (
        plane.reshape(*size, n) for plane, n in zip(planes, (3, 3, AUXILIARY), strict=True)
    )
    return Moments(count, mean, squares, auxiliary, int(packed[-1]))
