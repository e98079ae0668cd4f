"""Time of a frame that is right in part, and of many frames of mixed sizes.

    python -m experiments.performance.skipping [--size 1920x1080] [--frames 100]

A frame whose left half is right already, and one that has converged, against all of it; `denoise_batch`
against a loop of single calls, of frames in memory and from file to file. Both sides are warm and take
turns, answers are checked, and ratios are medians over rounds. Writes skipping.csv.
"""

import functools
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.performance import programs
from experiments.performance.run import size_of
from progden_jax.compilation import counting_compilations

OUTPUT = Path(__file__).with_suffix(".csv")
HEADER = (
    "what",
    "rounds",
    "seconds",
    "against",
    "ratio of processor time",
    "ratio by the clock",
    "note",
)
SIZES = ((128, 128), (160, 128), (135, 240), (216, 256), (256, 256))
TOLERANCE = 1e-5

Row = tuple[str, int, float, str, float, float, str]


def main() -> None:
    parser = _common.parser(__doc__)
    parser.set_defaults(data=_common.TRAIN, scenes=4)
    parser.add_argument(
        "--size", default="1920x1080", help="WIDTHxHEIGHT of the single frame, or none"
    )
    parser.add_argument("--frames", type=int, default=100, help="of the batch")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    names = _common.begin(arguments, f"{arguments.spp} spp, {arguments.denoiser}")
    denoiser = pd.denoisers.load(arguments.denoiser)

    def frame(size: tuple[int, int]) -> pd.Frame:
        found, _ = programs.load_frame(arguments.data, names, arguments.spp, size)
        return pd.Frame(found.color, found.variance)

    rows: list[Row] = []
    if arguments.size != "none":
        whole = frame(size_of(arguments.size))
        rows += partly(whole, denoiser, arguments.rounds, arguments.size)
    rows += batches(frame, denoiser, arguments.frames, arguments.rounds)
    measured = {row[0] for row in rows}
    before = _common.read_csv(arguments.output)
    kept = [tuple(row.values()) for row in before if row["what"] not in measured]
    _common.write_csv(arguments.output, HEADER, [*kept, *rows])
    print(_common.markdown(HEADER, rows))


def partly(whole: pd.Frame, denoiser: Any, rounds: int, size: str) -> Iterator[Row]:
    """A frame that is right in its left half, and one that is right everywhere."""
    variance = np.asarray(whole.variance)
    left = variance.copy()
    left[:, : left.shape[1] // 2] = 0
    half = whole.replace(variance=left)

    def call(frame: pd.Frame, *, skip: bool = True) -> Callable[[], pd.Result]:
        return lambda: jax.block_until_ready(
            pd.progressive_denoise(frame, denoiser, outputs=["image"], skip=skip)
        )

    calls = {
        "all of it": call(half, skip=False),
        "left half right": call(half),
        "converged": call(whole.replace(variance=np.zeros_like(variance))),
    }
    dense, skipped = calls["all of it"]().image, calls["left half right"]()
    off = np.sqrt(np.mean((dense - skipped.image) ** 2) / np.mean(np.square(dense)))
    if off > TOLERANCE:
        raise SystemExit(f"skipping gives another answer: {off:.1e} relative RMSE")
    assert skipped.skipped is not None
    share = skipped.skipped.computed / (whole.size[0] * whole.size[1])
    notes = {"left half right": f"{share:.3f} of the pixels computed, {off:.0e} off"}
    yield from compared(calls, "all of it", rounds, f"{size}: ", notes)


def batches(
    frame: Callable[[tuple[int, int]], pd.Frame], denoiser: Any, count: int, rounds: int
) -> Iterator[Row]:
    """`denoise_batch` against a loop."""
    made = [frame(size) for size in SIZES]
    frames = [made[i % len(made)] for i in range(count)]

    def loop() -> list[np.ndarray]:
        single = (pd.progressive_denoise(f, denoiser, outputs=["image"]) for f in frames)
        return [np.asarray(result.image) for result in single]

    def batch() -> list[np.ndarray]:
        return [np.asarray(result.image) for result in pd.denoise_batch(frames, denoiser)]

    with counting_compilations() as compiled:
        found = batch()
    heavy = sum("progressive" in name for name in compiled)
    for one, other in zip(found, loop(), strict=True):
        if np.abs(one - other).max() > TOLERANCE * np.abs(other).max():
            raise SystemExit("a batch gives another answer than single calls")
    label = f"{count} frames of {len(SIZES)} sizes: "
    notes = {"denoise_batch": f"{heavy} compilations of the heavy program"}
    yield from compared({"loop": loop, "denoise_batch": batch}, "loop", rounds, label, notes)
    with tempfile.TemporaryDirectory() as folder:
        calls = file_by_file(frames, denoiser, Path(folder))
        yield from compared(calls, "loop", rounds, f"{count} files of {len(SIZES)} sizes: ", {})


def file_by_file(
    frames: list[pd.Frame], denoiser: Any, folder: Path
) -> dict[str, Callable[[], None]]:
    """The same from EXR to EXR."""
    paths = [folder / f"{i:03}.exr" for i in range(len(frames))]
    for path, frame in zip(paths, frames, strict=True):
        pd.write_exr(path, frame)

    def write(path: Path, result: pd.Result) -> None:
        pd.write_exr(path.with_stem(f"{path.stem}-done"), result.image, overwrite=True)

    def loop() -> None:
        for path in paths:
            frame = pd.read_exr(path)
            write(path, pd.progressive_denoise(frame, denoiser, outputs=["image"]))

    def batch() -> None:
        readers = [functools.partial(pd.read_exr, path) for path in paths]
        sizes = [frame.size for frame in frames]
        results = pd.denoise_batch(readers, denoiser, sizes=sizes)
        for path, result in zip(paths, results, strict=True):
            write(path, result)

    return {"loop": loop, "denoise_batch": batch}


def compared(
    calls: dict[str, Callable[[], Any]],
    against: str,
    rounds: int,
    label: str,
    notes: dict[str, str],
) -> Iterator[Row]:
    """A row per call; the first round, which compiles, does not count."""
    clock: dict[str, list[float]] = {name: [] for name in calls}
    cpu: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            begun, used = time.perf_counter(), time.process_time()
            call()
            clock[name].append(time.perf_counter() - begun)
            cpu[name].append(time.process_time() - used)
    for name in calls:
        of_cpu, of_clock = (
            statistics.median(a / b for a, b in list(zip(of[name], of[against], strict=True))[1:])
            for of in (cpu, clock)
        )
        seconds = statistics.median(clock[name][1:])
        yield (label + name, rounds, seconds, against, of_cpu, of_clock, notes.get(name, ""))


if __name__ == "__main__":
    main()
