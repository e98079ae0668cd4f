"""`progden denoise`: files in, files out."""

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from cyclopts import Parameter

from progden_jax.cli._adaptation import AdaptOptions
from progden_jax.cli._options import (
    SAVE,
    CostOptions,
    EstimateOptions,
    NetworkOptions,
    ReadOptions,
    parse_save,
)
from progden_jax.cli._paths import Item, plan
from progden_jax.cli._progress import Shown, timed
from progden_jax.cli._run import (
    FAILED,
    OK,
    UsageError,
    complain,
    explain,
    print_json,
    show,
    tables,
)

if TYPE_CHECKING:
    from rich.progress import TaskID

    from progden_jax.cli._job import Outcome, Progress

HELP = """Denoise renders progressively: mix each with its denoised version so that it stays true.

Outputs hold the result in R, G, B and keep the input's windows, attributes and alpha. A file without variance
is denoised plainly. Nothing is replaced without --force.

```
progden denoise room.exr -o clean.exr
progden denoise frames/ -o clean/ --quality high --save alpha,sure
progden denoise frames/ -o clean/ --resume
progden denoise room.exr -o clean.exr --variance-from roomA.exr roomB.exr
progden denoise room.exr -o clean.exr --adapt
progden denoise room.exr -o clean.exr --post-correct --halves roomA.exr roomB.exr
progden denoise room.exr -o clean.exr --adapt --post-correct
progden denoise huge.exr -o clean.exr --max-memory 4GiB
progden denoise room.exr -o clean.exr --denoiser nfor --combiner nfor
progden denoise room.exr -o clean.exr --combiner two.safetensors --halves roomA.exr roomB.exr
```
"""


def denoise(
    *inputs: Annotated[
        Path, Parameter(name="IN", help="EXR files, or folders of them, subfolders included.")
    ],
    output: Annotated[
        str,
        Parameter(
            name=["--output", "-o"],
            help="A file for one input, else a folder, made if missing; a final slash means a folder.",
        ),
    ],
    read: ReadOptions | None = None,
    network: NetworkOptions | None = None,
    adaptation: AdaptOptions | None = None,
    estimate: EstimateOptions | None = None,
    cost: CostOptions | None = None,
    save: Annotated[
        str | None,
        Parameter(help=f"Further layers for the output, with commas: {', '.join(SAVE)}."),
    ] = None,
    half: Annotated[
        bool, Parameter(help="Write half floats: half the size, about 3 digits.")
    ] = False,
    reference: Annotated[
        Path | None,
        Parameter(help="The true image, to print errors against; or a folder of such."),
    ] = None,
    force: Annotated[bool, Parameter(help="Replace outputs that exist.")] = False,
    resume: Annotated[
        bool, Parameter(help="Leave out inputs whose outputs exist: to go on after an interrupt.")
    ] = False,
    json: Annotated[
        bool, Parameter(help="Print what was done as one JSON list, an object per file.")
    ] = False,
) -> int:
    read, network = read or ReadOptions(), network or NetworkOptions()
    estimate, cost = estimate or EstimateOptions(), cost or CostOptions()
    adaptation = adaptation or AdaptOptions()
    saved = parse_save(save)
    for options in (read, network, estimate, cost):
        options.check()
    adaptation.check(read, network, cost)
    if network.no_aux and {"albedo", "normal"} & set(saved):
        raise UsageError("--no-aux leaves albedo and normal out, and --save asks for them.")
    if force and resume:
        raise UsageError("--force replaces outputs that exist, and --resume keeps them: give one.")
    items = plan(
        inputs,
        Path(output),
        folder=output.endswith(("/", os.sep)),
        variance_from=read.variance_from or (),
        halves=adaptation.halves or (),
        reference=reference,
        force=force,
        resume=resume,
    )
    if not items:
        print_json([]) if json else print("every output exists: nothing was left to do")
        return OK
    from progden_jax import enable_compilation_cache, memory
    from progden_jax.batch import are_small, at_once_of
    from progden_jax.cli._job import Settings, process, shared_shapes

    enable_compilation_cache()
    shapes = shared_shapes(items)
    settings = Settings(read, network, adaptation, estimate, cost, saved, half, force, shapes)
    # What reports progress of its own takes all there is for as long as it takes.
    alone = estimate.exact or adaptation.fits or cost.max_memory is not None
    many = len(items) > 1 and are_small(shapes) and not alone
    with memory.kept() if many else contextlib.nullcontext():
        return _run_all(
            items,
            lambda item, outcome, progress: process(item, settings, outcome, progress),
            json=json,
            at_once=1 if alone else at_once_of(shapes),
        )


def _run_all(
    items: list[Item],
    process: "Callable[[Item, Outcome, Progress], None]",
    *,
    json: bool,
    at_once: int,
) -> int:
    """Every file, some at once, one that fails keeping no other; told of in order; the exit status."""
    from progden_jax.cli._job import Outcome

    outcomes = [Outcome(str(item.input), str(item.output)) for item in items]
    at_once = min(at_once, len(items))

    def attempt(item: Item, outcome: "Outcome", progress: "Progress") -> None:
        try:
            process(item, outcome, progress)
        except Exception as error:
            outcome.error = explain(error)

    def each(bars: "_Bars") -> "Iterator[Outcome]":
        """In order, as they are done; in this thread where it is one at a time, so that Ctrl-C ends it."""
        pairs = list(zip(items, outcomes, strict=True))
        if at_once == 1:
            for item, outcome in pairs:
                bars.advance(item.input.name)
                attempt(item, outcome, bars.follow)
                yield outcome
            return
        pool = ThreadPoolExecutor(at_once)
        try:
            futures = [pool.submit(attempt, *pair, _untold) for pair in pairs]
            for (item, outcome), future in zip(pairs, futures, strict=True):
                bars.advance(item.input.name)
                future.result()
                yield outcome
        finally:
            # What has begun is finished, so that whole files are left.
            pool.shutdown(wait=True, cancel_futures=True)

    try:
        with _Bars(len(items)) as bars:
            for outcome in each(bars):
                if outcome.error is not None:
                    complain(_about(outcome.input, outcome.error))
                for warning in outcome.warnings:
                    complain(_about(outcome.input, f"warning: {warning}"))
                if outcome.ok and not json:
                    show(outcome.line(), bars.bars)
    except KeyboardInterrupt:
        outcomes = [o for o in outcomes if o.ok or o.error]
        again = "; the same command with --resume goes on" if len(items) > 1 else ""
        complain(f"{sum(o.ok for o in outcomes)} of {len(items)} files were done{again}")
        if json:
            print_json([asdict(o) for o in outcomes])
        raise
    failed = sum(not o.ok for o in outcomes)
    if json:
        print_json([asdict(o) for o in outcomes])
    else:
        _print_scores(outcomes)
    if failed and len(items) > 1:
        complain(f"{failed} of {len(items)} files failed")
    return FAILED if failed else OK


def _untold(done: int, total: int, of: str = "") -> None:
    """Progress where several files are in work."""


def _about(path: str, message: str) -> str:
    """The message with its file in front, where it does not say so itself."""
    return message if message.startswith(path) else f"{path}: {message}"


class _Bars(Shown):
    """Progress on stderr if that is a terminal: of the files if they are many, and of what is long."""

    def __init__(self, total: int) -> None:
        self.bars = timed(speed_estimate_period=120)
        self.many = total > 1
        self.files = self.bars.add_task("", total=total, name="", completed=-1, visible=self.many)
        self.part: TaskID | None = None
        self.name = self.label = ""

    def __enter__(self) -> Self:
        return super().__enter__() if self.many else self

    def advance(self, name: str) -> None:
        """On to the next file."""
        self._end_part()
        self.name = name
        self.bars.update(self.files, advance=1, name=name)

    def follow(self, done: int, total: int, of: str = "the exact divergence") -> None:
        """Of what takes long with a file, in percent; one thing ends where the next begins."""
        label = f"% of {of} of {self.name}"
        if label != self.label:
            self._end_part()
        if self.part is None:
            self.bars.start()
            self.part, self.label = self.bars.add_task("", total=100, name=label), label
        # Not in whole percents, each of which may take longer than what the speed is taken from.
        self.bars.update(self.part, completed=100 * done / total)
        if done == total:
            self._end_part()

    def _end_part(self) -> None:
        if self.part is not None:
            self.bars.remove_task(self.part)
            self.part = None


def _print_scores(outcomes: "list[Outcome]") -> None:
    rows = {o.input: o.metrics for o in outcomes if o.metrics}
    if rows:
        from progden_jax.cli._compare import score_table

        tables().print(score_table(rows, of="file"))
