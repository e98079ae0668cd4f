"""The kernel of self-supervised post-correction: a noisy and a denoised image combined over a window.

All that belongs to one pixel is one array, its guides, (H, W, 13): noisy colour y, denoised colour z, albedo
ρ, normal n, and depth in the place of the paper's visibility, which renderers seldom write. Weights are made
and used a few offsets of the window at a time, in the derivative too.
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._neighbourhood import some_outputs
from progden_jax.frame import Frame

GUIDES = {"noisy": 3, "denoised": 3, "albedo": 3, "normal": 3, "depth": 1}
"""Their channels, in order."""

CHANNELS = sum(GUIDES.values())

_RADIANCE = 2
"""So many first guides whose squared differences are taken by their logarithm."""

_EPSILON = 1e-4

_LEAST = 1e-6
"""Weight that every pixel has for itself besides: where all others vanish, derivatives must not overflow."""

_UNROLLED = 4
"""Offsets whose sums XLA makes together, each in its own loop else."""

Weigh = Callable[[Array, Sequence[Array]], Float[Array, "h w"]]
"""From an offset's number in raster order and the squared distances (H, W) of the five guides there to its
weight."""


class Units(NamedTuple):
    """What guides are measured in: means over a whole render, so that bandwidths and rates suit any."""

    radiance: Float[Array, ""]
    depth: Float[Array, ""]


def units_of(frame: Frame) -> Units:
    """The mean radiance and depth; 1 for what is 0 or not there."""

    def mean(buffer: Array | None) -> Array:
        found = jnp.ones(()) if buffer is None else jnp.maximum(buffer, 0).mean()
        return jnp.where(found > 0, found, 1)

    return Units(mean(frame.color), mean(frame.depth))


def guides_of(
    frame: Frame, denoised: Float[Array, "h w 3"], units: Units
) -> Float[Array, "h w 13"]:
    """The guides of a frame; a buffer that it lacks is 0.

    Raises
    ------
    ValueError
        If the denoised image is not of the frame's size.
    """
    _checks.image("frame.color", frame.color)
    _checks.same_shape("denoised", denoised, "frame.color", frame.color)
    found = {
        "noisy": frame.color / units.radiance,
        "denoised": denoised / units.radiance,
        "albedo": frame.albedo,
        "normal": frame.normal,
        "depth": None if frame.depth is None else frame.depth / units.depth,
    }
    parts = []
    for name, channels in GUIDES.items():
        buffer = found[name]
        empty = jnp.zeros((*frame.size, channels), frame.color.dtype)
        parts.append(empty if buffer is None else buffer)
    return jnp.concatenate(parts, axis=-1)


def combine(
    guides: Float[Array, "h w 13"],
    weigh: Weigh,
    *,
    scales: Float[Array, "h w 9"] | None = None,
    window: int = 19,
) -> Float[Array, "h w 3"]:
    """g = Σ w_i (y_i + β_z(z − z_i) + β_ρ(ρ − ρ_i) + β_n(n − n_i)) / Σ w_i over the window inside the image.

    Parameters
    ----------
    guides : (H, W, 13), see `guides_of`.
    weigh : gives the weights w_i ≥ 0, see `bilateral` and `predicted`.
    scales : β of denoised colour, albedo and normal, three channels each; None stands for 1, 0 and 0.
    window : odd width in pixels.

    Notes
    -----
    Back et al. 2022, Eq. 10, and with no scales Eq. 3. The scales belong to the centre, so that they leave
    the sum: g = ȳ + Σ β(b − b̄) over the buffers b with weighted means b̄. Memory does not grow with the
    window.
    """
    _checks.image("guides", guides, channels=CHANNELS)
    _checks.odd_int("window", window)
    # Each channel by itself: joined ones XLA tells apart value by value.
    centers = [guides[..., n] for n in range(CHANNELS)]
    # Depth only weighs; what stands after the others is 1 inside the image, and so sums the weights.
    summed = [*centers[:-1], jnp.ones_like(centers[0])]
    border = window // 2
    padded = [jnp.pad(plane, border) for plane in [*summed, centers[-1]]]

    @jax.checkpoint
    def part(index: Array) -> list[Array]:
        corner = (index // window, index % window)
        there = [jax.lax.dynamic_slice(plane, corner, guides.shape[:2]) for plane in padded]
        pairs = zip([*there[:-2], there[-1]], centers, strict=True)
        squares = iter([(a - b) ** 2 for a, b in pairs])
        squared = [_total(itertools.islice(squares, n)) for n in GUIDES.values()]
        weight = weigh(index, squared)
        return [weight * plane for plane in there[:-1]]

    def add(total: list[Array], index: Array) -> tuple[list[Array], None]:
        return jax.tree.map(jnp.add, total, part(index)), None

    start = [_LEAST * plane for plane in summed]
    *sums, weights = jax.lax.scan(add, start, jnp.arange(window**2), unroll=_UNROLLED)[0]
    means = jnp.stack([plane / weights for plane in sums], axis=-1)
    differences = guides[..., 3:12] - means[..., 3:]
    if scales is None:
        return means[..., :3] + differences[..., :3]
    scaled = scales * differences
    return means[..., :3] + scaled[..., :3] + scaled[..., 3:6] + scaled[..., 6:]


def _total(parts: Iterable[Array]) -> Array:
    return functools.reduce(jnp.add, parts)


def bilateral(
    bandwidths: Float[Array, "h w 5"], center: Float[Array, "h w 1"], *, window: int
) -> Weigh:
    """Weights that fall with the distance of the guides, one bandwidth γ each; the centre's is its own, τ.

    Squared distances of radiance count by log(1 + ·). Back et al. 2022, Eq. 11.
    """
    falloff = [1 / (bandwidths[..., n] ** 2 + _EPSILON) for n in range(len(GUIDES))]

    def weigh(index: Array, squared: Sequence[Array]) -> Array:
        radiance, others = squared[:_RADIANCE], squared[_RADIANCE:]
        distances = [*(jnp.log1p(s) for s in radiance), *others]
        exponent = _total(d * f for d, f in zip(distances, falloff, strict=True))
        return jnp.where(index == window**2 // 2, center[..., 0], jnp.exp(-exponent))

    return weigh


def predicted(
    features: Float[Array, "h w c"], kernel: Float[Array, "k k c n"], bias: Float[Array, " n"]
) -> Weigh:
    """Weights that a network's last layer predicts, one output per offset, through a softplus."""

    def weigh(index: Array, squared: Sequence[Array]) -> Array:
        del squared
        return jax.nn.softplus(some_outputs(features[None], kernel, bias, index, 1)[0, 0])

    return weigh
