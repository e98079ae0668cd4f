"""Results for other programs (CSV, Parquet) and for papers (Markdown, LaTeX)."""

import csv
import importlib
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from progden_jax._files import replacing
from progden_jax.evaluation import statistics
from progden_jax.evaluation.database import Row
from progden_jax.evaluation.statistics import CONFIDENCE, METRICS, Interval, Table

FORMATS = (".csv", ".parquet", ".md", ".tex")


def export(
    path: Path,
    rows: Sequence[Row],
    *,
    baseline: str | None = None,
    confidence: float = CONFIDENCE,
) -> None:
    """Write results in the format that the path ends in; whole or not at all.

    .csv and .parquet have every row with its settings as columns, .md and .tex (for the package booktabs)
    means over scenes with confidence intervals, a table per metric.

    Parameters
    ----------
    baseline : a method that the tables compare with, see `statistics.relative_to`.

    Raises
    ------
    ValueError
        If the path ends otherwise, a package is missing, or there is no such baseline.
    """
    check_path(path)
    if path.suffix in (".csv", ".parquet"):
        with replacing(path) as temporary:
            (_write_csv if path.suffix == ".csv" else _write_parquet)(temporary, rows)
        return
    tables = summary(rows, baseline=baseline, confidence=confidence)
    text = (_markdown if path.suffix == ".md" else _latex)(tables, confidence)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_path(path: Path) -> None:
    """Raise ValueError for a format that is unknown, or cannot be written here."""
    if path.suffix not in FORMATS:
        raise ValueError(f"{path} cannot be exported to: it must end in {', '.join(FORMATS)}.")
    if path.suffix == ".parquet":
        _pyarrow()


class Summary:
    """A table for people: a method per line, samples per pixel across.

    Attributes
    ----------
    name, title : of the metric, for programs and for people.
    table : what it shows.
    best : samples per pixel -> the best method, the oracle aside.
    """

    def __init__(self, name: str, title: str, table: Table, best: dict[int, str]) -> None:
        self.name, self.title, self.table, self.best = name, title, table, best
        sizes = [
            abs(i.mean)
            for by_spp in table.values()
            for i in by_spp.values()
            if i.mean and _finite(i)
        ]
        # Three digits of the smallest.
        smallest = math.floor(math.log10(min(sizes))) if sizes else 0
        self._decimals = min(max(2 - smallest, 0), 8)

    @property
    def spps(self) -> list[int]:
        """The columns."""
        return statistics.spps(self.table)

    def cell(self, method: str, spp: int, plus_minus: str = " ± ") -> str:
        """Mean and half the interval's width; empty where there is nothing."""
        found = self.table[method].get(spp)
        if found is None:
            return ""
        mean = f"{found.mean:.{self._decimals}f}"
        return (
            mean if math.isnan(found.half) else f"{mean}{plus_minus}{found.half:.{self._decimals}f}"
        )


def summary(
    rows: Sequence[Row], *, baseline: str | None = None, confidence: float = CONFIDENCE
) -> list[Summary]:
    """What there is to tell of the rows, a table per metric."""
    real = list(dict.fromkeys(r.method for r in rows if r.settings.get("image") != "oracle"))
    found = []
    for metric, title in METRICS.items():
        if baseline is None:
            table = statistics.means(rows, metric, confidence)
        else:
            table = statistics.relative_to(rows, baseline, metric, confidence)
            title = f"{title}, ratio to {baseline}"
        found.append(Summary(metric, title, table, statistics.best(table, metric, real)))
    bias = statistics.sure_bias(rows, confidence)
    if bias and baseline is None:
        found.append(
            Summary("sure_bias", "SURE − MSE of the denoised image, over that MSE", bias, {})
        )
    return [s for s in found if s.table]


def records(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows as flat dictionaries of the same names, settings as "settings.NAME"."""
    names = list(dict.fromkeys(name for row in rows for name in row.settings))
    found = []
    for row in rows:
        record = {n: v for n, v in row._asdict().items() if n != "settings"}
        found.append(record | {f"settings.{n}": row.settings.get(n) for n in names})
    return found


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    found = records(rows)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(found[0]) if found else Row._fields)
        writer.writeheader()
        writer.writerows(found)


def _write_parquet(path: Path, rows: Sequence[Row]) -> None:
    arrow, parquet = _pyarrow()
    parquet.write_table(arrow.Table.from_pylist(records(rows)), path)


def _pyarrow() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise ValueError(
            "writing Parquet needs PyArrow: pip install 'progden_jax[evaluate]', or export .csv."
        ) from None


def _note(table: Table, confidence: float) -> str:
    """Over how many scenes, and what the intervals are, where there can be any."""
    counts = sorted({i.scenes for by_spp in table.values() for i in by_spp.values()})
    if counts == [1]:
        return "of one scene"
    scenes = "–".join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))
    return f"means over {scenes} scenes, {confidence:.0%} confidence intervals by Student's t"


def _markdown(tables: Sequence[Summary], confidence: float) -> str:
    parts = []
    for found in tables:
        lines = [
            f"## {found.title}, {_note(found.table, confidence)}\n",
            "| method | " + " | ".join(f"{n} spp" for n in found.spps) + " |",
            "| --- |" + " ---: |" * len(found.spps),
        ]
        for method in found.table:
            cells = [
                f"**{c}**" if found.best.get(n) == method else c
                for n in found.spps
                for c in [found.cell(method, n)]
            ]
            name = method.replace("|", "\\|")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


_ESCAPES = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "−": "$-$",
    "×": r"$\times$",
}


def _tex(text: str) -> str:
    return "".join(_ESCAPES.get(c, c) for c in text)


def _latex(tables: Sequence[Summary], confidence: float) -> str:
    out = io.StringIO()
    out.write("% Needs \\usepackage{booktabs}.\n")
    for found in tables:
        caption = f"{found.title}, {_note(found.table, confidence)}."
        heads = " & ".join(str(n) for n in found.spps)
        out.write(
            "\\begin{table}\n  \\centering\n"
            f"  \\caption{{{_tex(caption)}}}\n"
            f"  \\begin{{tabular}}{{l{'r' * len(found.spps)}}}\n"
            "    \\toprule\n"
            f"    & \\multicolumn{{{len(found.spps)}}}{{c}}{{samples per pixel}} \\\\\n"
            f"    \\cmidrule(l){{2-{len(found.spps) + 1}}}\n"
            f"    method & {heads} \\\\\n"
            "    \\midrule\n"
        )
        for method in found.table:
            cells = []
            for n in found.spps:
                cell = found.cell(method, n, " \\pm ")
                math_cell = cell and f"${cell}$"
                cells.append(f"\\boldmath{math_cell}" if found.best.get(n) == method else math_cell)
            out.write(f"    {_tex(method)} & " + " & ".join(cells) + " \\\\\n")
        out.write("    \\bottomrule\n  \\end{tabular}\n\\end{table}\n\n")
    return out.getvalue()


def _finite(found: Interval) -> bool:
    return math.isfinite(found.mean)
