"""Denoisers: pure functions of (weights, frame), found by name."""

import os
from pathlib import Path

import jax.numpy as jnp

from progden_jax import _checks
from progden_jax.denoisers import oidn, unet
from progden_jax.denoisers._base import Bound, Denoiser, FunctionDenoiser
from progden_jax.denoisers.oidn import OIDN
from progden_jax.denoisers.tza import read_tza, write_tza
from progden_jax.frame import Frame

__all__ = [
    "OIDN",
    "QUALITIES",
    "Bound",
    "Denoiser",
    "FunctionDenoiser",
    "for_frame",
    "load",
    "names",
    "prefilter",
    "read_tza",
    "save_tza",
    "usable_inputs",
    "write_tza",
]

PRECISIONS = ("highest", "high", "default", "tensorfloat32", "bfloat16")
"""Of the convolutions; see `OIDN`."""

QUALITIES = ("fast", "balanced", "high")
"""OIDN's small, base and large weights."""

_SIZES = {"fast": ("-small", ""), "balanced": ("",), "high": ("-large", "")}


def names() -> tuple[str, ...]:
    """The names that `load` knows."""
    return oidn.NAMES


def load(
    name: str | os.PathLike[str],
    *,
    exposure: float | None = None,
    inputs: tuple[str, ...] | None = None,
    precision: str = "highest",
) -> OIDN:
    """The denoiser of that name, or of the weights file (.tza) at that path.

    Parameters
    ----------
    name : one of `names()`, such as "oidn-hdr-alb-nrm", or the path of a file that ends in .tza.
    exposure : see `OIDN`.
    inputs : auxiliary buffers of a .tza file's network; by default by its number of input channels:
        3 radiance, 6 with albedo, 9 with albedo and normal.
    precision : see `OIDN`.

    Raises
    ------
    ValueError
        If there is no such name or file, or the file holds other weights than of OIDN's U-Net.
    """
    if exposure is not None and not exposure > 0:
        raise ValueError(f"exposure is {exposure}, expected a number above 0.")
    _checks.choice("precision", precision, PRECISIONS)
    if str(name).endswith(".tza"):
        params = unet.from_tensors(read_tza(name))
        if inputs is None:
            inputs = _inputs_of(params, source=os.fspath(name))
        return OIDN(params, inputs, exposure=exposure, name=Path(name).stem, precision=precision)
    if name not in names():
        raise ValueError(
            f"denoiser is {os.fspath(name)!r}, expected one of {', '.join(names())}, "
            "or a path that ends in .tza."
        )
    base = str(name).removeprefix("oidn-")
    kind = base.removesuffix("-small").removesuffix("-large")
    params = oidn.shipped_params("rt_" + base.replace("-", "_"))
    return OIDN(params, oidn.INPUTS[kind], exposure=exposure, name=str(name), precision=precision)


def _inputs_of(params: unet.Params, *, source: str) -> tuple[str, ...]:
    first = unet.layout(params)[0][0][0]
    channels = params[first]["kernel"].shape[2]
    by_channels = {3: (), 6: ("albedo",), 9: ("albedo", "normal")}
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
    name = next(stem + size for size in _SIZES[quality] if stem + size in names())
    return load(name, exposure=exposure)


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


def save_tza(path: str | os.PathLike[str], denoiser: OIDN, *, dtype: str = "float16") -> None:
    """Write a denoiser's weights as a .tza archive; OIDN's own library takes those in float16 only."""
    write_tza(path, unet.to_tensors(denoiser.params, dtype))
