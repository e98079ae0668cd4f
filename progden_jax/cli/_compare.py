"""Metrics against a reference, and their table."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rich.table import Table

METRICS = {"rmse": "RMSE", "smape": "SMAPE", "flip": "FLIP", "relmse": "relMSE"}
"""Names in progden_jax.metrics, and how people write them; of all of them less is better."""

Scores = dict[str, dict[str, float]]


def compare(images: Mapping[str, Any], reference: Any) -> Scores:
    """Image -> metric -> value, for (H, W, 3) finite linear radiance."""
    from progden_jax import metrics

    images = {name: np.asarray(image) for name, image in images.items()}
    reference = np.asarray(reference)
    return {
        name: {m: float(getattr(metrics, m)(image, reference)) for m in METRICS}
        for name, image in images.items()
    }


def score_table(rows: Mapping[str, Scores], *, of: str) -> "Table":
    """A table of row -> image -> metric, the best image of a row in bold."""
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(of, overflow="fold")
    table.add_column("image")
    for title in METRICS.values():
        table.add_column(title, justify="right")
    for label, scores in rows.items():
        best = {m: min(s[m] for s in scores.values()) for m in METRICS}
        for i, (name, values) in enumerate(scores.items()):
            cells = [f"[bold]{v:.4f}[/]" if v == best[m] else f"{v:.4f}" for m, v in values.items()]
            last = i == len(scores) - 1
            table.add_row("" if i else escape(label), name, *cells, end_section=last)
    return table
