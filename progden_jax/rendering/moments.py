"""Means and variances of samples that arrive in batches, in float64."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

AUXILIARY = 7
"""Channels of what goes with the radiance: albedo (3), normal (3), depth (1)."""


class Moments(NamedTuple):
    """What `spp` samples per pixel say; immutable, so that an interrupt finds it whole.

    `mean` and `squares` (sums of squared deviations from it) are (H, W, 3) of radiance, `auxiliary` is
    the mean of (H, W, 7) albedo, normal and depth, all float64; `discarded` counts samples that were
    not finite, which stand as black.
    """

    spp: int
    mean: Float[np.ndarray, "h w 3"]
    squares: Float[np.ndarray, "h w 3"]
    auxiliary: Float[np.ndarray, "h w 7"]
    discarded: int = 0

    @property
    def variance(self) -> Float[np.ndarray, "h w 3"]:
        """Of the mean, unbiased; needs two samples."""
        return self.squares / (self.spp * (self.spp - 1))


def none(height: int, width: int) -> Moments:
    """Of no samples."""
    rgb = np.zeros((height, width, 3))
    return Moments(0, rgb, rgb, np.zeros((height, width, AUXILIARY)))


def add(
    moments: Moments,
    radiance: Float[np.ndarray, "n h w 3"],
    auxiliary: Float[np.ndarray, "n h w 7"] | None = None,
) -> Moments:
    """With n more samples of every pixel (Chan, Golub, LeVeque 1983, eq. 2.1).

    Samples that are all equal keep a sum of squares of exactly zero.
    """
    bad = ~np.isfinite(radiance).all(-1)
    samples = radiance.astype(np.float64)
    discarded = int(np.count_nonzero(bad))
    if discarded:
        samples[bad] = 0
    n = len(samples)
    total = moments.spp + n
    mean = samples.mean(0)
    samples -= mean
    samples *= samples
    shift = mean - moments.mean
    aux = moments.auxiliary
    if auxiliary is not None:
        aux = aux + (auxiliary.sum(0, dtype=np.float64) - n * aux) / total
    return Moments(
        total,
        moments.mean + shift * (n / total),
        moments.squares + samples.sum(0) + shift * shift * (moments.spp * (n / total)),
        aux,
        moments.discarded + discarded,
    )
