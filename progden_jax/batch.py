"""Many frames of mixed sizes: few programs, and reading beside computing."""

import contextlib
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

import jax

from progden_jax import _checks, memory
from progden_jax._canvas import call_of, canvas_size, cropped, has_canvas
from progden_jax._devices import Device, on_each
from progden_jax._program import Job, checked_variance
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer
from progden_jax.pipeline import Result, job_of, progressive_denoise, rule_of
from progden_jax.skipping import Skip, Skipped, noisy_tiles
from progden_jax.survey import BUFFERS
from progden_jax.tstatistic import Bound

Size = tuple[int, int]

PROGRAMS = 3
"""So many shapes are compiled for a batch at most."""

_PIXELS_PER_PROGRAM = 5e5
"""Padding that costs as much time as another program from the compilation cache, about. Compiling it costs
some times as much, but once."""

AT_ONCE = 2
"""Frames in work: while one is read, prepared or handed on, another computes."""

_SMALL, _SMALL_AT_ONCE = 1 << 18, 4
"""So few pixels leave cores without work now and then, and take little memory: more of them are in work."""


def denoise_batch(
    frames: Sequence[Frame] | Iterable[Frame | Callable[[], Frame]],
    denoiser: Denoiser,
    *,
    mixer: Mixer | None = None,
    method: Method | None = None,
    bound: Bound | bool = True,
    key: jax.Array | None = None,
    outputs: Sequence[str] = ("image",),
    skip: Skip | bool = True,
    max_memory: int | None = None,
    sizes: Sequence[Size] | None = None,
    at_once: int | None = None,
    devices: Sequence[Device] | None = None,
) -> Iterator[Result]:
    """`progressive_denoise` of every frame, in order, as they are asked for.

    Some frames are in work at once, on threads, also while the caller writes the last result. Frames of
    similar sizes are padded to one shape, so that few programs are compiled.

    Parameters
    ----------
    frames : frames, or functions that read them, called on the threads; may be a generator.
    denoiser, mixer, method, bound, key, outputs, skip, max_memory : as for `progressive_denoise`; the same
        key for all, so that each result is the one of a call of its own, to rounding.
    sizes : (height, width) of every frame, where they are known beforehand but `frames` does not tell: then
        at most three programs serve them all. Of frames in a sequence they are taken. Else every
        size has that of its canvas.
    at_once : frames in work, and so in memory, per device. None: two, or four where `sizes` are known and
        small.
    devices : several compute a frame each at the same time, or with `max_memory` a window each of the same
        frame. None: all of this process. In a run of several processes (``jax.distributed``) give each
        its share of the frames, such as ``frames[jax.process_index()::jax.process_count()]``.

    Raises
    ------
    ValueError
        As `progressive_denoise`, when the frame's turn comes.
    """
    if sizes is None and isinstance(frames, Sequence) and all(isinstance(f, Frame) for f in frames):
        sizes = [f.size for f in frames if isinstance(f, Frame)]
    canvases = shared_canvases(sizes or ())
    if at_once is None:
        at_once = at_once_of(canvases)
    _checks.positive_int("at_once", at_once)
    if devices is None:
        devices = jax.local_devices()
    job = job_of(denoiser, mixer, method, key, outputs, bound)
    if len(devices) > 1 and max_memory is None:
        read = _in_order(_read, frames, at_once * len(devices))
        return _on_devices(read, job, rule_of(skip, job), canvases, devices)
    # Once, not for every frame.
    on_device, mixing = jax.device_put((job.denoiser, job.mixer))
    first_of = Once()

    def run(given: Frame | Callable[[], Frame]) -> Result:
        frame = _read(given)
        own = canvas_of(frame.size)
        canvas = canvases.get(own, own)

        def call() -> Result:
            result = progressive_denoise(
                frame,
                on_device,
                mixer=mixing,
                method=job.method,
                bound=job.bound or False,
                key=job.key,
                outputs=job.outputs,
                skip=skip,
                max_memory=max_memory,
                canvas=canvas,
                devices=devices if len(devices) > 1 else None,
            )
            return jax.block_until_ready(result)

        return first_of((canvas, frame.albedo is None, frame.normal is None), call)

    small = are_small(canvases) and max_memory is None
    return _in_order(run, frames, at_once, memory.kept if small else contextlib.nullcontext)


def _read(frame: Frame | Callable[[], Frame]) -> Frame:
    return frame if isinstance(frame, Frame) else frame()


def _on_devices(
    frames: Iterator[Frame],
    job: Job,
    rule: Skip | None,
    canvases: dict[Size, Size],
    devices: Sequence[Device],
) -> Iterator[Result]:
    """In order; frames of one shape wait until there is one for every device, or too many wait."""
    groups: dict[Any, list[tuple[int, Frame, Size]]] = {}
    done: dict[int, Result] = {}

    def compute(kind: Any) -> None:
        group = groups.pop(kind)
        calls = (call_of(job, frame, canvas) for _, frame, canvas in group)
        for (index, frame, canvas), found in zip(
            group, on_each(job.program, job, calls, devices), strict=True
        ):
            whole = Skipped(0, canvas[0] * canvas[1])
            done[index] = cropped(found, frame.size)._replace(skipped=whole)

    following = 0
    for index, frame in enumerate(frames):
        variance = checked_variance(frame)
        canvas = frame.size
        if has_canvas(job.denoiser):
            canvas = canvases.get(canvas_of(frame.size), canvas_of(frame.size))
        if rule is not None and not noisy_tiles(frame.color, variance, rule).any():
            done[index] = progressive_denoise(
                frame,
                job.denoiser,
                mixer=job.mixer,
                method=job.method,
                bound=job.bound or False,
                key=job.key,
                outputs=job.outputs,
                skip=rule,
            )
        else:
            kind = (canvas, *(getattr(frame, name) is None for name in BUFFERS))
            groups.setdefault(kind, []).append((index, frame, canvas))
            if len(groups[kind]) == len(devices):
                compute(kind)
            elif sum(map(len, groups.values())) >= PROGRAMS * len(devices):
                compute(next(iter(groups)))
        while following in done:
            yield done.pop(following)
            following += 1
    for kind in list(groups):
        compute(kind)
    yield from (done[index] for index in sorted(done))


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


def at_once_of(canvases: dict[Size, Size]) -> int:
    """Frames to have in work, of those shapes where they are known, see `shared_canvases`."""
    return _SMALL_AT_ONCE if are_small(canvases) else AT_ONCE


def are_small(canvases: dict[Size, Size]) -> bool:
    """Whether the shapes are known, see `shared_canvases`, and each has so few pixels."""
    return bool(canvases) and all(height * width <= _SMALL for height, width in canvases.values())


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


def _in_order(
    run: Callable[[Any], Any],
    items: Iterable[Any],
    at_once: int,
    during: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
) -> Iterator[Any]:
    """`run` of every item on threads; what a caller does not ask for any more is not begun."""
    pending: deque[Future[Any]] = deque()
    with during():
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
