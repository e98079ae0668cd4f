"""The training loop: steps, curves, evaluation, checkpoints."""

import json
import os
import subprocess
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import progden_jax
from progden_jax.training import order
from progden_jax.training.checkpoints import Checkpoints, claim, defaults_of, describe, plain
from progden_jax.training.curves import Curves
from progden_jax.training.evaluation import Scores
from progden_jax.training.step import State, Task, keep_best, make_start, make_step, schedule

WEIGHTS = "weights.safetensors"
"""The best weights so far, in the run's folder."""


class Report(Protocol):
    """What is told while training goes on."""

    def started(self, step: int, steps: int) -> None:
        """Training is about to begin, at this step of so many."""
        ...

    def stepped(self, step: int, values: dict[str, float] | None) -> None:
        """A step is done; at intervals with the curves' values."""
        ...

    def evaluated(self, step: int, scores: Scores, *, best: bool) -> None:
        """The held-out scenes were looked at."""
        ...


class Outcome(NamedTuple):
    """What training came to: its last state, the file of the best weights, and whether it stopped early."""

    state: State
    weights: Path
    stopped_early: bool


class Trainer:
    """The loop for one task, compiled once.

    Parameters
    ----------
    task : what to train, on what.
    devices : to share each batch between, by default all; the batch must be a multiple of their number.

    Raises
    ------
    ValueError
        If the batch cannot be shared.
    """

    def __init__(self, task: Task, *, devices: Sequence[Any] | None = None) -> None:
        devices = jax.devices() if devices is None else devices
        if task.config.batch % len(devices):
            raise ValueError(
                f"batch is {task.config.batch}, which {len(devices)} devices cannot share: take a multiple."
            )
        mesh = Mesh(np.asarray(devices), ("batch",))
        self.task = task
        self._everywhere = NamedSharding(mesh, PartitionSpec())
        self._arrays = jax.device_put(dict(task.arrays), self._everywhere)
        self._key = jax.device_put(jax.random.key(task.config.seed), self._everywhere)
        self._start = make_start(task)
        self._step = make_step(task, mesh if len(devices) > 1 else None)
        self._rate = jax.jit(schedule(task.config))
        self._metadata = {
            "commit": commit(),
            "version": progden_jax.__version__,
            "config": json.dumps(plain(task.config)),
        }

    def run(
        self,
        folder: str | os.PathLike[str],
        *,
        report: Report | None = None,
        until: int | None = None,
    ) -> Outcome:
        """Train to the end of the schedule, or go on with what `folder` holds; see `train`."""
        task, config, folder = self.task, self.task.config, Path(folder)
        claim(folder, describe(task.kind, config, task.items), defaults_of(config))
        with closing(Checkpoints(folder)) as checkpoints:
            state = jax.device_put(self._start(self._key), self._everywhere)
            state = checkpoints.restore(state) or state
            with closing(Curves(folder, int(state.step))) as curves:
                outlets = _Outlets(folder, curves, checkpoints, report)
                state = self._loop(state, min(config.steps, until or config.steps), outlets)
        early = _exhausted(state, config) and int(state.step) < config.steps
        return Outcome(state, folder / WEIGHTS, early)

    def _loop(self, state: State, end: int, outlets: "_Outlets") -> State:
        task, config, report = self.task, self.task.config, outlets.report
        step = int(state.step)
        if report:
            report.started(step, config.steps)
        pending: list[dict[str, jax.Array]] = []
        last: dict[str, jax.Array] = {}
        begin, begun = time.perf_counter(), step
        while step < end and not _exhausted(state, config):
            chosen = order.indices(
                step, count=len(task.items), batch=config.batch, seed=config.seed
            )
            state, scalars = self._step(state, self._arrays, self._key, jnp.asarray(chosen))
            jax.block_until_ready(last)  # at most one step ahead
            last = scalars
            pending.append(scalars)
            step += 1
            values = None
            if step % config.log_every == 0 or step == config.steps:
                values = _means(pending)
                if not np.isfinite(values["loss"]):
                    raise ValueError(
                        f"the loss is {values['loss']} at step {step}: lower peak_rate or clip_norm, and "
                        "choose another folder; this one goes on from its last checkpoint."
                    )
                pending = []
                values["rate"] = float(np.asarray(self._rate(step - 1)))
                values["seconds_per_step"] = (time.perf_counter() - begin) / (step - begun)
                begin, begun = time.perf_counter(), step
                outlets.curves.write(step, {f"train/{k}": v for k, v in values.items()})
            if report:
                report.stepped(step, values)
            if step % config.evaluate_every == 0 or step == config.steps:
                state = self._evaluate(state, outlets)
                begin, begun = time.perf_counter(), step
            if step % config.checkpoint_every == 0 or step == end or _exhausted(state, config):
                outlets.checkpoints.save(state)
        return state

    def _evaluate(self, state: State, outlets: "_Outlets") -> State:
        scores = self.task.evaluate(state.average)
        state = keep_best(state, jnp.float32(scores.score))
        step, best = int(state.step), int(state.best_step) == int(state.step)
        outlets.curves.write(step, {"held-out/score": scores.score} | scores.flat())
        if best:
            said = {**self._metadata, "steps": str(step), "score": f"{scores.score:.6f}"}
            self.task.export(outlets.folder / WEIGHTS, state.best, said)
        if outlets.report:
            outlets.report.evaluated(step, scores, best=best)
        return state


class _Outlets(NamedTuple):
    """Where a run goes to."""

    folder: Path
    curves: Curves
    checkpoints: Checkpoints
    report: Report | None


def train(
    task: Task,
    folder: str | os.PathLike[str],
    *,
    report: Report | None = None,
    until: int | None = None,
    devices: Sequence[Any] | None = None,
) -> Outcome:
    """Train to the end of the schedule, or go on with what `folder` holds.

    Checkpoints hold all that matters, and each step's examples follow from the seed and the step: a run that
    was killed and gone on with gives the same weights, bit for bit, as one that was not. (On GPUs that
    takes XLA_FLAGS=--xla_gpu_deterministic_ops=true, for cuDNN may sum in any order.)

    Parameters
    ----------
    task, devices : see `Trainer`.
    folder : of the run: checkpoints, curves, and the best weights so far. Made if missing.
    until : stop after this step, as if killed but with a checkpoint; the schedule stays as it is.

    Raises
    ------
    ValueError
        If `folder` holds another run, the batch cannot be shared, or the loss is no longer finite.
    """
    return Trainer(task, devices=devices).run(folder, report=report, until=until)


def _exhausted(state: State, config: Any) -> bool:
    return bool(config.patience) and int(state.stale) >= config.patience


def _means(scalars: list[dict[str, jax.Array]]) -> dict[str, float]:
    return {
        name: float(np.mean([np.asarray(s[name], np.float64) for s in scalars]))
        for name in scalars[0]
    }


def commit() -> str:
    """The commit of the source tree that runs, "unknown" where it is no Git checkout."""
    here = Path(__file__).parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=here,
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip()
