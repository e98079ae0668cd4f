"""Run time and memory of each part and of the whole, against other programs and against the operations.

    python -m experiments.performance.run [--sizes 512x512 1920x1080] [--probes 1 4]

Compared with are OIDN's own library through pyoidn (forward pass), the paper's pipeline as a plain eager
PyTorch program (torch_baseline.py; needs the extra "bench"), and the operations at the speed of a large 3×3
convolution. Every answer is checked before it is timed. What is compared takes turns, and ratios are
medians over rounds of the ratio within a round, so that a busy machine disturbs both sides alike. Processor
time, summed over threads, hardly depends on who else uses the machine; the clock does.
Writes OUTPUT, OUTPUT-errors.csv and OUTPUT-processes.csv, and tables (.md) and a figure (.png) of them.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import progden_jax as pd
from experiments import _common
from experiments.performance import process, programs
from experiments.performance.programs import (
    BOUND,
    FEATURES,
    FORWARD,
    NATIVE,
    NET,
    OURS,
    SHIPPED,
    TORCH,
    WHOLE,
    Program,
    Scene,
)
from experiments.performance.step import convolution
from progden_jax import _amx, mixers

OUTPUT = Path(__file__).with_name("run.csv")
SIZES = ("256x256", "512x512", "1920x1080")
LIMIT = "operations"
TOLERANCE = 1e-4
"""Largest relative RMSE at which two programs' answers count as the same."""


class Row(NamedTuple):
    """A program's median times at one size, and medians over rounds of ratios within a round."""

    size: str
    part: str
    probes: int | str
    program: str
    ms: float
    processor_ms: float
    ours_per_this: float
    processor_ours_per_this: float
    operations_1e9: float | str
    per_limit: float | str
    processor_per_limit: float | str
    per_direct: float | str
    processor_per_direct: float | str
    limit_gflops: float
    direct_gflops: float
    relative_rmse: float | str
    temporaries_mb: float | str
    rounds: int


class Error(NamedTuple):
    """What K probes cost and how far their divergence, and the image from it, are off."""

    size: str
    program: str
    probes: int
    ms: float
    divergence_error: float
    image_rmse: float


class Process(NamedTuple):
    """What a fresh process needed."""

    size: str
    program: str
    max_memory: str
    cache: str
    ready_s: float
    first_result_s: float
    second_s: float
    programs: int
    compiled: int
    again: int
    smaller_size: int
    peak_mb: float


def take_turns(
    turns: Sequence[Program], rounds: int, budget: float
) -> list[list[tuple[float, float]]]:
    """Per program the seconds of every round, by the clock and by processor time; at least one round."""
    times: list[list[tuple[float, float]]] = [[] for _ in turns]
    end = time.perf_counter() + budget
    for done in range(rounds):
        if done and time.perf_counter() > end:
            break
        for program, found in zip(turns, times, strict=True):
            clock, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(program.run())
            found.append((time.perf_counter() - clock, time.process_time() - processor))
    return times


def rows_of(size: str, turns: Sequence[Program], rounds: int, budget: float) -> list[Row]:
    """Measures them, with a convolution for the limit beside them."""
    for program in turns:
        if program.off is not None and program.off > TOLERANCE:
            raise SystemExit(
                f"{program.name}, {program.part} at {size}: {program.off:.1e} off, so no time counts."
            )
    fastest, direct = (_convolution(together) for together in (_amx.ALIGNED, 1))
    *times, peaks, direct_peaks = take_turns([*turns, fastest, direct], rounds, budget)
    count = fastest.operations
    assert count
    ours = {p.part: t for p, t in zip(turns, times, strict=True) if p.name == OURS}
    operations = {p.part: p.operations for p in turns if p.name == OURS}
    found = []
    for program, seconds in zip(turns, times, strict=True):
        total = operations[program.part]
        clock, processor = (statistics.median(s) for s in zip(*seconds, strict=True))
        ours_clock, ours_processor = _ratios(ours[program.part], seconds)
        by_fastest, by_direct = (
            _ratios(seconds, [[v * total / count for v in peak] for peak in found_peaks])
            if total
            else ("", "")
            for found_peaks in (peaks, direct_peaks)
        )
        row = Row(
            size=size,
            part=program.part,
            probes=program.probes or "",
            program=program.name,
            ms=1e3 * clock,
            processor_ms=1e3 * processor,
            ours_per_this=ours_clock,
            processor_ours_per_this=ours_processor,
            operations_1e9=total / 1e9 if total else "",
            per_limit=by_fastest[0],
            processor_per_limit=by_fastest[1],
            per_direct=by_direct[0],
            processor_per_direct=by_direct[1],
            limit_gflops=count / statistics.median(p[0] for p in peaks) / 1e9,
            direct_gflops=count / statistics.median(p[0] for p in direct_peaks) / 1e9,
            relative_rmse="" if program.off is None else program.off,
            temporaries_mb="" if program.temporaries is None else program.temporaries / 1e6,
            rounds=len(seconds),
        )
        found.append(row)
    return found


def _convolution(together: int) -> Program:
    """What operations are measured by, warm."""
    run, images, count = convolution(1, 512, 96, by_xla=False, together=together)
    jax.block_until_ready(run(*images))
    return Program(LIMIT, None, LIMIT, lambda: run(*images), count)


def _ratios(a: Iterable[Sequence[float]], b: Iterable[Sequence[float]]) -> tuple[float, float]:
    """Medians over rounds of a/b, by the clock and by processor time."""
    pairs = [[x / y for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]
    return statistics.median(p[0] for p in pairs), statistics.median(p[1] for p in pairs)


def errors(
    size: str, scene: Scene, reference: np.ndarray, probes: Sequence[int], torch: bool
) -> list[Error]:
    """Of the divergence against the exact one, and of the image that the shipped mixer makes of it."""
    exact = np.asarray(pd.exact_divergence(scene.f, scene.x, scene.variance).divergence)
    truth = jax.numpy.asarray(reference)
    estimators: dict[tuple[str, int], Callable[[], Any]] = {}
    for k in probes:
        kinds: dict[str, pd.Method] = {
            "jvp": pd.MonteCarlo(probes=k),
            "structured": pd.Probing(probes=k),
        }
        for kind, method in kinds.items():
            run = jax.jit(lambda f, x, v, m=method: m.evaluate(f, x, v, programs.KEY).divergence)
            estimators[f"{OURS}, {kind}", k] = lambda r=run: r(scene.f, scene.x, scene.variance)
        if torch:
            estimators[f"{TORCH}, differences", k] = programs.torch_divergence(scene, k)
    estimates = {name: np.asarray(run()) for name, run in estimators.items()}
    turns = [Program(n, k, n, run) for (n, k), run in estimators.items()]
    times = take_turns(turns, 5, 60)

    def row(name: str, k: int, seconds: float, estimate: np.ndarray) -> Error:
        image = pd.progressive_denoise(
            scene.frame, scene.denoiser, divergence=jax.numpy.asarray(estimate)
        ).image
        off = np.sqrt(np.mean((estimate - exact) ** 2) / np.mean(exact**2))
        return Error(size, name, k, 1e3 * seconds, float(off), float(pd.metrics.rmse(image, truth)))

    return [row("exact", 0, float("nan"), exact)] + [
        row(n, k, statistics.median(s[0] for s in seconds), estimates[n, k])
        for (n, k), seconds in zip(estimators, times, strict=True)
    ]


def processes(
    size: str,
    scene: Scene,
    denoiser: str,
    probes: int,
    names: Sequence[str],
    bounds: Sequence[str] = (),
) -> list[Process]:
    """Each program in a process of its own, this project's with an empty cache and with a filled one.

    This project's with each `max_memory` of `bounds`, too.
    """
    found = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        np.savez(folder / process.FRAME, **scene.buffers)  # pyright: ignore[reportArgumentType]
        process.save_params(folder / process.DENOISER, scene.denoiser.params)
        process.save_params(folder / process.MIXER, scene.paper.params)
        mixers.save_mixer(folder / process.MIXER_FILE, scene.paper)
        for name in names:
            turns = [("", "")]
            if name == OURS:
                turns = [("empty", ""), ("filled", "")]
                turns += [(cache, bound) for bound in bounds for cache in ("empty", "filled")]
            for cache, bound in turns:
                words = [name, str(folder), "--denoiser", denoiser, "--probes", str(probes)]
                words += ["--max-memory", bound] if bound else []
                printed = subprocess.run(
                    [sys.executable, "-m", process.__name__, *words, "--began", str(time.time())],
                    env=os.environ | {"PROGDEN_CACHE": str(folder / "cache")},
                    cwd=Path(__file__).parents[2],
                    stdout=subprocess.PIPE,
                    check=True,
                ).stdout
                values = json.loads(printed)
                found.append(Process(size, name, bound, cache, **values))
    return found


def targets(rows: Sequence[Row], found: Sequence[Process]) -> list[Sequence[object]]:
    """What was to be reached, at the largest size and with 4 probes where these were measured."""
    size = rows[-1].size
    here = {(r.part, r.probes, r.program): r for r in rows if r.size == size}
    counts = sorted(r.probes for r in here.values() if isinstance(r.probes, int))
    k = 4 if 4 in counts else counts[0]
    table: list[Sequence[object]] = []

    def add(what: str, target: str, clock: float, processor: float | str) -> None:
        table.append((what, target, f"{clock:.2f}", processor and f"{processor:.2f}"))

    if native := here.get((FORWARD, "", NATIVE)):
        ratios = native.ours_per_this, native.processor_ours_per_this
        add("forward pass / native OIDN", "≤ 1.2", *ratios)
    if torch := here.get((WHOLE, k, TORCH)):
        ratios = 1 / torch.ours_per_this, 1 / torch.processor_ours_per_this
        add(f"PyTorch / whole, {k} probes", "≥ 3", *ratios)
    peaks = {p.program: p.peak_mb for p in found if p.size == size and p.cache != "empty"}
    if TORCH in peaks:
        add(f"peak memory / PyTorch's, {k} probes", "≤ 0.5", peaks[OURS] / peaks[TORCH], "")
    for kind in ("", SHIPPED):
        if (FEATURES + kind, "", OURS) not in here:
            continue
        small = [here[part, "", OURS] for part in (FEATURES + kind, BOUND)]
        whole = here[WHOLE + kind, k, OURS]
        ratios = (
            sum(r.ms for r in small) / whole.ms,
            sum(r.processor_ms for r in small) / whole.processor_ms,
        )
        add(f"features and t-bound / whole{kind}, {k} probes", "≤ 0.1", *ratios)
    net = here[NET, "", OURS]
    speeds = [("", net.per_limit, net.processor_per_limit)]
    if _amx.available():
        speeds.append((", row by row", net.per_direct, net.processor_per_direct))
    for how, clock, processor in speeds:
        if isinstance(clock, float) and isinstance(processor, float):
            add(f"mixing net / operations{how}", "≤ 1.3", clock, processor)
    return [(f"{what}, {size}", *rest) for what, *rest in table]


def tables(rows: Sequence[Row], off: Sequence[Error], found: Sequence[Process]) -> str:
    """Markdown."""

    def number(value: float | str, form: str = ".2f") -> str:
        return value if isinstance(value, str) else f"{value:{form}}"

    text = [
        _common.machine() + (f", torch {_torch_version()}" if programs.has_torch() else ""),
        _common.markdown(
            ("ratio", "target", "by the clock", "by processor time"), targets(rows, found)
        ),
        _common.markdown(
            (
                *("size", "part", "probes", "program", "ms", "processor ms", "ours / this"),
                *("by processor time", "this / operations", "by processor time"),
                *("off", "temporaries, MB"),
            ),
            (
                (
                    *(r.size, r.part, r.probes, r.program, f"{r.ms:.1f}", f"{r.processor_ms:.1f}"),
                    *(f"{r.ours_per_this:.2f}", f"{r.processor_ours_per_this:.2f}"),
                    *(number(r.per_limit), number(r.processor_per_limit)),
                    *(number(r.relative_rmse, ".0e"), number(r.temporaries_mb, ".0f")),
                )
                for r in rows
            ),
        ),
        f"The convolution for the operations ran at a median of "
        f"{statistics.median(r.limit_gflops for r in rows):.0f} GFLOP/s by "
        + (
            "AMX, with rows summed, and row by row, which does all operations, at "
            f"{statistics.median(r.direct_gflops for r in rows):.0f}."
            if _amx.available()
            else "XLA."
        ),
    ]
    if off:
        header = ("size", "program", "probes", "ms", "error of the divergence", "RMSE of the image")
        text.append(_common.markdown(header, ((*e[:3], f"{e.ms:.1f}", *e[4:]) for e in off)))
    if found:
        header = (
            *(
                "size",
                "program",
                "max_memory",
                "cache",
                "imports and loading, s",
                "first result, s",
                "again, s",
            ),
            *("programs", "compiled", "programs, again", "8 pixels smaller", "peak, MB"),
        )
        text.append(_common.markdown(header, found))
    return "\n\n".join(text) + "\n"


def _torch_version() -> str:
    from importlib.metadata import version

    return version("torch")


def figure(rows: Sequence[Row], off: Sequence[Error], probes: int) -> Figure:
    """Time against size, per program, and error against time, per number of probes."""
    made = Figure(figsize=(12 if off else 8, 3.8), layout="constrained")
    axes = made.subplots(1, 3 if off else 2)
    panels = (("forward pass", FORWARD, ""), (f"whole, {probes} probes", WHOLE, probes))
    for axis, (title, part, k) in zip(axes, panels, strict=False):
        chosen = [r for r in rows if (r.part, r.probes) == (part, k)]
        for name in dict.fromkeys(r.program for r in chosen):
            line = [(_megapixels(r.size), r.ms) for r in chosen if r.program == name]
            axis.loglog(*zip(*line, strict=True), "o-", label=name)
        line = [
            (_megapixels(r.size), r.operations_1e9 / r.limit_gflops * 1e3)
            for r in chosen
            if r.program == OURS and isinstance(r.operations_1e9, float)
        ]
        axis.loglog(*zip(*line, strict=True), "k--", label=LIMIT)
        axis.set(title=title, xlabel="megapixels", ylabel="ms")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.legend()
    for name in dict.fromkeys(e.program for e in off if e.probes):
        line = [(e.ms, e.divergence_error) for e in off if e.program == name]
        axes[2].loglog(*zip(*line, strict=True), "o-", label=name)
    if off:
        counts = ", ".join(str(k) for k in sorted({e.probes for e in off} - {0}))
        title = f"divergence at {off[0].size}, {counts} probes"
        axes[2].set(title=title, xlabel="ms", ylabel="relative RMSE")
        axes[2].legend(loc="lower left")
        for axis in (axes[2].xaxis, axes[2].yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
    return made


def _megapixels(size: str) -> float:
    return float(np.prod([int(n) for n in size.split("x")])) / 1e6


def size_of(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"."""
    width, height = (int(n) for n in text.split("x"))
    return height, width


def main() -> None:
    parser = _common.parser(__doc__)
    parser.set_defaults(data=_common.TRAIN, scenes=4)
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="WIDTHxHEIGHT, smallest first")
    parser.add_argument("--probes", type=int, nargs="+", default=(1, 4, 16))
    parser.add_argument("--against", nargs="*", choices=(NATIVE, TORCH), default=(NATIVE, TORCH))
    parser.add_argument("--denoiser", default="oidn-hdr", help="of OIDN's base or small networks")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=7, help="at most, per size")
    parser.add_argument("--budget", type=float, default=120, help="seconds of rounds per group")
    parser.add_argument("--error-size", default="128x128", help="of the exact divergence, or none")
    parser.add_argument(
        "--no-processes", action="store_true", help="without cold starts and peak memory"
    )
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    names = _common.begin(arguments, f"{arguments.spp} spp, {arguments.denoiser}")
    against = list(arguments.against)
    if TORCH in against and not programs.has_torch():
        print("PyTorch is not installed and is left out: pip install 'progden_jax[bench]'\n")
        against.remove(TORCH)
    denoiser = pd.denoisers.load(arguments.denoiser)

    def scene(size: str) -> tuple[Scene, np.ndarray]:
        frame, truth = programs.load_frame(arguments.data, names, arguments.spp, size_of(size))
        return Scene(frame, denoiser), truth

    rows: list[Row] = []
    off: list[Error] = []
    found: list[Process] = []
    probes = 4 if 4 in arguments.probes else arguments.probes[0]
    for size in arguments.sizes:
        made, _ = scene(size)
        print(f"{size} ...", flush=True)
        groups = [programs.parts(made, against)]
        groups += [programs.wholes(made, k, against) for k in arguments.probes]
        for group in groups:
            rows += rows_of(size, list(group), arguments.rounds, arguments.budget)
        if not arguments.no_processes:
            every = (OURS, *against)
            found += processes(size, made, arguments.denoiser, probes, every)
        write(arguments.output, rows, off, found, probes)
    if arguments.error_size != "none":
        size = arguments.error_size
        off = errors(size, *scene(size), arguments.probes, TORCH in against)
    print(write(arguments.output, rows, off, found, probes))


def write(
    output: Path,
    rows: Sequence[Row],
    off: Sequence[Error],
    found: Sequence[Process],
    probes: int,
) -> str:
    """Tables and figure of what is there so far; the tables' text."""
    for kind, ending, table in (
        (Row, "", rows),
        (Error, "-errors", off),
        (Process, "-processes", found),
    ):
        if table:
            path = output.with_stem(output.stem + ending)
            _common.write_csv(path, kind._fields, table)
    text = tables(rows, off, found)
    _common.write_text(output.with_suffix(".md"), text)
    _common.save_figure(output.with_suffix(".png"), figure(rows, off, probes))
    return text


if __name__ == "__main__":
    main()
