"""Peak memory of `progden denoise --max-memory` on one huge EXR file, in a process of its own.

    python -m experiments.performance.huge [--size 8192x8192] [--max-memory 4GiB]

The file is renders of --data side by side, mirrored. With --noisy SHARE only that part of its rows has noise:
what is right is skipped, and memory is the same in less time. Writes a row to huge.csv.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.performance import programs
from experiments.performance.run import size_of
from progden_jax.memory import parse_size, shown

OUTPUT = Path(__file__).with_name("huge.csv")
HEADER = ("size", "noisy", "max_memory", "peak", "interpreter", "seconds", "cpu", "limit_kept")

_RUN = """
import sys
from experiments.performance import process
interpreter = process.memory("VmRSS")
from progden_jax.cli import main
status = main(sys.argv[1:])
print(interpreter, process.memory("VmHWM"), __import__("time").process_time(), file=sys.stderr)
sys.exit(status)
"""


def main() -> None:
    parser = _common.parser(__doc__)
    parser.set_defaults(data=_common.TRAIN, scenes=4)
    parser.add_argument("--size", default="8192x8192", help="WIDTHxHEIGHT")
    parser.add_argument("--max-memory", default="4GiB")
    parser.add_argument("--noisy", type=float, default=1.0, help="share of rows with variance")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    names = _common.begin(arguments, f"{arguments.spp} spp, {arguments.size}")
    limit = parse_size(arguments.max_memory)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.exr", Path(folder) / "out.exr"
        write(source, arguments.data, names, arguments.spp, arguments.size, arguments.noisy)
        flags = [str(source), "-o", str(target), "--no-aux", "--max-memory", arguments.max_memory]
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", _RUN, "denoise", *flags],
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        seconds = time.perf_counter() - begun
        if done.returncode:
            raise SystemExit(done.stderr)
        interpreter, peak, cpu = (float(n) for n in done.stderr.split()[-3:])
        check(source, target)
    above = (peak - interpreter) * 1e6
    kept = above <= limit
    print(
        f"peak {shown(above)} above the interpreter's {interpreter:.0f} MB, limit {shown(limit)}: "
        f"{'kept' if kept else 'MISSED'}; {seconds:.0f} s, {cpu:.0f} s of processor time"
    )
    row = (
        arguments.size,
        arguments.noisy,
        arguments.max_memory,
        f"{above / 2**30:.2f} GiB",
        f"{interpreter:.0f} MB",
        f"{seconds:.0f}",
        f"{cpu:.0f}",
        "yes" if kept else "no",
    )
    rows = [tuple(found.values()) for found in _common.read_csv(arguments.output)]
    _common.write_csv(arguments.output, HEADER, [*rows, row])


def write(path: Path, data: Path, names: list[str], spp: int, size: str, noisy: float) -> None:
    """The input."""
    color, variance = (
        programs.mosaic(data, names, spp, buffer, size_of(size)) for buffer in ("color", "variance")
    )
    variance[int(noisy * len(variance)) :] = 0
    pd.write_exr(path, pd.Frame(color, variance), spp=spp)


def check(source: Path, target: Path) -> None:
    """That the output is an image of its size that is not the input."""
    before, after = (np.asarray(pd.read_exr(p, auxiliary=False).color) for p in (source, target))
    if before.shape != after.shape or not np.isfinite(after).all():
        raise SystemExit("the output has another size, or values that are not finite")
    if (before == after).all():
        raise SystemExit("the output is the input")


if __name__ == "__main__":
    main()
