"""The convolution of `_amx.cc` as a primitive of JAX, with bias, ReLU and masks: sums stay in the cache."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.extend as jex
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, UInt8

from progden_jax import _amx
from progden_jax._kernel_products import by_products
from progden_jax._numeric import own_zero
from progden_jax._slopes import bits_for, packed, unpacked
from progden_jax._upsampling import corners, of_corners, shuffled

_ABSENT: tuple[Any, ...] = (
    *(np.zeros((0,) * rank, np.float32) for rank in (4, 4, 4, 4, 1, 4)),
    *(np.zeros((0,) * rank, np.uint8) for rank in (4, 3)),
)
"""What stands for an operand that is not given."""

_PLUS = 5
"""Which operand is added."""

_primitive = jex.core.Primitive("amx_convolution")


def convolution(
    low: Float[Array, "n h w ci"] | None,
    folded: Float[Array, "2 2 ci 4*co"] | None,
    image: Float[Array, "n h2 w2 cs"] | None,
    kernel: Float[Array, "kh kw cs co"] | None,
    *,
    planes: int,
    bias: Float[Array, " co"] | None = None,
    plus: Float[Array, "n h2 w2 co"] | None = None,
    gate: UInt8[Array, "n h3 w2 co"] | None = None,
    bits: int = 1,
    inside: UInt8[Array, "#n h2 w2"] | None = None,
    relu: bool = False,
    together: int = _amx.ALIGNED,
) -> Float[Array, "n h2 w2 co"]:
    """The convolution of `image` with zeros around it, and of `low` with each pixel repeated over 2×2.

    Either may be None. Of the derivative of a ReLU a bit per value is kept.

    Parameters
    ----------
    low, folded : of half the size, with the kernel's taps added where they meet one pixel, for the four
        output pixels over each of `low`'s cells of 2×2 in raster order.
    image, kernel : of the output's size; the kernel's sides are odd.
    planes : how many bfloat16 stand for a value, see `_amx.planes`.
    bias, plus : added.
    gate : zeros where it has no bit: bit r of row i is for row ``bits * i + r``.
    inside : zeros where it is 0.
    relu : zeros where the sum is not above 0.
    together : rows that may be computed together, with sums of them multiplied in place of each; only three
        planes are. Parts of an image get the same bits where they begin at multiples of so many rows.
    """
    some, by = (low, folded) if image is None else (image, kernel)
    if some is None or by is None:
        raise ValueError("low or image, each with its kernel, must be given.")
    n, h, w, _ = some.shape
    outputs = by.shape[-1]
    if image is None:
        h, w, outputs = 2 * h, 2 * w, outputs // 4
    given = (low, folded, image, kernel, bias, plus, gate, inside)
    return _primitive.bind(
        *(b if a is None else a for a, b in zip(given, _ABSENT, strict=True)),
        shape=(n, h, w, outputs),
        planes=planes,
        bits=bits,
        relu=relu,
        together=together,
    )


def _call(*operands: Array, shape: Sequence[int], relu: bool, **numbers: int) -> Array:
    # What is added may be overwritten, as each value is read once, before the sum is put there.
    aliases = {_PLUS: 0} if operands[_PLUS].size else {}
    out = jax.ShapeDtypeStruct(tuple(shape), jnp.float32)
    call = jax.ffi.ffi_call(_amx.TARGET, out, input_output_aliases=aliases)
    return call(
        *operands, relu=np.bool_(relu), **{name: np.int64(n) for name, n in numbers.items()}
    )


@functools.cache
def _compiled_alone(**settings: Any) -> Any:
    return jax.jit(functools.partial(_primitive.bind, **settings))


def _jvp(operands: Sequence[Array], tangents: Sequence[Any], **settings: Any) -> tuple[Array, Any]:
    out = _primitive.bind(*operands, **settings)
    low, folded, image, kernel, _, _, gate, inside = operands
    by_low, by_folded, by_image, by_kernel, by_bias, by_plus = (
        None if isinstance(t, ad.Zero) or not t.size else t for t in tangents[:6]
    )
    planes, bits = settings["planes"], settings["bits"]
    if settings["relu"]:
        bits = bits_for(out.shape[1])
        gate, inside = packed(out > 0, bits), _ABSENT[7]
    slopes = []
    if not (by_low is None and by_image is None):
        slopes.append(
            convolution(
                *((None, None) if by_low is None else (by_low, folded)),
                *((None, None) if by_image is None else (by_image, kernel)),
                planes=planes,
                plus=by_plus,
                gate=gate if gate.size else None,
                bits=bits,
                inside=inside if inside.size else None,
                together=settings["together"],
            )
        )
        by_plus = None
    by_weights = [] if by_plus is None else [by_plus]
    if by_folded is not None:
        by_weights.append(shuffled(by_products(low, of_corners(by_folded), None)))
    if by_kernel is not None:
        by_weights.append(by_products(image, by_kernel, None))
    if by_bias is not None:
        by_weights.append(jnp.broadcast_to(by_bias, out.shape))
    slopes += [_where(gate, inside, slope, bits) for slope in by_weights]
    return out, functools.reduce(jnp.add, slopes) if slopes else jnp.zeros_like(out)


@functools.partial(jax.checkpoint, prevent_cse=False, static_argnums=3)
def _where(gate: Array, inside: Array, value: Array, bits: int) -> Array:
    """A checkpoint, so that of the gate no more is kept than it is."""
    if gate.size:
        value = jnp.where(unpacked(gate, bits), value, own_zero(value))
    return jnp.where(inside[..., None] != 0, value, own_zero(value)) if inside.size else value


def _transposed(
    cotangent: Any,
    *operands: Any,
    shape: Any,
    planes: int,
    bits: int,
    relu: bool,
    together: int,
) -> list[Any]:
    _, folded, _, kernel, bias, _, gate, inside = operands
    if relu or bias.size:
        raise NotImplementedError("a convolution with a ReLU or a bias is not linear.")
    found: list[Any] = [None] * len(operands)
    wanted = [i for i in (0, 2, 5) if ad.is_undefined_primal(operands[i])]
    if isinstance(cotangent, ad.Zero):
        for i in wanted:
            found[i] = ad.Zero(operands[i].aval)
        return found
    cotangent = _where(gate, inside, cotangent, bits)
    for i in wanted:
        aval = operands[i].aval
        if not aval.size:
            found[i] = ad.Zero(aval)
        elif i == 5:
            found[i] = cotangent
        elif i == 0:
            found[i] = jax.linear_transpose(
                lambda x: corners(x, folded, lax.Precision.HIGHEST), aval
            )(cotangent)[0]
        else:
            turned = kernel[::-1, ::-1].swapaxes(2, 3)
            found[i] = convolution(None, None, cotangent, turned, planes=planes, together=together)
    return found


def _batched(operands: Sequence[Array], axes: Sequence[Any], *, shape: Any, **settings: Any) -> Any:
    mapped = zip(operands, axes, strict=True)
    arrays = [a if d is None else jnp.moveaxis(a, d, 0) for a, d in mapped]
    size = next(a.shape[0] for a, d in zip(arrays, axes, strict=True) if d is not None)
    weights = (1, 3, 4)
    if any(axes[i] is not None for i in weights):
        of_each = [a for a, d in zip(arrays, axes, strict=True) if d is not None]

        def one(some: list[Array]) -> Array:
            left = iter(some)
            given = (a if d is None else next(left) for a, d in zip(arrays, axes, strict=True))
            return _primitive.bind(*given, shape=shape, **settings)

        return lax.map(one, of_each), 0
    n = shape[0]
    joined = []
    for i, (a, d) in enumerate(zip(arrays, axes, strict=True)):
        if i in weights or not a.size or (d is None and i == 7 and a.shape[0] == 1):
            joined.append(a[0] if d is not None else a)
            continue
        each = a if d is not None else jnp.broadcast_to(a, (size, *a.shape))
        each = jnp.broadcast_to(each, (size, n, *each.shape[2:]))
        joined.append(each.reshape(size * n, *each.shape[2:]))
    found = _primitive.bind(*joined, shape=(size * n, *shape[1:]), **settings)
    return found.reshape(size, *shape), 0


_primitive.def_impl(lambda *operands, **settings: _compiled_alone(**settings)(*operands))
_primitive.def_abstract_eval(
    lambda *_, shape, **__: ShapedArray(tuple(shape), jnp.dtype(jnp.float32))
)
mlir.register_lowering(_primitive, mlir.lower_fun(_call, multiple_results=False), platform="cpu")
ad.primitive_jvps[_primitive] = _jvp
ad.primitive_transposes[_primitive] = _transposed
batching.primitive_batchers[_primitive] = _batched
