"""Collaborative first-order regression with non-local-means weights, in blocks of pixels.

Around every pixel p a linear model of the features is fitted to the image, each neighbour q counting by
w_pq = exp(−d_pq / k²), d_pq the distance of the patches around p and q in a guide. The model predicts all of p's
window, and what the models around a pixel predict for it is averaged with the same weights.

The weights of a block's pixels towards all that their windows reach form one matrix, so that moments and
predictions are matrix products. Blocks are mapped over in groups: weights exist for one group at a time. Inside,
images are channels-first.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

BLOCK = 8
"""Edge in pixels of a block."""

_GROUP = 32
"""Blocks side by side that are computed at once: some 6 MB per array of weights."""

_RELATIVE_NOISE = 1e-4
"""Differences of this share of the radiance count as noise, whatever the variance says."""

_LEAST = 1e-18
"""Squared radiance: keeps 0/0 out of distances between black pixels, and its square is no 0 in float32."""

_FAR = 1e4
"""A distance at which the weight is 0."""


@dataclasses.dataclass(frozen=True)
class Windows:
    """Which neighbours a pixel is compared to, and how.

    Attributes
    ----------
    radius : of the window, in pixels.
    patch : radius of the patches that are compared, in pixels.
    """

    radius: int
    patch: int

    @property
    def size(self) -> int:
        """Edge of a window."""
        return 2 * self.radius + 1

    @property
    def region(self) -> int:
        """Edge of what the windows of a block reach."""
        return BLOCK + 2 * self.radius

    @property
    def reach(self) -> int:
        """How far from a pixel a prediction for it can depend on the image."""
        return 2 * self.radius + self.patch


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
) -> Float[Array, "k h w c"]:
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
    Bitterli et al. 2016, sections 4 and 5.2. Distances as of Rousselle et al. 2012, Eq. 3, averaged over patch and
    channels, never below 0.
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
            return lax.dynamic_slice(
                of, begin, (of.shape[0], tall + 2 * halo, wide + 2 * halo)
            )

        near = part(compared, windows.radius + windows.patch)
        channels = guide.shape[-1]
        distances = patch_distances(near[:channels], near[channels:], windows)
        values = part(taken, windows.radius)
        return _predict(
            jnp.split(_blocks(values, windows), [image.shape[-1]], axis=1),
            _blocks(part(member, windows.radius), windows),
            _matrices(distances, windows),
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
    return jnp.moveaxis(sums[:, :-1] / weight, 1, -1)


def patch_distances(
    guide: Float[Array, "g y x"], variance: Float[Array, "g y x"], windows: Windows
) -> Float[Array, "dy dx h w"]:
    """Distance between the patches around each pixel and around its neighbours, by offset.

    The first and last radius + patch rows and columns are neighbours only.
    """
    radius, size = windows.radius, windows.size
    rows, columns = (n - 2 * radius for n in guide.shape[1:])
    here = (slice(None), slice(radius, radius + rows), slice(radius, radius + columns))
    values, noise = guide[here], variance[here]

    def of_row(dy: Array) -> Array:
        there, its_noise = (
            jnp.stack(
                [row[..., dx : dx + columns] for dx in range(size)]
            )
            for row in (lax.dynamic_slice_in_dim(a, dy, rows, 1) for a in (guide, variance))
        )
        difference = (values - there) ** 2 - (noise + jnp.minimum(noise, its_noise))
        level = _RELATIVE_NOISE**2 * (values**2 + there**2) + _LEAST
        pairs = (difference / (level + noise + its_noise)).mean(1)
        for axis in (-2, -1):
            # A barrier each, or the compiler computes sums of sums anew for every term.
            pairs = lax.optimization_barrier(pairs)
            pairs = _running_mean(pairs, axis, 2 * windows.patch + 1)
        return jnp.maximum(pairs, 0)

    return lax.map(of_row, jnp.arange(size))


def _running_mean(values: Array, axis: int, window: int) -> Array:
    length = values.shape[axis] - window + 1
    parts = (lax.slice_in_dim(values, n, n + length, axis=axis) for n in range(window))
    return functools.reduce(jnp.add, parts) / window


def _matrices(distances: Float[Array, "dy dx h w"], windows: Windows) -> Float[Array, "b p q"]:
    """Distances from each pixel p of a block to each pixel q of its region, far outside the window.

    With q counted row by row, going from p to the pixel on its right moves all neighbours by 1, and to
    the pixel below by the region's edge: rows of a matrix that are padded a little too long, and read at the
    right length.
    """
    size, edge = windows.size, windows.region
    length, blocks = edge**2, distances.shape[-1] // BLOCK
    d = distances.reshape(size, size, BLOCK, blocks, BLOCK).transpose(3, 2, 4, 0, 1)
    d = _pad_last(d, edge).reshape(blocks, BLOCK, BLOCK, size * edge)
    d = _pad_last(d, length + 1).reshape(blocks, BLOCK, BLOCK * (length + 1))
    d = _pad_last(d, BLOCK * length + edge).reshape(blocks, -1)
    return d[:, : BLOCK**2 * length].reshape(blocks, BLOCK**2, length)


def _pad_last(values: Array, length: int) -> Array:
    widths = [(0, 0)] * (values.ndim - 1) + [(0, length - values.shape[-1])]
    return jnp.pad(values, widths, constant_values=_FAR)


def _predict(
    values: list[Array],
    member: Float[Array, "b 1 q"],
    distances: Float[Array, "b p q"],
    bandwidths: tuple[float, ...],
    ridge: float,
    precision: Any,
) -> Float[Array, "k c+1 y x"]:
    """Sums of weighted predictions over a group's region, and of their weights as a last channel."""
    image, features = values
    count = jnp.maximum(member.sum(-1, keepdims=True), 1)
    # Centred per block, for float32 loses small covariances beside large means.
    features = features - (member * features).sum(-1, keepdims=True) / count
    model = jnp.concatenate((member, member * features), 1)
    order = model.shape[1]
    pairs = [(i, j) for i in range(order) for j in range(i, order)]
    products = [model[:, i] * model[:, j] for i, j in pairs]
    products += [model[:, i] * image[:, c] for i in range(order) for c in range(image.shape[1])]
    moments = jnp.stack(products, 1)
    centers = _centers(member)
    results = []
    for bandwidth in bandwidths:
        weights = jnp.exp(distances * (-1 / bandwidth**2))
        found = jnp.einsum("bmq,bpq->bmp", moments, weights, precision=precision)
        known = {pair: found[:, n] for n, pair in enumerate(pairs)}
        gram = jnp.stack(
            [
                jnp.stack([known[min(i, j), max(i, j)] for j in range(order)], 1)
                for i in range(order)
            ],
            1,
        )
        right = found[:, len(pairs) :].reshape(len(found), order, image.shape[1], -1)
        fits = solve_ridge(gram, right, ridge) * centers[:, None, None]
        fits = fits.reshape(len(fits), -1, fits.shape[-1])
        both = jnp.concatenate((fits, centers[:, None]), 1)
        spread = jnp.einsum("bmp,bpq->bmq", both, weights, precision=precision)
        at = spread[:, :-1].reshape(len(fits), order, image.shape[1], -1)
        predicted = (at * model[:, :, None]).sum(1)
        total = jnp.concatenate((predicted, member * spread[:, -1:]), 1)
        edge = round(member.shape[-1] ** 0.5)
        results.append(total.reshape(len(fits), -1, edge, edge))
    return _overlapped(jnp.stack(results, 1), 0, -1, BLOCK)


def _centers(member: Float[Array, "b 1 q"]) -> Float[Array, "b p"]:
    """Of the block's own pixels, in the middle of its region."""
    edge = round(member.shape[-1] ** 0.5)
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
    total = jnp.where(gram[:, 0, 0] > 0, gram[:, 0, 0], 1)
    first = (jnp.arange(order) == 0)[:, None]
    rows = jnp.arange(order)[:, None, None]
    gram = gram + jnp.eye(order)[:, :, None].astype(gram.dtype) * jnp.where(
        first, 0, ridge * total[:, None]
    )[:, :, None]
    system = jnp.concatenate((gram, right), 2)
    for j in range(order):
        least = total if j == 0 else ridge * total
        pivot = jnp.maximum(system[:, j, j], least)[:, None, None]
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
