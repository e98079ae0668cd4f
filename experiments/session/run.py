"""A real render by Mitsuba 3, denoised progressively while its samples grow.

    python -m experiments.session.run [--seed 3] [--size 256x256] [--spp 2 4 8 ... 256]

Needs the extra "render". After every step OUTPUT/current.png (open it in a viewer that follows changes) and a
line with the errors against a reference that is rendered first; in the end OUTPUT/steps.png with the steps
side by side, and OUTPUT/run.csv.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.image
import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common
from experiments.performance.run import size_of
from progden_jax import metrics, rendering, sheet
from progden_jax._files import replacing

HERE = Path(__file__).parent
SPP = (2, 4, 8, 16, 32, 64, 128, 256)
SHOWN = 5


class Step(NamedTuple):
    """One update; seconds are of the clock, `rendered` since the start."""

    spp: int
    rendered: float
    update: float
    skipped: float
    render_rmse: float
    mix_rmse: float
    render_flip: float
    mix_flip: float


class Seen(NamedTuple):
    """What there was to look at after a step."""

    spp: int
    render: np.ndarray
    mix: np.ndarray
    alpha: np.ndarray


def main() -> None:
    arguments = parse()
    pd.enable_compilation_cache()
    print(_common.machine())
    arguments.output.mkdir(parents=True, exist_ok=True)
    size = size_of(arguments.size)
    scene = rendering.scene(arguments.seed, arguments.kind, size=size)
    *_, truth = rendering.series(scene, [arguments.reference_spp], seed=arguments.seed + 1)
    reference = np.asarray(truth.color)
    exposure = sheet.exposure_for(reference)
    session = pd.Session(
        pd.denoisers.load(arguments.denoiser),
        size,
        outputs=("image", "alpha"),
        skip=pd.Skip(tolerance=arguments.converged),
    )
    steps: list[Step] = []
    seen: list[Seen] = []
    rendered, begun = 0.0, time.perf_counter()
    for frame in rendering.series(scene, arguments.spp, seed=arguments.seed):
        rendered += time.perf_counter() - begun
        begun = time.perf_counter()
        result = session.update(frame)
        image = np.asarray(result.image)
        update = time.perf_counter() - begun
        render = np.asarray(frame.color)
        spp = int(frame.spp)
        with replacing(arguments.output / "current.png") as beside:
            matplotlib.image.imsave(beside, sheet.display(image, exposure), format="png")
        images = (frame.color, result.image)
        errors = [f(i, truth.color) for f in (metrics.rmse, metrics.flip) for i in images]
        skipped = result.skipped.pixels / (size[0] * size[1]) if result.skipped else 0.0
        steps.append(Step(spp, rendered, update, skipped, *map(float, errors)))
        seen.append(Seen(spp, render, image, np.asarray(result.alpha)))
        print(line(steps[-1]), flush=True)
        begun = time.perf_counter()
    _common.write_csv(arguments.output / "run.csv", Step._fields, steps)
    draw(arguments.output / "steps.png", seen, reference, exposure)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=3, help="of the scene and its samples")
    parser.add_argument("--kind", choices=rendering.KINDS, default="room")
    parser.add_argument("--size", default="256x256", help="WIDTHxHEIGHT")
    parser.add_argument("--spp", type=int, nargs="+", default=SPP)
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--denoiser", default="oidn-hdr-alb-nrm")
    parser.add_argument(
        "--converged", type=float, default=0.005, help="relative standard error that is left alone"
    )
    parser.add_argument("--output", type=Path, default=HERE, help="a folder")
    return parser.parse_args()


def line(step: Step) -> str:
    """For people."""
    return (
        f"{step.spp:5d} spp after {step.rendered:6.1f} s, update {step.update * 1e3:6.0f} ms, "
        f"{step.skipped:4.0%} left alone; RMSE {step.render_rmse:.4f} → {step.mix_rmse:.4f}, "
        f"FLIP {step.render_flip:.3f} → {step.mix_flip:.3f}"
    )


def draw(path: Path, seen: list[Seen], reference: np.ndarray, exposure: float) -> None:
    """Some steps from first to last, a column each: render, what the session gave, α."""
    some = [seen[i] for i in sorted({*np.linspace(0, len(seen) - 1, SHOWN).round().astype(int)})]
    figure = Figure(figsize=(2.3 * (len(some) + 1), 7), layout="constrained")
    axes: Any = figure.subplots(3, len(some) + 1, squeeze=False)
    for column, step in enumerate(some):
        axes[0, column].set_title(f"{step.spp} spp")
        for row, image in enumerate((step.render, step.mix)):
            axes[row, column].imshow(sheet.display(image, exposure))
        axes[2, column].imshow(step.alpha.mean(-1), vmin=0, vmax=1, cmap="gray")
    axes[0, -1].set_title("reference")
    axes[0, -1].imshow(sheet.display(reference, exposure))
    for row, label in enumerate(("render", "session", "α")):
        axes[row, 0].set_ylabel(label)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    _common.save_figure(path, figure)


if __name__ == "__main__":
    main()
