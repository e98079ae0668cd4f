"""Jobs given out to workers, so that few programs are compiled and a lost worker costs no row."""

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

from progden_jax.evaluation.database import Row
from progden_jax.evaluation.measure import Job, measure

ATTEMPTS = 3
"""So often is a job begun whose worker is lost."""


class Failed(NamedTuple):
    """A job that cannot be done, and why."""

    reason: str


class Lost(NamedTuple):
    """A worker that ended in the middle of a job, and how; another has taken its place."""

    reason: str


Outcome = list[Row] | Failed


class Workers(Protocol):
    """Processes that measure, here or elsewhere, known by numbers from 0."""

    count: int

    def give(self, worker: int, job: Job) -> None:
        """Let an idle worker begin."""
        ...

    def wait(self) -> tuple[int, Outcome | Lost]:
        """The next worker that has ended its job, and with what; that worker is idle then."""
        ...

    def close(self) -> None:
        """End them, whatever they are doing."""
        ...


def attempt(job: Job) -> Outcome:
    """The rows of a job, or why there are none."""
    try:
        return measure(job)
    except Exception as error:
        text = " ".join(str(error).split())
        foreseen = isinstance(error, ValueError | OSError) and text
        return Failed(text if foreseen else f"unexpected {type(error).__name__}: {text[:300]}")


class Here:
    """The one worker that is this process."""

    count = 1

    def __init__(self) -> None:
        self._job: Job | None = None

    def give(self, worker: int, job: Job) -> None:
        self._job = job

    def wait(self) -> tuple[int, Outcome | Lost]:
        assert self._job is not None
        return 0, attempt(self._job)

    def close(self) -> None:
        pass


def dispatch(jobs: Sequence[Job], workers: Workers) -> Iterator[tuple[Job, Outcome]]:
    """Each job with what came of it, as they end.

    A worker stays with the jobs of one compiled program while there are any; then it takes a program that no
    one has yet, before it helps with another's.
    """
    queues: dict[Any, deque[Job]] = {}
    for job in jobs:
        queues.setdefault(_program(job), deque()).append(job)
    doing: dict[int, Job] = {}
    last: dict[int, Any] = {}
    losses: Counter[Job] = Counter()

    def give_to(worker: int) -> None:
        left = [program for program, queue in queues.items() if queue]
        if not left:
            return
        if worker not in last or last[worker] not in left:
            free = [program for program in left if program not in last.values()]
            last[worker] = max(free or left, key=lambda program: len(queues[program]))
        doing[worker] = queues[last[worker]].popleft()
        workers.give(worker, doing[worker])

    for worker in range(workers.count):
        give_to(worker)
    while doing:
        worker, outcome = workers.wait()
        job = doing.pop(worker)
        if isinstance(outcome, Lost):
            losses[job] += 1
            if losses[job] < ATTEMPTS:
                queues[_program(job)].appendleft(job)
            else:
                outcome = Failed(
                    f"{ATTEMPTS} workers were lost on it, the last one because {outcome.reason}; if that is "
                    "for lack of memory, take fewer workers or set --max-memory."
                )
        if not isinstance(outcome, Lost):
            yield job, outcome
        # Who is idle for want of jobs may help with one that has come back.
        for idle in range(workers.count):
            if idle not in doing:
                give_to(idle)


def _program(job: Job) -> Any:
    return None if job.shown is None else job.shown.program()
