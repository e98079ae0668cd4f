"""A plan carried out: what is missing is computed and kept, row by row."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from progden_jax.evaluation import parts
from progden_jax.evaluation.database import FILE, Database
from progden_jax.evaluation.dispatch import Failed, Here, Workers, dispatch
from progden_jax.evaluation.measure import Job, jobs
from progden_jax.evaluation.plan import Plan
from progden_jax.training.index import Item


class Report(Protocol):
    """What is told while a plan is carried out."""

    def started(self, missing: int, present: int) -> None:
        """How many rows are to be computed, and how many are there."""
        ...

    def added(self, job: Job, rows: int) -> None:
        """So many rows are kept."""
        ...

    def failed(self, job: Job, reason: str) -> None:
        """The job's rows are not to be had."""
        ...


class Done(NamedTuple):
    """Numbers of rows: computed now, there before, and failed."""

    computed: int
    present: int
    failed: int


def carry_out(
    plan: Plan,
    run: Path,
    *,
    report: Report,
    workers: Callable[[int], Workers] = lambda jobs: Here(),
    keep_images: bool = False,
    max_memory: int | None = None,
) -> Done:
    """Compute the plan's rows that are not in the run's database; one that fails keeps no other.

    Parameters
    ----------
    run : folder, made if missing.
    workers : told how many jobs there are, makes what does them; only called if there are any.
    keep_images : of all rows, and not of those only whose samples per pixel the plan names; where they are to
        be kept, rows without an image count as missing.

    Raises
    ------
    ValueError
        If the files of the plan cannot be read, or the folder cannot be used: see `Database`.
    """
    run = run.resolve()
    cells = plan.cells()
    with Database(run) as database:
        _check_labels(plan, database)
        data = plan.data
        known, shown = database.known(), database.known(with_images=True)

        def keeps(item: Item) -> bool:
            return keep_images or item.spp in data.keep_images

        missing = [c for c in cells if c.key not in (shown if keeps(c.item) else known)]
        rest: dict[str, Any] = {"variance_of": data.variance_of, "crop": data.crop}
        made = jobs(missing, run=run, max_memory=max_memory, **rest)
        todo = [job if keeps(job.item) else job._replace(run=None) for job in made]
        present = len(cells) - len(missing)
        report.started(len(missing), present)
        computed = failed = 0
        if not todo:
            return Done(0, present, 0)
        crew = workers(len(todo))
        try:
            for job, outcome in dispatch(todo, crew):
                if isinstance(outcome, Failed):
                    failed += len(job.cells)
                    report.failed(job, outcome.reason)
                    continue
                database.add(outcome)
                computed += len(outcome)
                report.added(job, len(outcome))
        finally:
            crew.close()
    return Done(computed, present, failed)


def _check_labels(plan: Plan, database: Database) -> None:
    """A label means one thing in a run."""
    there = database.labels()
    for label, settings in plan.methods:
        told = {**settings.flat(), **parts.trained_as(settings)}
        before = there.get(label, told)
        if before != told:
            changed = sorted(n for n in {*before, *told} if before.get(n) != told.get(n))
            raise ValueError(
                f"{database.run / FILE} has results of {label!r} with another {', '.join(changed)}: "
                "give the method a label of its own, or name another folder."
            )
