"""What errors tend to: at the references' 4096 samples per pixel, by Stein's estimate, for want of a truth.

python -m experiments.related_work.limit

Methods and scenes are those of limit.yaml, or of another such file. Buffers that references lack are those of
the 512 spp renders, where the estimate stands beside what is measured.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.related_work.plot import name
from progden_jax import evaluation
from progden_jax.evaluation.images import estimate, mean_of, show
from progden_jax.evaluation.plan import Plan
from progden_jax.frame import centre, repaired
from progden_jax.training.index import Item

SWEEP = Path(__file__).with_name("limit.yaml")

SPP = 512


class Found(NamedTuple):
    """Root mean squared errors of a method on a render, the measured one without the reference's noise."""

    scene: str
    method: str
    spp: int
    estimated: float
    measured: float | None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sweep", type=Path, default=SWEEP, help="file of methods and scenes")
    parser.add_argument("--data", type=Path, help="folder of NAME_SSSSSSspp.exr files")
    parser.add_argument("--probes", type=int, default=0, help="for mixes; 0: as if α were constant")
    arguments = parser.parse_args()
    data: dict[str, Any] = {"spp": [SPP]}
    if arguments.data is not None:
        data |= {"data": [str(arguments.data)], "scenes": []}
    plan = evaluation.load(arguments.sweep, data=data)
    pd.enable_compilation_cache()
    print(f"{_common.machine()}\n{len(plan.items)} scenes\n")
    rows = [row for item in plan.items for row in of_scene(item, plan, arguments.probes)]
    print(table(rows))


def of_scene(item: Item, plan: Plan, probes: int) -> Iterator[Found]:
    """Every method on the render and on its reference."""
    frame = pd.read_exr(item.path).replace(spp=None)
    truth = pd.read_exr(item.reference, auxiliary=False).replace(spp=None)
    frame, truth = repaired(frame), repaired(truth)
    if plan.data.crop:
        frame, truth = (centre(f, plan.data.crop) for f in (frame, truth))
    best = frame.replace(color=truth.color, variance=truth.variance)
    reference = np.asarray(truth.color)
    for spp, given in ((SPP, frame), (_common.REFERENCE_SPP, best)):
        made: dict[Any, Any] = {}
        for method in plan.methods:
            settings = dataclasses.replace(method.settings, risk_probes=probes)
            same = settings.estimate()
            if settings.image != "render" and same not in made:
                made[same] = estimate(given, settings, None)
            shown = show(settings, given, made.get(same), reference)
            measured = None
            if spp == SPP:
                squared = (np.asarray(shown.image, np.float64) - reference) ** 2
                measured = _root(squared.mean() - mean_of(truth.variance))
            yield Found(item.scene, name(settings.flat()), spp, _root(shown.risk), measured)


def _root(square: Any) -> float:
    """An estimate that is below 0 stands for no error."""
    return float(np.sqrt(max(square, 0)))


def table(rows: list[Found]) -> str:
    """Means over the scenes, and in how many of them the estimate is above the render's."""
    lines = []
    most = [row for row in rows if row.spp == _common.REFERENCE_SPP]
    render = {row.scene: row.estimated for row in most if row.method == "render"}
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method]
        measured = [row.measured for row in own if row.measured is not None]
        estimated = (
            [row.estimated for row in own if row.spp == spp] for spp in (SPP, _common.REFERENCE_SPP)
        )
        means = (float(np.mean(found)) for found in (measured, *estimated))
        above = sum(row.estimated > render[row.scene] for row in most if row.method == method)
        lines.append((method, *means, above))
    return _common.markdown(
        (
            "RMSE",
            f"{SPP} spp",
            f"{SPP} spp, estimated",
            f"{_common.REFERENCE_SPP} spp, estimated",
            f"scenes above the render, of {len(render)}",
        ),
        lines,
    )


if __name__ == "__main__":
    main()
