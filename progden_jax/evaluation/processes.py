"""Workers that are processes of this machine, each with a share of its cores and a pipe of its own."""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import cast

import jax

from progden_jax import _devices, enable_compilation_cache
from progden_jax.evaluation.dispatch import Lost, Outcome, attempt
from progden_jax.evaluation.measure import Job


class Processes:
    """See `dispatch.Workers`. A worker that dies takes no other with it: they share no lock and no queue.

    Parameters
    ----------
    count : of processes. Each computes on its share of the cores that this one may use.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        cores = _devices.cores()
        self._cores = [cores[i::count] or cores for i in range(count)]
        # Forked children would have this process's XLA threads, locked as they were.
        self._context = multiprocessing.get_context("spawn")
        self._busy: set[int] = set()
        self._workers = [self._start(i) for i in range(count)]

    def give(self, worker: int, job: Job) -> None:
        _, pipe = self._workers[worker]
        self._busy.add(worker)
        # One that died meanwhile is told of by `wait`.
        with contextlib.suppress(OSError):
            pipe.send(job)

    def wait(self) -> tuple[int, Outcome | Lost]:
        pipes = {self._workers[i][1]: i for i in self._busy}
        pipe = cast(Connection, wait(list(pipes))[0])
        worker = pipes[pipe]
        self._busy.remove(worker)
        try:
            return worker, pipe.recv()
        except (EOFError, OSError):
            process, _ = self._workers[worker]
            process.join()
            reason = f"its process ended with exit code {process.exitcode}"
            pipe.close()
            self._workers[worker] = self._start(worker)
            return worker, Lost(reason)

    def close(self) -> None:
        for process, _ in self._workers:
            process.kill()
        for process, pipe in self._workers:
            process.join()
            pipe.close()

    def _start(self, worker: int) -> tuple[BaseProcess, Connection]:
        ours, theirs = self._context.Pipe()
        cache = jax.config.values["jax_compilation_cache_dir"]
        arguments = (theirs, self._cores[worker], self.count > 1, cache)
        process = self._context.Process(target=_serve, args=arguments, daemon=True)
        process.start()
        theirs.close()
        return process, ours


def _serve(pipe: Connection, cores: Sequence[int], sharing: bool, cache: str | None) -> None:
    """Measure until the other end of the pipe is closed, also by the death of the process there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent ends us
    os.sched_setaffinity(0, cores)
    if sharing:
        # Each would else take three quarters of a GPU's memory.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if cache is not None:
        enable_compilation_cache(Path(cache))
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(attempt(pipe.recv()))
