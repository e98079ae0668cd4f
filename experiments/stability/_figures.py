"""The table and the plot of experiments/stability."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import _common

COLUMNS = ("numerical", "elsewhere", "total")
COLORS = {
    "FiniteDifference": "tab:red",
    "MonteCarlo, gaussian": "tab:orange",
    "MonteCarlo": "tab:green",
    "Probing": "tab:blue",
    "Probing, sigma": "tab:cyan",
    "Probing, unit": "tab:purple",
    "Exact": "black",
}
STYLES = {"float32": "-", "TF32": "--", "bfloat16": ":"}
EXPOSURES = {"automatic": "-", "fixed": "--"}

Medians = dict[tuple[str, str, str, str, str], dict[str, float]]


def medians(header: Sequence[str], rows: Sequence[tuple]) -> Medians:
    """Over frames, by (study, setting, exposure, network, method): errors, and the share that is finite."""
    groups: dict[tuple, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        cell = dict(zip(header, row, strict=True))
        group = ("study", "setting", "exposure", "network", "method")
        groups[tuple(cell[name] for name in group)].append(cell)
    return {
        group: {name: float(np.median([c[name] for c in cells])) for name in COLUMNS}
        | {"finite": float(np.mean([c["finite"] for c in cells])), "frames": len(cells)}
        for group, cells in groups.items()
    }


def summary(header: Sequence[str], rows: Sequence[tuple]) -> str:
    """The medians as a table."""
    lines = [
        (*group, *(float(f"{cell[name]:.2g}") for name in COLUMNS), cell["finite"], cell["frames"])
        for group, cell in medians(header, rows).items()
    ]
    names = ("study", "setting", "exposure", "network", "method", *COLUMNS, "finite", "frames")
    return _common.markdown(names, lines)


def plot(header: Sequence[str], rows: Sequence[tuple], path: Path) -> None:
    """Three panels: the step of differences, the scale of radiance, hard inputs."""
    found = medians(header, rows)
    figure = Figure(figsize=(16, 5), layout="constrained")
    steps, scales, inputs = figure.subplots(1, 3)

    for network, style in STYLES.items():
        points = sorted(
            (float(g[1]), c["numerical"])
            for g, c in found.items()
            if g[0] == "epsilon" and g[3] == network
        )
        _line(steps, points, f"differences, {network}", "tab:red", style, marker="o")
        for group, cell in found.items():
            if group[0] == "precision" and group[3] == network and "gauss" in group[4]:
                label = f"derivatives, {network}: {cell['numerical']:.1g}"
                steps.axhline(cell["numerical"], color="tab:green", linestyle=style, label=label)
    chance = [
        c["total"] for g, c in found.items() if g[:2] == ("precision", "float32") and "ga" in g[4]
    ]
    if chance:
        steps.axhline(chance[0], color="grey", lw=4, alpha=0.4, label="chance (4 Gaussian probes)")
    steps.set(xscale="log", yscale="log", xlabel="ε", title="Step of finite differences")

    for exposure, style in EXPOSURES.items():
        for method, color in COLORS.items():
            points = sorted(
                (float(g[1]), c["numerical"])
                for g, c in found.items()
                if g[0] == "scale" and g[2] == exposure and g[4] == method
            )
            label = method if exposure == "automatic" else ""
            _line(scales, points, label, color, style, marker=".")
    scales.set(
        xscale="log",
        yscale="log",
        xlabel="radiance ×",
        title="Scale, float32, ε = 1e-4; dashed: fixed exposure",
    )

    settings = list(dict.fromkeys(g[1] for g in found if g[0] == "inputs"))
    for offset, (method, color) in enumerate(COLORS.items()):
        for column, marker in (("elsewhere", "o"), ("total", "_")):
            points = [
                (settings.index(g[1]) + 0.1 * (offset - 3), c[column])
                for g, c in found.items()
                if g[0] == "inputs" and g[4] == method
            ]
            _line(inputs, points, method if marker == "o" else "", color, "none", marker=marker)
    inputs.set(yscale="log", title="Hard inputs, float32, untouched pixels; bars: with chance")
    inputs.set_xticks(range(len(settings)), settings)
    for axes in (steps, scales, inputs):
        axes.set_ylabel("relative RMSE of σ²f'")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    _common.save_figure(path, figure)


def _line(
    axes: Any, points: list[tuple[float, float]], label: str, color: str, style: str, marker: str
) -> None:
    if points:
        x, y = zip(*points, strict=True)
        axes.plot(
            x,
            np.maximum(y, 1e-9),
            linestyle=style,
            color=color,
            marker=marker,
            label=label or None,
            ms=6,
        )
