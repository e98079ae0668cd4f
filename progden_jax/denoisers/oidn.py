"""Open Image Denoise's ray-tracing filter in JAX, with the weights of the installed pyoidn wheel.

Matches the native library to float32 rounding. Its steps, per pixel: colour times exposure, NaN to 0, clamped
at 0, perceptually uniform (PU) transfer; albedo clamped to [0, 1]; normals clamped to [-1, 1] and moved to
[0, 1]; zeros up to a multiple of 16; the U-Net; and the inverse of the colour's steps.
"""

import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks, transfer
from progden_jax.denoisers import unet
from progden_jax.denoisers._network import (
    Network,
    Params,
    Valid,
    lit,
    normal_to_unit,
    run,
)
from progden_jax.denoisers.graph import Node
from progden_jax.denoisers.tza import parse_tza
from progden_jax.frame import Frame

INPUTS: dict[str, tuple[str, ...]] = {
    "hdr": (),
    "hdr-alb": ("albedo",),
    "hdr-alb-nrm": ("albedo", "normal"),
    "hdr-calb-cnrm": ("albedo", "normal"),
}
"""Sets of weights for radiance, and the auxiliary buffers that each takes (c: free of noise)."""

NAMES = (
    *(f"oidn-{name}{size}" for name in INPUTS for size in ("", "-small")),
    "oidn-hdr-calb-cnrm-large",
)
"""The networks that OIDN ships for radiance."""


@jax.tree_util.register_pytree_with_keys_class
class OIDN(Network):
    """One of OIDN's networks for radiance: a pytree whose leaves are its weights and exposure.

    Parameters
    ----------
    params : see `Params`.
    inputs : auxiliary buffers taken besides the colour: (), ("albedo",) or ("albedo", "normal").
    exposure : what radiance is multiplied by before the transfer function (OIDN's inputScale), or None:
        found from each frame's log-average luminance, as OIDN does. A constant in derivatives.
    name : for messages.
    precision : of the convolutions; "highest" keeps float32 on GPUs. "tensorfloat32" (GPUs) is about
        6e-4 off in the image and 4 % in the divergence, "bfloat16" 6e-3 and 10 % (relative RMSE per
        pixel: experiments/stability). Neither will do for finite differences. On CPUs with AMX (`progden
        devices`) "high" is 4e-6 off in each convolution and hardly saves time; elsewhere on
        CPUs all but "bfloat16" are float32. Exact("cone") computes in
        float32 whatever this says.
    """

    leaves = ("params", "exposure")

    def __init__(
        self,
        params: Params,
        inputs: tuple[str, ...] = (),
        *,
        exposure: float | Array | None = None,
        name: str = "oidn",
        precision: str = "highest",
    ) -> None:
        super().__init__(params, inputs, name=name, precision=precision)
        self.exposure = exposure

    @property
    def nodes(self) -> tuple[Node, ...]:
        return unet.graph(self.params)

    def encode(self, x: Array, exposure: Array) -> Array:
        return transfer.pu_hdr(lit(x * exposure))

    def decode(self, y: Array, exposure: Array) -> Array:
        return transfer.pu_hdr_inverse(y) / exposure

    def transferred(self, role: str, buffer: Array) -> Array:
        return normal_to_unit(buffer) if role == "normal" else jnp.clip(buffer, 0, 1)

    def exposure_of(self, frame: Frame, valid: Valid) -> Array:
        exposure = self.exposure
        if exposure is None:
            exposure = autoexposure(lax.stop_gradient(frame.color), valid=valid)
        return lax.stop_gradient(jnp.asarray(exposure, frame.color.dtype))

    def __repr__(self) -> str:
        return f"OIDN({self.name!r}, inputs={self.inputs}, exposure={self.exposure})"


@jax.jit
def autoexposure(color: Float[Array, "h w 3"], *, valid: Valid = None) -> Float[Array, ""]:
    """0.18 / 2^mean(log2 L) over bins of about 16×16 pixels of mean luminance L > 1e-8; 1 for a black image.

    `valid` is the true (height, width), may be traced, of an image padded beyond it.
    """
    height, width = color.shape[:2] if valid is None else valid
    rows, row_counts = _bins(color.shape[0], height, color.dtype)
    columns, column_counts = _bins(color.shape[1], width, color.dtype)
    exact = lax.Precision.HIGHEST

    # Row by row, for a huge frame's luminance takes a third of its memory; pixels and channels as one
    # axis, for loops over three channels are no vectors.
    def add_row(sums: Array, given: tuple[Array, Array]) -> tuple[Array, None]:
        row, which = given
        sane = jnp.where((row < 0) | jnp.isnan(row), 0, row)
        return sums.at[which].add(jnp.minimum(sane, jnp.finfo(row.dtype).max), mode="drop"), None

    of_row = jnp.where(rows.any(0), rows.argmax(0), len(rows))
    flat = color.reshape(len(color), -1)
    sums, _ = lax.scan(add_row, jnp.zeros((len(rows), flat.shape[1]), color.dtype), (flat, of_row))
    weights = jnp.asarray([0.212671, 0.715160, 0.072169], color.dtype)
    luminance = (sums.reshape(len(rows), -1, 3) * weights).sum(-1)
    sums = jnp.matmul(luminance, columns.T, precision=exact)
    counts = row_counts[:, None] * column_counts
    means = sums / jnp.maximum(counts, 1)
    lit = (means > 1e-8) & (counts > 0)
    logs = jnp.where(lit, jnp.log2(jnp.where(lit, means, 1)), 0)
    number = lit.sum()
    average = logs.sum() / jnp.maximum(number, 1)
    return jnp.where(number > 0, 0.18 / jnp.exp2(average), 1).astype(color.dtype)


def _bins(size: int, valid: Array | int, dtype: Any) -> tuple[Array, Array]:
    """Membership (bins, size) of pixels in OIDN's bins along one axis, and the pixels per bin."""
    bins = -(-size // 16)
    number = (valid + 15) // 16
    index = jnp.arange(bins)
    begin = jnp.where(index < number, index * valid // number, valid)
    end = jnp.where(index < number, (index + 1) * valid // number, valid)
    pixel = jnp.arange(size)
    members = (pixel >= begin[:, None]) & (pixel < end[:, None])
    return members.astype(dtype), (end - begin).astype(dtype)


class _Prefilter(NamedTuple):
    encode: Callable[[Array], Array]
    decode: Callable[[Array], Array]


_PREFILTERS = {
    "albedo": _Prefilter(
        lambda a: transfer.srgb(jnp.clip(a, 0, 1)),
        lambda y: transfer.srgb_inverse(jnp.clip(y, 0, 1)),
    ),
    "normal": _Prefilter(normal_to_unit, lambda y: jnp.clip(y * 2 - 1, -1, 1)),
}


@functools.partial(jax.jit, static_argnames="role")
def prefilter_buffer(params: Params, buffer: Float[Array, "h w 3"], *, role: str) -> Array:
    """An albedo or normal buffer, (H, W, 3), denoised by OIDN's network for it."""
    _checks.choice("role", role, _PREFILTERS)
    _checks.image(role, buffer)
    encode, decode = _PREFILTERS[role]
    return decode(run(unet.graph(params), params, (encode(jnp.nan_to_num(buffer, nan=0.0)),)))


@functools.cache
def shipped_params(name: str) -> dict[str, dict[str, np.ndarray]]:
    """Parameters of a set of weights inside the pyoidn wheel, by OIDN's name ("rt_hdr_alb", ...).

    Raises
    ------
    ValueError
        If pyoidn is missing, holds no such weights, or keeps them in a way unknown here.
    """
    return unet.from_tensors(parse_tza(_blob(name), source=f"OIDN's weights {name}"))


def _blob(name: str) -> bytes:
    from elftools.common.exceptions import ELFError
    from elftools.elf.elffile import ELFFile
    from elftools.elf.hash import GNUHashSection

    library = _core_library()
    symbol_name = f"_ZN4oidn5blobs7weights{len(name)}{name}E"
    try:
        with library.open("rb") as file:
            elf = ELFFile(file)
            table = cast(GNUHashSection, elf.get_section_by_name(".gnu.hash"))
            symbol = None if table is None else table.get_symbol(symbol_name)
            if symbol is None:
                raise ValueError(
                    f"{library} holds no weights named {name}; the radiance networks are {', '.join(NAMES)}."
                )
            section = cast(Any, elf.get_section(symbol["st_shndx"]))
            file.seek(section["sh_offset"] + symbol["st_value"] - section["sh_addr"])
            return file.read(symbol["st_size"])
    except (OSError, ELFError) as error:
        raise ValueError(
            f"cannot read OIDN's weights from {library} ({error}): give a weights file (.tza) instead."
        ) from error


def _core_library() -> Path:
    spec = importlib.util.find_spec("pyoidn")
    if spec is None or spec.origin is None:
        raise ValueError("OIDN's weights come with the package pyoidn: pip install pyoidn.")
    folder = Path(spec.origin).parent
    found = sorted(folder.glob("oidn/lib/libOpenImageDenoise_core*.so*"))
    if not found:
        raise ValueError(
            f"{folder} holds no libOpenImageDenoise_core.so: on this system pyoidn's weights cannot be read; "
            "give a weights file (.tza) instead."
        )
    return found[-1]
