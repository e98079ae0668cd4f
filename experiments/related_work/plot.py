"""Combiner, post-correction and adaptation by SURE behind several denoisers, alone and mixed.

progden sweep experiments/related_work/sweep.yaml -o runs/related_work
python -m experiments.related_work.plot runs/related_work
progden sweep experiments/related_work/fitted.yaml -o runs/related_work-fitted
python -m experiments.related_work.plot runs/related_work-fitted
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments import _common, _plots
from progden_jax import memory
from progden_jax.evaluation import Row, statistics

METRICS = {n: statistics.METRICS[n] for n in ("relmse", "rmse", "smape", "flip")}

REPAIRS = {
    "sure": "adapted by SURE",
    "post-correct": "post-corrected",
    "sure-correct": "corrected by SURE",
}

MIXED = ", mixed"

COLORS = {
    "": "tab:orange",
    "combined": "tab:blue",
    "adapted by SURE": "tab:red",
    "post-corrected": "tab:green",
    "corrected by SURE": "tab:purple",
}
"""By what is done to a denoiser."""


def name(settings: Mapping[str, Any]) -> str:
    """Denoiser, what repairs it, and whether it is mixed."""
    if settings["image"] == "render":
        return "render"
    parts = [settings["denoiser"]]
    if settings.get("combiner", "none") != "none":
        parts.append("combined")
    if settings.get("adaptation", "none") != "none":
        parts.append(REPAIRS[settings["adaptation"]])
    return ", ".join(parts) + (MIXED if settings["image"] == "mix" else "")


def _rank(settings: Mapping[str, Any]) -> tuple[bool, str, bool]:
    """The render first, a mix behind what is mixed."""
    label = name(settings)
    return label != "render", label.removesuffix(MIXED), label.endswith(MIXED)


def errors(rows: Sequence[Row], metric: str) -> str:
    """Means over scenes; of mixes the worst ratio to the better of what is mixed, at the most samples."""
    means = _plots.over_scenes(rows, metric)
    most = max(row.spp for row in rows)
    last = [row for row in rows if row.spp == most]
    lines = []
    for method, by_spp in means.items():
        worst = ""
        if method.endswith(MIXED):
            over = ("render", method.removesuffix(MIXED))
            worst = f"{statistics.worst(last, metric, over)[method].ratio:.3f}"
        lines.append((method, *by_spp.values(), worst))
    spps = (f"{spp} spp" for spp in statistics.spps(statistics.means(rows, metric)))
    return _common.markdown(
        (METRICS[metric], *spps, f"worst scene over the better of both, {most} spp"), lines
    )


def costs(rows: Sequence[Row]) -> str:
    """Median time and most memory of a render, where nothing was compiled."""
    lines = [
        (method, found.seconds, "" if found.memory is None else memory.shown(found.memory))
        for method, found in statistics.costs(rows).items()
    ]
    return _common.markdown(("method", "seconds", "memory"), lines)


def shown(how: str) -> tuple[str, str, str]:
    """Label, style and colour of a curve, by what is done to the denoiser."""
    if how == "render":
        return how, "-", "gray"
    what = how.removesuffix(MIXED.lstrip(", ")).rstrip(", ")
    return how or "denoised", "--" if how == what else "-", COLORS[what]


def convergence(rows: Sequence[Row], path: Path) -> None:
    """relMSE and RMSE over spp, a column per denoiser; mixes with solid lines."""
    groups = statistics.split(rows, "denoiser")
    groups = {d: _plots.renamed(own, name) for d, own in groups.items()}
    figure = Figure(figsize=(3.4 * len(groups), 6.4), layout="constrained")
    axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
    for column, (denoiser, own) in zip(axes.T, groups.items(), strict=True):
        for axis, metric in zip(column, ("relmse", "rmse"), strict=True):
            for method, by_spp in _plots.over_scenes(own, metric).items():
                label, style, color = shown(method.removeprefix(denoiser).lstrip(", "))
                values = list(by_spp.values())
                axis.plot(list(by_spp), values, style, color=color, marker="o", ms=3, label=label)
            axis.set(xscale="log", yscale="log", xlabel="samples per pixel")
            _plots.spp_ticks(axis, (row.spp for row in own))
            axis.grid(alpha=0.3)
        column[0].set_title(denoiser)
    for axis, metric in zip(axes[:, 0], ("relmse", "rmse"), strict=True):
        axis.set_ylabel(METRICS[metric])
    curves = [axis.get_legend_handles_labels() for axis in axes[0]]
    labelled = {label: h for group in curves for h, label in zip(*group, strict=True)}
    figure.legend(list(labelled.values()), list(labelled), loc="outside lower center", ncols=3)
    _common.save_figure(path, figure)


def draw(rows: Sequence[Row], output: Path) -> str:
    """Tables, and a figure of convergence."""
    fitted = any("adaptation" in row.settings for row in rows)
    # Rows come in the order in which they were finished.
    rows = sorted(rows, key=lambda r: (r.scene, r.spp, _rank(r.settings)))
    stem = "fitted" if fitted else "related_work"
    convergence(rows, output / f"{stem}.png")
    named = _plots.renamed(rows, name)
    columns = (*METRICS, "seconds", "memory")
    _common.write_csv(
        output / f"{stem}.csv",
        ("scene", "spp", "method", *columns),
        ((r.scene, r.spp, r.method, *(getattr(r, c) for c in columns)) for r in named),
    )
    return "\n\n".join([*(errors(named, metric) for metric in METRICS), costs(named)])


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
