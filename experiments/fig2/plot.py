"""Error and what is estimated of it without a reference, over spp (paper, Figure 2).

    progden sweep experiments/fig2/sweep.yaml -o runs/fig2
    python -m experiments.fig2.plot runs/fig2

The render's error is estimated by its variance, the denoised image's by SURE, and the mix's by SURE of
the whole chain: the derivative goes through denoiser, divergence, mixer and bound. "α held" leaves the
derivative of α out, as the closed form does.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import _common, _plots
from progden_jax.evaluation import Row

SHOWN = ("render", "denoised", "mix")


def name(settings: Mapping[str, Any]) -> str:
    """Of an image in the figure."""
    held = settings["image"] == "mix" and "risk_probes" not in settings
    return "mix, α held" if held else settings["image"]


def table(rows: Sequence[Row]) -> str:
    """Medians and ranges over scenes of estimate over truth, and RMSE (root of the mean over scenes)."""
    groups: dict[tuple[int, str], list[tuple[Any, Any]]] = defaultdict(list)
    for row in rows:
        groups[row.spp, row.method].append((row.mse, row.risk))
    lines = []
    order = [
        (spp, name) for spp in sorted({spp for spp, _ in groups}) for name in _plots.methods(rows)
    ]
    for spp, image in (key for key in order if key in groups):
        mse, risk = np.asarray(groups[spp, image], np.float64).T
        shown = spp, image, float(np.sqrt(mse.mean()))
        if np.isnan(risk).any():
            lines.append((*shown, "", ""))
            continue
        ratio = risk / mse
        spread = f"{np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f})"
        lines.append((*shown, spread, f"{(risk < 0).sum()} of {len(risk)}"))
    header = ("spp", "image", "RMSE", "estimated over true MSE: median (range)", "negative")
    return _common.markdown(header, lines)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Per scene RMSE over spp, and its estimate dashed where that is positive."""
    scenes = sorted({row.scene for row in rows})
    columns = min(4, len(scenes))
    count = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.4 * columns, 3.1 * count), layout="constrained")
    axes = figure.subplots(count, columns, squeeze=False, sharex=True).ravel()
    for axis, scene in zip(axes, scenes, strict=False):
        for image in SHOWN:
            own = [row for row in rows if (row.scene, row.method) == (scene, image)]
            mse, risk = np.asarray([(row.mse, row.risk) for row in own], np.float64).T
            spps, color = [row.spp for row in own], _plots.IMAGES[image]
            axis.plot(spps, np.sqrt(np.maximum(mse, 0)), "o-", color=color, ms=3, label=image)
            estimate = np.sqrt(np.where(risk > 0, risk, np.nan))
            axis.plot(spps, estimate, "x--", color=color, label=f"{image}, estimate")
        axis.set(xscale="log", yscale="log", title=scene)
        _plots.spp_ticks(axis, (row.spp for row in rows))
        axis.grid(alpha=0.3)
    for axis in axes[len(scenes) :]:
        axis.set_axis_off()
    figure.supxlabel("samples per pixel")
    figure.supylabel("RMSE")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=6, fontsize=8)
    _common.save_figure(path, figure)


def draw(rows: Sequence[Row], output: Path) -> str:
    """A figure per denoiser."""
    groups = _plots.by_denoiser(_plots.renamed(rows, name))
    _plots.write_rows(output / "fig2.csv", groups, ("mse", "risk"))
    parts = []
    for denoiser, own in groups.items():
        plot(own, output / f"fig2-{Path(denoiser).stem}.png")
        parts.append(f"## {denoiser}\n\n{table(own)}")
    return "\n\n".join(parts)


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
