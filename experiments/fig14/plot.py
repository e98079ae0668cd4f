"""The scene of the most extreme variance: does the mix fall behind the render? (paper, Figure 14)

    progden sweep experiments/fig14/sweep.yaml -o runs/fig14
    python -m experiments.fig14.plot runs/fig14

The scene is the one with the largest variance of a pixel over the squared mean radiance of its image, at the
fewest samples that pictures were kept of.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common, _plots
from progden_jax import sheet
from progden_jax.evaluation import Row
from progden_jax.exr import read_layers


def extremity(frame: pd.Frame) -> float:
    """The largest variance over the squared mean, both of the mean over channels."""
    frame, _ = pd.repair(frame)
    assert frame.variance is not None
    mean = np.asarray(frame.color, np.float64).mean()
    return float(np.asarray(frame.variance, np.float64).mean(-1).max() / mean**2)


def save_pictures(rows: Sequence[Row], path: Path, title: str) -> None:
    """Render, denoised image, mix, α and errors, a line per number of samples."""
    lines = []
    for row in rows:
        layers = read_layers(str(row.image))
        noisy = np.asarray(pd.read_exr(row.render).color)
        images = (noisy, layers["denoised"], layers[""], layers["alpha"])
        lines.append(sheet.Row(f"{row.spp} spp", *images))
    truth = np.asarray(pd.read_exr(rows[0].reference).color)
    sheet.save_sheet(path, lines, truth, title=title)


def table(rows: Sequence[Row]) -> str:
    """Of one scene."""
    order = list(_plots.IMAGES)
    lines = [
        (
            *(row.spp, row.method, *(getattr(row, metric) for metric in _plots.METRICS)),
            row.alpha if row.method == "mix" else "",
        )
        for row in sorted(rows, key=lambda row: (row.spp, order.index(row.method)))
    ]
    return _common.markdown(("spp", "image", *_plots.METRICS.values(), "mean α"), lines)


def draw(rows: Sequence[Row], output: Path) -> str:
    """A sheet of pictures, a plot and tables of one scene."""
    denoiser, rows = _plots.of_one_denoiser(rows)
    shown = [row for row in _plots.kept(rows) if row.method == "mix"]
    at = min(row.spp for row in shown)
    found = {
        row.scene: extremity(pd.read_exr(row.render))
        for row in rows
        if (row.method, row.spp) == ("render", at)
    }
    ranking = sorted(found, key=lambda scene: -found[scene])
    scene = ranking[0]
    own = [row for row in rows if row.scene == scene]
    _plots.write_rows(output / "fig14.csv", {denoiser: own})
    title = f"{scene}, the scene of the most extreme variance; {denoiser}"
    save_pictures([row for row in shown if row.scene == scene], output / "fig14-sheet.png", title)
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    for axis, metric in zip(figure.subplots(1, 3), _plots.METRICS, strict=True):
        _plots.plot_over_spp(axis, own, metric)
    figure.axes[0].legend()
    _common.save_figure(output / "fig14.png", figure)
    header = ("scene", f"largest variance over squared mean, {at} spp")
    scenes = _common.markdown(header, [(s, found[s]) for s in ranking])
    return f"{scenes}\n\n## {scene}\n\n{table(own)}"


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
