"""Convergence: error over spp of render, denoiser and mixes (paper, Figure 10).

progden sweep experiments/fig10/sweep.yaml -o runs/fig10
python -m experiments.fig10.plot runs/fig10
"""

import itertools
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from experiments import _common, _plots
from progden_jax.evaluation import Row


def slopes(rows: Sequence[Row]) -> str:
    """Errors per spp, and what is left of them each time the samples are quadrupled."""
    lines = []
    for metric, title in _plots.METRICS.items():
        means = _plots.over_scenes(rows, metric)
        for name in (name for name in _plots.IMAGES if name in means):
            values = list(means[name].values())
            ratios = " ".join(f"{b / a:.2f}" for a, b in itertools.pairwise(values))
            lines.append((title, name, *values, ratios))
    spps = (f"{spp} spp" for spp in sorted({row.spp for row in rows}))
    return _common.markdown(("error", "image", *spps, "over the one before"), lines)


def draw(rows: Sequence[Row], output: Path) -> str:
    """A row of plots per denoiser, a column per metric."""
    groups = {
        denoiser: [row for row in own if row.method in _plots.IMAGES]
        for denoiser, own in _plots.by_denoiser(rows).items()
    }
    _plots.write_rows(output / "fig10.csv", groups)
    figure = Figure(figsize=(12, 3.7 * len(groups)), layout="constrained")
    axes = figure.subplots(len(groups), len(_plots.METRICS), squeeze=False)
    for line, (denoiser, own) in zip(axes, groups.items(), strict=True):
        for axis, metric in zip(line, _plots.METRICS, strict=True):
            _plots.plot_over_spp(axis, own, metric)
            axis.set_title(denoiser)
    axes[0, 0].legend()
    _common.save_figure(output / "fig10.png", figure)
    return "\n\n".join(f"## {denoiser}\n\n{slopes(own)}" for denoiser, own in groups.items())


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
