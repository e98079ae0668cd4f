"""Train the method whole and without each of its parts, all with the same short budget (paper, Table 4).

python -m experiments.table4.train --data ../shared/data/train --output runs/table4

Each run is a folder of its own. The same command goes on where it was killed and skips what is done.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import progden_jax as pd
from progden_jax.training import MixerConfig, MixerTask, config, train
from progden_jax.training.evaluation import Scores

TRAIN = Path(__file__).resolve().parents[3] / "shared" / "data" / "train"


class Run(NamedTuple):
    """What differs from the configuration that its name begins with."""

    title: str
    changes: Mapping[str, Any] = {}


BUDGETS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("cpu", {"steps": 600, "batch": 12, "crop": 64, "peak_rate": 1e-3, "ema": 0.99}),
    "multiscale": ("multiscale", {"steps": 300, "crop": 64, "draws": 1}),
}
"""The configuration that runs begin from, and its budget; `evaluate_every` is a third of the steps."""

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


def configuration(
    name: str, data: tuple[str, ...], changes: Mapping[str, Any] | None = None
) -> MixerConfig:
    """Of that run."""
    base, budget = BUDGETS[name.partition("-")[0]]
    fields = {**budget, **RUNS[name].changes, "data": data, **(changes or {})}
    for every in ("evaluate_every", "checkpoint_every"):
        fields.setdefault(every, max(1, fields["steps"] // 3))
    return config.load(MixerConfig, base, fields)


class Lines:
    """A line per evaluation, see `progden_jax.training.Report`."""

    def __init__(self, name: str) -> None:
        self.name = name

    def started(self, step: int, steps: int) -> None:
        print(f"{self.name}: step {step} of {steps}", flush=True)

    def stepped(self, step: int, values: dict[str, float] | None) -> None:
        pass

    def evaluated(self, step: int, scores: Scores, *, best: bool) -> None:
        print(f"{self.name}: step {step}, score {scores.score:.4f}{' (best)' * best}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default=str(TRAIN), help="folder of NAME_SSSSSSspp.exr files")
    parser.add_argument("--output", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--only", nargs="*", choices=RUNS, default=list(RUNS), metavar="RUN")
    parser.add_argument(
        "--set", nargs="*", default=(), metavar="FIELD=VALUE", help="over every configuration's"
    )
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    changes = dict(config.parse_change(text, MixerConfig) for text in arguments.set)
    for name in arguments.only:
        task = MixerTask(configuration(name, (arguments.data,), changes))
        train(task, arguments.output / name, report=Lines(name))


if __name__ == "__main__":
    main()
