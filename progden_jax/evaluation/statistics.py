"""Means over scenes, and how sure they are."""

import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from progden_jax.evaluation.cost import Cost
from progden_jax.evaluation.database import Row
from progden_jax.evaluation.settings import names, parse

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


class Worst(NamedTuple):
    """The largest ratio, and the render that has it."""

    ratio: float
    scene: str
    spp: int


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


def worst(rows: Sequence[Row], metric: str, over: Collection[str]) -> dict[str, Worst]:
    """The largest ratio of a method's value to the least of those of `over` on the same render.

    Of a metric that is better the less it is: above 1 the method is somewhere worse than each of them,
    whatever the means say. Renders where the values are not all there and above 0 are left out, and methods
    without any.
    """
    least: dict[tuple[str, int], list[float]] = {}
    for row in rows:
        if row.method in over:
            least.setdefault((row.scene, row.spp), []).append(getattr(row, metric) or 0.0)
    found: dict[str, Worst] = {}
    for row in rows:
        value, others = getattr(row, metric), least.get((row.scene, row.spp), [])
        if value is None or len(others) < len(over) or min(others) <= 0:
            continue
        here = Worst(value / min(others), row.scene, row.spp)
        found[row.method] = max(found.get(row.method, here), here)
    return found


def shares(table: Table, baseline: str, best: str, spps: Collection[int]) -> dict[str, float]:
    """Method -> its share of the gain of `best` over the baseline, in the mean over these samples per pixel.

    0 is the baseline, 1 the best; a method may be beyond either. Empty where `best` gains nothing.

    Raises
    ------
    ValueError
        If the table lacks the baseline, `best`, or one of the samples per pixel of them.
    """
    for name in (baseline, best):
        if lacking := [spp for spp in spps if spp not in table.get(name, {})]:
            raise ValueError(f"{name!r} has no results at {', '.join(map(str, lacking))} spp.")
    values = {
        method: float(np.mean([by_spp[spp].mean for spp in spps]))
        for method, by_spp in table.items()
        if by_spp.keys() >= set(spps)
    }
    gain = values[baseline] - values[best]
    return {m: (values[baseline] - v) / gain for m, v in values.items()} if gain else {}


def split(rows: Iterable[Row], setting: str) -> dict[Any, list[Row]]:
    """Rows by the value of a setting, with those that have none, such as the render, in every group.

    Labels that were made of the settings lose this one, so that methods are called alike in all groups.
    """
    rows = list(rows)
    values = dict.fromkeys(row.settings[setting] for row in rows if setting in row.settings)
    # Parsing takes long, and most rows share their settings with others.
    alike = {(row.method, repr(row.settings)): row for row in rows}
    labels = {key: _label(row, setting) for key, row in alike.items()}
    relabelled = [row._replace(method=labels[row.method, repr(row.settings)]) for row in rows]
    return {
        value: [row for row in relabelled if row.settings.get(setting, value) == value]
        for value in values
    }


def _label(row: Row, without: str) -> str:
    known = names()
    settings = parse({n: v for n, v in row.settings.items() if n in known}, source=row.method)
    return settings.label([without]) if settings.label() == row.method else row.method


def costs(rows: Iterable[Row]) -> dict[str, Cost]:
    """Method -> the median of its seconds over renders, and the most memory, where they are known.

    Neither is for a method's first render of a size in a process, when its programs are compiled. Of the
    memory single renders tell too little: what earlier ones have freed may be at hand still.
    """
    found: dict[str, list[Row]] = {}
    for row in rows:
        if row.seconds is not None:
            found.setdefault(row.method, []).append(row)
    return {
        method: Cost(
            float(np.median([row.seconds for row in own if row.seconds is not None])),
            max((row.memory for row in own if row.memory is not None), default=None),
        )
        for method, own in found.items()
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
