"""Does the mix beat render and denoiser, and does SURE tell the denoiser's error?

progden sweep experiments/main_job/sweep.yaml -o runs/main_job
python -m experiments.main_job.plot runs/main_job
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

import progden_jax as pd
from experiments import _common, _plots
from progden_jax.evaluation import Row, statistics

METRICS = {**_plots.METRICS, "relmse": statistics.METRICS["relmse"]}
FIREFLY_SHARE = 0.04
"""A render has fireflies if 0.1 % of its values hold more than this share of its summed variance."""


def firefly_share(variance: np.ndarray) -> float:
    """The share of the summed variance that its largest 0.1 % hold."""
    ordered = np.sort(np.asarray(variance, np.float64).ravel())[::-1]
    return float(ordered[: max(1, ordered.size // 1000)].sum() / ordered.sum())


def means(rows: Sequence[Row]) -> str:
    """Per spp and image."""
    found = {metric: _plots.over_scenes(rows, metric) for metric in METRICS}
    spps = sorted({row.spp for row in rows})
    lines = [
        (spp, name, *(found[metric][name][spp] for metric in METRICS))
        for spp in spps
        for name in ("render", "denoised", "mix")
    ]
    return _common.markdown(("spp", "image", *METRICS.values()), lines)


def worst(rows: Sequence[Row]) -> str:
    """Per spp the scene where the mix falls behind most."""
    lines = []
    for spp in sorted({row.spp for row in rows}):
        own = [row for row in rows if row.spp == spp]
        ratio, scene, _ = statistics.worst(own, "rmse", ("render", "denoised"))["mix"]
        lines.append((spp, ratio, scene))
    return _common.markdown(("spp", "ratio", "scene"), lines)


class Risk(NamedTuple):
    """SURE of a denoised image beside the truth, means over its pixels."""

    scene: str
    spp: int
    share: float
    mse: float
    sure: float
    error: float

    @property
    def quiet(self) -> bool:
        return self.share <= FIREFLY_SHARE


def risks_of(rows: Sequence[Row]) -> list[Risk]:
    """From 128 spp on, where the variances are known well, renders with the least outliers first."""
    found = []
    for row in rows:
        if row.method != "denoised" or row.spp < 128:
            continue
        share = firefly_share(np.asarray(pd.read_exr(row.render).variance))
        values = (row.denoised_mse, row.sure, row.sure_error)
        found.append(Risk(row.scene, row.spp, share, *cast(tuple[float, float, float], values)))
    return sorted(found, key=lambda risk: risk.share)


def risks(found: Sequence[Risk]) -> str:
    """Each render's."""
    header = ("scene", "spp", "share of 0.1 %", "true MSE", "ratio", "± from pixels", "fireflies")
    lines = ((*r[:4], r.sure / r.mse, r.error / r.mse, "no" if r.quiet else "yes") for r in found)
    return _common.markdown(header, lines)


def together(found: Sequence[Risk]) -> str:
    """Mean SURE over mean MSE, means over scenes, per spp."""
    lines = []
    for spp in sorted({risk.spp for risk in found}):
        for which, chosen in (("without fireflies", [r for r in found if r.quiet]), ("all", found)):
            own = [risk for risk in chosen if risk.spp == spp]
            if own:
                ratio = sum(r.sure for r in own) / sum(r.mse for r in own)
                lines.append((spp, which, len(own), ratio))
    return _common.markdown(("spp", "renders", "scenes", "ratio"), lines)


def draw(rows: Sequence[Row], output: Path) -> str:
    """Tables alone."""
    parts = []
    for denoiser, own in _plots.by_denoiser(rows).items():
        found = risks_of(own)
        parts += [
            f"## {denoiser}, mean over scenes\n\n{means(own)}",
            f"RMSE of the mix over the better of render and denoised, worst scene:\n\n{worst(own)}",
            f"Mean SURE over true MSE (the reference's own variance taken off):\n\n{together(found)}",
            risks(found),
        ]
    return "\n\n".join(parts)


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
