"""Means over scenes, and how sure they are."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from progden_jax.evaluation.database import Row

CONFIDENCE = 0.95

METRICS = {
    "rmse": "RMSE",
    "smape": "SMAPE",
    "relmse": "relMSE",
    "flip": "FLIP",
    "ssim": "SSIM",
    "mse": "MSE",
}
"""Columns of a row that say how far a method is from the truth, and how people write them."""

HIGHER_IS_BETTER = frozenset({"ssim"})


class Interval(NamedTuple):
    """A mean over so many scenes, and half the width of its confidence interval (NaN for a single scene)."""

    mean: float
    half: float
    scenes: int


Table = dict[str, dict[int, Interval]]
"""Method -> samples per pixel -> interval."""


def interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """Student's t interval for the mean of what the values are a sample of.

    Exact for normal values. Errors over scenes are skewed, so with few scenes it covers the mean somewhat
    less often than it says; what compares methods on the same scenes (`relative_to`) is nearer to normal.

    Notes
    -----
    Student 1908, The Probable Error of a Mean.
    """
    array = np.asarray(values, np.float64)
    count = len(array)
    if count < 2:
        return Interval(float(array.mean()), math.nan, count)
    quantile = float(stdtrit(count - 1, (1 + confidence) / 2))
    return Interval(
        float(array.mean()), quantile * float(array.std(ddof=1)) / math.sqrt(count), count
    )


def means(rows: Iterable[Row], metric: str, confidence: float = CONFIDENCE) -> Table:
    """Of one of `METRICS`, over the scenes."""
    found: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        value = getattr(row, metric)
        if value is not None:
            found.setdefault(row.method, {}).setdefault(row.spp, []).append(value)
    return {
        method: {spp: interval(values, confidence) for spp, values in sorted(by_spp.items())}
        for method, by_spp in found.items()
    }


def relative_to(
    rows: Sequence[Row], baseline: str, metric: str, confidence: float = CONFIDENCE
) -> Table:
    """Ratios to the baseline's value on the same render: geometric means over scenes; below 1 it is less.

    Scenes differ far more than methods do, so pairs tell methods apart where the means' intervals overlap.
    The intervals are Student's of the logarithms, to first order. Renders where either value is not above
    0 are left out.

    Raises
    ------
    ValueError
        If no row is of the baseline.
    """
    base = {(r.scene, r.spp): getattr(r, metric) for r in rows if r.method == baseline}
    if not base:
        there = ", ".join(dict.fromkeys(row.method for row in rows))
        raise ValueError(f"baseline is {baseline!r}, expected one of the methods: {there}.")
    logarithms = []
    for row in rows:
        value, other = getattr(row, metric), base.get((row.scene, row.spp))
        if value is not None and other is not None and value > 0 and other > 0:
            logarithms.append(row._replace(**{metric: math.log(value / other)}))
    return {
        method: {
            spp: Interval(math.exp(found.mean), math.exp(found.mean) * found.half, found.scenes)
            for spp, found in by_spp.items()
        }
        for method, by_spp in means(logarithms, metric, confidence).items()
    }


def sure_bias(rows: Iterable[Row], confidence: float = CONFIDENCE) -> Table:
    """How far SURE is from the denoised image's true MSE: the mean difference over the mean MSE.

    0 where it is unbiased. Methods that share SURE have the same.
    """
    found: dict[str, dict[int, list[tuple[float, float]]]] = {}
    for row in rows:
        if row.sure is not None and row.denoised_mse is not None:
            pairs = found.setdefault(row.method, {}).setdefault(row.spp, [])
            pairs.append((row.sure, row.denoised_mse))
    table: Table = {}
    for method, by_spp in found.items():
        table[method] = {}
        for spp, pairs in sorted(by_spp.items()):
            sure, truth = np.asarray(pairs, np.float64).T
            error = interval(sure - truth, confidence)
            size = float(truth.mean())
            if size > 0:
                table[method][spp] = Interval(error.mean / size, error.half / size, error.scenes)
    return table


def best(table: Table, metric: str, among: Iterable[str]) -> dict[int, str]:
    """Samples per pixel -> the method of the best mean."""
    choose = max if metric in HIGHER_IS_BETTER else min
    found = {}
    for spp in spps(table):
        candidates = {m: table[m][spp].mean for m in among if spp in table.get(m, {})}
        if candidates:
            found[spp] = choose(candidates, key=candidates.__getitem__)
    return found


def spps(table: Table) -> list[int]:
    """All samples per pixel in it."""
    return sorted({spp for by_spp in table.values() for spp in by_spp})
