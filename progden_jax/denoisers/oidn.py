"""Open Image Denoise's ray-tracing filter in JAX, with the weights of the installed pyoidn wheel.

Matches the native library to float32 rounding. Its steps, per pixel: colour times exposure, NaN to 0, clamped
at 0, perceptually uniform (PU) transfer; albedo clamped to [0, 1]; normals clamped to [-1, 1] and moved to
[0, 1]; zeros up to a multiple of 16; the U-Net; and the inverse of the colour's steps.
"""

import dataclasses
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
from progden_jax.denoisers._base import Bound
from progden_jax.denoisers.graph import Layered, Node
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
class OIDN:
    """One of OIDN's networks for radiance: a pytree whose leaves are its weights and exposure.

    Parameters
    ----------
    params : see `unet.Params`.
    inputs : auxiliary buffers taken besides the colour: (), ("albedo",) or ("albedo", "normal").
    exposure : what radiance is multiplied by before the transfer function (OIDN's inputScale), or None:
        found from each frame's log-average luminance, as OIDN does. A constant in derivatives.
    name : for messages.
    precision : of the convolutions; "highest" keeps float32 on GPUs. "tensorfloat32" (GPUs only) is about
        6e-4 off in the image and 4 % in the divergence, "bfloat16" 6e-3 and 10 % (relative RMSE per
        pixel: experiments/stability). Neither will do for finite differences. Exact("cone") computes in
        float32 whatever this says.
    """

    canvas = True

    def __init__(
        self,
        params: unet.Params,
        inputs: tuple[str, ...] = (),
        *,
        exposure: float | Array | None = None,
        name: str = "oidn",
        precision: str = "highest",
    ) -> None:
        first = next(iter(unet.layout(params)[0][0]))
        taken, expected = params[first]["kernel"].shape[2], 3 * (1 + len(inputs))
        if taken != expected:
            raise ValueError(
                f"the weights of {name} take {taken} input channels; radiance with "
                f"{' and '.join(inputs) or 'nothing else'} makes {expected}."
            )
        self.params = params
        self.inputs = inputs
        self.exposure = exposure
        self.name = name
        self.precision = precision

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance, at least 0.

        Raises
        ------
        ValueError
            If the frame is no single image, or lacks a buffer that the network takes.
        """
        return _jitted_call(self, frame)

    def bind(self, frame: Frame, *, valid: tuple[Array | int, Array | int] | None = None) -> Bound:
        """f with y = f(x) for the frame's auxiliary buffers and exposure; a pytree, so it passes through jit.

        `valid` is the true (height, width), may be traced, of a frame padded beyond it with zeros.
        """
        _checks.image("frame.color", frame.color)
        auxiliary = []
        for name in self.inputs:
            buffer = getattr(frame, name)
            if buffer is None:
                raise ValueError(
                    f"{self.name} takes {' and '.join(self.inputs)}, and this frame has no {name}: "
                    "choose a network with fewer inputs, such as 'oidn-hdr', or give the buffer."
                )
            buffer = jnp.nan_to_num(buffer, nan=0.0)
            if name == "normal":
                auxiliary.append(jnp.clip(buffer, -1, 1) * 0.5 + 0.5)
            else:
                auxiliary.append(jnp.clip(buffer, 0, 1))
        exposure = self.exposure
        if exposure is None:
            exposure = autoexposure(frame.color, valid=valid)
        exposure = lax.stop_gradient(jnp.asarray(exposure, frame.color.dtype))
        return BoundOIDN(self, tuple(auxiliary), exposure, valid)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input."""
        return unet.receptive_radius(self.params)

    def __repr__(self) -> str:
        return f"OIDN({self.name!r}, inputs={self.inputs}, exposure={self.exposure})"

    def tree_flatten_with_keys(self) -> tuple[list[tuple[Any, Any]], Any]:
        keys = (jax.tree_util.GetAttrKey("params"), jax.tree_util.GetAttrKey("exposure"))
        children, static = self.tree_flatten()
        return list(zip(keys, children, strict=True)), static

    def tree_flatten(self) -> tuple[tuple[Any, Any], Any]:
        return (self.params, self.exposure), (self.inputs, self.name, self.precision)

    @classmethod
    def tree_unflatten(cls, static: Any, children: Any) -> "OIDN":
        denoiser = object.__new__(cls)
        denoiser.params, denoiser.exposure = children
        denoiser.inputs, denoiser.name, denoiser.precision = static
        return denoiser


@jax.jit
def _jitted_call(denoiser: OIDN, frame: Frame) -> Array:
    return denoiser.bind(frame)(frame.color)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BoundOIDN:
    """y = f(x) for one frame: what `OIDN.bind` gives."""

    denoiser: OIDN
    auxiliary: tuple[Array, ...]
    exposure: Array
    valid: tuple[Array | int, Array | int] | None

    def __call__(self, x: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance."""
        _checks.image("x", x)
        return _run_bound(self, x)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input."""
        return self.denoiser.receptive_radius

    @property
    def alignment(self) -> int:
        """Pixels after which the way that outputs depend on inputs repeats."""
        return unet.ALIGNMENT

    @property
    def layers(self) -> tuple[tuple[Node, ...], unet.Params]:
        """The network's graph and parameters."""
        return unet.graph(self.denoiser.params), self.denoiser.params

    def layered(self, x: Float[Array, "h w 3"]) -> Layered:
        """f taken apart at x, for algorithms that look inside the network."""
        encoded, slope = jax.jvp(self._encode, (x,), (jnp.ones_like(x),))
        inputs = jnp.concatenate((encoded, *self.auxiliary), axis=-1)
        inside = _inside(x.shape[:2], self.valid)
        if inside is not None:
            inputs, slope = jnp.where(inside, inputs, 0), jnp.where(inside, slope, 0)
        inputs = _pad_to_alignment(inputs)
        aligned = _inside(inputs.shape[:2], _aligned(self.valid))
        params = self.denoiser.params
        return Layered(unet.graph(params), params, inputs, aligned, slope, self._decode)

    def _encode(self, x: Array) -> Array:
        radiance = x * self.exposure
        # At exactly 0 the derivative is the one from the right: black pixels respond to light.
        radiance = jnp.where((radiance < 0) | jnp.isnan(radiance), 0, radiance)
        return transfer.pu_hdr(radiance)

    def _decode(self, y: Array) -> Array:
        return transfer.pu_hdr_inverse(y) / self.exposure


@jax.jit
def _run_bound(f: BoundOIDN, x: Array) -> Array:
    inside = _inside(x.shape[:2], f.valid)
    y = run_unet(
        f.denoiser.params,
        (f._encode(x), *f.auxiliary),
        inside=inside,
        valid=f.valid,
        precision=f.denoiser.precision,
    )
    y = f._decode(y)
    return y if inside is None else jnp.where(inside, y, 0)


Valid = tuple[Array | int, Array | int] | None


def _inside(shape: tuple[int, ...], valid: Valid) -> Array | None:
    if valid is None:
        return None
    rows, columns = (jnp.arange(n) < v for n, v in zip(shape, valid, strict=True))
    return (rows[:, None] & columns[None, :])[..., None]


def _aligned(valid: Valid) -> Valid:
    if valid is None:
        return None
    size = unet.ALIGNMENT
    return (valid[0] + size - 1) // size * size, (valid[1] + size - 1) // size * size


def _pad_to_alignment(x: Array) -> Array:
    return jnp.pad(
        x, ((0, -x.shape[0] % unet.ALIGNMENT), (0, -x.shape[1] % unet.ALIGNMENT), (0, 0))
    )


def run_unet(
    params: unet.Params,
    channels: tuple[Float[Array, "h w 3"], ...],
    *,
    inside: Array | None = None,
    valid: tuple[Array | int, Array | int] | None = None,
    precision: str = "highest",
) -> Float[Array, "h w 3"]:
    """The network on transferred channels of any size, padded with zeros as OIDN pads and cropped again."""
    x = jnp.concatenate(channels, axis=-1)
    if inside is not None:
        x = jnp.where(inside, x, 0)
    y = unet.apply(
        params,
        _pad_to_alignment(x),
        valid=_aligned(valid),
        precision=lax.Precision.HIGHEST if precision == "highest" else cast(Any, precision),
    )
    return y[: x.shape[0], : x.shape[1]]


@jax.jit
def autoexposure(
    color: Float[Array, "h w 3"], *, valid: tuple[Array | int, Array | int] | None = None
) -> Float[Array, ""]:
    """0.18 / 2^mean(log2 L) over bins of about 16×16 pixels of mean luminance L > 1e-8; 1 for a black image.

    `valid` is the true (height, width), may be traced, of an image padded beyond it.
    """
    height, width = color.shape[:2] if valid is None else valid
    sane = jnp.where((color < 0) | jnp.isnan(color), 0, color)
    sane = jnp.minimum(sane, jnp.finfo(color.dtype).max)
    weights = jnp.asarray([0.212671, 0.715160, 0.072169], color.dtype)
    luminance = (sane * weights).sum(-1)
    rows, row_counts = _bins(color.shape[0], height, color.dtype)
    columns, column_counts = _bins(color.shape[1], width, color.dtype)
    exact = lax.Precision.HIGHEST
    sums = jnp.matmul(jnp.matmul(rows, luminance, precision=exact), columns.T, precision=exact)
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
    "normal": _Prefilter(
        lambda n: jnp.clip(n, -1, 1) * 0.5 + 0.5, lambda y: jnp.clip(y * 2 - 1, -1, 1)
    ),
}


@functools.partial(jax.jit, static_argnames="role")
def prefilter_buffer(params: unet.Params, buffer: Float[Array, "h w 3"], *, role: str) -> Array:
    """An albedo or normal buffer, (H, W, 3), denoised by OIDN's network for it."""
    _checks.choice("role", role, _PREFILTERS)
    _checks.image(role, buffer)
    encode, decode = _PREFILTERS[role]
    return decode(run_unet(params, (encode(jnp.nan_to_num(buffer, nan=0.0)),)))


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
