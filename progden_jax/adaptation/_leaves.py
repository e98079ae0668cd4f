"""Some of a pytree's weights, to be changed."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

Numbers = tuple[int, ...]
"""Of leaves, in the order of ``jax.tree.leaves``."""


def chosen(tree: Any, only: Sequence[str], *, after: Any = None) -> Numbers:
    """The floating-point leaves below layers or attributes of these names; all, if there are no names.

    Numbered as in a tree where those of `after` come first.

    Raises
    ------
    ValueError
        If there are none, or nothing has such a name.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    real = [
        (number, {_name(part) for part in path})
        for number, (path, leaf) in enumerate(leaves, len(jax.tree.leaves(after)))
        if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    if not real:
        raise ValueError(
            f"{tree!r} has no weights to adapt: give a pytree with floating-point leaves, such as a network "
            "of progden_jax.denoisers."
        )
    known = set().union(*(names for _, names in real))
    if unknown := sorted(set(only) - known):
        raise ValueError(
            f"only names {', '.join(unknown)}, expected some of {', '.join(sorted(known))}."
        )
    return tuple(number for number, names in real if not only or names & set(only))


def _name(part: Any) -> str:
    return str(next(getattr(part, n) for n in ("name", "key", "idx") if hasattr(part, n)))


def taken(tree: Any, numbers: Numbers) -> list[Any]:
    """Those leaves."""
    leaves = jax.tree.leaves(tree)
    return [leaves[number] for number in numbers]


def replaced(tree: Any, numbers: Numbers, values: Sequence[Any]) -> Any:
    """The tree with other values there."""
    leaves, form = jax.tree.flatten(tree)
    for number, value in zip(numbers, values, strict=True):
        leaves[number] = value
    return jax.tree.unflatten(form, leaves)
