"""Train the method whole and without each of its parts, all with the same short budget (paper, Table 4).

python -m experiments.table4.train --data ../shared/data/train --output runs/table4

Each run is a folder of its own. The same command goes on where it was killed and skips what is done.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import progden_jax as pd
from experiments import _training


class Run(NamedTuple):
    """What differs from the configuration that its name begins with."""

    title: str
    changes: Mapping[str, Any] = {}


BUDGETS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("cpu", {"steps": 600, "batch": 12, "crop": 64, "peak_rate": 1e-3, "ema": 0.99}),
    "multiscale": ("multiscale", {"steps": 300, "crop": 64, "draws": 1}),
}
"""The configuration that runs begin from, and its budget."""

RUNS = {
    "paper": Run("paper's network, whole"),
    "paper-sure": Run("without SURE", {"options": {"sure": False}}),
    "paper-ratio": Run("without f_act", {"options": {"ratio": False}}),
    "paper-swap": Run("without swap", {"swap": 0.0}),
    "multiscale": Run("multiscale, whole"),
    "multiscale-scales": Run("without other windows", {"options": {"without": ["scales"]}}),
    "multiscale-divergence": Run("without f'", {"options": {"without": ["divergence"]}}),
    "multiscale-relative": Run("without relative ones", {"options": {"without": ["relative"]}}),
    "multiscale-start": Run("without the closed form's start", {"options": {"start": "none"}}),
    "multiscale-loss": Run("SMAPE as its loss", {"loss": "smape"}),
}
"""Folder -> run; the name up to the hyphen is the whole method."""


def main() -> None:
    parser = _training.parser(__doc__)
    parser.add_argument("--only", nargs="*", choices=RUNS, default=list(RUNS), metavar="RUN")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    runs = {}
    for name in arguments.only:
        base, budget = BUDGETS[name.partition("-")[0]]
        fields = {**budget, **RUNS[name].changes, "data": [str(arguments.data)]}
        runs[name] = _training.configuration(base, fields | _training.changes(arguments.set))
    _training.train_all(runs, arguments.output)


if __name__ == "__main__":
    main()
