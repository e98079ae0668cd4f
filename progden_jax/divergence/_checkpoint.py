"""What a long run has found so far, in a file that survives the process."""

import hashlib
import logging
import os
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend import core

from progden_jax._files import replacing

FORMAT = "progden-exact-1"

logger = logging.getLogger(__name__)


def fingerprint(*parts: Any) -> str:
    """A hash of names, numbers, arrays, jaxprs and pytrees of them, the same in every process."""
    digest = hashlib.sha256(FORMAT.encode())
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


def save(path: Path, key: str, found: np.ndarray, done: int) -> None:
    """Put a checkpoint at `path`, in one step."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, format=FORMAT, key=key, found=found, done=done)


def load(path: Path, key: str, found: np.ndarray) -> int:
    """Fill `found` from the checkpoint at `path`; how many units it holds, 0 without a usable one.

    Raises
    ------
    ValueError
        If it is a checkpoint of something else.
    """
    if not path.exists():
        return 0
    try:
        with path.open("rb") as file, np.load(file) as stored:
            held, values, done = str(stored["key"]), stored["found"], int(stored["done"])
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        logger.warning("%s is no whole checkpoint (%s): starting over", os.fspath(path), error)
        return 0
    if held != key:
        raise ValueError(
            f"{path} is the checkpoint of another run: other pixels, weights or settings. "
            "Give the path of this run's, or remove it."
        )
    found[...] = values
    return done
