"""What the layers of a network compute, one image at a time and channels last."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _amx
from progden_jax._amx_convolution import convolution
from progden_jax._convolution import same_convolution, upsampled_convolution
from progden_jax._upsampling import folded
from progden_jax.denoisers.nodes import BATCH, BATCH_EPSILON


class Moments(NamedTuple):
    """Mean and variance of each channel over a batch of images."""

    mean: Float[Array, " c"]
    variance: Float[Array, " c"]


class Weighted(NamedTuple):
    """What a `Filter` computed, which fixes its derivative."""

    weights: Float[Array, "h w taps"]
    image: Float[Array, "h w c"]
    result: Float[Array, "h w c"]


def convolve(layer: Any, x: Array, precision: Any, level: int) -> Array:
    kernel = jnp.asarray(layer["kernel"])
    value = same_convolution(x[None], kernel, precision, rows_together(level))[0]
    return value + layer["bias"] if "bias" in layer else value


def rows_together(level: int) -> int:
    """See `_amx.ALIGNED`."""
    return max(_amx.ALIGNED >> level, 1)


def folds(layer: Any, precision: Any) -> bool:
    """Where the upsampling joins the convolution that reads it. Untried on GPUs."""
    square = jnp.shape(layer["kernel"])[:2] == (3, 3)
    float32 = precision != "bfloat16" or _amx.planes(precision, layer["kernel"]) > 0
    return square and float32 and jax.default_backend() == "cpu"


def rectifies(layer: Any, precision: Any, like: Array) -> bool:
    """Where a convolution of such values takes its bias and ReLU along."""
    return _amx.planes(precision, layer["kernel"], like, layer.get("bias", like)) > 0


def convolve_rectified(
    layer: Any,
    low: Array | None,
    others: Sequence[Array],
    inside: Array | None,
    precision: Any,
    level: int,
) -> Array:
    """A convolution of `low`, upsampled, beside the others, and the ReLU that follows it."""
    kernel = jnp.asarray(layer["kernel"])
    coarse, split = (None, None), 0
    if low is not None:
        split = low.shape[-1]
        coarse = low[None], folded(kernel[:, :, :split])
    image = jnp.concatenate(others, axis=-1)[None] if others else None
    return convolution(
        *coarse,
        image,
        None if image is None else kernel[:, :, split:],
        planes=_amx.planes(precision, kernel),
        bias=layer.get("bias"),
        inside=None if inside is None else inside[None, :, :, 0].astype(jnp.uint8),
        relu=True,
        together=rows_together(level),
    )[0]


def convolve_upsampled(
    layer: Any, low: Array, others: Sequence[Array], precision: Any, level: int
) -> Array:
    h, w, _ = low.shape
    skip = jnp.concatenate(others, axis=-1) if others else jnp.zeros((2 * h, 2 * w, 0), low.dtype)
    kernel = jnp.asarray(layer["kernel"])
    together = rows_together(level)
    value = upsampled_convolution(low[None], skip[None], kernel, precision, together)[0]
    return value + layer["bias"] if "bias" in layer else value


def normalized(layer: Any, x: Array) -> tuple[Array, Moments]:
    mean = lax.pmean(x.mean((0, 1)), BATCH)
    variance = lax.pmean(((x - mean) ** 2).mean((0, 1)), BATCH)
    gain = layer["scale"] * lax.rsqrt(variance + BATCH_EPSILON)
    return (x - mean) * gain + layer["shift"], Moments(mean, variance)


def filtered(image: Array, logits: Array, size: int, mask: Array | None) -> Weighted:
    if mask is None:
        mask = jnp.ones((*image.shape[:2], 1), bool)
    border = ((size // 2,) * 2, (size // 2,) * 2, (0, 0))
    near = patches(jnp.pad(mask, border), size)[..., 0]
    weights = jax.nn.softmax(jnp.where(near, logits, jnp.finfo(logits.dtype).min), axis=-1)
    weights = jnp.where(mask, weights, 0)
    around = patches(jnp.pad(image, border), size)
    return Weighted(weights, image, (weights[..., None] * around).sum(-2))


def patches(x: Float[Array, "*b h w c"], size: int) -> Float[Array, "*b h2 w2 taps c"]:
    """The size×size pixels in raster order at every place where they all are inside x."""
    height, width = (n - size + 1 for n in x.shape[-3:-1])
    rows = jnp.stack([x[..., i : i + height, :, :] for i in range(size)], axis=-2)
    both = jnp.stack([rows[..., j : j + width, :, :] for j in range(size)], axis=-2)
    return both.reshape(*x.shape[:-3], height, width, size**2, x.shape[-1])


def children(x: Float[Array, "h w c"]) -> list[Float[Array, "h2 w2 c"]]:
    """The four values under each pixel of the next level, in raster order."""
    h, w, c = x.shape
    cells = x.reshape(h // 2, 2, w // 2, 2, c)
    return [cells[:, i, :, j] for i in (0, 1) for j in (0, 1)]


def max_pool(x: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    """The largest of each 2×2, whose derivative goes to the first of them in raster order on ties."""
    best, *others = children(x)
    for other in others:
        best = jnp.where(other > best, other, best)
    return best


def upsample(x: Float[Array, "h w c"]) -> Float[Array, "2h 2w c"]:
    """Each pixel repeated over 2×2."""
    h, w, c = x.shape
    return jnp.broadcast_to(x[:, None, :, None], (h, 2, w, 2, c)).reshape(2 * h, 2 * w, c)
