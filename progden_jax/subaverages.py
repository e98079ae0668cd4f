"""Sub-averages of one render's samples: half buffers, renders of several seeds, what a growing render gained.

Each averages samples that no other has, so that their noise is independent, and together they make up the
render.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.frame import Frame, repaired

_DIFFERING = ("color", "albedo", "normal", "depth")


class SubAverages(NamedTuple):
    """A render and its B sub-averages.

    Attributes
    ----------
    frame : of all samples, buffer by buffer.
    differences : by buffer, (B, H, W, C): a sub-average is the frame plus its difference, and weighted by the
        shares these sum to 0. Noise in them and in the frame is uncorrelated. Buffers not named are shared.
    shares : (B,) of the samples, their sum is 1.
    """

    frame: Frame
    differences: dict[str, Float[Array, "b h w c"]]
    shares: Float[Array, " b"]


def averaged(frames: Sequence[Frame], *, names: Sequence[str] = ()) -> SubAverages:
    """The render that sub-averages make up: half or quarter buffers, or renders with several seeds.

    Where all tell their samples per pixel, each counts by these, else equally. Bad pixels are repaired;
    albedo, normal and depth are averaged where all have them.

    The variance is Σ p_b² σ_b² of the shares p where all frames have one, else the sub-averages' own,
    Σ p_b (x_b − x)² / (B − 1), which is unbiased and, of two, off by about 140 % at every pixel. One frame
    alone stays as it is.

    Parameters
    ----------
    names : of the frames, for messages; by default frames[0] and so on.

    Raises
    ------
    ValueError
        If there is no frame, one is no single image, or sizes differ.
    """
    if not frames:
        raise ValueError("there are no frames: give the sub-averages of a render.")
    _check_images(frames, names or [f"frames[{n}]" for n in range(len(frames))])
    if all(frame.spp is not None for frame in frames):
        return _averaged(list(frames), None)
    # Not of JAX where nothing is known, so that it can be looked at under `jit`.
    shares: Any = np.full(len(frames), 1 / len(frames), np.float32)
    return _averaged(list(frames), shares)._replace(shares=shares)


@jax.jit
def _averaged(frames: list[Frame], shares: Array | None) -> SubAverages:
    """By the samples per pixel where no shares are given."""
    count, spp = len(frames), None
    if shares is None:
        spp = jnp.stack([jnp.asarray(frame.spp, jnp.float32) for frame in frames])
        shares = spp / spp.sum()
    sound = [repaired(frame) for frame in frames]
    means, differences = {}, {}
    for name in _DIFFERING:
        buffers = [getattr(frame, name) for frame in sound]
        if all(buffer is not None for buffer in buffers):
            means[name] = sum(p * b for p, b in zip(shares, buffers, strict=True))
            differences[name] = jnp.stack(buffers) - means[name]
    variances = [frame.variance for frame in sound]
    variance = None
    if all(v is not None for v in variances):
        variance = sum(p**2 * v for p, v in zip(shares, variances, strict=True))
    elif count > 1:
        variance = jnp.tensordot(shares, differences["color"] ** 2, 1) / (count - 1)
    whole = Frame(**means, variance=variance, spp=None if spp is None else spp.sum())
    return SubAverages(whole, differences, shares)


def nested(frames: Sequence[Frame]) -> list[Frame]:
    """What a growing render's frames hold beyond the one before, each as a frame of these samples alone.

    Parameters
    ----------
    frames : with rising samples per pixel, each with the samples of the one before, as `progden render` makes
        them; their variances unbiased. Bad pixels stay.

    Returns
    -------
    As many frames. Albedo, normal and depth, hardly noisy, are the last frame's. A single sample has no
    variance.

    Raises
    ------
    ValueError
        If samples per pixel or variances are lacking, do not rise, or the frames are no such series.

    Notes
    -----
    With a of n samples, x of N and m = N − n, the rest is r = (N x − n a)/m, and both sums of squares about
    the means and n m/N (r − a)² make up that of all (Chan, Golub, LeVeque 1983, eq. 2.1). Of N values that
    are split into n and m at random the expectation of the last term is 1/(N − 1) of the whole sum, whatever
    their distribution; in independent renders it is 1 + 2n/m times as large, or more, by which they are told.
    """
    _check_series(frames)
    last, found = frames[-1], [frames[0]]
    for before, frame in itertools.pairwise(frames):
        (n, a, squares_a), (total, x, squares) = _moments(before), _moments(frame)
        m = total - n
        rest = (total * x - n * a) / m
        apart = n * m / total * (rest - a) ** 2
        _refuse_independent(apart, squares, n, total)
        left = np.maximum(squares - squares_a - apart, 0)
        variance = None if m == 1 else np.asarray(left / (m * (m - 1)), np.float32)
        found.append(Frame(rest.astype(np.float32), variance, spp=m))
    shared = {name: getattr(last, name) for name in _DIFFERING if name != "color"}
    return [frame.replace(**shared) for frame in found]


def _check_images(frames: Sequence[Frame], names: Sequence[str]) -> None:
    for name, frame in zip(names, frames, strict=True):
        _checks.image(f"{name}.color", frame.color)
        _checks.same_shape(f"{name}.color", frame.color, f"{names[0]}.color", frames[0].color)


def _check_series(frames: Sequence[Frame]) -> None:
    _check_images(frames, [f"frames[{n}]" for n in range(len(frames))])
    for number, frame in enumerate(frames):
        if frame.spp is None or frame.variance is None:
            lacking = "samples per pixel" if frame.spp is None else "variance"
            raise ValueError(f"frames[{number}] has no {lacking}, which sub-averages follow from.")
    spp = [float(frame.spp) for frame in frames]
    if not spp or any(a >= b for a, b in itertools.pairwise(spp)):
        listed = ", ".join(f"{n:g}" for n in spp) or "none"
        raise ValueError(f"the frames have {listed} samples per pixel, expected rising ones.")


def _moments(frame: Frame) -> tuple[float, np.ndarray, np.ndarray]:
    """Samples, their mean, and the sum of squares about it, float64."""
    spp = float(frame.spp)
    color, variance = (np.asarray(b, np.float64) for b in (frame.color, frame.variance))
    return spp, color, variance * spp * (spp - 1)


def _refuse_independent(apart: np.ndarray, squares: np.ndarray, n: float, total: float) -> None:
    """Raise if apart is more than 1/(total − 1) of the squares on average, as in independent renders."""
    noisy = (squares > 0).all(-1)
    if not noisy.any():
        return
    # In a series no part is more than the whole; in other renders that would drown the mean.
    parts = np.minimum(apart[noisy] / squares[noisy], 1)
    ratios = (total - 1) * parts.mean(-1)
    error = ratios.std() / np.sqrt(ratios.size)
    if ratios.mean() - 1 > max(n / (total - n), 5 * error):
        raise ValueError(
            f"the frame of {total:g} samples per pixel does not go on from that of {n:g}, but is a render by "
            "itself: sub-averages take frames of one series, as `progden render` makes them."
        )


def cuts(counts: Iterable[int], total: int, parts: int) -> tuple[int, ...]:
    """Which counts divide `total` samples into so many parts that are as equal as can be.

    Parameters
    ----------
    counts : of samples, at which a growing render was kept; those from `total` up do not count.
    parts : one more than what is returned, in rising order.

    Raises
    ------
    ValueError
        If there are too few.
    """
    below = sorted({count for count in counts if count < total})
    if len(below) < parts - 1:
        listed = ", ".join(map(str, below)) or "none"
        raise ValueError(
            f"of fewer than {total} samples per pixel there are renders of {listed}, and {parts} "
            f"sub-averages take {parts - 1}: leave {total} out, or render the series with further counts."
        )

    def unequal(chosen: tuple[int, ...]) -> int:
        return sum((b - a) ** 2 for a, b in itertools.pairwise((0, *chosen, total)))

    return min(itertools.combinations(below, parts - 1), key=unequal)
