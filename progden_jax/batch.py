"""Many frames of mixed sizes: few programs, and reading beside computing."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax

from progden_jax import _checks
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer
from progden_jax.pipeline import Result, canvas_size, progressive_denoise
from progden_jax.skipping import Skip

Size = tuple[int, int]

PROGRAMS = 3
"""So many shapes are compiled for a batch at most."""

_PIXELS_PER_PROGRAM = 4e6
"""Padding that costs as much time as compiling another program, about."""

AT_ONCE = 2
"""Frames in work: while one is read, prepared or handed on, another computes."""


def denoise_batch(
    frames: Sequence[Frame] | Iterable[Frame | Callable[[], Frame]],
    denoiser: Denoiser,
    *,
    mixer: Mixer | None = None,
    method: Method | None = None,
    key: jax.Array | None = None,
    outputs: Sequence[str] = ("image",),
    skip: Skip | bool = True,
    max_memory: int | None = None,
    sizes: Sequence[Size] | None = None,
    at_once: int = AT_ONCE,
) -> Iterator[Result]:
    """`progressive_denoise` of every frame, in order, as they are asked for.

    Some frames are in work at once, on threads, also while the caller writes the last result. Frames of
    similar sizes are padded to one shape, so that few programs are compiled.

    Parameters
    ----------
    frames : frames, or functions that read them, called on the threads; may be a generator.
    denoiser, mixer, method, key, outputs, skip, max_memory : as for `progressive_denoise`; the same key for
        all, so that each result is the one of a call of its own, to rounding.
    sizes : (height, width) of every frame, where they are known beforehand but `frames` does not tell: then
        at most three programs serve them all. Of frames in a sequence they are taken. Else every
        size has that of its canvas.
    at_once : frames in work, and so in memory.

    Raises
    ------
    ValueError
        As `progressive_denoise`, when the frame's turn comes; if sizes are not as many as frames.
    """
    _checks.positive_int("at_once", at_once)
    if sizes is None and isinstance(frames, Sequence) and all(isinstance(f, Frame) for f in frames):
        sizes = [f.size for f in frames if isinstance(f, Frame)]
    canvases = shared_canvases(sizes or ())
    first_of = Once()

    def run(frame: Frame | Callable[[], Frame]) -> Result:
        read = frame if isinstance(frame, Frame) else frame()
        canvas = canvases.get(canvas_of(read.size))

        def call() -> Result:
            result = progressive_denoise(
                read,
                denoiser,
                mixer=mixer,
                method=method,
                key=key,
                outputs=outputs,
                skip=skip,
                max_memory=max_memory,
                canvas=canvas,
            )
            return jax.block_until_ready(result)

        return first_of((canvas, read.albedo is None, read.normal is None), call)

    return _in_order(run, frames, at_once)


def canvas_of(size: Size) -> Size:
    """The shape that a frame of that size is computed at on its own."""
    return canvas_size(size[0]), canvas_size(size[1])


def shared_canvases(sizes: Iterable[Size], most: int = PROGRAMS) -> dict[Size, Size]:
    """For each canvas of these frames the shape to compute it at: at most so many, and no more than pay.

    The pair of shapes whose union costs least is joined, again and again, while that costs less than
    compiling another program or there are too many.
    """
    counts = Counter(canvas_of(size) for size in sizes)
    groups: dict[Size, list[Size]] = {canvas: [canvas] for canvas in counts}

    def cost(shape: Size, members: list[Size]) -> float:
        return sum(counts[m] * (shape[0] * shape[1] - m[0] * m[1]) for m in members)

    def joined(a: Size, b: Size) -> tuple[float, Size]:
        union = (max(a[0], b[0]), max(a[1], b[1]))
        more = cost(union, groups[a] + groups[b]) - cost(a, groups[a]) - cost(b, groups[b])
        return more, union

    while len(groups) > 1:
        pairs = [(a, b) for i, a in enumerate(groups) for b in list(groups)[:i]]
        a, b = min(pairs, key=lambda pair: joined(*pair)[0])
        more, union = joined(a, b)
        if more > _PIXELS_PER_PROGRAM and len(groups) <= most:
            break
        members = groups.pop(a) + groups.pop(b)
        groups[union] = groups.get(union, []) + members
    return {member: shape for shape, members in groups.items() for member in members}


class Once:
    """Calls of one kind wait for the first of it, which compiles."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.kinds: dict[Any, threading.Lock] = {}
        self.done: set[Any] = set()

    def __call__(self, kind: Any, call: Callable[[], Result]) -> Result:
        if kind in self.done:
            return call()
        with self.lock:
            own = self.kinds.setdefault(kind, threading.Lock())
        with own:
            result = call()
            self.done.add(kind)
        return result


def _in_order(run: Callable[[Any], Result], items: Iterable[Any], at_once: int) -> Iterator[Result]:
    """`run` of every item on threads; what a caller does not ask for any more is not begun."""
    pending: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(at_once, thread_name_prefix="progden")
    try:
        for item in items:
            pending.append(pool.submit(run, item))
            if len(pending) > at_once:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
