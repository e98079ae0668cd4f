"""A render as it grows: frames at increasing samples per pixel, each with the samples of the one before."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from progden_jax import _checks
from progden_jax.frame import Frame
from progden_jax.rendering.loading import loaded
from progden_jax.rendering.moments import Moments, add, none
from progden_jax.rendering.sampling import Samples


def series(
    scene: Any,
    spp: Sequence[int],
    seed: int = 0,
    *,
    size: tuple[int, int] | None = None,
    sensor: int = 0,
    max_depth: int | None = None,
) -> Iterator[Frame]:
    """Frames of a scene at each of these samples per pixel, yielded as soon as they are rendered.

    Means and variances are accumulated in float64 from single samples. They are unbiased, pixels are
    independent (box filter), and a frame holds the samples of those before it. On one machine and
    variant the same arguments give the same bits.

    Parameters
    ----------
    scene : what `rendering.scene` or `rendering.load_scene` return, or any dictionary for
        ``mitsuba.load_dict`` or loaded scene. Its film, filter and sampler are not used.
    spp : increasing, from 2 up (one sample has no variance): [2, 8, 32].
    seed : of the samples, from 0 up.
    size : height and width in pixels; by default the sensor's film has them.
    sensor : which of the scene's sensors.
    max_depth : take a path tracer of this depth instead of the scene's integrator.

    Yields
    ------
    Frame
        Colour, variance, albedo, world-space normal, depth (0 where a path leaves the scene), spp.

    Raises
    ------
    ValueError
        If an argument is not of these, or Mitsuba cannot load or render the scene.
    """
    counts = checked_spp(spp)
    samples = Samples(loaded(scene), size=size, seed=seed, sensor=sensor, max_depth=max_depth)
    for moments in grow(samples, none(*samples.size), counts):
        if moments.spp in counts:
            yield frame(moments)


def grow(samples: Samples, moments: Moments, counts: Sequence[int]) -> Iterator[Moments]:
    """The moments after every wave, and whenever one of the counts above `moments.spp` is reached."""
    stops = [count for count in counts if count > moments.spp]
    if not stops:
        return
    for wave in samples.waves(moments.spp, stops[-1]):
        end = wave.start + len(wave.radiance)
        for stop in [stop for stop in stops if moments.spp < stop < end] + [end]:
            part = slice(moments.spp - wave.start, stop - wave.start)
            aux = None if wave.auxiliary is None else wave.auxiliary[part]
            moments = add(moments, wave.radiance[part], aux)
            yield moments


def frame(moments: Moments, *, auxiliary: bool = True) -> Frame:
    """The moments as a frame in float32."""
    color, variance, aux = (
        values.astype(np.float32) for values in (moments.mean, moments.variance, moments.auxiliary)
    )
    if not auxiliary:
        return Frame(color, variance, spp=moments.spp)
    return Frame(color, variance, aux[..., :3], aux[..., 3:6], aux[..., 6:], spp=moments.spp)


def checked_spp(spp: Sequence[int]) -> tuple[int, ...]:
    """`spp`, or a ValueError unless it increases from 2 up."""
    counts = tuple(spp)
    for count in counts:
        _checks.positive_int("spp", count)
    if not counts or counts[0] < 2 or any(a >= b for a, b in itertools.pairwise(counts)):
        raise ValueError(
            f"spp is {', '.join(map(str, counts)) or 'empty'}, expected increasing numbers from 2 up "
            "(one sample has no variance), such as 2, 8, 32."
        )
    return counts
