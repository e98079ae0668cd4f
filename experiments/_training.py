"""What the experiments that train mixers share."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import progden_jax as pd
from experiments import _common
from progden_jax.training import MixerConfig, MixerTask, config, loop, train
from progden_jax.training.evaluation import Scores


def parser(description: str | None) -> argparse.ArgumentParser:
    """A command line with --data, --output and --set."""
    made = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--data", type=Path, default=_common.TRAIN)
    made.add_argument("--output", type=Path, required=True, help="folder of the runs")
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
    for name, chosen in runs.items():
        train(MixerTask(chosen), output / name, report=_Lines(name))


def trained(runs: Path | None, names: Mapping[str, Any]) -> dict[str, pd.NetworkMixer]:
    """The weights of those runs in the folder that have some."""
    files = {} if runs is None else {name: runs / name / loop.WEIGHTS for name in names}
    found = {name: pd.load_mixer(file) for name, file in files.items() if file.exists()}
    return {name: mixer for name, mixer in found.items() if isinstance(mixer, pd.NetworkMixer)}


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
