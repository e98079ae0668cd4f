"""Renders, references and estimates as arrays in memory, one per buffer with the examples stacked."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import progden_jax as pd
from progden_jax import subaverages
from progden_jax.frame import repaired
from progden_jax.subaverages import SubAverages
from progden_jax.training.config import Meaning, RunConfig
from progden_jax.training.estimates import EstimateCache, EstimateCaches
from progden_jax.training.index import Item, earlier, index, split

Progress = Callable[[int, int], None]
"""Called with how many of how many are done."""


class Examples(NamedTuple):
    """`arrays` are (N, H, W, C), but for mean_variance (N,) and divergence (N, draws, H, W, 3).

    By `EstimateCaches` of D denoisers, denoised, probe and tangent are (N, D, H, W, 3) and divergence is
    (N, draws, D, H, W, 3). Of B sub-averages, parts and denoised_parts are (N, B, H, W, 3) and shares (N, B).
    """

    items: tuple[Item, ...]
    arrays: dict[str, np.ndarray]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, of all of them."""
        return self.arrays["color"].shape[1:3]


def load(
    items: Sequence[Item],
    *,
    variance_of: Meaning = "mean",
    cache: EstimateCache | EstimateCaches | None = None,
    draws: int = 1,
    auxiliary: Sequence[str] = (),
    parts: int = 1,
    progress: Progress = lambda done, total: None,
) -> Examples:
    """The examples, bad pixels repaired.

    Parameters
    ----------
    cache : gives denoised images, and divergences if it has a method; None leaves them out.
    draws : divergences of so many seeds per render.
    auxiliary : buffers to take besides, of albedo, normal and depth.
    parts : sub-averages of each render, from those of its scene with fewer samples.

    Raises
    ------
    ValueError
        If sizes differ, a render lacks a variance or a buffer asked for, or its sub-averages cannot be had.
    """
    rows: dict[str, list] = {}
    references: dict[object, np.ndarray] = {}
    size = None
    for done, item in enumerate(items):
        progress(done, len(items))
        frame = _repaired(item, variance_of)
        if size is None:
            size = frame.size
        if frame.size != size:
            raise ValueError(
                f"{item.path} is {_size(frame.size)} pixels and {items[0].path} is {_size(size)}: the images "
                "that are trained on must be of one size; cut them into crops of it."
            )
        if item.reference not in references:
            references = {item.reference: np.asarray(_repaired(item, "mean", reference=True).color)}
        reference = references[item.reference]
        if reference.shape[:2] != size:
            raise ValueError(
                f"{item.reference} is {_size(reference.shape)} pixels but {item.path} is {_size(size)}."
            )
        row = {"color": frame.color, "variance": frame.variance, "reference": reference}
        row["mean_variance"] = np.asarray(frame.variance).mean(dtype=np.float64)
        for name in auxiliary:
            row[name] = getattr(frame, name)
            if row[name] is None:
                raise ValueError(f"{item.path} has no {name}, which this network takes.")
        if cache is not None:
            found = [cache.get(frame, seed) for seed in range(draws)]
            row["denoised"] = found[0].denoised
            drawn = [e.divergence for e in found if e.divergence is not None]
            if drawn:
                row["divergence"] = np.stack(drawn)
            if found[0].probe is not None:
                row["probe"], row["tangent"] = found[0].probe, found[0].tangent
        if parts > 1:
            if isinstance(cache, EstimateCaches):
                raise ValueError("sub-averages are of one denoiser.")
            row |= _parts(item, frame, parts, variance_of, cache)
        for name, value in row.items():
            rows.setdefault(name, []).append(np.asarray(value, np.float32))
    progress(len(items), len(items))
    return Examples(tuple(items), {name: np.stack(values) for name, values in rows.items()})


def load_split(
    config: RunConfig,
    *,
    cache: EstimateCache | EstimateCaches | None = None,
    draws: int = 1,
    auxiliary: Sequence[str] = (),
    parts: int = 1,
    progress: Progress = lambda done, total: None,
) -> tuple[Examples, Examples]:
    """(to train on, held out) of the folders that the configuration names; see `load`.

    Where it names no samples per pixel, the lowest of each scene that nothing divides are left out.

    Raises
    ------
    ValueError
        Also if the crop is larger than the images, or a folder is named "valid".
    """
    for folder in config.data:
        if Path(folder).resolve().name == "valid":
            raise ValueError(
                f"{folder} is named as data kept for reports, which must not be trained on: take another "
                "folder, or rename it if it is not."
            )
    items = index(config.data, spp=config.spp, reference_spp=config.reference_spp)
    if not config.spp:
        by_scene = itertools.groupby(items, key=lambda item: item.scene)
        items = [item for _, own in by_scene for item in list(own)[parts - 1 :]]
    training, held = split(items, share=config.held_out, scenes=config.held_out_scenes)
    both = load(
        training + held,
        variance_of=config.variance_of,
        cache=cache,
        draws=draws,
        auxiliary=auxiliary,
        parts=parts,
        progress=progress,
    )
    if config.crop > min(both.size):
        raise ValueError(f"crop is {config.crop}, but the images are {_size(both.size)} pixels.")
    count = len(training)
    first, last = (
        Examples(both.items[part], {name: array[part] for name, array in both.arrays.items()})
        for part in (slice(count), slice(count, None))
    )
    return first, last


def _repaired(item: Item, variance_of: Meaning, *, reference: bool = False) -> pd.Frame:
    if reference:
        frame = pd.read_exr(item.reference, auxiliary=False).replace(variance=None, spp=None)
    else:
        given = None if variance_of == "mean" else variance_of
        frame = pd.read_exr(item.path, variance_of=given).replace(spp=None)
        if frame.variance is None:
            raise ValueError(
                f"{item.path} has no variance, and training needs that of the sample mean."
            )
    return repaired(frame)


def sub_averages(item: Item, series: Mapping[int, pd.Frame]) -> SubAverages:
    """Of an item's render, from it and the `earlier` ones of its nested series by samples per pixel.

    Raises
    ------
    ValueError
        If it does not go on from them.
    """
    frames = [frame.replace(spp=spp) for spp, frame in sorted(series.items())]
    try:
        return subaverages.averaged(subaverages.nested(frames))
    except ValueError as error:
        raise ValueError(f"{item.path}: {error}") from None


def _parts(
    item: Item, frame: pd.Frame, count: int, variance_of: Meaning, cache: EstimateCache | None
) -> dict[str, Any]:
    """The render's sub-averages as arrays."""
    series = {
        spp: _repaired(item._replace(path=path), variance_of)
        for spp, path in earlier(item, count).items()
    }
    found = sub_averages(item, {**series, item.spp: frame})
    differences = found.differences["color"]
    row: dict[str, Any] = {"parts": frame.color + differences, "shares": found.shares}
    if cache is not None:
        row["denoised_parts"] = cache.parts(frame, differences, found.shares)
    return row


def _size(size: Sequence[int]) -> str:
    return f"{size[1]}×{size[0]}"
