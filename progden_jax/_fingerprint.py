"""Hashes of what determines a result, to name what is kept of it after."""

import hashlib
import re
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.extend import core


def fingerprint(*parts: Any) -> str:
    """A hash of names, numbers, arrays, jaxprs and pytrees of them, the same in every process."""
    digest = hashlib.sha256()
    for part in parts:
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            digest.update(jax.tree_util.keystr(path).encode())
            if isinstance(leaf, core.ClosedJaxpr):
                # Functions inside are printed with their addresses.
                digest.update(re.sub(r"0x[0-9a-f]+", "", str(leaf)).encode())
                for constant in _constants(leaf):
                    _add_array(digest, constant)
            elif hasattr(leaf, "dtype"):
                _add_array(digest, leaf)
            else:
                digest.update(repr(leaf).encode())
            digest.update(b"\0")
    return digest.hexdigest()[:32]


def _add_array(digest: Any, value: Any) -> None:
    array = np.ascontiguousarray(value)
    digest.update(f"{array.dtype}{array.shape}".encode())
    digest.update(array.view(np.uint8) if array.ndim else array.tobytes())


def _constants(jaxpr: Any) -> Iterator[Any]:
    """Of a jaxpr and of those within it."""
    yield from getattr(jaxpr, "consts", ())
    for equation in jaxpr.eqns:
        for inner in jax.tree.leaves(list(equation.params.values())):
            if isinstance(inner, core.ClosedJaxpr | core.Jaxpr):
                yield from _constants(inner)
