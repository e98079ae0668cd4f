"""What `progden render` takes over bare `mi.render` calls for the same numbers of samples.

    python -m experiments.performance.rendering

Processor time of a whole job: loading, series with variance, albedo, normal and depth, reference, files. The
bare calls are one per length, of a scene that is loaded, into nothing. They take turns.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments import _common
from progden_jax import rendering
from progden_jax.rendering import files
from progden_jax.rendering.loading import loaded


def processor_seconds(run: Callable[[], Any]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", choices=rendering.KINDS, default=rendering.KINDS)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--size", type=int, default=128, help="edge in pixels")
    parser.add_argument("--spp", type=int, nargs="+", default=(16, 64))
    parser.add_argument("--reference-spp", type=int, default=512)
    parser.add_argument("--variant", default="scalar_rgb", help="Mitsuba's")
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    mi = rendering.use_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    print(_common.machine(), f"Mitsuba {mi.__version__}, {arguments.variant}", sep="; ")
    size, spp = (arguments.size, arguments.size), tuple(arguments.spp)
    sampling = files.Sampling(spp=spp, reference_spp=arguments.reference_spp, size=size)
    rows = []
    for kind in arguments.kinds:
        job = files.procedural(arguments.seed, kind, sampling)
        scene = loaded(rendering.scene(arguments.seed, kind, size=size))

        def ours(job: files.Job = job) -> None:
            with tempfile.TemporaryDirectory() as folder:
                files.render(job, Path(folder))

        def bare(scene: Any = scene) -> None:
            for seed, count in enumerate((spp[-1], arguments.reference_spp)):
                if count:
                    mi.render(scene, spp=count, seed=seed).numpy()

        pairs = [
            (processor_seconds(ours), processor_seconds(bare)) for _ in range(arguments.rounds)
        ]
        own, plain = (statistics.median(part) for part in zip(*pairs, strict=True))
        ratio = statistics.median(a / b for a, b in pairs)
        rows.append((kind, f"{own:.1f}", f"{plain:.1f}", f"{ratio:.2f}"))
        print(rows[-1], flush=True)
    print(_common.markdown(("scene", "progden render, s", "mi.render, s", "ratio"), rows))


if __name__ == "__main__":
    main()
