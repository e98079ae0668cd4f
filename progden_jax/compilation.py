"""The persistent compilation cache: what is compiled once is not compiled again in the next run."""

import contextlib
import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import platformdirs


def cache_folder() -> Path:
    """Where compiled programs are kept: $PROGDEN_CACHE, or the user's cache folder for progden_jax."""
    chosen = os.environ.get("PROGDEN_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("progden_jax"))


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled programs in `folder` from now on (default `cache_folder()`); its path.

    Returns None, and leaves JAX as it is, where the folder cannot be written. Call it before anything is
    compiled. The command line does; the library itself never changes JAX's settings.
    """
    path = cache_folder() if folder is None else Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(path, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return path


@functools.cache
def _compilations() -> list[str]:
    names: list[str] = []

    def listen(event: str, duration_secs: float, **details: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(str(details.get("fun_name", "")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    return names


def count_compilations() -> int:
    """How many programs this process compiled, or read from the cache, since the first call."""
    return len(_compilations())


@contextlib.contextmanager
def counting_compilations() -> Iterator[list[str]]:
    """The names of the programs compiled, or read from the cache, within the block; filled at its end."""
    found: list[str] = []
    before = count_compilations()
    try:
        yield found
    finally:
        found += _compilations()[before:]
