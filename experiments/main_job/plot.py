"""Does the mix beat render and denoiser, and does SURE tell the denoiser's error?

progden sweep experiments/main_job/sweep.yaml -o runs/main_job
python -m experiments.main_job.plot runs/main_job
"""

from collections.abc import Sequence
from pathlib import Path

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


def risks(rows: Sequence[Row]) -> str:
    """SURE against the truth where the variances are known well, renders with the least outliers first."""
    lines = []
    for row in rows:
        if row.method != "denoised" or row.spp < 128:
            continue
        assert None not in (row.sure, row.sure_error, row.denoised_mse)
        share = firefly_share(np.asarray(pd.read_exr(row.render).variance))
        ratios = (row.sure / row.denoised_mse, row.sure_error / row.denoised_mse)  # pyright: ignore
        fireflies = "yes" if share > FIREFLY_SHARE else "no"
        lines.append((row.scene, row.spp, share, row.denoised_mse, *ratios, fireflies))
    header = ("scene", "spp", "share of 0.1 %", "true MSE", "ratio", "± from pixels", "fireflies")
    return _common.markdown(header, sorted(lines, key=lambda line: line[2]))


def draw(rows: Sequence[Row], output: Path) -> str:
    """Tables alone."""
    parts = []
    for denoiser, own in _plots.by_denoiser(rows).items():
        parts += [
            f"## {denoiser}, mean over scenes\n\n{means(own)}",
            f"RMSE of the mix over the better of render and denoised, worst scene:\n\n{worst(own)}",
            f"Mean SURE over true MSE (the reference's own variance taken off):\n\n{risks(own)}",
        ]
    return "\n\n".join(parts)


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
