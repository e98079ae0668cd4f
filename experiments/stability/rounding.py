"""Numerical formats that the machine at hand may lack, emulated inside any JAX function."""

from typing import Any

import jax
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

TF32_MANTISSA = 10

_ROUNDED = {"conv_general_dilated": 2, "amx_convolution": 4}
"""Convolution -> how many of its operands, the first, are images and kernels."""


def tf32(f: Any) -> jax.tree_util.Partial:
    """f with the inputs of its convolutions rounded as TensorFloat-32 rounds them, tangents likewise."""
    return jax.tree_util.Partial(_apply, f)


def _apply(f: Any, x: jax.Array) -> jax.Array:
    traced = jax.make_jaxpr(f)(x)
    return _run(traced.jaxpr, traced.consts, [x])[0]


def _run(program: Jaxpr, constants: list[Any], inputs: list[Any]) -> list[Any]:
    values = dict(zip((*program.constvars, *program.invars), (*constants, *inputs), strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for equation in program.eqns:
        operands = [read(atom) for atom in equation.invars]
        # Convolutions with a rule of their own for derivatives are derived as they stand.
        inner = equation.params.get("call_jaxpr", equation.params.get("jaxpr"))
        if isinstance(inner, ClosedJaxpr):
            results = _run(inner.jaxpr, list(inner.consts), operands)
        else:
            count = _ROUNDED.get(equation.primitive.name, 0)
            rounded = [lax.reduce_precision(a, 8, TF32_MANTISSA) for a in operands[:count]]
            operands = [*rounded, *operands[count:]]
            results = equation.primitive.bind(*operands, **equation.params)
            if not equation.primitive.multiple_results:
                results = [results]
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in program.outvars]
