"""How large a window may be for the memory that is given."""

import contextlib
import ctypes
import functools
import math
import os
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from progden_jax import tiling

UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 2**10, "mi": 2**20, "gi": 2**30}

SLACK = 1.15
"""For what XLA's count of temporaries does not have: scratch inside convolutions, copies of windows."""


def parse_size(text: str) -> int:
    """Bytes from a number with a unit: "4GiB", "500 MB", "2e9".

    Raises
    ------
    ValueError
        If it is no such size, or not above 0.
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:e\+?[0-9]+)?)\s*([kmg]i?)?b?\s*", text.lower())
    try:
        size = 0 if match is None else int(float(match[1]) * UNITS[match[2] or ""])
    except ValueError:
        size = 0
    if size <= 0:
        raise ValueError(
            f"the size is {text!r}, expected bytes as a number with a unit, such as 4GiB or 500MB."
        )
    return size


def shown(size: float) -> str:
    """Bytes for people."""
    for unit, name in ((2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size:.0f} bytes"


def resident() -> int:
    """Bytes of memory that this process holds; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


class Peak:
    """The memory that is taken from now on, beyond what is held now: of JAX's device, or of this process.

    The process may hold what it has freed, and take it again unseen, above all in blocks of less than 32 MiB.
    """

    def __init__(self) -> None:
        trim()
        self._stats = jax.devices()[0].memory_stats() or {}
        self._held, self._told = resident(), False
        # The kernel's record of the highest begins anew.
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
            self._told = True

    def read(self) -> int | None:
        """Bytes; None where the system does not tell, as a device that had held as much before."""
        if self._stats:
            highest = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
            grown = highest > self._stats.get("peak_bytes_in_use", 0)
            return highest - self._stats["bytes_in_use"] if grown else None
        highest = re.search(r"VmHWM:\s*(\d+) kB", _status()) if self._told else None
        return max(int(highest[1]) * 1024 - self._held, 0) if highest else None


def _status() -> str:
    try:
        return Path("/proc/self/status").read_text()
    except OSError:
        return ""


def trim() -> None:
    """Give back what was freed: a compiler leaves some hundred MB to the C library, which keeps them."""
    with contextlib.suppress(OSError, AttributeError):  # no glibc
        ctypes.CDLL(None).malloc_trim(0)


def release() -> None:
    """Give back what JAX has adopted and nobody holds: it lets go only when it is next called."""
    for _ in range(2):  # a view of an array of its own, and then that array
        jax.device_put(0)


def trim_for(pixels: int) -> None:
    """Before an image of so many is computed: `trim` if it is large, now and after each compilation.

    A program's peak would else come on top of what the compiler has left, or the frame before.
    """
    if pixels >= _WORTH_TRIMMING:
        trim()
        _trim_after_compiling()


_WORTH_TRIMMING = 1 << 20
"""Pixels of a frame."""


@functools.cache
def _trim_after_compiling() -> None:
    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and duration_secs > 0.3:
            trim()

    jax.monitoring.register_event_duration_secs_listener(listen)


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """What is freed in this block stays with the process, which so need not ask for each page again.

    For small images, one after the other: they free and take the same some hundred MB again and again. It is
    given back at the end of the block, or of the last of several at a time. No-op without glibc, or where
    the user has set what glibc keeps.
    """
    if not _is_ours_to_set():
        yield
        return
    with _KEPT.lock:
        _KEPT.blocks += 1
        if _KEPT.blocks == 1:
            _set(_KEEP)
    try:
        yield
    finally:
        with _KEPT.lock:
            _KEPT.blocks -= 1
            if _KEPT.blocks == 0:
                _set(_USUAL)
                trim()


# Of malloc.h: M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_MMAP_MAX. The latter are what glibc adapts to
# by itself once something of 32 MiB was freed; told anything, it adapts no longer.
_KEEP = {-1: 2**31 - 1, -2: 64 << 20, -4: 0}
_USUAL = {-1: 64 << 20, -2: 128 << 10, -3: 32 << 20, -4: 1 << 16}


class _Kept:
    """How many blocks of `kept` are open, in all threads."""

    def __init__(self) -> None:
        self.lock, self.blocks = threading.Lock(), 0


_KEPT = _Kept()


def _set(options: dict[int, int]) -> None:
    for option, value in options.items():
        ctypes.CDLL(None).mallopt(option, value)


@functools.cache
def _is_ours_to_set() -> bool:
    chosen = " ".join((*os.environ, os.environ.get("GLIBC_TUNABLES", "")))
    if re.search(r"MALLOC_(TRIM|TOP|MMAP)_|malloc\.(trim|top|mmap)_", chosen):
        return False
    try:
        return bool(ctypes.CDLL(None).gnu_get_libc_version)
    except (OSError, AttributeError):
        return False


HUGE_PAGES = "glibc.malloc.hugetlb=1"
"""What asks for huge pages, in the environment variable ``GLIBC_TUNABLES`` of a new process."""

_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")


def huge_pages() -> bool:
    """Whether what this process allocates comes in huge pages, as far as Linux can find some.

    Images are too large for the C library to keep what was freed: each run touches all its pages anew.
    """
    try:
        chosen = _PAGES.read_text()
    except OSError:
        return False
    asked = HUGE_PAGES in os.environ.get("GLIBC_TUNABLES", "")
    return "[always]" in chosen or ("[madvise]" in chosen and asked)


def window_edge(
    available: float,
    smallest: int,
    step: int,
    needs: Callable[[int], Any],
    guess: Callable[[int], float],
) -> int:
    """The edge of the largest square window whose program fits into so many bytes.

    Parameters
    ----------
    available : bytes for one window's program: its arguments, results and temporaries.
    smallest : the least edge that is of use.
    step : multiples that edges are of.
    needs : the compiled program for a window of that edge, as `jax.stages.Compiled`.
    guess : of a window's pixels, bytes for each, to start from; too many cost speed, too few a compilation.

    Raises
    ------
    ValueError
        If not even the smallest window fits.
    """
    edges = tiling.window_edges(smallest, step)

    def largest(bytes_of_each: Callable[[int], float]) -> int:
        fitting = [n for n in edges if n * n * bytes_of_each(n * n) * SLACK <= available]
        return fitting[-1] if fitting else smallest

    edge = largest(guess)
    while True:
        per_pixel = bytes_of(needs(edge)) / edge**2
        trim()
        if edge**2 * per_pixel * SLACK <= available:
            return edge
        if edge == smallest:
            least = math.ceil(edge**2 * per_pixel * SLACK)
            raise ValueError(
                f"max_memory leaves {shown(max(available, 0))} for a window, and the least, of "
                f"{edge}×{edge} pixels, takes {shown(least)}: give at least "
                f"{shown(least - available)} more, or a smaller network."
            )
        edge = min(largest(lambda _, known=per_pixel: known), edges[edges.index(edge) - 1])


def bytes_of(compiled: Any) -> int:
    """What a program's arguments, results and temporaries take, as XLA counts."""
    found = compiled.memory_analysis()
    return found.temp_size_in_bytes + found.argument_size_in_bytes + found.output_size_in_bytes


def guess(denoiser: Any, method: Any, mixer: Any = None, size: tuple[int, int] = (0, 0)) -> float:
    """Bytes per pixel that the program of a window of that size may take, from the widest layers."""
    chunk = getattr(method, "chunk", None) or 1
    network = _widest(denoiser, 128) * chunk
    whole = 4 * 2.3 * max(network, _widest(mixer, 0))
    banded = getattr(denoiser, "in_bands", None)
    return _BANDS * whole + _BESIDE if banded is not None and banded(*size) else whole


_BANDS, _BESIDE = 0.12, 275
"""What bands take of a whole image's memory, and bytes per pixel of images at full size beside them."""


def _widest(network: Any, otherwise: int) -> int:
    """The most channels that a convolution takes and gives; `otherwise` where there is none."""
    kernels = (a.shape for a in jax.tree.leaves(network) if getattr(a, "ndim", 0) == 4)
    return max((taken + given for *_, taken, given in kernels), default=otherwise)
