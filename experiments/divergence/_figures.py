"""The table and the plot of `methods`."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments import _common

COLORS = {
    "differences": "tab:red",
    "rademacher": "tab:green",
    "probing": "tab:blue",
    "truncated": "tab:orange",
    "exact": "black",
}
TARGETS = {4: 0.38, 16: 0.20, 64: 0.12, 256: 0.06}
"""Of the error over that of as many differences, or of no fewer passes."""

Row = dict[str, str]


def medians(rows: Sequence[Row]) -> dict[tuple[str, str, int], dict[str, float]]:
    """Over frames, by (denoiser, method, probes)."""
    frames = {(r["denoiser"], r["scene"], r["spp"], r["method"], int(r["probes"])): r for r in rows}
    groups: dict[tuple[str, str, int], list[dict[str, float]]] = defaultdict(list)
    for (denoiser, scene, spp, method, count), row in frames.items():
        cell = {name: float(row[name]) for name in ("error", "mean_error", "passes", "seconds")}
        cell["image"], cell["rmse"] = float(row["image"]), abs(float(row["rmse_ratio"]) - 1)
        cell["smape"] = abs(float(row["smape_ratio"]) - 1)
        other = frames.get((denoiser, scene, spp, "differences", count))
        cell["ratio"] = float("nan") if other is None else cell["error"] / float(other["error"])
        for name in ("sure", "sure_window", "alpha"):
            cell[name] = float(row[name]) / float(row[f"{name}_exact"])
        groups[denoiser, method, count].append(cell)
    return {
        group: {name: float(np.median([c[name] for c in cells])) for name in cells[0]}
        | {"frames": len(cells)}
        for group, cells in groups.items()
    }


def table(rows: Sequence[Row]) -> str:
    """The medians as a table."""
    names = {
        "passes": "passes",
        "error": "error per pixel",
        "ratio": "to differences",
        "mean_error": "error of the mean",
        "sure": "SURE map",
        "sure_window": "averaged",
        "alpha": "α",
        "image": "image",
        "rmse": "its RMSE",
        "smape": "its SMAPE",
        "frames": "frames",
    }
    lines = []
    for (denoiser, method, count), cell in sorted(medians(rows).items(), key=lambda g: g[0][::2]):
        target = TARGETS.get(count, "") if method in ("probing", "truncated") else ""
        values = [float(f"{cell[name]:.3g}") for name in names]
        lines.append((denoiser, method, count, *values, target))
    return _common.markdown(("denoiser", "method", "K", *names.values(), "target"), lines)


def pareto(rows: Sequence[Row], path: Path) -> None:
    """Error per pixel over passes and over time, every frame and the medians."""
    found = medians(rows)
    denoisers = sorted({row["denoiser"] for row in rows})
    figure = Figure(figsize=(11, 4.5 * len(denoisers)), layout="constrained")
    axes = figure.subplots(len(denoisers), 2, squeeze=False)
    for line, denoiser in zip(axes, denoisers, strict=True):
        for axis, cost in zip(line, ("passes", "seconds"), strict=True):
            for method in ("differences", "rademacher", "probing", "truncated"):
                own = [r for r in rows if (r["denoiser"], r["method"]) == (denoiser, method)]
                points = sorted(
                    (c[cost], c["error"]) for g, c in found.items() if g[:2] == (denoiser, method)
                )
                axis.plot(
                    [float(r[cost]) for r in own],
                    [float(r["error"]) for r in own],
                    ".",
                    color=COLORS[method],
                    alpha=0.25,
                )
                if points:
                    axis.plot(*zip(*points, strict=True), "o-", color=COLORS[method], label=method)
            exact = found[denoiser, "exact", 0][cost]
            axis.axvline(exact, color=COLORS["exact"], label="exact, by cones: no error")
            axis.axhline(0.01, color="gray", linewidth=0.8, linestyle=":")
            axis.set(
                xscale="log",
                yscale="log",
                xlabel=f"{'denoiser passes' if cost == 'passes' else 'seconds'} per frame",
                ylabel="relative RMSE of σ²·∂f/∂x per pixel",
                title=denoiser,
            )
            axis.legend()
    _common.save_figure(path, figure)
