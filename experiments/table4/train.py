"""Train the method whole and without each of its parts, all with the same short budget (paper, Table 4).

python -m experiments.table4.train

Each run is a folder of its own. The same command goes on where it was killed and skips what is done.
"""

from typing import Any

import progden_jax as pd
from experiments import _training

BUDGETS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("cpu", {"steps": 600, "batch": 12, "crop": 64, "peak_rate": 1e-3, "ema": 0.99}),
    "multiscale": ("multiscale", {"steps": 300, "crop": 64, "draws": 1}),
}
"""The configuration that runs begin from, and its budget."""

RUNS: dict[str, dict[str, Any]] = {
    "paper": {},
    "paper-sure": {"options": {"sure": False}},
    "paper-ratio": {"options": {"ratio": False}},
    "paper-swap": {"swap": 0.0},
    "multiscale": {},
    "multiscale-scales": {"options": {"without": ["scales"]}},
    "multiscale-divergence": {"options": {"without": ["divergence"]}},
    "multiscale-relative": {"options": {"without": ["relative"]}},
    "multiscale-start": {"options": {"start": "none"}},
    "multiscale-loss": {"loss": "smape"},
}
"""Folder -> what differs from the budget that its name begins with; trained.yaml says what is left out."""


def main() -> None:
    parser = _training.parser(__doc__, "table4")
    parser.add_argument("--only", nargs="*", choices=RUNS, default=list(RUNS), metavar="RUN")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    runs = {}
    for name in arguments.only:
        base, budget = BUDGETS[name.partition("-")[0]]
        fields = {**budget, **RUNS[name], "data": [str(arguments.data)]}
        runs[name] = _training.configuration(base, fields | _training.changes(arguments.set))
    _training.train_all(runs, arguments.output)


if __name__ == "__main__":
    main()
