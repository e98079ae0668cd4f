"""The kernel of self-supervised post-correction: a noisy and a denoised image combined over a window.

All that belongs to one pixel is one array, its guides, (H, W, 13): noisy colour y, denoised colour z, albedo
ρ, normal n, and depth in the place of the paper's visibility, which renderers seldom write. Weights are made
and used one offset of the window at a time, in the derivative too.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._neighbourhood import Shifted, some_outputs, weighted_sums
from progden_jax.frame import Frame

GUIDES = {"noisy": 3, "denoised": 3, "albedo": 3, "normal": 3, "depth": 1}
"""Their channels, in order."""

CHANNELS = sum(GUIDES.values())

_RADIANCE = slice(0, 2)
"""Guides whose squared differences are taken by their logarithm."""

_EPSILON = 1e-4

_LEAST = 1e-6
"""Weight that every pixel has for itself besides: where all others vanish, derivatives must not overflow."""

Weigh = Callable[[Array, Float[Array, "5 h w"]], Float[Array, "h w"]]
"""From an offset's number in raster order and the squared distances of the guides there to its weight."""


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
    # The last that is summed is 1 inside the image: it sums the weights. Depth only weighs.
    ones = jnp.ones_like(guides[..., :1])
    planes = jnp.concatenate([guides[..., :-1], ones, guides[..., -1:]], axis=-1).transpose(2, 0, 1)

    def weights_of(index: Array, shifted: Shifted) -> Array:
        squares = (shifted(index) - planes) ** 2
        distances = jnp.concatenate([squares[: CHANNELS - 1], squares[CHANNELS:]])
        return weigh(index, jnp.stack(list(_by_guide(distances))))[None]

    total = weighted_sums(planes, weights_of, window=window, summed=CHANNELS)
    total = total + _LEAST * planes[:CHANNELS]
    means = (total[:-1] / total[-1]).transpose(1, 2, 0)
    differences = guides[..., 3:12] - means[..., 3:]
    if scales is None:
        return means[..., :3] + differences[..., :3]
    scaled = scales * differences
    return means[..., :3] + scaled[..., :3] + scaled[..., 3:6] + scaled[..., 6:]


def _by_guide(squares: Float[Array, "13 h w"]) -> Iterator[Float[Array, "h w"]]:
    start = 0
    for channels in GUIDES.values():
        yield squares[start : start + channels].sum(0)
        start += channels


def bilateral(
    bandwidths: Float[Array, "h w 5"], center: Float[Array, "h w 1"], *, window: int
) -> Weigh:
    """Weights that fall with the distance of the guides, one bandwidth γ each; the centre's is its own, τ.

    Squared distances of radiance count by log(1 + ·). Back et al. 2022, Eq. 11.
    """
    falloff = (1 / (bandwidths**2 + _EPSILON)).transpose(2, 0, 1)

    def weigh(index: Array, squared: Array) -> Array:
        distances = squared.at[_RADIANCE].set(jnp.log1p(squared[_RADIANCE]))
        weight = jnp.exp(-(distances * falloff).sum(0))
        return jnp.where(index == window**2 // 2, center[..., 0], weight)

    return weigh


def predicted(
    features: Float[Array, "h w c"], kernel: Float[Array, "k k c n"], bias: Float[Array, " n"]
) -> Weigh:
    """Weights that a network's last layer predicts, one output per offset, through a softplus."""

    def weigh(index: Array, squared: Array) -> Array:
        del squared
        return jax.nn.softplus(some_outputs(features[None], kernel, bias, index, 1)[0, 0])

    return weigh
