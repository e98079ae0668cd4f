"""What a long run has found so far, in a file that survives the process."""

import logging
import os
import zipfile
from pathlib import Path

import numpy as np

from progden_jax._files import replacing

FORMAT = "progden-checkpoint-1"

logger = logging.getLogger(__name__)


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
