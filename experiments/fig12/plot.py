"""Window sizes of the t-bound, with and without the shift to the highest variance (paper, Figure 12).

progden sweep experiments/fig12/sweep.yaml -o runs/fig12
python -m experiments.fig12.plot runs/fig12
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common, _plots
from progden_jax.evaluation import Row, statistics
from progden_jax.sheet import display, exposure_for

UNBOUNDED = "not bounded"
USUAL = pd.Bound().window
NO_SHIFT = ", no shift"


def called(window: int, *, shift: bool) -> str:
    """A bound in tables."""
    return f"{window}×{window}{'' if shift else NO_SHIFT}"


def name(settings: Mapping[str, Any]) -> str:
    """A method in tables."""
    if settings["image"] != "mix":
        return settings["image"]
    if not settings["bound"]:
        return UNBOUNDED
    return called(settings["bound.window"], shift=settings["bound.shift"])


def windows_of(rows: Sequence[Row]) -> list[int]:
    """Those that there are."""
    return sorted({row.settings.get("bound.window", USUAL) for row in rows})


def plot(rows: Sequence[Row], path: Path) -> None:
    """RMSE and SMAPE over those of the mix that is not bounded, over the window's width."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    windows = windows_of(rows)
    for axis, metric in zip(figure.subplots(1, 2), ("rmse", "smape"), strict=True):
        means = _plots.over_scenes(rows, metric)
        for number, spp in enumerate(means[UNBOUNDED]):
            for shift, style in ((True, "o-"), (False, "s--")):
                found = [means[called(window, shift=shift)][spp] for window in windows]
                axis.plot(
                    windows,
                    np.asarray(found) / means[UNBOUNDED][spp],
                    style,
                    color=f"C{number}",
                    ms=4,
                    label=f"{spp} spp{'' if shift else NO_SHIFT}",
                )
        axis.axhline(1, color="gray", linewidth=0.8)
        title = _plots.METRICS[metric]
        axis.set(xlabel="window, pixels", ylabel=f"{title} over that without a bound")
        axis.set_xticks(windows)
        axis.grid(alpha=0.3)
    figure.axes[1].legend(fontsize=7, ncols=2)
    _common.save_figure(path, figure)


def pictures(rows: Sequence[Row], path: Path) -> None:
    """The mixes of one render, a row with and one without shift; the reference and no bound beside them."""
    windows, by_name = windows_of(rows), {row.method: row for row in rows}
    truth = np.asarray(pd.read_exr(rows[0].reference).color)
    exposure = exposure_for(truth)
    figure = Figure(figsize=(2 * len(windows) + 2, 4.6), layout="constrained")
    axes = figure.subplots(2, len(windows) + 1)
    shown = [(axes[0, 0], UNBOUNDED)]
    for line, shift in zip(axes, (True, False), strict=True):
        names = (called(window, shift=shift) for window in windows)
        shown += zip(line[1:], names, strict=True)
    for axis, method in shown:
        row = by_name[method]
        image = np.asarray(pd.read_exr(str(row.image)).color)
        axis.imshow(display(image, exposure), interpolation="nearest")
        axis.set_title(f"{method}: {row.rmse:.4f}", fontsize=9)
    axes[1, 0].imshow(display(truth, exposure), interpolation="nearest")
    axes[1, 0].set_title("reference", fontsize=9)
    for axis in axes.ravel():
        axis.set_axis_off()
    figure.suptitle(f"{rows[0].scene}, {rows[0].spp} spp; RMSE")
    _common.save_figure(path, figure)


def draw(rows: Sequence[Row], output: Path) -> str:
    """A plot, pictures of the render on which the shift weighs most, and tables."""
    denoiser, _ = _plots.of_one_denoiser(rows)
    rows = _plots.renamed(rows, name)
    _plots.write_rows(output / "fig12.csv", {denoiser: rows})
    plot(rows, output / "fig12.png")
    with_shift = called(USUAL, shift=True)
    shown = _plots.kept(rows)
    without = [row for row in shown if row.method in (with_shift, called(USUAL, shift=False))]
    most = statistics.worst(without, "rmse", [with_shift])[called(USUAL, shift=False)]
    own = [row for row in shown if (row.scene, row.spp) == (most.scene, most.spp)]
    pictures(own, output / "fig12-pictures.png")
    told = f"pictures: {most.scene} at {most.spp} spp, RMSE without the shift over with: {most.ratio:.4f}"
    return f"{_plots.summary(rows)}\n\n{told}"


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
