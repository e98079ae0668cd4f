"""Collaborative first-order regression with non-local-means weights, in blocks of pixels.

Around every pixel p a linear model of the features is fitted to the image, each neighbour q counting by
w_pq = exp(−d_pq / k²), d_pq the distance of the patches around p and q in a guide. The model predicts all of
p's window, and what the models around a pixel predict for it is averaged with the same weights.

The weights of a block's pixels towards all that their windows reach form one matrix, so that moments and
predictions are matrix products. Blocks are mapped over in groups: weights exist for one group at a time.
Inside, images are channels-first.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from progden_jax.denoisers._patches import BLOCK, Windows, matrices, patch_distances

_GROUP = 32
"""Blocks side by side that are computed at once: some 6 MB per array of weights."""


class Regression(NamedTuple):
    """The filtered images, and how far each pixel depends on itself, by bandwidth.

    Attributes
    ----------
    image : (K, H, W, C).
    leverage : (K, H, W) the derivative of a pixel's value by its own input, all weights constant; a constant
        in derivatives itself.
    """

    image: Float[Array, "k h w c"]
    leverage: Float[Array, "k h w"]


def regress(
    image: Float[Array, "h w c"],
    features: Float[Array, "h w f"],
    guide: Float[Array, "h w g"],
    variance: Float[Array, "h w g"],
    inside: Bool[Array, "h w"],
    *,
    windows: Windows,
    bandwidths: tuple[float, ...],
    ridge: float,
    precision: Any = "highest",
) -> Regression:
    """The image as the models of its neighbourhoods predict it, for every bandwidth.

    Parameters
    ----------
    image : (H, W, C) what is filtered; the result is linear in it but for the guide.
    features : (H, W, F) what it is modelled by, F may be 0: then the models are constants.
    guide : (H, W, G) what patches are compared in.
    variance : (H, W, G) of the guide, at least 0.
    inside : (H, W) False where the image is padding, whose values must repeat the image's border.
    windows : see `Windows`.
    bandwidths : k of the weights; more smooth more.
    ridge : λ, added to the features' weighted covariance: features that spread less than √λ in a window
        hardly count.
    precision : of the matrix products.

    Notes
    -----
    Bitterli et al. 2016, sections 4 and 5.2. Distances are those of Rousselle et al. 2012,
    averaged over patch and channels, never below 0.
    """
    height, width = inside.shape
    group = min(_GROUP, -(-width // BLOCK))
    tall, wide = BLOCK, BLOCK * group
    rows, columns = -(-height // tall), -(-width // wide)
    fill = ((0, rows * tall - height), (0, columns * wide - width))
    member = _extended(inside[None].astype(image.dtype), windows.radius, fill, mode="constant")
    taken = _extended(_first(jnp.concatenate((image, features), -1)), windows.radius, fill)
    compared = _extended(
        _first(jnp.concatenate((guide, variance), -1)), windows.radius + windows.patch, fill
    )

    # Recomputed in reverse mode: a group's weights are not to be kept for all groups.
    @jax.checkpoint
    def one(index: Array) -> Array:
        begin = (0, index // columns * tall, index % columns * wide)

        def part(of: Array, halo: int) -> Array:
            return lax.dynamic_slice(of, begin, (of.shape[0], tall + 2 * halo, wide + 2 * halo))

        near = part(compared, windows.radius + windows.patch)
        channels = guide.shape[-1]
        distances = patch_distances(near[:channels], near[channels:], windows)
        values = _blocks(part(taken, windows.radius), windows)
        return _predict(
            values[:, : image.shape[-1]],
            values[:, image.shape[-1] :],
            _blocks(part(member, windows.radius), windows),
            matrices(distances),
            bandwidths,
            ridge,
            precision,
        )

    sums = lax.map(one, jnp.arange(rows * columns))
    sums = sums.reshape(rows, columns, *sums.shape[1:])
    sums = _overlapped(_overlapped(sums, 1, -1, wide), 0, -2, tall)
    r = windows.radius
    sums = sums[:, :, r : r + height, r : r + width]
    weight = jnp.where(inside, sums[:, -1:], 1)
    *predicted, leverage = jnp.moveaxis(sums[:, :-1] / weight, 1, 0)
    return Regression(jnp.stack(predicted, -1), leverage)


def _predict(
    image: Float[Array, "b c q"],
    features: Float[Array, "b f q"],
    member: Float[Array, "b 1 q"],
    distances: Float[Array, "b p q"],
    bandwidths: tuple[float, ...],
    ridge: float,
    precision: Any,
) -> Float[Array, "k m y x"]:
    """Sums over a group's region: of weighted predictions, of their leverages, and of the weights."""
    blocks, channels, pixels = image.shape
    count = jnp.maximum(member.sum(-1, keepdims=True), 1)
    # Centred per block, for float32 loses small covariances beside large means.
    features = features - (member * features).sum(-1, keepdims=True) / count
    model = jnp.concatenate((member, member * features), 1)
    order = model.shape[1]
    upper = np.triu_indices(order)
    where = np.zeros((order, order), int)
    where[upper] = where[upper[::-1]] = np.arange(len(upper[0]))
    products = model[:, upper[0]] * model[:, upper[1]]
    moments = (model[:, :, None] * image[:, None]).reshape(blocks, -1, pixels)
    moments = jnp.concatenate((products, moments), 1)
    own = _centers(member)
    unit = jnp.broadcast_to(
        jnp.eye(order, dtype=image.dtype)[..., None], (order, order, own.shape[1])
    )
    twice = np.where(upper[0] == upper[1], 1, 2).astype(image.dtype)[:, None]

    def of(bandwidth: Array) -> Array:
        weights = jnp.exp(distances * (-1 / bandwidth**2))
        found = jnp.einsum("bmq,bpq->bmp", moments, weights, precision=precision)
        right = found[:, products.shape[1] :].reshape(blocks, order, channels, -1)
        right = jnp.concatenate((right, jnp.broadcast_to(unit, (blocks, *unit.shape))), 2)
        solved = solve_ridge(found[:, where], right, ridge) * own[:, None, None]
        fits = solved[:, :, :channels].reshape(blocks, order * channels, -1)
        inverse = solved[:, upper[0], channels + upper[1]] * twice
        spread = jnp.einsum(
            "bmp,bpq->bmq",
            jnp.concatenate((fits, own[:, None]), 1),
            weights,
            precision=precision,
        )
        at = spread[:, :-1].reshape(blocks, order, channels, pixels)
        predicted = (at * model[:, :, None]).sum(1)
        inverse, fixed = lax.stop_gradient((inverse, weights))
        squares = jnp.einsum("bmp,bpq->bmq", inverse, fixed**2, precision=precision)
        leverage = (squares * products).sum(1, keepdims=True)
        return jnp.concatenate((predicted, leverage, member * spread[:, -1:]), 1)

    edge = math.isqrt(pixels)
    parts = lax.map(of, jnp.asarray(bandwidths, image.dtype))
    return _overlapped(parts.reshape(*parts.shape[:3], edge, edge), 1, -1, BLOCK)


def _centers(member: Float[Array, "b 1 q"]) -> Float[Array, "b p"]:
    """Of the block's own pixels, in the middle of its region."""
    edge = math.isqrt(member.shape[-1])
    begin = (edge - BLOCK) // 2
    cut = slice(begin, begin + BLOCK)
    return member.reshape(-1, edge, edge)[:, cut, cut].reshape(-1, BLOCK**2)


def solve_ridge(
    gram: Float[Array, "b n n p"], right: Float[Array, "b n c p"], ridge: float
) -> Float[Array, "b n c p"]:
    """Coefficients of the weighted least squares, from its normal equations, for many pixels at once.

    The first of n is the constant, whose own entry is the sum of the weights; λ times that is added for
    all others. Elimination in order needs no pivoting: eliminated covariances stay above λ but for rounding,
    and are held there.
    """
    order = gram.shape[1]
    # A pixel weighs itself with 1; less is padding, whose squares could underflow.
    total = jnp.where(gram[:, 0, 0] >= 1, gram[:, 0, 0], 1)
    first = (jnp.arange(order) == 0)[:, None]
    rows = jnp.arange(order)[:, None, None]
    gram = (
        gram
        + jnp.eye(order)[:, :, None].astype(gram.dtype)
        * jnp.where(first, 0, ridge * total[:, None])[:, :, None]
    )
    system = jnp.concatenate((gram, right), 2)
    for j in range(order):
        pivot = total if j == 0 else jnp.maximum(system[:, j, j], ridge * total)
        pivot = pivot[:, None, None]
        scaled = system[:, j : j + 1] / pivot
        system = jnp.where(rows == j, scaled, system - system[:, :, j : j + 1] * scaled)
    return system[:, :, order:]


def _first(image: Array) -> Array:
    return jnp.moveaxis(image, -1, 0)


def _extended(image: Array, halo: int, fill: Any, mode: Any = "edge") -> Array:
    widths = [(0, 0), *((halo, after + halo) for _, after in fill)]
    return jnp.pad(image, widths, mode=mode)


def _blocks(part: Float[Array, "c y x"], windows: Windows) -> Float[Array, "b c q"]:
    """The regions of a group's blocks, side by side, which overlap."""
    channels, edge = len(part), windows.region
    blocks = (part.shape[2] - 2 * windows.radius) // BLOCK
    steps = -(-edge // BLOCK)
    padded = jnp.pad(part, ((0, 0), (0, 0), (0, (blocks + steps - 1) * BLOCK - part.shape[2])))
    cells = padded.reshape(channels, edge, -1, BLOCK).transpose(2, 0, 1, 3)
    found = jnp.concatenate([cells[n : n + blocks] for n in range(steps)], -1)
    return found[..., :edge].reshape(blocks, channels, edge**2)


def _overlapped(parts: Array, among: int, along: int, stride: int) -> Array:
    """Sum of parts that lie `stride` apart along an axis and overlap; axis `among` counts them and goes."""
    parts = jnp.moveaxis(parts, (among, along), (0, 1))
    number, length, rest = parts.shape[0], parts.shape[1], parts.shape[2:]
    steps = -(-length // stride)
    parts = jnp.pad(parts, [(0, 0), (0, steps * stride - length)] + [(0, 0)] * len(rest))
    parts = parts.reshape(number, steps, stride, *rest)
    none = [(0, 0)] * (1 + len(rest))
    total = functools.reduce(
        jnp.add,
        (jnp.pad(parts[:, n], [(n, steps - 1 - n), *none]) for n in range(steps)),
    )
    return jnp.moveaxis(total.reshape(-1, *rest), 0, along)
