"""What a denoiser is to the rest of the library."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Float

from progden_jax.frame import Frame

Bound = Callable[[Float[Array, "h w 3"]], Float[Array, "h w 3"]]
"""A denoiser of which only the colour is left open: y = f(x)."""


@runtime_checkable
class Denoiser(Protocol):
    """Anything that turns a frame into a denoised image, differentiably.

    A denoiser that is a pytree with its weights as leaves can be passed through ``jax.jit`` and
    ``jax.grad``; any other object is treated as a constant. A denoiser whose class sets
    ``canvas = True`` takes ``bind(frame, valid=(height, width))`` for a frame padded beyond its true
    size, and then one compiled program serves images of nearby sizes. One that also has
    ``receptive_radius`` and ``alignment`` in pixels and ``exposure_of(frame, valid)``, and takes what the
    latter gives as ``bind(..., exposure=...)``, can work on tiles: see `progden_jax.tiling.Tileable`.
    """

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The denoised image y, (H, W, 3) linear radiance."""
        ...

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x), x the colour; all else that it needs is taken from `frame` as constants."""
        ...


@jax.jit
def call(denoiser: Any, frame: Frame) -> Array:
    """The denoised image, as one program; the denoiser is a pytree."""
    return denoiser.bind(frame)(frame.color)


def aligned_radius(denoiser: Any) -> int:
    """How far beyond its core a tile must reach that begins and ends at multiples of the alignment."""
    return getattr(denoiser, "aligned_radius", denoiser.receptive_radius)


class Bounded:
    """A bound denoiser that reaches as far as its ``denoiser`` says."""

    denoiser: Any

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input."""
        return self.denoiser.receptive_radius

    @property
    def alignment(self) -> int:
        """Pixels after which the way that outputs depend on inputs repeats."""
        return self.denoiser.alignment


@jax.tree_util.register_pytree_node_class
class FunctionDenoiser:
    """A JAX function of the colour alone as a denoiser: ``FunctionDenoiser(lambda x: ...)``.

    Compiled programs are kept per function object, as by ``jax.jit``: what the function closes over
    counts as constant. To vary weights, pass ``jax.tree_util.Partial(function, weights)``.
    """

    def __init__(self, function: Bound) -> None:
        partial = jax.tree_util.Partial
        # A partial of a partial would hide the weights that the inner one has as leaves.
        self.function = function if isinstance(function, partial) else partial(function)

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        return self.function(frame.color)

    def bind(self, frame: Frame) -> Bound:
        del frame
        return self.function

    def tree_flatten(self) -> tuple[tuple[Bound], None]:
        return (self.function,), None

    @classmethod
    def tree_unflatten(cls, _: None, children: tuple[Bound]) -> "FunctionDenoiser":
        denoiser = object.__new__(cls)
        (denoiser.function,) = children
        return denoiser


@jax.tree_util.register_static
class _Constant:
    """An object that is no pytree, passed through ``jax.jit`` as a constant, told apart by identity."""

    def __init__(self, denoiser: Denoiser) -> None:
        self.denoiser = denoiser

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        return self.denoiser(frame)

    def __getattr__(self, name: str) -> Any:
        if name == "denoiser":  # not set yet, while it is copied
            raise AttributeError(name)
        return getattr(self.denoiser, name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Constant) and self.denoiser is other.denoiser

    def __hash__(self) -> int:
        return id(self.denoiser)

    def __repr__(self) -> str:
        return repr(self.denoiser)


def passable(denoiser: Denoiser) -> Any:
    """The denoiser in a form that ``jax.jit`` takes as an argument."""
    # Not treedef_is_leaf, which takes a pytree of settings alone, such as NFOR, for a leaf.
    is_leaf = jax.tree.structure(denoiser) == jax.tree.structure(0)
    return _Constant(denoiser) if is_leaf else denoiser
