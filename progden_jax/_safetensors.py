"""Weights in safetensors files: nested dictionaries of arrays, and text that says what they are."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from progden_jax import _checks
from progden_jax._files import replacing

DTYPES = ("float16", "float32")
ENDING = ".safetensors"


def shipped(folder: Path, prefix: str) -> dict[str, Path]:
    """The weights in the folder whose names begin so, by the rest of their names."""
    files = sorted(folder.glob(f"{prefix}*{ENDING}"))
    return {file.stem.removeprefix(prefix): file for file in files}


def write(
    path: str | os.PathLike[str], params: Any, metadata: Mapping[str, str], *, dtype: str
) -> None:
    """Write nested dictionaries of arrays, rounded to `dtype`, and metadata; whole or not at all.

    Raises
    ------
    ValueError
        If the path does not end in .safetensors, `dtype` is not "float16" or "float32", or a weight is not
        finite in it.
    """
    _checks.choice("dtype", dtype, DTYPES)
    if not os.fspath(path).endswith(ENDING):
        raise ValueError(f"the weights go to {os.fspath(path)}, expected a name in {ENDING}.")
    tensors = {}
    for name, value in flatten_dict(params, sep=".").items():
        with np.errstate(over="ignore"):
            tensors[name] = np.asarray(value).astype(dtype, order="C")
        if not np.isfinite(tensors[name]).all():
            raise ValueError(f"the weights {name} are not all finite in {dtype}: nothing written.")
    data = save(tensors, {"format": "progden_jax", "dtype": dtype} | dict(metadata))
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """What `write` wrote: nested dictionaries of float32 arrays, and the metadata.

    Raises
    ------
    ValueError
        If there is no such file, or it is no whole safetensors file of this project.
    """
    source = os.fspath(path)
    try:
        with Path(path).open("rb"):
            pass
        with safe_open(path, framework="numpy") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except OSError as error:
        raise ValueError(f"cannot read the weights {source}: {error.strerror}.") from error
    except SafetensorError as error:
        raise ValueError(f"{source} is no safetensors file, or is cut short ({error}).") from error
    if metadata.get("format") != "progden_jax":
        raise ValueError(
            f"{source} was not written by progden_jax: its metadata does not say what network it holds. "
            "Load the arrays yourself and give them to the network's class."
        )
    arrays = {tuple(name.split(".")): np.asarray(t, np.float32) for name, t in tensors.items()}
    return unflatten_dict(arrays), metadata
