"""Convolutions by AMX, the matrix units of x86 server CPUs since 2023, where a C++ compiler is at hand.

XLA convolves on CPUs in float32 by vector units. The matrix units multiply bfloat16 sixteen times as fast;
`_amx.cc` makes float32 of that. It is compiled at first use against the headers that jaxlib carries, and
kept in the cache folder.
"""

import contextlib
import ctypes
import functools
import hashlib
import importlib.metadata
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from progden_jax.compilation import cache_folder

TARGET = "progden_convolve"
_SOURCE = Path(__file__).with_suffix(".cc")
_FLAGS = (
    *("-std=c++17", "-O3", "-shared", "-fPIC", "-w"),
    *("-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mavx512bf16"),
    *("-mamx-tile", "-mamx-bf16"),
)
_NEEDED = {"avx512bw", "avx512dq", "avx512vl", "avx512_bf16", "amx_tile", "amx_bf16"}
_PATIENCE = 120.0
"""Seconds that the compiler may take; it takes ten."""

_PLANES = {"bfloat16": 1, "high": 2, "tensorfloat32": 2}
"""Precision -> how many bfloat16 stand for a value: relative errors of 2e-3, 4e-6, and 2e-7 with three."""

ALIGNED = 8
"""Rows at whose multiples bands begin, and tiles of networks that pool thrice or more. Only within them rows
are computed together, so that a pixel gets the same bits in each."""

_FEWEST = 512
"""Weights of a kernel below which its tiles would be mostly empty."""


def planes(precision: Any, kernel: Any, *others: Any) -> int:
    """How many bfloat16 stand for each value of a convolution by that kernel; 0 where XLA should do it."""
    fits = all(jnp.result_type(a) == jnp.float32 for a in (kernel, *others))
    if not (fits and np.size(kernel) >= _FEWEST and available()):
        return 0
    name = precision.name if isinstance(precision, lax.Precision) else str(precision)
    return _PLANES.get(name.lower(), 3)


def available() -> bool:
    """Whether this process convolves by AMX; the first call may compile for ten seconds."""
    return jax.default_backend() == "cpu" and status() is None


@functools.cache
def status() -> str | None:
    """None where AMX can be used, else why not."""
    if os.environ.get("PROGDEN_AMX", "1") in ("", "0"):
        return "switched off by PROGDEN_AMX"
    if missing := _NEEDED - _cpu_flags():
        return f"the CPU has no {', '.join(sorted(missing))}"
    try:
        library = _loaded()
        if not library.progden_asks_for_amx():
            return "the system does not let this process use AMX"
        jax.ffi.register_ffi_target(
            TARGET, jax.ffi.pycapsule(library.progden_convolve), platform="cpu"
        )
    except (OSError, RuntimeError, AttributeError, subprocess.SubprocessError) as error:
        logging.getLogger(__name__).info("AMX is not used: %s", error)
        return str(error)
    return None


def _cpu_flags() -> set[str]:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("flags"):
                return set(line.partition(":")[2].split())
    return set()


def _loaded() -> ctypes.CDLL:
    """The compiled `_amx.cc`: from the cache folder, or made for this process where it cannot be kept."""
    compiler = _compiler()
    try:
        return ctypes.CDLL(str(_cached(compiler)))
    except OSError:
        with tempfile.TemporaryDirectory(prefix="progden-") as scratch:
            return ctypes.CDLL(str(_compiled(compiler, Path(scratch) / "amx.so")))


def _cached(compiler: str) -> Path:
    """The library in the cache folder: made once per compiler, flags and jaxlib."""
    version = subprocess.run(
        [compiler, "--version"], capture_output=True, timeout=_PATIENCE, check=True
    ).stdout
    parts = (
        _SOURCE.read_bytes(),
        version,
        repr(_FLAGS).encode(),
        importlib.metadata.version("jaxlib").encode(),
    )
    path = cache_folder() / f"amx-{hashlib.sha256(b'|'.join(parts)).hexdigest()[:20]}.so"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".amx-") as scratch:
            os.replace(_compiled(compiler, Path(scratch) / path.name), path)
    return path


def _compiler() -> str:
    names = (os.environ.get("CXX", ""), "c++", "g++", "clang++")
    found = next((path for name in names if name and (path := shutil.which(name))), None)
    if found is None:
        raise RuntimeError("there is no C++ compiler (c++, g++, clang++ or $CXX)")
    return found


def _compiled(compiler: str, path: Path) -> Path:
    command = [compiler, *_FLAGS, "-isystem", jax.ffi.include_dir(), str(_SOURCE), "-o", str(path)]
    made = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE, check=False)
    if made.returncode:
        last = made.stderr.strip().splitlines()[-1:] or ["no message"]
        raise RuntimeError(f"{compiler} could not compile {_SOURCE.name}: {last[0]}")
    return path
