"""Convolution whose derivative by the kernel is fast on CPUs too."""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen.dtypes import promote_dtype
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from progden_jax import _amx
from progden_jax._amx_convolution import convolution
from progden_jax._kernel_products import by_products
from progden_jax._upsampling import corners, folded, of_cells, repeated

_LAYOUT = ("NHWC", "HWIO", "NHWC")


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


_VECTOR = 4
"""Eigen, which convolves on CPUs, gathers a kernel's inputs in vectors only if these divide the channels."""


def _convolve(inputs: Array, kernel: Array, precision: Any, together: int = _amx.ALIGNED) -> Array:
    missing = -inputs.shape[-1] % _VECTOR
    if kernel.shape[:2] == (1, 1):
        return jnp.matmul(inputs, kernel[0, 0], precision=_of_products(precision))
    if planes := _amx.planes(precision, kernel, inputs):
        return convolution(None, None, inputs, kernel, planes=planes, together=together)
    if precision == "bfloat16":
        return lax.conv_general_dilated(
            *(inputs.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16), (1, 1), "SAME"),
            dimension_numbers=_LAYOUT,
            preferred_element_type=inputs.dtype,
        )
    if missing and jax.default_backend() == "cpu":
        inputs = jnp.pad(inputs, ((0, 0), (0, 0), (0, 0), (0, missing)))
        kernel = jnp.pad(kernel, ((0, 0), (0, 0), (0, missing), (0, 0)))
    return lax.conv_general_dilated(
        inputs, kernel, (1, 1), "SAME", dimension_numbers=_LAYOUT, precision=precision
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def same_convolution(
    inputs: Float[Array, "n h w ci"],
    kernel: Float[Array, "kh kw ci co"],
    precision: lax.PrecisionLike = None,
    together: int = _amx.ALIGNED,
) -> Float[Array, "n h w co"]:
    """Convolution with zero padding to the same size; kernel sides must be odd.

    Parts of an image get the same bits where they begin at multiples of `together` rows.

    XLA makes the derivative by the kernel a convolution with a kernel as large as the image, which runs on
    CPUs at a fifth to a tenth of the forward pass's speed. There it is matrix products here.
    """
    return _convolve(inputs, kernel, precision, together)


@functools.partial(same_convolution.defjvp, symbolic_zeros=True)
def _jvp(
    precision: Any, together: int, primals: tuple[Array, Array], tangents: tuple[Any, Any]
) -> tuple[Array, Array]:
    (inputs, kernel), (by_inputs, by_kernel) = primals, tangents
    out = same_convolution(inputs, kernel, precision, together)
    slopes = []
    if not isinstance(by_inputs, SymbolicZero):
        slopes.append(same_convolution(by_inputs, kernel, precision, together))
    if not isinstance(by_kernel, SymbolicZero):
        along = by_products if jax.default_backend() == "cpu" else _convolve
        slopes.append(along(inputs, by_kernel, _of_products(precision)))
    return out, _total(slopes, out)


def rectified_convolution(
    inputs: Float[Array, "*b h w ci"],
    kernel: Float[Array, "kh kw ci co"],
    bias: Float[Array, " co"],
    *,
    plus: Float[Array, "*b h w co"] | None = None,
    inside: Bool[Array, "h w 1"] | None = None,
    precision: Any = None,
) -> Float[Array, "*b h w co"]:
    """The ReLU of `same_convolution` and a bias, and of what is given to add, zero where not inside."""
    images = inputs.reshape(-1, *inputs.shape[-3:])
    if plus is not None:
        plus = plus.reshape(-1, *plus.shape[-3:])
    others = (images, bias) if plus is None else (images, bias, plus)
    if planes := _amx.planes(precision, kernel, *others):
        there = None if inside is None else inside[None, :, :, 0].astype(jnp.uint8)
        settings: dict[str, Any] = {"bias": bias, "plus": plus, "inside": there, "relu": True}
        out = convolution(None, None, images, kernel, planes=planes, **settings)
    else:
        out = same_convolution(images, kernel, precision) + bias
        out = jax.nn.relu(out if plus is None else plus + out)
        out = out if inside is None else jnp.where(inside, out, 0)
    return out.reshape(*inputs.shape[:-1], kernel.shape[-1])


class RectifiedConv(nn.Module):
    """`rectified_convolution` with the weights of flax's ``Conv`` of that name."""

    features: int
    size: int
    kernel_init: Any = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(
        self,
        inputs: Float[Array, "*b h w ci"],
        inside: Bool[Array, "h w 1"] | None,
        plus: Float[Array, "*b h w co"] | None = None,
    ) -> Float[Array, "*b h w co"]:
        shape = (self.size, self.size, inputs.shape[-1], self.features)
        kernel = self.param("kernel", self.kernel_init, shape)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        # As flax's convolutions do, in the type that all of them promote to.
        inputs, kernel, bias = promote_dtype(inputs, kernel, bias)
        return rectified_convolution(inputs, kernel, bias, plus=plus, inside=inside)


def _of_products(precision: Any) -> Any:
    """What matrix products of float32 take for a convolution's precision."""
    return None if precision == "bfloat16" else precision


def _total(slopes: list[Array], out: Array) -> Array:
    """Their sum. No zeros are added where there are some: a linearised network would keep them in memory."""
    return functools.reduce(jnp.add, slopes) if slopes else jnp.zeros_like(out)


_FEW = 4
"""Channels up to which the skip joins the 2×2 convolution, as cells of 2×2 pixels: as fast, and its part of
the output takes no memory of its own."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def upsampled_convolution(
    low: Float[Array, "n h w ci"],
    skip: Float[Array, "n 2h 2w cs"],
    kernel: Float[Array, "3 3 ci+cs co"],
    precision: lax.PrecisionLike = None,
    together: int = _amx.ALIGNED,
) -> Float[Array, "n 2h 2w co"]:
    """`same_convolution` of `low`, each pixel repeated over 2×2, beside `skip`, in fewer operations.

    Among repeated pixels the nine taps of an output pixel meet but four different ones. So the four output
    pixels of each of `low`'s are one 2×2 convolution: 4 multiplications where there were 9.
    """
    channels = low.shape[-1]
    weights, rest = folded(kernel[:, :, :channels]), kernel[:, :, channels:]
    beside = skip.shape[-1]
    if planes := _amx.planes(precision, kernel, low, skip):
        fine = (skip, rest) if beside else (None, None)
        return convolution(low, weights, *fine, planes=planes, together=together)
    joined = 0 < beside <= _FEW
    if joined:
        n, h, w, _ = low.shape
        cells = jnp.moveaxis(skip.reshape(n, h, 2, w, 2, -1), 3, 2).reshape(n, h, w, -1)
        low = jnp.concatenate([low, cells], axis=-1)
        weights = jnp.concatenate([weights, of_cells(rest)], axis=2)
    out = corners(low, weights, precision)
    if beside and not joined:
        out = out + same_convolution(skip, rest, precision, together)
    return out


@functools.partial(upsampled_convolution.defjvp, symbolic_zeros=True)
def _upsampled_jvp(
    precision: Any,
    together: int,
    primals: tuple[Array, Array, Array],
    tangents: tuple[Any, Any, Any],
) -> tuple[Array, Array]:
    (low, skip, kernel), (by_low, by_skip, by_kernel) = primals, tangents
    out = upsampled_convolution(low, skip, kernel, precision, together)
    slopes = []
    channels = low.shape[-1]
    if not isinstance(by_low, SymbolicZero):
        if isinstance(by_skip, SymbolicZero):
            skip_slope, taken = skip[..., :0], kernel[:, :, :channels]
        else:
            skip_slope, taken = by_skip, kernel
        slopes.append(upsampled_convolution(by_low, skip_slope, taken, precision, together))
    elif not isinstance(by_skip, SymbolicZero):
        slopes.append(same_convolution(by_skip, kernel[:, :, channels:], precision, together))
    if not isinstance(by_kernel, SymbolicZero):
        both = jnp.concatenate([repeated(low), skip], axis=-1)
        slopes.append(by_products(both, by_kernel, _of_products(precision)))
    return out, _total(slopes, out)
