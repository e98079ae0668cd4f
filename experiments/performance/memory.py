"""Peak memory and time of the whole pipeline, each program in a process of its own, with and without a bound.

    python -m experiments.performance.memory [--size 1920x1080] [--max-memory 2GiB 1500MiB]

Memory is what is used above imports and inputs. The seconds are of one call each: `run` has ratios of many.
"""

from pathlib import Path

import progden_jax as pd
from experiments import _common
from experiments.performance import programs
from experiments.performance.run import NATIVE, OURS, TORCH, Process, Scene, processes, size_of


def main() -> None:
    parser = _common.parser(__doc__)
    parser.set_defaults(data=_common.TRAIN, scenes=4)
    parser.add_argument("--size", default="1920x1080", help="WIDTHxHEIGHT")
    parser.add_argument("--max-memory", nargs="*", default=("2GiB", "1500MiB"))
    parser.add_argument("--against", nargs="*", choices=(NATIVE, TORCH), default=(TORCH,))
    parser.add_argument("--probes", type=int, default=4)
    parser.add_argument("--denoiser", default="oidn-hdr", help="of OIDN's base or small networks")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_name("memory.csv"))
    arguments = parser.parse_args()
    names = _common.begin(arguments, f"{arguments.spp} spp, {arguments.denoiser}, {arguments.size}")
    frame, _ = programs.load_frame(arguments.data, names, arguments.spp, size_of(arguments.size))
    scene = Scene(frame, pd.denoisers.load(arguments.denoiser))
    found = processes(
        *(arguments.size, scene, arguments.denoiser, arguments.probes),
        (OURS, *arguments.against),
        arguments.max_memory,
    )
    _common.write_csv(arguments.output, Process._fields, found)
    rows = [
        (
            *(p.program, p.max_memory, p.cache),
            *(f"{p.first_result_s:.1f}", f"{p.second_s:.1f}", f"{p.peak_mb:.0f}"),
        )
        for p in found
    ]
    header = ("program", "max_memory", "cache", "first result, s", "again, s", "peak, MB")
    print(_common.markdown(header, rows))


if __name__ == "__main__":
    main()
