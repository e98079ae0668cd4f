"""What `evaluate` and `sweep` share: flags, progress, tables, exports."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from progden_jax.cli._progress import Shown, timed
from progden_jax.cli._run import FAILED, OK, UsageError, complain, print_json, tables

if TYPE_CHECKING:
    from progden_jax.evaluation import Plan, Row
    from progden_jax.evaluation.dispatch import Workers
    from progden_jax.evaluation.exports import Summary
    from progden_jax.evaluation.measure import Job


@Parameter(name="*", group="What is compared")
@dataclass(frozen=True)
class PlanOptions:
    """Over what a configuration says."""

    spp: Annotated[
        tuple[int, ...],
        Parameter(
            consume_multiple=True,
            help="Samples per pixel to take [default: all but the reference's].",
        ),
    ] = ()
    scenes: Annotated[
        tuple[str, ...], Parameter(consume_multiple=True, help="Only these scenes.")
    ] = ()
    reference_spp: Annotated[
        int | None,
        Parameter(help="Samples per pixel of the references [default: each scene's highest]."),
    ] = None
    set: Annotated[
        tuple[str, ...],
        Parameter(
            name="--set",
            help="setting=value for all methods, such as denoiser=oidn-hdr or bound.c=3; may be repeated.",
        ),
    ] = ()

    def load(
        self, config: Path | None, data: Sequence[Path], methods: Sequence[str] = ()
    ) -> "Plan":
        """The plan; what is wrong with it is wrong usage."""
        from progden_jax.evaluation import Settings, load
        from progden_jax.training.config import parse_change

        changes: dict[str, Any] = {
            "data": [str(folder) for folder in data],
            "spp": list(self.spp),
            "scenes": list(self.scenes),
            "reference_spp": self.reference_spp,
        }
        try:
            return load(
                config,
                data={name: value for name, value in changes.items() if value},
                base=dict(parse_change(text, Settings) for text in self.set),
                methods=methods,
            )
        except ValueError as error:
            raise UsageError(str(error)) from None


@Parameter(name="*", group="Results")
@dataclass(frozen=True)
class ResultOptions:
    """What is kept and shown."""

    keep_images: Annotated[
        bool,
        Parameter(help="Keep each result with its α, SURE and denoised image in OUTPUT/images."),
    ] = False
    export: Annotated[
        tuple[Path, ...],
        Parameter(
            help="Write results to a file, .csv or .parquet (every row), .md or .tex (means over scenes); "
            "may be repeated."
        ),
    ] = ()
    baseline: Annotated[
        str | None,
        Parameter(
            help="Show ratios to this method's errors, scene by scene, instead of the errors."
        ),
    ] = None
    confidence: Annotated[
        float, Parameter(help="Of the intervals over scenes [default: 0.95].")
    ] = 0.95
    max_memory: Annotated[
        str | None, Parameter(help="Of one worker, such as 4GiB; large images go in parts.")
    ] = None
    json: Annotated[bool, Parameter(help="Print what was done and the means as JSON.")] = False

    def check(self) -> None:
        """Raise UsageError for what is wrong whatever the files hold."""
        from progden_jax.evaluation.exports import check_path

        if not 0 < self.confidence < 1:
            raise UsageError(f"--confidence is {self.confidence:g}, expected a share below 1.")
        self.max_bytes()
        for path in self.export:
            try:
                check_path(path)
            except ValueError as error:
                raise UsageError(f"--export: {error}") from None

    def max_bytes(self) -> int | None:
        """The bound on memory in bytes."""
        from progden_jax.cli._options import CostOptions

        return CostOptions(max_memory=self.max_memory).max_bytes()

    def show(self, run: Path, **facts: Any) -> None:
        """The run's tables, on stdout and into the files asked for."""
        from progden_jax.evaluation import export, rows
        from progden_jax.evaluation.exports import summary

        found = rows(run)
        if not found:
            complain(f"{run} holds no results yet")
            return
        chosen: dict[str, Any] = {"baseline": self.baseline, "confidence": self.confidence}
        shown = summary(found, **chosen)
        for path in self.export:
            export(path, found, **chosen)
        if self.json:
            print_json({"run": str(run), **facts, "means": _means(shown)})
            return
        _print(shown, found)
        for path in self.export:
            print(f"written: {path}")


def carry_out(
    plan: "Plan",
    run: Path,
    results: ResultOptions,
    workers: "Callable[[int], Workers] | None" = None,
) -> int:
    """Compute what is missing, show what there is; the exit status."""
    from progden_jax import evaluation

    others = {} if workers is None else {"workers": workers}
    with _Report() as report:
        done = evaluation.carry_out(
            plan,
            run,
            report=report,
            keep_images=results.keep_images,
            max_memory=results.max_bytes(),
            **others,
        )
    facts = done._asdict() | {"failures": report.failures}
    results.show(run, **facts)
    if not results.json:
        failed = f", {done.failed} failed" if done.failed else ""
        print(f"{done.computed} rows computed, {done.present} were there{failed}: {run}")
    return FAILED if done.failed else OK


def print_plan(plan: "Plan", *, json: bool) -> None:
    """The methods with their settings, and how many rows they make."""
    methods = [{"method": label, **settings.flat()} for label, settings in plan.methods]
    items, total = len(plan.items), len(plan.items) * len(plan.methods)
    if json:
        print_json({"methods": methods, "renders": items, "rows": total})
        return
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    columns = list(dict.fromkeys(name for method in methods for name in method))
    # What all that have a setting share needs no column.
    values = {c: {str(m[c]) for m in methods if c in m} for c in columns}
    varied = [c for c in columns if len(values[c]) > 1 or c == "method"]
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in varied:
        table.add_column(name, overflow="fold")
    for method in methods:
        table.add_row(*(str(method.get(name, "")) for name in varied))
    tables().print(table, markup=False)
    if shared := [f"{c}={v}" for c in columns if c not in varied for v in values[c]]:
        print(f"the same in all that have it: {', '.join(shared)}")
    print(f"{len(methods)} methods × {items} renders = {total} rows")


class _Report(Shown):
    """A bar on stderr if that is a terminal; failures as lines there, whatever it is."""

    def __init__(self) -> None:
        self.failures: list[str] = []
        self.bars = timed("rows")
        self._task = self.bars.add_task("", total=None, name="reading")

    def started(self, missing: int, present: int) -> None:
        self.bars.update(self._task, total=missing, name="compiling")

    def added(self, job: "Job", rows: int) -> None:
        self.bars.update(self._task, advance=rows, name=f"{job.item.scene}, {job.item.spp} spp")

    def failed(self, job: "Job", reason: str) -> None:
        path = str(job.item.path)
        self.failures.append(reason if path in reason else f"{path}: {reason}")
        complain(self.failures[-1])
        self.bars.update(self._task, advance=len(job.cells))


def _means(shown: "list[Summary]") -> dict[str, Any]:
    return {
        s.name: {
            method: {spp: found._asdict() for spp, found in by_spp.items()}
            for method, by_spp in s.table.items()
        }
        for s in shown
    }


def _print(shown: "list[Summary]", rows: "list[Row]") -> None:
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    console = tables()
    for found in shown:
        table = Table(box=SIMPLE_HEAD, pad_edge=False, title=found.title, title_justify="left")
        table.add_column("method", overflow="fold")
        for spp in found.spps:
            table.add_column(f"{spp} spp", justify="right")
        for method in found.table:
            cells = [escape(found.cell(method, spp)) for spp in found.spps]
            marked = [
                f"[bold]{cell}[/]" if found.best.get(spp) == method else cell
                for spp, cell in zip(found.spps, cells, strict=True)
            ]
            table.add_row(escape(method), *marked)
        console.print(table)
    scenes = len({row.scene for row in rows})
    print(f"means over {scenes} scene{'s' if scenes > 1 else ''}")
