"""Transfer functions: what networks see instead of raw radiance and variance, with their inverses.

All are pure, monotone, elementwise functions of floating-point arrays of any shape. They keep the
dtype and have finite derivatives wherever they are finite. Radiance is meant to be at least 0 and
clamped by the caller; below 0 the functions go on (oddly, or in a line) rather than give a NaN.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax.frame import HALF_MAX

# OIDN's fit of a perceptually uniform curve: the pieces, and where they meet before and after.
_A = 1412.83765
_B, _C, _D = 1.64593172, 0.431384981, -0.00294139609
_E, _F, _G = 0.192653254, 0.00626026094, 0.998620152
_Y0, _Y1 = 1.57945760e-6, 0.0322087631
_X0, _X1 = 0.00223151711, 0.370974749

PU_HDR_SCALE = 1 / (_E * math.log(HALF_MAX + _F) + _G)
"""1 / pu(65504): brings the whole range of half floats to [0, 1]."""

_LOG_SCALE = math.log(HALF_MAX + 1)


def pu(y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """OIDN's perceptually uniform encoding of radiance.

    A line near 0, then a power, then a logarithm; the pieces meet to within 2e-8, the
    rounding of their constants. Negative values follow the line.

    Parameters
    ----------
    y : linear radiance of any shape, at least 0.

    Returns
    -------
    Values of the same shape and dtype: 0 at 0, about 1 at 1 and 3.14 at 65504.

    Raises
    ------
    ValueError
        If `y` is not floating point.

    References
    ----------
    Open Image Denoise 2, PU transfer function (after Aydın, Mantiuk, Seidel 2008).
    """
    y = _floating("y", y)
    # Every branch sees only its own inputs, so that the others leave no NaN in derivatives.
    line, log = y < _Y0, y >= _Y1
    power = _B * jnp.where(line | log, _Y1, y) ** _C + _D
    return jnp.where(
        line, _A * y, jnp.where(log, _E * jnp.log(jnp.where(log, y, 1) + _F) + _G, power)
    )


def pu_inverse(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Radiance from its perceptually uniform encoding: the inverse of `pu`.

    Parameters
    ----------
    x : encoded values of any shape, up to 3.14 for radiance that half floats hold. The result grows
        as exp(5.2 x) and overflows float32 near 18.

    Returns
    -------
    Linear radiance of the same shape and dtype.

    Raises
    ------
    ValueError
        If `x` is not floating point.
    """
    x = _floating("x", x)
    line, log = x < _X0, x >= _X1
    power = ((jnp.where(line | log, _X1, x) - _D) / _B) ** (1 / _C)
    log_y = (jnp.where(log, x, 1) - _G) / _E
    return jnp.where(line, x / _A, jnp.where(log, jnp.exp(log_y) - _F, power))


def pu_hdr(y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """`pu` scaled so that [0, 65504] becomes [0, 1]: the colour input of OIDN's HDR networks."""
    return pu(y) * PU_HDR_SCALE


def pu_hdr_inverse(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Radiance from values in [0, 1]: the inverse of `pu_hdr`."""
    return pu_inverse(_floating("x", x) / PU_HDR_SCALE)


def srgb(y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The sRGB encoding of linear values in [0, 1] (IEC 61966-2-1): what OIDN gives albedo networks."""
    y = _floating("y", y)
    line = y <= 0.0031308
    return jnp.where(line, 12.92 * y, 1.055 * jnp.where(line, 1, y) ** (1 / 2.4) - 0.055)


def srgb_inverse(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Linear values from their sRGB encoding: the inverse of `srgb`."""
    x = _floating("x", x)
    line = x <= 0.04045
    return jnp.where(line, x / 12.92, ((jnp.where(line, 1, x) + 0.055) / 1.055) ** 2.4)


def log1p_normalized(y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """log(1 + y) / log(65505): radiance in [0, 65504] becomes [0, 1]. Odd in y.

    Parameters
    ----------
    y : linear radiance (or albedo) of any shape, at least 0.

    Raises
    ------
    ValueError
        If `y` is not floating point.
    """
    y = _floating("y", y)
    return _odd(jnp.log1p, y) / _LOG_SCALE


def log1p_normalized_inverse(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """65505^x − 1: the inverse of `log1p_normalized`. Odd in x; overflows float32 at 8.

    Parameters
    ----------
    x : encoded values of any shape, in [0, 1] for radiance that half floats hold.

    Raises
    ------
    ValueError
        If `x` is not floating point.
    """
    x = _floating("x", x)
    return _odd(jnp.expm1, x * _LOG_SCALE)


def arctan(v: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The arctangent of a variance or risk, which squeezes any real value into ±π/2.

    Parameters
    ----------
    v : values of any shape and sign, in squared radiance.

    Raises
    ------
    ValueError
        If `v` is not floating point.
    """
    return jnp.arctan(_floating("v", v))


def arctan_inverse(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The tangent, for looking at features; large values do not survive the way through `arctan`.

    Warning: never rebuild a variance, SURE or divergence from arctan features by this function.
    Near ±π/2 neighbouring floats lie far apart: in float32 a value of 1e4 comes back wrong by
    up to 1e-3 of itself, and all beyond 1e7 or so are one value. Keep the raw arrays.

    Parameters
    ----------
    x : values of any shape in [−π/2, π/2]. Whatever the dtype rounds to or past ±π/2 counts as the
        last value inside, so that the sign is right and the result finite (float32: about
        1.3e7 at most; half: 2067).

    Raises
    ------
    ValueError
        If `x` is not floating point.
    """
    x = _floating("x", x)
    last = np.asarray(np.pi / 2, x.dtype)
    if float(last) > np.pi / 2:
        last = np.nextafter(last, np.asarray(0, x.dtype))
    return jnp.tan(jnp.clip(x, -last, last))


class Transfer(NamedTuple):
    """A transfer function under a name, for networks whose settings are text."""

    name: str
    forward: Callable[[Array], Array]
    inverse: Callable[[Array], Array]


_TRANSFERS = {
    transfer.name: transfer
    for transfer in (
        Transfer("log", log1p_normalized, log1p_normalized_inverse),
        Transfer("pu", pu_hdr, pu_hdr_inverse),
        Transfer("arctan", arctan, arctan_inverse),
    )
}


def by_name(name: str) -> Transfer:
    """The transfer function called "log" (`log1p_normalized`), "pu" (`pu_hdr`) or "arctan".

    Raises
    ------
    ValueError
        For any other name.
    """
    _checks.choice("transfer", name, _TRANSFERS)
    return _TRANSFERS[name]


def _odd(function: Callable[[Array], Array], y: Array) -> Array:
    negative = y < 0
    result = function(jnp.where(negative, -y, y))
    return jnp.where(negative, -result, result)


def _floating(name: str, value: Any) -> Array:
    array = jnp.asarray(value)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(
            f"{name} has dtype {array.dtype}, expected floating-point linear values: "
            f"convert it first, for instance with {name}.astype('float32')."
        )
    return array
