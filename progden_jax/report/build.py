"""From a run's folder to the page's folder, whole or not at all."""

import functools
import json
import math
import os
import shutil
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from progden_jax import _devices, _files, metrics, sheet
from progden_jax.evaluation.database import Row, rows
from progden_jax.exr import read_exr_with_info, read_layers
from progden_jax.frame import centre
from progden_jax.report.contents import Pictures, document, newest
from progden_jax.report.images import ImageFiles

Progress = Callable[[int, int], None]
"""Called with how many of how many rows have their pictures."""
T = TypeVar("T")
Flip = Literal["auto", "all", "none"]

_SITE = Path(__file__).parent / "site"
# Of the largest image that has a FLIP map unasked: a 1920×1080 one takes minutes.
_FLIP_PIXELS = 512 * 512
# What a report's folder holds; anything else in it is somebody's own.
_OURS = {"index.html", "report.css", "js", "data.js", "images"}
_MARK = '<meta name="generator" content="progden report"'


class Built(NamedTuple):
    """The page, how many rows and image files it has, and what had to be left out."""

    page: Path
    rows: int
    images: int
    warnings: tuple[str, ...]


def build_report(
    run: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    title: str | None = None,
    scenes: Collection[str] = (),
    images: bool = True,
    flip: Flip = "auto",
    force: bool = False,
    progress: Progress = lambda done, total: None,
) -> Built:
    """Write the page for a run's results into a folder; open its index.html in any browser.

    Pictures that are missing, damaged or of another size than their reference are left out with a
    warning; tables and plots need none.

    Parameters
    ----------
    run : the folder that `progden evaluate` or `progden sweep` wrote.
    output : the folder to write, in one that exists; it appears when it is complete.
    title : the page's title; by default the run folder's name.
    scenes : only these; by default all.
    images : False leaves pictures out.
    flip : which pictures get a FLIP map: "auto" those of up to 512×512 pixels, for larger ones take
        a minute or more each, "all", or "none".
    force : whether a report that is already there may be replaced.

    Raises
    ------
    ValueError
        If the run has no results, a scene is not in it, or `output` may not be written to.
    OSError
        If it cannot be written.
    """
    run, output = Path(run), Path(output)
    chosen = _chosen(run, scenes)
    _check_output(run, output, force)
    with _files.replacing_folder(output) as beside:
        shutil.copytree(_SITE, beside, dirs_exist_ok=True)
        gathered = _Gathered(run, ImageFiles(beside / "images"), flip, len(chosen), progress)
        if images:
            gathered.add(chosen)
        contents = document(
            chosen,
            gathered.pictures,
            title=title or run.resolve().name,
            exposures=gathered.exposures,
        )
        script = f"progden.data = {json.dumps(contents, allow_nan=False)};\n"
        (beside / "data.js").write_text(script, encoding="ascii")
        written = len(list((beside / "images").iterdir()))
    return Built(output / "index.html", len(chosen), written, tuple(gathered.warnings))


def _chosen(run: Path, scenes: Collection[str]) -> list[Row]:
    found = rows(run)
    if not found:
        raise ValueError(f"{run} has no results yet: let its evaluation finish a scene first.")
    if unknown := sorted(set(scenes) - {row.scene for row in found}):
        names = ", ".join(sorted({row.scene for row in found}))
        raise ValueError(f"{run} has no scene {', '.join(unknown)}; it has {names}.")
    return newest([row for row in found if not scenes or row.scene in scenes])


def _check_output(run: Path, output: Path, force: bool) -> None:
    if not output.resolve().parent.is_dir():
        raise ValueError(f"{output} cannot be made: there is no folder {output.resolve().parent}.")
    if not os.path.lexists(output):
        return
    if not output.is_dir():
        raise ValueError(f"{output} is a file: the report is a folder, name another.")
    held = {path.name for path in output.iterdir()}
    if held and not _is_report(output, held):
        raise ValueError(
            f"{output} holds other things than a report, which will not be removed: name another folder."
        )
    if run.resolve().is_relative_to(output.resolve()):
        raise ValueError(f"{output} holds the run itself: name another folder.")
    if held and not force:
        raise ValueError(f"{output} exists: pass force=True (--force) to replace it.")


def _is_report(folder: Path, held: set[str]) -> bool:
    page = folder / "index.html"
    return held <= _OURS and page.is_file() and _MARK in page.read_text("utf-8", "replace")


class _Gathered:
    """Pictures and exposures of rows, worked on in threads: reading, FLIP and deflate release Python."""

    def __init__(
        self, run: Path, files: ImageFiles, flip: Flip, total: int, progress: Progress
    ) -> None:
        self.pictures: dict[str, Pictures] = {}
        self.exposures: dict[str, float] = {}
        self.warnings: list[str] = []
        self._run, self._files, self._which_flip = run, files, flip
        self._total, self._progress = total, progress
        self._lock = threading.Lock()

    def add(self, chosen: Sequence[Row]) -> None:
        """Write the pictures of all rows, those of one reference together so that it is read once."""
        groups: dict[tuple[str, str | None, int | None], list[Row]] = {}
        for row in chosen:
            groups.setdefault((row.scene, row.reference, row.crop), []).append(row)
        self._progress(0, self._total)
        pool = ThreadPoolExecutor(len(_devices.cores()))
        try:
            list(pool.map(self._add_group, groups.values()))
        finally:
            pool.shutdown(cancel_futures=True)
        self.warnings.sort()

    def _add_group(self, group: Sequence[Row]) -> None:
        shown = functools.partial(_color, crop=group[0].crop)
        reference = self._read(group[0].reference, shown)
        name = None if reference is None else self._files.add(reference)
        if reference is not None:
            self._expose(group[0].scene, reference)
        # The most samples first: without a reference they set the exposure.
        for row in sorted(group, key=lambda row: -row.spp):
            layers = self._layers(row)
            if reference is not None and layers and layers[""].shape != reference.shape:
                self._warn(
                    f"{row.image or row.render} is {_size(layers[''])} pixels but its reference "
                    f"{row.reference} is {_size(reference)}; its pictures are left out"
                )
                layers = {}
            pictures = Pictures(reference=name)
            if layers:
                self._expose(row.scene, layers[""])
                flip = None if reference is None else self._flip(layers[""], reference, row)
                pictures = Pictures(
                    image=self._files.add(layers[""]),
                    reference=name,
                    flip=flip,
                    **{n: self._files.add(layers[n]) for n in ("alpha", "sure") if n in layers},
                )
            with self._lock:
                self.pictures[row.key] = pictures
                self._progress(len(self.pictures), self._total)

    def _layers(self, row: Row) -> Mapping[str, np.ndarray]:
        if row.image is not None:
            layers = self._read(os.path.join(self._run, row.image), read_layers) or {}
            if layers and "" not in layers:
                self._warn(f"{row.image} has no channels R, G, B")
            return layers if "" in layers else {}
        shown = functools.partial(_color, crop=row.crop)
        color = self._read(row.render, shown) if row.method == "render" else None
        return {} if color is None else {"": color}

    def _flip(self, image: Any, reference: Any, row: Row) -> str | None:
        if self._which_flip == "none":
            return None
        if self._which_flip == "auto" and image.shape[0] * image.shape[1] > _FLIP_PIXELS:
            self._warn(
                "pictures of more than 512×512 pixels have no FLIP maps, which would take minutes each: "
                "--flip all makes them"
            )
            return None
        try:
            errors = metrics.flip_map(image, reference)
        except ValueError as error:
            self._warn(f"{row.scene}, {row.spp} spp, {row.method}: no FLIP map, as {error}")
            return None
        # A display has no more steps, and what is beyond them is most of the file.
        return self._files.add((np.round(errors * 256) / 256)[..., None])

    def _read(self, path: str | None, read: Callable[[str], T]) -> T | None:
        """What `read` makes of the file, None with a warning if it cannot, None without a path."""
        if path is None:
            return None
        try:
            return read(path)
        except (ValueError, OSError) as error:
            self._warn(str(error))
            return None

    def _expose(self, scene: str, image: np.ndarray) -> None:
        with self._lock:
            if scene not in self.exposures:
                finite = np.nan_to_num(image, posinf=0, neginf=0)
                self.exposures[scene] = math.log2(sheet.exposure_for(finite))

    def _warn(self, text: str) -> None:
        with self._lock:
            if text not in self.warnings:
                self.warnings.append(text)


def _color(path: str, crop: int | None) -> np.ndarray:
    frame, _ = read_exr_with_info(path, channels="variance=none", auxiliary=False)
    return np.asarray((centre(frame, crop) if crop else frame).color)


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}×{image.shape[0]}"
