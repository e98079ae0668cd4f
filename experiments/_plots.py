"""What the tables and figures made of sweeps share: the rows of a run, what is said of them, curves."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from experiments import _common
from progden_jax import evaluation
from progden_jax.evaluation import Row, statistics

METRICS = {name: statistics.METRICS[name] for name in ("rmse", "smape", "flip")}

GOALS = {"rmse": 0.95, "smape": 0.85, "flip": 0.90}
"""Shares of the oracle's gain over the denoiser, means over scenes and `LEAST_SPP` and more."""

LEAST_SPP = 32
"""From here up the paper's averages begin."""

IMAGES = {
    "render": "tab:blue",
    "denoised": "tab:orange",
    "mix closed-form": "tab:purple",
    "mix": "tab:green",
    "oracle": "gray",
}
"""Methods that most figures show, as they are called where all are of one denoiser, and their colours."""


def command(
    description: str | None, folder: Path, draw: Callable[[Sequence[Row], Path], str]
) -> None:
    """Print what `draw` says of a run's rows and of the folder for its files; both from the command line."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder that `progden sweep` wrote")
    parser.add_argument("--output", type=Path, default=folder, help="folder for figures and CSV")
    arguments = parser.parse_args()
    try:
        found = evaluation.rows(arguments.run)
        if not found:
            raise ValueError("there are no results yet: let its sweep finish a scene first.")
        arguments.output.mkdir(parents=True, exist_ok=True)
        text = draw([_opened(row, arguments.run) for row in found], arguments.output)
    except KeyError as error:
        lacking = f"there are no results of {error}, which this shows: carry out its own sweep"
        raise SystemExit(f"{arguments.run}: {lacking}.") from None
    except ValueError as error:
        raise SystemExit(f"{arguments.run}: {error}") from None
    print(f"{len({row.scene for row in found})} scenes, {len(found)} rows of {arguments.run}\n")
    print(text)


def _opened(row: Row, run: Path) -> Row:
    """With the path of its image as it can be opened."""
    return row if row.image is None else row._replace(image=str(run / row.image))


def kept(rows: Iterable[Row]) -> list[Row]:
    """Those whose images were kept.

    Raises
    ------
    ValueError
        If there are none.
    """
    found = [row for row in rows if row.image is not None]
    if not found:
        raise ValueError("no images were kept: run the sweep again with --keep-images.")
    return found


def by_denoiser(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Denoiser, by name -> its rows and the render's, the methods called alike for each."""
    return dict(sorted(statistics.split(rows, "denoiser").items()))


def of_one_denoiser(rows: Sequence[Row]) -> tuple[str, list[Row]]:
    """The denoiser and its rows, as `by_denoiser` has them.

    Raises
    ------
    ValueError
        If there are several.
    """
    found = by_denoiser(rows)
    if len(found) != 1:
        raise ValueError(f"this shows one denoiser, and the run has {', '.join(found) or 'none'}.")
    return next(iter(found.items()))


def renamed(rows: Iterable[Row], name: Callable[[Mapping[str, Any]], str]) -> list[Row]:
    """Methods called by what their settings are."""
    return [row._replace(method=name(row.settings)) for row in rows]


def methods(rows: Iterable[Row]) -> list[str]:
    """The render first and the oracle last."""
    order = {"render": 0, "denoised": 1, "oracle": 3}
    found = dict.fromkeys(row.method for row in rows)
    return sorted(found, key=lambda method: order.get(method, 2))


def over_scenes(rows: Iterable[Row], metric: str) -> dict[str, dict[int, float]]:
    """Method -> samples per pixel -> mean."""
    table = statistics.means(rows, metric)
    return {m: {spp: found.mean for spp, found in by.items()} for m, by in table.items()}


def from_least(spps: Iterable[int]) -> list[int]:
    """The samples per pixel that averages are of: from `LEAST_SPP` up; the highest, where there are none."""
    spps = list(spps)
    return [spp for spp in spps if spp >= min(LEAST_SPP, max(spps))]


def shares(rows: Sequence[Row], metric: str) -> dict[str, float]:
    """Method -> its share of the oracle's gain over the denoiser."""
    table = statistics.means(rows, metric)
    return statistics.shares(table, "denoised", "oracle", from_least(statistics.spps(table)))


def summary(rows: Sequence[Row]) -> str:
    """Errors relative to the denoiser's per spp, shares of the oracle's gain, and the worst renders."""
    from_8 = [row for row in rows if row.spp >= 8]
    at_512 = [row for row in rows if row.spp == 512]
    parts = []
    for metric, title in METRICS.items():
        means, gained = over_scenes(rows, metric), shares(rows, metric)
        worst = statistics.worst(from_8, metric, ("render", "denoised"))
        worst_512 = statistics.worst(at_512, metric, ("render",))
        denoised = means["denoised"]
        lines = [
            (
                name,
                *(float(f"{means[name][spp] / denoised[spp]:.4f}") for spp in denoised),
                f"{gained[name]:.1%}" if name in gained else "",
                f"{worst[name].ratio:.3f}" if name in worst else "",
                f"{worst_512[name].ratio:.3f}" if name in worst_512 else "",
            )
            for name in methods(rows)
            if name != "denoised"
        ]
        header = (
            f"{title} over the denoiser's",
            *(f"{spp} spp" for spp in denoised),
            f"of the oracle's gain, ≥ {LEAST_SPP} spp (goal {GOALS[metric]:.0%})",
            "worst over the better of both, ≥ 8 spp",
            "worst over the render, 512 spp",
        )
        parts.append(_common.markdown(header, lines))
    return "\n\n".join(parts)


def write_rows(
    path: Path, groups: Mapping[str, Iterable[Row]], columns: Sequence[str] = tuple(METRICS)
) -> None:
    """A CSV of what a figure shows, by denoiser."""
    values = (
        (denoiser, row.scene, row.spp, row.method, *(getattr(row, column) for column in columns))
        for denoiser, rows in groups.items()
        for row in rows
    )
    _common.write_csv(path, ("denoiser", "scene", "spp", "method", *columns), values)


def plot_over_spp(
    axis: Axes, rows: Sequence[Row], metric: str, colors: Mapping[str, str] = IMAGES
) -> None:
    """Means over scenes of those of the methods that there are, log-log."""
    means = over_scenes(rows, metric)
    for name in (name for name in colors if name in means):
        style = ":" if name == "oracle" else "o-"
        values = list(means[name].values())
        axis.plot(list(means[name]), values, style, color=colors[name], ms=4, label=name)
    title = statistics.METRICS[metric]
    axis.set(xscale="log", yscale="log", xlabel="samples per pixel", ylabel=title)
    spp_ticks(axis, (row.spp for row in rows))
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.grid(alpha=0.3)


def spp_ticks(axis: Axes, spps: Iterable[int]) -> None:
    """A tick for each."""
    found = sorted(set(spps))
    axis.set_xticks(found, labels=[str(spp) for spp in found])
    axis.minorticks_off()
