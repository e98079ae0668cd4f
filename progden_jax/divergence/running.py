"""The exact divergence step by step: with progress, to be interrupted and resumed, in bounded memory."""

import functools
import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from progden_jax import _checkpoint, _devices
from progden_jax._fingerprint import fingerprint
from progden_jax.denoisers import graph
from progden_jax.divergence import _reach, cone, exact, windows
from progden_jax.divergence._base import Evaluation, Function, check_arguments
from progden_jax.divergence.exact import Exact

SAVE_SECONDS = 10.0
"""At most this often a checkpoint is written while a run goes on."""

_CHUNKS_PER_STEP = 32

logger = logging.getLogger(__name__)


def exact_divergence(
    f: Function,
    x: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    *,
    method: Exact | None = None,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Evaluation:
    """f(x) with its exact divergence, for images on which that takes minutes to hours.

    The same numbers as ``divergence(f, x, variance, method=Exact())`` to rounding, in steps of about a
    second. It runs on the host: not inside ``jit``, ``vmap`` or ``grad``. Of a pytree f one program is
    compiled per image size.

    Parameters
    ----------
    f, x, variance : as for `divergence`.
    method : the algorithm; by default the quickest.
    progress : called as ``progress(done, total)`` before the first step and after each, in units of its own
        (pixels or colours). What it raises ends the run, the checkpoint being kept.
    checkpoint : a file for what is found, written every ten seconds and when an exception, such as that of
        Ctrl-C, ends the run. A call with equal f, x and method goes on from it, on the same machine to the
        same bits as without a break. A broken file is told of in the log and ignored. It stays when
        all is done, so that nothing is lost until the result is safe: then remove it.

    Raises
    ------
    ValueError
        As `divergence`; if an argument is traced; if the checkpoint is of another run, or its folder missing.

    Notes
    -----
    Memory by cones, OIDN's base network at 1920×1080 on a CPU: 2 GiB at its peak, the one pass through the
    network, and 1 GiB from then on (ReLU masks, 0.25 kB per pixel). By colours: what
    ``jax.linearize(f, x)`` keeps. A checkpoint is a padded image, 25 MB at that size.
    """
    run = ExactRun(f, x, variance, method=method)
    return run.finish(progress=progress, checkpoint=checkpoint)


class ExactRun:
    """An exact divergence on its way; `exact_divergence` in two parts, for those who need the key.

    Attributes
    ----------
    key : what the answer depends on, as a hash: name a checkpoint after it.
    done, total : units found and to be found.
    """

    def __init__(
        self,
        f: Function,
        x: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        *,
        method: Exact | None = None,
    ) -> None:
        method = Exact() if method is None else method
        if not isinstance(method, Exact):
            raise ValueError(
                f"method is {method!r}, expected an Exact: other methods take no steps."
            )
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((f, x, variance))):
            raise ValueError(
                "exact_divergence got traced values, and it runs on the host step by step: call it outside "
                "of jit, vmap and grad, or use divergence(f, x, variance, method=Exact())."
            )
        x, self._variance = check_arguments(f, x, variance)
        algorithm = method.choose(f, x)
        self._steps: _Steps = (
            _ByCone(f, x, method) if algorithm == "cone" else _ByColors(f, x, method, algorithm)
        )
        self.key, self.total, self.done = self._steps.key, self._steps.total, 0

    def finish(
        self,
        *,
        progress: Callable[[int, int], None] | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> Evaluation:
        """Take the steps that are left; see `exact_divergence`."""
        path = None if checkpoint is None else Path(checkpoint)
        found = self._steps.found
        if path is not None:
            if not path.parent.is_dir():
                raise ValueError(
                    f"checkpoint is {path}, and the folder {path.parent} does not exist: make it first."
                )
            self.done = max(self.done, _checkpoint.load(path, self.key, found))
        saved, last = self.done, time.monotonic()
        try:
            if progress is not None:
                progress(self.done, self.total)
            while self.done < self.total:
                self.done = self._steps.advance(self.done)
                if path is not None and time.monotonic() - last > SAVE_SECONDS:
                    saved = self._save(path)
                    last = time.monotonic()
                if progress is not None:
                    progress(self.done, self.total)
        finally:
            if path is not None and self.done > saved:
                self._save(path)
        diagonal = jnp.asarray(self._steps.diagonal())
        return Evaluation(
            self._steps.value, self._variance * diagonal, jnp.zeros_like(self._steps.value)
        )

    def _save(self, path: Path) -> int:
        try:
            _checkpoint.save(path, self.key, self._steps.found, self.done)
        except OSError as error:
            # A full disk must not end what took an hour.
            logger.warning("cannot write the checkpoint %s: %s", path, error)
        return self.done


class _Steps(Protocol):
    """One algorithm: `advance` fills in `found` from unit `done` on and says how far it came.

    Filling in the same units twice is harmless, so an exception may come at any time.
    """

    key: str
    total: int
    found: np.ndarray
    value: Array

    def advance(self, done: int) -> int: ...

    def diagonal(self) -> Any: ...


class _ByCone:
    """Units are pixels of the padded image, phase by phase."""

    def __init__(self, f: Any, x: Array, method: Exact) -> None:
        exact.check_layered(f)
        self.nodes = tuple(f.layers[0])
        run = _closed(_cone_primal, f)
        self.value, self.slope, self.prepared, self.params, inputs, inside = run(f, x)
        extent = [] if inside is None else inside
        self.key = fingerprint(
            _checkpoint.FORMAT, "cone", repr(self.nodes), self.params, inputs, extent
        )
        self.size = (inputs.shape[0], inputs.shape[1])
        self.plan = windows.plan(self.nodes, self.params)
        self.cells = cone.cells_per_phase(self.plan, self.size)
        self.total = self.cells * self.plan.period**2
        self.found = np.zeros((self.total, 3), x.dtype)
        self.chunk = min(method.chunk or exact.cone_chunk(), self.cells)
        self.number = min(_CHUNKS_PER_STEP * self.chunk, self.cells)
        self.workers = 1

    def advance(self, done: int) -> int:
        """The first step, which compiles, alone; then as many at once as keep the machine busy."""
        starts = [done]
        while len(starts) < self.workers and (end := self._end(starts[-1])) < self.total:
            starts.append(end)
        with ThreadPoolExecutor(self.workers) as pool:
            for start, rows in zip(starts, pool.map(self._step, starts), strict=True):
                end = self._end(start)
                self.found[start:end] = rows[: end - start]
        self.workers = _steps_at_once()
        return self._end(starts[-1])

    def _end(self, start: int) -> int:
        """Where a step ends: with its phase at the latest."""
        return min(start + self.number, (start // self.cells + 1) * self.cells)

    def _step(self, start: int) -> np.ndarray:
        phase, first = divmod(start, self.cells)
        rows = _cone_step(
            self.params,
            self.prepared,
            np.int32(phase),
            np.int32(first),
            nodes=self.nodes,
            size=self.size,
            number=self.number,
            chunk=self.chunk,
        )
        return np.asarray(rows)

    def diagonal(self) -> Any:
        whole = cone.assemble(self.found, self.size, self.plan.period)
        height, width = self.value.shape[:2]
        return self.slope * whole[:height, :width]


class _ByColors:
    """Units are colours: tangents that light every pixel of a colour."""

    def __init__(self, f: Any, x: Array, method: Exact, algorithm: str) -> None:
        self.colors = method.colors(f, x, algorithm)
        jaxpr = _reach.tangent_jaxpr(f, x)
        self.key = fingerprint(_checkpoint.FORMAT, "colors", self.colors, jaxpr, x)
        self.value, self.tangent = _closed(jax.linearize, f)(f, x)
        self.total = int(self.colors.max()) + 1
        self.found = np.zeros(x.shape, x.dtype)
        self.chunk = min(method.chunk or exact.COLORS_AT_ONCE, self.total)
        self.painted = jnp.asarray(self.colors)

    def advance(self, done: int) -> int:
        part = _colors_step(
            self.tangent, self.painted, np.int32(done), chunk=self.chunk, dtype=self.found.dtype
        )
        end = min(done + self.chunk, self.total)
        lit = (self.colors >= done) & (self.colors < end)
        np.copyto(self.found, np.asarray(part), where=lit)
        return end

    def diagonal(self) -> Any:
        return self.found


def _steps_at_once() -> int:
    """The small products of a step keep but one core busy."""
    return len(_devices.cores()) if jax.default_backend() == "cpu" else 1


def _closed(run: Callable[..., Any], f: Any) -> Callable[..., Any]:
    """`run` of (f, x), compiled for all values of a pytree f, else for this function alone."""
    if jax.tree_util.all_leaves([f]):
        return lambda f, x: jax.jit(functools.partial(run, f))(x)
    return _compiled(run)


@functools.cache
def _compiled(run: Callable[..., Any]) -> Callable[..., Any]:
    return jax.jit(run)


def _cone_primal(f: Any, x: Array) -> tuple[Any, ...]:
    layered: graph.Layered = f.layered(x)
    value, slope, kept = exact.cone_primal(layered, x)
    plan = windows.plan(layered.nodes, layered.params)
    prepared = cone.prepare(plan, layered.params, kept)
    return value, slope, prepared, layered.params, layered.inputs, layered.inside


@functools.partial(jax.jit, static_argnames=("nodes", "size", "number", "chunk"))
def _cone_step(
    params: Any,
    prepared: cone.Prepared,
    phase: Array,
    first: Array,
    *,
    nodes: tuple[graph.Node, ...],
    size: tuple[int, int],
    number: int,
    chunk: int,
) -> Float[Array, "cells 3"]:
    return cone.some_cells(
        windows.plan(nodes, params),
        params,
        prepared,
        size,
        phase,
        first,
        number,
        chunk=chunk,
        precision=lax.Precision.HIGHEST,
    )


@functools.partial(jax.jit, static_argnames=("chunk", "dtype"))
def _colors_step(tangent: Any, painted: Array, first: Array, *, chunk: int, dtype: Any) -> Array:
    return exact.some_colors(tangent, painted, first + jnp.arange(chunk), dtype)
