"""What mixing gains over OIDN, beside the closed form and what an oracle could gain (paper, Table 3).

progden sweep experiments/table3/sweep.yaml -o runs/table3
python -m experiments.table3.plot runs/table3
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments import _plots
from progden_jax.evaluation import Row
from progden_jax.mixers import CLOSED_FORM


def name(settings: Mapping[str, Any]) -> str:
    """Of an image in the table."""
    if settings["image"] != "mix":
        return settings["image"]
    if settings["mixer"] != CLOSED_FORM:
        return "mix"
    window = settings["mixer.window"]
    return (
        "closed form" if settings["mixer.confidence"] else f"paper's closed form, {window}×{window}"
    )


def draw(rows: Sequence[Row], output: Path) -> str:
    """Tables alone."""
    groups = _plots.by_denoiser(_plots.renamed(rows, name)).items()
    return "\n\n".join(f"## {denoiser}\n\n{_plots.summary(own)}" for denoiser, own in groups)


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
