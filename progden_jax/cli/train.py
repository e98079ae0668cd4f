"""`progden train`: weights from renders."""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from progden_jax.cli._progress import counting, timed
from progden_jax.cli._run import OK, UsageError, print_json, show

if TYPE_CHECKING:
    from progden_jax.training import RunConfig, Task
    from progden_jax.training.evaluation import Scores

HELP = """Train a mixing network, a denoiser or a combiner on renders with references.

```
progden train mixer --config cpu --data renders/ --output runs/hdr
progden train denoiser --config cpu --set inputs=['albedo','normal'] --data renders/ -o runs/unet
progden train combiner --config cpu --set denoiser=nfor --data renders/ -o runs/combiner
progden train combiner --config cpu --set buffers=2 --data renders/ -o runs/halves
progden train mixer --config mine.toml --set denoiser=oidn-hdr-alb-nrm -o runs/aux
tensorboard --logdir runs
```
"""

_MIXER_HELP = """Train a mixing network for one denoiser; the best so far are OUTPUT/weights.safetensors.

The same command goes on where it was killed, and comes to the same weights. Give them to
`progden denoise --mixer`. Denoised images and their divergences are kept in a cache folder between runs.
"""

_DENOISER_HELP = """Train a denoiser; the best weights so far are OUTPUT/weights.safetensors.

The same command goes on where it was killed, and comes to the same weights.
"""

_COMBINER_HELP = """Train a deep combiner for one denoiser; the best so far are OUTPUT/weights.safetensors.

The same command goes on where it was killed, and comes to the same weights. Give them to
`progden denoise --combiner`. Denoised images are kept in a cache folder between runs. With --set buffers=2
it combines two sub-averages of the samples, made of each render and an earlier one of its nested series, as
`progden render` makes them; 8,16,32 samples have exact halves.
"""

_CONFIG = Parameter(
    help="A named configuration (paper, cpu, smoke, and for mixers and denoisers gpu; those that made "
    "what is shipped: for mixers multiscale and any, for denoisers small, wider and kpcn, for combiners "
    "wide; for denoisers also residual and residual-small) or a file, .toml or .yaml; it may begin with "
    'base = "cpu" and change fields [default: cpu].'
)
_DATA = Parameter(
    consume_multiple=True,
    help="Folders of NAME_SSSSSSspp.exr files; of each scene the most samples are the reference.",
)
_OUTPUT = Parameter(
    name=["--output", "-o"], help="Folder of this run: checkpoints, curves, weights."
)
_SET = Parameter(name="--set", help="field=value, over the configuration's; may be repeated.")
_UNTIL = Parameter(help="Stop after this step; the same command without it goes on.")
_CACHE = Parameter(help="Where denoised images and divergences are kept.")
_JSON = Parameter(help="Print the result as one JSON object.")

app = App(name="train", help=HELP)


def mixer(
    *,
    output: Annotated[Path, _OUTPUT],
    config: Annotated[str, _CONFIG] = "cpu",
    data: Annotated[tuple[Path, ...], _DATA] = (),
    set: Annotated[tuple[str, ...], _SET] = (),
    until: Annotated[int | None, _UNTIL] = None,
    cache: Annotated[Path | None, _CACHE] = None,
    json: Annotated[bool, _JSON] = False,
) -> int:
    from progden_jax.training import MixerConfig, MixerTask

    chosen = _load(MixerConfig, config, data, set)
    task = functools.partial(MixerTask, chosen, cache_folder=cache)
    return _train(task, output, share=chosen.batch, until=until, json=json)


_ = app.command(mixer, help=_MIXER_HELP, usage="Usage: progden train mixer -o OUTPUT [OPTIONS]")


def denoiser(
    *,
    output: Annotated[Path, _OUTPUT],
    config: Annotated[str, _CONFIG] = "cpu",
    data: Annotated[tuple[Path, ...], _DATA] = (),
    set: Annotated[tuple[str, ...], _SET] = (),
    until: Annotated[int | None, _UNTIL] = None,
    json: Annotated[bool, _JSON] = False,
) -> int:
    from progden_jax.training import DenoiserConfig, DenoiserTask

    chosen = _load(DenoiserConfig, config, data, set)
    # Batch normalisation would take a core's part of the batch for all of it.
    share = 1 if chosen.architecture == "residual" else chosen.batch
    task = functools.partial(DenoiserTask, chosen)
    return _train(task, output, share=share, until=until, json=json)


_ = app.command(
    denoiser, help=_DENOISER_HELP, usage="Usage: progden train denoiser -o OUTPUT [OPTIONS]"
)


def combiner(
    *,
    output: Annotated[Path, _OUTPUT],
    config: Annotated[str, _CONFIG] = "cpu",
    data: Annotated[tuple[Path, ...], _DATA] = (),
    set: Annotated[tuple[str, ...], _SET] = (),
    until: Annotated[int | None, _UNTIL] = None,
    cache: Annotated[Path | None, _CACHE] = None,
    json: Annotated[bool, _JSON] = False,
) -> int:
    from progden_jax.training import CombinerConfig, CombinerTask

    chosen = _load(CombinerConfig, config, data, set)
    task = functools.partial(CombinerTask, chosen, cache_folder=cache)
    return _train(task, output, share=chosen.batch, until=until, json=json)


_ = app.command(
    combiner, help=_COMBINER_HELP, usage="Usage: progden train combiner -o OUTPUT [OPTIONS]"
)


def _load(
    kind: "type[RunConfig]", name: str, data: tuple[Path, ...], changes: tuple[str, ...]
) -> Any:
    from progden_jax.training import config

    try:
        values = dict(config.parse_change(text, kind) for text in changes)
        if data:
            values["data"] = [str(folder) for folder in data]
        found = config.load(kind, name, values)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if not found.data:
        raise UsageError("no data: name folders of renders with --data.")
    return found


def _train(
    make: "Callable[..., Task]",
    output: Path,
    *,
    share: int,
    until: int | None,
    json: bool,
) -> int:
    from progden_jax import enable_compilation_cache
    from progden_jax._devices import cores_as_devices
    from progden_jax.training import train

    if until is not None and until < 1:
        raise UsageError(f"--until is {until}, expected a step from 1 up.")
    enable_compilation_cache()
    cores_as_devices(share)
    with counting("renders, denoised") as progress:
        task = make(progress=progress)
    with contextlib.closing(_Report(quiet=json)) as report:
        outcome = train(task, output, report=report, until=until)
    step, best = int(outcome.state.step), int(outcome.state.best_step)
    if json:
        print_json(
            {
                "weights": str(outcome.weights) if best else None,
                "step": step,
                "best_step": best,
                "best_score": float(outcome.state.best_score),
                "stopped_early": outcome.stopped_early,
            }
        )
    elif best:
        print(f"step {step}; the best weights are of step {best}: {outcome.weights}")
    else:
        print(f"step {step}; no evaluation yet")
    return OK


class _Report:
    """A bar with the time left where stderr is a terminal, and a line per evaluation on stdout."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = timed("step", transient=False, speed_estimate_period=300)
        self._task = self._bar.add_task("", total=None, name="")
        self._bar.start()

    def started(self, step: int, steps: int) -> None:
        self._bar.reset(self._task, total=steps, completed=step, name="compiling")

    def stepped(self, step: int, values: dict[str, float] | None) -> None:
        self._bar.update(self._task, completed=step)
        if values:
            name = f"loss {values['loss']:.5f}, {values['seconds_per_step']:.3g} s a step"
            self._bar.update(self._task, name=name)

    def evaluated(self, step: int, scores: "Scores", *, best: bool) -> None:
        if self._quiet:
            return
        line = (
            f"step {step}: score {scores.score:.4f}{' (best)' if best else ''}; {_summary(scores)}"
        )
        show(line, self._bar)

    def close(self) -> None:
        self._bar.stop()


def _summary(scores: "Scores") -> str:
    """Means over spp of each image's errors, on one line."""
    parts = []
    for metric in next(iter(scores.table.values())):
        means = []
        for image, by_metric in scores.table.items():
            values = by_metric[metric].values()
            means.append(f"{image} {sum(values) / len(values):.4f}")
        parts.append(f"{metric.upper()} {', '.join(means)}")
    return "; ".join(parts)
