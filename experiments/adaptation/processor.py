"""What a fit takes of the processors: by this the steps of `equal_time.yaml` were chosen.

    python -m experiments.adaptation.processor [experiments/adaptation/equal_time.yaml] [--steps 60]

Per method that fits anything the seconds of a step, all threads added up, so that other work on the machine
counts little, and those of all its steps. Looks at the blocks that choose are part of it, and what a fit
begins with: few steps would seem to take long.
"""

import dataclasses
import time
from pathlib import Path

import jax

import progden_jax as pd
from experiments import _common
from progden_jax import evaluation
from progden_jax.evaluation import parts
from progden_jax.evaluation.settings import NONE, Settings
from progden_jax.frame import centre, repaired

CONFIG = Path(__file__).with_name("equal_time.yaml")

PART = {"sure": "fitting", "sure-correct": "fitting", "post-correct": "correction"}
"""The part of the settings that has the steps."""


def main() -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("config", type=Path, nargs="?", default=CONFIG, help="of a sweep")
    parser.add_argument("--steps", type=int, default=60, help="to time of each fit")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    print(_common.machine() + "\n")
    plan = evaluation.load(arguments.config)
    (_, _, frame, _), *_ = _common.series(arguments.data, _common.scenes(arguments.data), [128])
    frame = repaired(centre(frame, plan.data.crop) if plan.data.crop else frame)
    # Methods that share a fit are told of once.
    fits = {m.settings.estimate(): m for m in plan.methods if m.settings.adaptation != NONE}
    lines = []
    for label, settings in fits.values():
        step = seconds(frame, settings, arguments.steps) / arguments.steps
        steps = getattr(settings, PART[settings.adaptation]).steps
        lines.append((label, step, steps, step * steps))
    header = ("fit", "processor seconds per step", "steps", "processor seconds")
    print(_common.markdown(header, lines))


def seconds(frame: pd.Frame, settings: Settings, steps: int) -> float:
    """Of the processors, for so many steps where all is compiled."""
    denoiser = parts.denoiser_for(frame, settings)
    parts.adapted(frame, denoiser, limited(settings, 1))
    start = time.process_time()
    found = parts.adapted(frame, denoiser, limited(settings, steps))
    jax.block_until_ready(jax.tree.leaves(found))
    return time.process_time() - start


def limited(settings: Settings, steps: int) -> Settings:
    """The same with so many steps."""
    part = PART[settings.adaptation]
    fewer = dataclasses.replace(getattr(settings, part), steps=steps)
    return dataclasses.replace(settings, **{part: fewer})


if __name__ == "__main__":
    main()
