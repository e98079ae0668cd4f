"""Denoisers: pure functions of (weights, frame), found by name."""

import os
from pathlib import Path
from typing import cast

import jax.numpy as jnp

from progden_jax import _checks, _safetensors
from progden_jax.denoisers import files, graph, nfor, oidn, unet
from progden_jax.denoisers._base import Bound, Denoiser, FunctionDenoiser
from progden_jax.denoisers._network import PRECISIONS, Network
from progden_jax.denoisers.files import ARCHITECTURES, save, save_tza
from progden_jax.denoisers.nfor import NFOR
from progden_jax.denoisers.oidn import OIDN
from progden_jax.denoisers.own import INPUT_SETS, KPCN, UNet
from progden_jax.denoisers.residual import ResidualNet
from progden_jax.denoisers.tza import read_tza, write_tza
from progden_jax.frame import Frame

__all__ = [
    "ARCHITECTURES",
    "INPUT_SETS",
    "KPCN",
    "NFOR",
    "OIDN",
    "QUALITIES",
    "Bound",
    "Denoiser",
    "FunctionDenoiser",
    "Network",
    "ResidualNet",
    "UNet",
    "for_frame",
    "load",
    "names",
    "prefilter",
    "read_tza",
    "save",
    "save_tza",
    "usable_inputs",
    "write_tza",
]

QUALITIES = ("fast", "balanced", "high")
"""OIDN's small, base and large weights."""

_SIZES = {"fast": ("-small", ""), "balanced": ("",), "high": ("-large", "")}


def names() -> tuple[str, ...]:
    """The names that `load` knows: OIDN's networks, NFOR, and the networks that come with the package."""
    return (*oidn.NAMES, nfor.NAME, *files.shipped())


def load(
    name: str | os.PathLike[str],
    *,
    exposure: float | None = None,
    inputs: tuple[str, ...] | None = None,
    precision: str = "highest",
) -> Network | NFOR:
    """The denoiser of that name, or of the weights file at that path.

    Parameters
    ----------
    name : one of `names()`, such as "oidn-hdr-alb-nrm", or the path of a file that ends in .tza (an `OIDN`)
        or .safetensors (a `UNet`, `KPCN` or `ResidualNet`, as `save` wrote it).
    exposure : see `OIDN`; no other takes one.
    inputs : auxiliary buffers of a .tza file's network; by default by its number of input channels:
        3 radiance, 6 with albedo, 9 with albedo and normal.
    precision : see `OIDN`.

    Raises
    ------
    ValueError
        If there is no such name or file, or the file holds other weights.
    """
    if exposure is not None and not exposure > 0:
        raise ValueError(f"exposure is {exposure}, expected a number above 0.")
    text = os.fspath(name)
    _checks.choice("precision", precision, PRECISIONS)
    if text.endswith(".tza"):
        params = unet.from_tensors(read_tza(name))
        if inputs is None:
            inputs = _inputs_of(params, source=text)
        return OIDN(params, inputs, exposure=exposure, name=Path(name).stem, precision=precision)
    if inputs is not None:
        raise ValueError(f"inputs is {inputs}; only .tza files do not tell, and {text} does.")
    if text in oidn.NAMES:
        base = text.removeprefix("oidn-")
        kind = base.removesuffix("-small").removesuffix("-large")
        params = oidn.shipped_params("rt_" + base.replace("-", "_"))
        return OIDN(params, oidn.INPUTS[kind], exposure=exposure, name=text, precision=precision)
    own = files.shipped()
    if not text.endswith(_safetensors.ENDING) and text not in own and text != nfor.NAME:
        raise ValueError(
            f"denoiser is {text!r}, expected one of {', '.join(names())}, "
            "or a path that ends in .tza or .safetensors."
        )
    if exposure is not None:
        raise ValueError(
            f"exposure is {exposure}, and {text} is no OIDN network: it takes radiance as it is."
        )
    if text == nfor.NAME:
        return NFOR(precision=precision)
    return files.load_own(own.get(text, Path(text)), precision=precision)


def _inputs_of(params: unet.Params, *, source: str) -> tuple[str, ...]:
    channels = graph.input_channels(unet.graph(params), params)
    by_channels = {3 * (1 + len(inputs)): inputs for inputs in oidn.INPUTS.values()}
    if channels not in by_channels:
        raise ValueError(
            f"{source} holds a network of {channels} input channels; expected 3 (radiance), "
            "6 (with albedo) or 9 (with albedo and normal)."
        )
    return by_channels[channels]


def usable_inputs(frame: Frame) -> tuple[str, ...]:
    """The auxiliary buffers of `frame` that say something: present, not constant, as OIDN combines them.

    A normal without an albedo is left out, for OIDN has no network that takes one.
    """
    telling = [
        name
        for name in ("albedo", "normal")
        if (buffer := getattr(frame, name)) is not None
        and bool((buffer != buffer[..., :1, :1, :]).any())
    ]
    if "albedo" not in telling:
        return ()
    return tuple(telling)


def for_frame(
    frame: Frame,
    *,
    quality: str = "balanced",
    clean_aux: bool = False,
    exposure: float | None = None,
) -> OIDN:
    """OIDN's network for the buffers that `frame` has; those absent or constant are left out.

    Parameters
    ----------
    quality : "fast", "balanced" or "high": the small, base and large weights where OIDN has them.
    clean_aux : albedo and normal are free of noise (rendered so, or from `prefilter`).
    """
    _checks.choice("quality", quality, QUALITIES)
    found = usable_inputs(frame)
    stem = {0: "oidn-hdr", 1: "oidn-hdr-alb", 2: "oidn-hdr-alb-nrm"}[len(found)]
    if clean_aux and len(found) == 2:
        stem = "oidn-hdr-calb-cnrm"
    name = next(stem + size for size in _SIZES[quality] if stem + size in oidn.NAMES)
    return cast(OIDN, load(name, exposure=exposure))


def prefilter(frame: Frame, *, quality: str = "balanced") -> Frame:
    """The frame with its albedo and normal denoised by OIDN's own networks for them.

    Then take a network for clean buffers ("oidn-hdr-calb-cnrm"), as OIDN's documentation advises.
    `quality` "high" takes the large weights; there are no small ones.
    """
    _checks.choice("quality", quality, QUALITIES)
    size = "_large" if quality == "high" else ""
    filtered = {}
    for role, short in (("albedo", "alb"), ("normal", "nrm")):
        buffer = getattr(frame, role)
        if buffer is not None:
            params = oidn.shipped_params(f"rt_{short}{size}")
            filtered[role] = oidn.prefilter_buffer(params, jnp.asarray(buffer), role=role)
    return frame.replace(**filtered)
