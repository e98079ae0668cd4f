"""Convolution whose derivative by the kernel is fast on CPUs too."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

_LAYOUT = ("NHWC", "HWIO", "NHWC")
_STRIP = 1024
"""Pixels whose columns are made at once: few enough for them to stay in a core's cache."""


def convolve(inputs: Array, kernel: Array, *arguments: Any, **settings: Any) -> Array:
    """``lax.conv_general_dilated`` as flax calls it; plain odd-sized ones get `same_convolution`."""
    strides, padding, *_ = (*arguments, None, None)
    dilated = any(d != 1 for name in settings if "dilation" in name for d in settings[name])
    plain = (
        inputs.ndim == 4
        and padding == "SAME"
        and tuple(strides or (1, 1)) == (1, 1)
        and not dilated
        and settings.get("feature_group_count", 1) == 1
        and all(n % 2 for n in kernel.shape[:2])
    )
    if plain:
        return same_convolution(inputs, kernel, settings.get("precision"))
    return lax.conv_general_dilated(inputs, kernel, *arguments, **settings)


def _convolve(inputs: Array, kernel: Array, precision: Any) -> Array:
    return lax.conv_general_dilated(
        inputs, kernel, (1, 1), "SAME", dimension_numbers=_LAYOUT, precision=precision
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def same_convolution(
    inputs: Float[Array, "n h w ci"],
    kernel: Float[Array, "kh kw ci co"],
    precision: lax.PrecisionLike = None,
) -> Float[Array, "n h w co"]:
    """Convolution with zero padding to the same size; kernel sides must be odd.

    XLA makes the derivative by the kernel a convolution with a kernel as large as the image, which runs on
    CPUs at a fifth to a tenth of the forward pass's speed. There it is matrix products here.
    """
    return _convolve(inputs, kernel, precision)


@functools.partial(same_convolution.defjvp, symbolic_zeros=True)
def _jvp(
    precision: Any, primals: tuple[Array, Array], tangents: tuple[Any, Any]
) -> tuple[Array, Array]:
    (inputs, kernel), (by_inputs, by_kernel) = primals, tangents
    out = same_convolution(inputs, kernel, precision)
    slope = jnp.zeros_like(out)
    if not isinstance(by_inputs, SymbolicZero):
        slope = slope + same_convolution(by_inputs, kernel, precision)
    if not isinstance(by_kernel, SymbolicZero):
        along = _by_products if jax.default_backend() == "cpu" else _convolve
        slope = slope + along(inputs, by_kernel, precision)
    return out, slope


def _by_products(inputs: Array, kernel: Array, precision: Any) -> Array:
    """The convolution again, in a form whose transpose by the kernel is a few products per strip of rows."""
    (kh, kw, ci, co), (n, h, w, _) = kernel.shape, inputs.shape
    height = max(d for d in range(1, h + 1) if h % d == 0 and d * w <= max(w, _STRIP))
    strips = h // height
    padded = jnp.pad(inputs, ((0, 0), (kh // 2,) * 2, (kw // 2,) * 2, (0, 0)))
    # With few channels all taps are one product, else each row of them, which copies less.
    parts = 1 if ci < 32 else kh
    blocks = kernel.reshape(parts, -1, co)

    @jax.checkpoint  # else the columns of all strips are kept
    def one(strip: Array, blocks: Array) -> Array:
        start = (strip // strips, strip % strips * height, 0, 0)
        size = (1, height + kh - 1, w + kw - 1, ci)
        rows = lax.dynamic_slice(padded, start, size)[0]
        if parts == 1:
            taps = [rows[i : i + height, j : j + w] for i in range(kh) for j in range(kw)]
            columns = [jnp.concatenate(taps, axis=-1)]
        else:
            wide = jnp.concatenate([rows[:, j : j + w] for j in range(kw)], axis=-1)
            columns = [wide[i : i + height] for i in range(kh)]
        flat = sum(
            jnp.matmul(c.reshape(height * w, -1), b, precision=precision)
            for c, b in zip(columns, blocks, strict=True)
        )
        return jnp.reshape(flat, (height, w, co))

    return lax.map(lambda strip: one(strip, blocks), jnp.arange(n * strips)).reshape(n, h, w, co)
