"""Files of combiners' weights."""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from progden_jax import _safetensors, denoisers
from progden_jax.combiner.denoiser import DeepCombiner
from progden_jax.combiner.network import KernelNetwork, Params
from progden_jax.denoisers import Denoiser, files
from progden_jax.denoisers._base import passable

KIND = "combiner"


def names() -> tuple[str, ...]:
    """The denoisers that weights are shipped for."""
    return tuple(_shipped())


def _shipped() -> dict[str, Path]:
    return _safetensors.shipped(files.FOLDER, f"{KIND}-")


def save(
    path: str | os.PathLike[str],
    combiner: DeepCombiner,
    *,
    dtype: str = "float16",
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write a combiner's weights and settings so that `load` gives it back; whole or not at all.

    Parameters
    ----------
    path : ends in .safetensors.
    dtype : "float16" halves the file, at about three digits, or "float32".
    metadata : further text to keep with it; "denoiser" names the one it was trained for, by default that
        behind which it stands.

    Raises
    ------
    ValueError
        If the path ends otherwise, or a weight is not finite in `dtype`.
    """
    said = {"denoiser": getattr(combiner.denoiser, "name", ""), **(metadata or {})}
    own = {"kind": KIND, "options": json.dumps(dataclasses.asdict(combiner.network))}
    _safetensors.write(path, combiner.params, {**said, **own}, dtype=dtype)


class Weights(NamedTuple):
    """What a file holds: the weights, the network that they are of, and where they come from."""

    params: Params
    network: KernelNetwork
    metadata: dict[str, str]


def load(name: str | os.PathLike[str], denoiser: Denoiser | None = None) -> DeepCombiner:
    """The combiner of those weights behind a denoiser.

    Parameters
    ----------
    name : one of `names()`, or a path that ends in .safetensors.
    denoiser : by default the one that the weights were trained for.

    Raises
    ------
    ValueError
        If there is no such name or file, or the file holds no combiner.
    """
    params, network, metadata = read(name)
    if denoiser is None:
        denoiser = denoisers.load(metadata.get("denoiser", ""))
    return DeepCombiner(params, passable(denoiser), network)


def read(name: str | os.PathLike[str]) -> Weights:
    """The weights alone; arguments and errors are `load`'s."""
    text = os.fspath(name)
    path = Path(text)
    if not text.endswith(_safetensors.ENDING):
        if text not in names():
            raise ValueError(
                f"combiner is {text!r}, expected one of {', '.join(names())}, or a path that ends in "
                f"{_safetensors.ENDING}."
            )
        path = _shipped()[text]
    params, metadata = _safetensors.read(path)
    if metadata.get("kind") != KIND:
        found = metadata.get("kind") or metadata.get("architecture", "nothing")
        raise ValueError(
            f"{path} holds no combiner (its metadata says {found!r}): give a file from `progden train "
            "combiner` or progden_jax.combiner.save."
        )
    try:
        network = KernelNetwork(**json.loads(metadata["options"]))
        network.check(params)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    return Weights(params, network, metadata)
