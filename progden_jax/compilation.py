"""The persistent compilation cache: what is compiled once is not compiled again in the next run."""

import os
from pathlib import Path

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
