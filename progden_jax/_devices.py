"""One program over several devices: a stack of windows or frames, one for each."""

import contextlib
import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Device = Any
"""A `jax.Device`."""

_AXIS = "stack"
_SPLIT = PartitionSpec(_AXIS)


def cores() -> list[int]:
    """The CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def cores_as_devices(batch: int) -> None:
    """Let JAX, where it has not begun yet, see CPU cores as devices: as many as share a batch evenly.

    Of a training step XLA runs much on one core only. Shared between devices, all cores have something to do.
    Settings of the user's stay, and so does a JAX that has begun.
    """
    count = max(n for n in range(1, min(len(cores()), _MOST) + 1) if batch % n == 0)
    said = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if said or getattr(jax.config, "jax_num_cpu_devices", -1) != -1:
        return
    with contextlib.suppress(RuntimeError):  # what JAX raises once it has begun
        jax.config.update("jax_num_cpu_devices", count)


_MOST = 8
"""Cores to make devices of: each keeps a copy of all examples."""


def on_each(
    program: Any, job: Any, calls: Iterable[tuple[Any, ...]], devices: Sequence[Device]
) -> Iterator[Any]:
    """``program(job, *call)`` of every call in order, one per device at a time; results are NumPy arrays.

    The calls' arguments must have the same shapes. With devices of several processes (`jax.distributed`) all
    of them make the same calls, and get all results.
    """
    run = _sharded(program, tuple(devices))
    mesh = Mesh(np.asarray(devices), (_AXIS,))
    job = jax.tree.map(lambda leaf: _everywhere(leaf, mesh), job)
    calls = iter(calls)
    while some := list(itertools.islice(calls, len(devices))):
        # Devices that would have nothing to do repeat the last.
        filled = [*some, *[some[-1]] * (len(devices) - len(some))]
        stacked = jax.tree.map(lambda *leaves: _stack(leaves, mesh), *filled)
        results = jax.tree.map(_on_host, run(job, *stacked))
        for i in range(len(some)):
            yield jax.tree.map(lambda a, i=i: a[i], results)


@functools.lru_cache(maxsize=16)
def _sharded(program: Any, devices: tuple[Device, ...]) -> Callable[..., Any]:
    mesh = Mesh(np.asarray(devices), (_AXIS,))

    def local(job: Any, *stacked: Any) -> Any:
        found = program(job, *jax.tree.map(lambda a: a[0], stacked))
        return jax.tree.map(lambda a: a[None], found)

    def run(job: Any, *stacked: Any) -> Any:
        specs = (PartitionSpec(), *(_SPLIT for _ in stacked))
        mapped = jax.shard_map(local, mesh=mesh, in_specs=specs, out_specs=_SPLIT, check_vma=False)
        return mapped(job, *stacked)

    return jax.jit(run)


def _stack(leaves: Iterable[Any], mesh: Mesh) -> jax.Array:
    parts = [np.asarray(leaf) for leaf in leaves]
    shape = (len(parts), *parts[0].shape)

    def part(index: Any) -> np.ndarray:
        return parts[index[0].start or 0][None]

    return jax.make_array_from_callback(shape, NamedSharding(mesh, _SPLIT), part)


def _everywhere(leaf: Any, mesh: Mesh) -> jax.Array:
    """A copy on every device."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        data = _everywhere(jax.random.key_data(leaf), mesh)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    whole = np.asarray(leaf, jnp.result_type(leaf))
    sharding = NamedSharding(mesh, PartitionSpec())
    return jax.make_array_from_callback(whole.shape, sharding, lambda _: whole)


def _on_host(stacked: jax.Array) -> np.ndarray:
    if stacked.is_fully_addressable:
        return np.asarray(stacked)
    return np.asarray(multihost_utils.process_allgather(stacked, tiled=True))
