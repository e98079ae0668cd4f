"""Workers that are actors of a Ray cluster, on one machine or several."""

import contextlib
import importlib
import os
import sys
import warnings
from typing import Any

from progden_jax import enable_compilation_cache
from progden_jax.evaluation.dispatch import Lost, Outcome, attempt
from progden_jax.evaluation.measure import Job


class Cluster:
    """See `dispatch.Workers`. All machines must see the renders, and the run's folder, under the same paths.

    Parameters
    ----------
    count : of workers; None: as many as the cluster has GPUs for, or CPUs where `gpus` is 0.
    jobs : that there are; more workers are not started.
    address : of a running cluster, "auto" for the one of this machine; None: one is started here, for as
        long as this lives.
    gpus : that each worker has for itself; Ray shows it no other.

    Raises
    ------
    ValueError
        If Ray is missing, there is no cluster at the address, or it has too little for one worker.
    """

    def __init__(
        self,
        count: int | None = None,
        *,
        jobs: int,
        address: str | None = None,
        gpus: float = 0,
    ) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            ray: Any = importlib.import_module("ray")
        except ImportError:
            raise ValueError(
                "Ray is not installed: pip install 'progden_jax[sweep]', or leave --ray and --address out."
            ) from None
        self._ray = ray
        try:
            with warnings.catch_warnings():
                # JAX warns of forks; Ray's are of other programs.
                warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called")
                ray.init(
                    address=address or "local",
                    include_dashboard=None if address else False,
                    configure_logging=False,
                    log_to_driver=False,
                )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ValueError(f"no Ray cluster at {address or 'this machine'}: {error}") from None
        have = ray.cluster_resources()
        room = int(have.get("GPU", 0) / gpus) if gpus else int(have.get("CPU", 0))
        if room < 1:
            ray.shutdown()
            what = f"{gpus:g} GPUs, and the cluster has {have.get('GPU', 0):g}" if gpus else "a CPU"
            raise ValueError(f"each worker needs {what}: choose another --num-gpus or --address.")
        self.count = min(count or room, room, jobs)
        cache = os.environ.get("PROGDEN_CACHE")
        self._class = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0)(_Measurer)
        self._arguments = (cache,)
        self._actors = [self._start() for _ in range(self.count)]
        self._busy: dict[Any, int] = {}
        # Where Ray tells of lost workers, but results go.
        self._stdout = contextlib.redirect_stdout(sys.stderr)
        self._stdout.__enter__()

    def give(self, worker: int, job: Job) -> None:
        self._busy[self._actors[worker].attempt.remote(job)] = worker

    def wait(self) -> tuple[int, Outcome | Lost]:
        (done, *_), _ = self._ray.wait(list(self._busy), num_returns=1)
        worker = self._busy.pop(done)
        try:
            return worker, self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            self._actors[worker] = self._start()
            return worker, Lost(" ".join(str(error).split())[:300])

    def close(self) -> None:
        for actor in self._actors:
            self._ray.kill(actor)
        self._ray.shutdown()
        self._stdout.__exit__(None, None, None)

    def _start(self) -> Any:
        return self._class.remote(*self._arguments)


class _Measurer:
    """What an actor is."""

    def __init__(self, cache: str | None) -> None:
        enable_compilation_cache(cache)

    def attempt(self, job: Job) -> Outcome:
        return attempt(job)
