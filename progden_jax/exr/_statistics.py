"""The variance of the pixel mean from what a renderer writes: names never tell what a variance
means.

Everything is computed in float64 and returned in float32. Values are not repaired: NaN stays NaN.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from progden_jax.exr._file import ExrError

MEANINGS = ("mean", "samples", "std", "second-moment")
"""What the file's variance channels can be declared to hold."""

_ATTRIBUTES = ("samplesperpixel", "spp", "samplecount", "samples")
_CYCLES = re.compile(r"cycles\.(.*)\.samples")


def from_samples(variance: np.ndarray, spp: float) -> np.ndarray:
    """Var[mean] = Var[samples] / spp, for a `variance` with Bessel's correction, as pbrt's."""
    return (variance.astype(np.float64) / spp).astype(np.float32)


def from_std(deviation: np.ndarray) -> np.ndarray:
    """The square of the standard deviation of the mean."""
    return np.square(deviation.astype(np.float64)).astype(np.float32)


def from_moments(first: np.ndarray, second: np.ndarray, spp: float) -> tuple[np.ndarray, int]:
    """Var[mean] = max(m2 − m1², 0) / (spp − 1), and how many values rounding had made negative.

    m2 − m1² is the samples' variance about their own mean, which is low by (spp − 1)/spp; Bessel's
    factor spp/(spp − 1) makes it unbiased, and the mean of spp samples has 1/spp of it. With one
    sample the difference is zero and so is the result.
    """
    spread = second.astype(np.float64) - np.square(first.astype(np.float64))
    negative = int((spread < 0).sum())
    return (np.maximum(spread, 0) / max(spp - 1, 1)).astype(np.float32), negative


def from_renders(renders: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean of n ≥ 2 independent renders of equal spp, and its variance Σ (x_i − mean)² / (n (n −
    1)).

    For two it is (A − B)²/4. Unbiased, but with n − 1 degrees of freedom it is very noisy itself:
    its relative standard deviation is sqrt(2/(n − 1)) under Gaussian noise, 141 % for two renders.
    """
    total = np.stack([r.astype(np.float64) for r in renders])
    n = len(renders)
    with np.errstate(invalid="ignore"):  # inf − inf is NaN, which the frame's repair counts
        mean = total.mean(0)
        variance = np.square(total - mean).sum(0) / (n * (n - 1))
    return mean.astype(np.float32), variance.astype(np.float32)


def uncertainty(count: int) -> list[str]:
    """Warnings of a variance from so few renders."""
    if count >= 4:
        return []
    percent = 100 * (2 / (count - 1)) ** 0.5
    return [
        f"a variance from {count} renders is itself off by about {percent:.0f} % at every pixel"
    ]


def are_halves(
    color: np.ndarray, renders: list[np.ndarray], shares: np.ndarray | None = None
) -> bool:
    """Whether `color` is the mean of `renders` up to rounding, small beside how they differ.

    `shares` weigh the renders; None: equally.
    """
    if len(renders) < 2:
        return False
    total = np.stack([r.astype(np.float64) for r in renders])
    finite = np.isfinite(total).all(0) & np.isfinite(color)
    total, color = total[:, finite], color[finite].astype(np.float64)
    # Magnitudes compressed, so that no firefly decides alone; both sides of the comparison are.
    scale = np.maximum(np.abs(total).max(0, initial=0), 1e-12)
    mean = np.average(total, axis=0, weights=shares)
    off = np.square((mean - color) / scale).sum()
    spread = np.square((total - mean) / scale).sum() / len(renders)
    return bool(off <= 0.01 * spread)


def check_spp(spp: Any) -> None:
    """Raise unless `spp` is None or a positive finite number."""
    if spp is None:
        return
    number = isinstance(spp, (int, float, np.integer, np.floating)) and not isinstance(spp, bool)
    if not number or not math.isfinite(spp) or spp <= 0:
        raise ExrError(f"spp (--spp) is {spp!r}, expected a positive number of samples per pixel.")


def find_spp(
    stem: str, header: Mapping[str, Any], view_layer: str = ""
) -> tuple[float | None, str]:
    """Samples per pixel by the file's attributes, else by its name (NAME_000064spp), and which it
    was.

    Attributes: samplesPerPixel (pbrt, this package) and its like, and Cycles'
    cycles.VIEWLAYER.samples.
    """
    found: list[tuple[float, str]] = []
    for name, value in header.items():
        cycles = _CYCLES.fullmatch(name)
        wanted = view_layer in ("", cycles[1]) if cycles else name.lower() in _ATTRIBUTES
        number = _number(value) if wanted else None
        if number is not None:
            found.append((number, f"attribute {name}"))
    if len({number for number, _ in found}) == 1:
        return found[0]
    match = re.search(r"_(\d{1,9})spp$", stem, re.IGNORECASE)
    if match and int(match[1]) > 0:
        return int(match[1]), "the file's name"
    return None, ""


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    if not math.isfinite(number) or number <= 0:
        return None
    return int(number) if number.is_integer() else number
