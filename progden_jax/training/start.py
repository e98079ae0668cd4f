"""Weights that training goes on from."""

from typing import Any

import jax


def match(start: str, found: Any, expected: Any) -> None:
    """Check that the weights of that name have the shapes of those to be trained.

    Raises
    ------
    ValueError
        If they do not; says the first that differs.
    """
    ours, theirs = (_shapes(params) for params in (expected, found))
    for name in [*ours, *theirs]:
        if ours.get(name) != theirs.get(name):
            raise ValueError(
                f"start is {start!r}, which has {_said(theirs.get(name))} weights {name}; this configuration "
                f"makes {_said(ours.get(name))}: give it the options that those weights were trained with."
            )


def _shapes(params: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path, simple=True, separator="."): v.shape for path, v in leaves}


def _said(shape: tuple[int, ...] | None) -> str:
    return "no" if shape is None else "×".join(map(str, shape))
