"""What the experiments that train mixers share."""

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments import _common
from progden_jax._devices import cores_as_devices
from progden_jax.training import MixerConfig, MixerTask, config, train
from progden_jax.training.evaluation import Scores

RUNS = Path(__file__).resolve().parents[1] / "runs"
"""Where configurations of sweeps look for what was trained."""


def parser(description: str | None, name: str) -> argparse.ArgumentParser:
    """A command line with --data, --output, by default `RUNS` / name, and --set."""
    made = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--data", type=Path, default=_common.TRAIN)
    made.add_argument("--output", type=Path, default=RUNS / name, help="folder of the runs")
    made.add_argument(
        "--set", nargs="*", default=(), metavar="FIELD=VALUE", help="over every configuration's"
    )
    return made


def changes(texts: list[str]) -> dict[str, Any]:
    """Of --set."""
    return dict(config.parse_change(text, MixerConfig) for text in texts)


def configuration(base: str, fields: Mapping[str, Any]) -> MixerConfig:
    """That configuration with these fields, evaluated three times."""
    fields = dict(fields)
    for every in ("evaluate_every", "checkpoint_every"):
        fields.setdefault(every, max(1, fields["steps"] // 3))
    return config.load(MixerConfig, base, fields)


def train_all(runs: Mapping[str, MixerConfig], output: Path) -> None:
    """Each run in a folder of its own; goes on where it was killed, and leaves alone what is done."""
    cores_as_devices(math.gcd(*(chosen.batch for chosen in runs.values())))
    for name, chosen in runs.items():
        train(MixerTask(chosen), output / name, report=_Lines(name))


class _Lines:
    """A line per evaluation, see `progden_jax.training.Report`."""

    def __init__(self, name: str) -> None:
        self.name = name

    def started(self, step: int, steps: int) -> None:
        print(f"{self.name}: step {step} of {steps}", flush=True)

    def stepped(self, step: int, values: dict[str, float] | None) -> None:
        pass

    def evaluated(self, step: int, scores: Scores, *, best: bool) -> None:
        print(f"{self.name}: step {step}, score {scores.score:.4f}{' (best)' * best}", flush=True)
