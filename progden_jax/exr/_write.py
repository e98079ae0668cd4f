"""Frames, images and named layers into an OpenEXR file that is either whole or not there."""

import os
from collections.abc import Collection, Mapping
from typing import Any, NoReturn

import numpy as np
import OpenEXR

from progden_jax._files import replacing
from progden_jax.exr._channels import alpha_of, find
from progden_jax.exr._file import ExrError, Part, load, on_all_cores, quiet
from progden_jax.exr._info import ExrInfo
from progden_jax.exr._names import Source
from progden_jax.frame import HALF_MAX, Frame

PathLike = str | os.PathLike[str]

COMPRESSIONS = ("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab")

# What describes the old file's storage or part, not the picture; preview shows the old picture.
_NOT_KEPT = {
    "channels",
    "chunkCount",
    "compression",
    "dwaCompressionLevel",
    "lineOrder",
    "maxSamplesPerPixel",
    "name",
    "preview",
    "tiles",
    "type",
    "version",
    "zipCompressionLevel",
}


def write_exr(
    path: PathLike,
    image: Any,
    *,
    layers: Mapping[str, Any] | None = None,
    like: PathLike | ExrInfo | None = None,
    spp: float | None = None,
    overwrite: bool = False,
    half: bool | Collection[str] = False,
    compression: str = "zip",
    attributes: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Write an image or a frame with named layers; returns notes on what had to be changed.

    Channels are R, G, B and, of a frame, Variance.R/G/B (of the mean), Albedo.R/G/B, Normal.X/Y/Z
    and Depth.Z, all float: `read_exr` gives the same frame back, bit for bit. The file appears
    under its name only when it is complete and has been read back.

    Parameters
    ----------
    path : the file to write, in a folder that exists.
    image : (H, W, 3) linear radiance, or one Frame.
    layers : name -> (H, W, 3), written as name.R/G/B, or (H, W) or (H, W, 1), as name.Y.
    like : the input (its path, or what `progden_jax.exr.read_exr_with_info` told of it, which knows what was
        chosen among several parts): its windows, pixel aspect, chromaticities, camera and all other
        attributes are kept, and its alpha channel (premultiplied, as EXR has it).
    spp : samples per pixel, written as the attribute samplesPerPixel; by default the frame's, else
        that of `like`.
    overwrite : whether an existing file may be replaced.
    half : store colour, albedo, normal and layers in half precision, clipping at ±65504; variance
        and depth, whose range half does not hold, stay float. Or the names of the layers to store
        so, such as ("Albedo", "Normal").
    compression : none, rle, zips, zip or piz (lossless); pxr24, b44, b44a, dwaa or dwab (lossy).
    attributes : texts to write into the header, by name.

    Raises
    ------
    ExrError
        If the file exists, cannot be written in full (nothing is left behind), or shapes do not
        fit.
    """
    target = _check_target(path, overwrite)
    if compression not in COMPRESSIONS:
        raise ExrError(
            f"compression is {compression!r}, expected one of {', '.join(COMPRESSIONS)}."
        )
    notes: list[str] = []
    channels, size = _channels_of(image, layers or {}, half=half, notes=notes)
    if spp is None and isinstance(image, Frame) and image.spp is not None:
        spp = float(image.spp)
    header: dict[str, Any] = {}
    if like is not None:
        part, alpha, like_spp = _like(like)
        if part.size != size:
            raise ExrError(
                f"{os.fspath(path)}: the image is {_text(size)} pixels but like has "
                f"{_text(part.size)}: attributes and alpha can only be kept from a file of the "
                "same size."
            )
        header = {
            name: value
            for name, value in part.header.items()
            if name not in _NOT_KEPT and not (isinstance(value, list) and not value)
        }  # the library can read an empty list but not write it
        spp = like_spp if spp is None else spp
        if alpha is not None:
            channels.setdefault("A", alpha)
    if spp is not None:
        header["samplesPerPixel"] = int(spp) if float(spp).is_integer() else float(spp)
    header |= attributes or {}
    header |= {
        "type": OpenEXR.scanlineimage,
        "compression": getattr(
            OpenEXR, f"{'NO' if compression == 'none' else compression.upper()}_COMPRESSION"
        ),
    }
    _write(target, header, channels)
    return tuple(notes)


def _check_target(path: PathLike, overwrite: bool) -> str:
    """The file that will be written, symbolic links followed."""
    target = os.path.realpath(path)
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        raise ExrError(f"{os.fspath(path)}: cannot be written: there is no folder {folder}.")
    if os.path.lexists(target):
        if not os.path.isfile(target):
            raise ExrError(f"{os.fspath(path)}: cannot be written: it exists and is not a file.")
        if not overwrite:
            raise ExrError(
                f"{os.fspath(path)}: the file exists; pass overwrite=True (--force) to replace it."
            )
    return target


def _channels_of(
    image: Any, layers: Mapping[str, Any], *, half: bool | Collection[str], notes: list[str]
) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
    pictures: dict[str, tuple[Any, str]] = {"": (image, "RGB")}
    if isinstance(image, Frame):
        if image.color.ndim != 3:
            raise ExrError(
                f"the frame is a batch {image.color.shape[:-3]}: write its frames one by one."
            )
        pictures = {"": (image.color, "RGB"), "Variance": (image.variance, "RGB")}
        pictures |= {"Albedo": (image.albedo, "RGB"), "Normal": (image.normal, "XYZ")}
        pictures |= {"Depth": (image.depth, "Z")}
    for name, value in layers.items():
        if not name or name.strip(".") != name or "\0" in name or len(name.encode()) > 250:
            raise ExrError(f"layers: {name!r} cannot name a layer.")
        if name in pictures and pictures[name][0] is not None:
            raise ExrError(
                f"layers: the frame writes a layer {name!r} itself; choose another name."
            )
        pictures[name] = (value, "RGB" if np.ndim(value) == 3 and np.shape(value)[-1] != 1 else "Y")
    size = np.shape(pictures[""][0])[:2]
    channels = {}
    for name, (value, components) in pictures.items():
        if value is None:
            continue
        what = f"layers[{name!r}]" if name in layers else "image"
        pixels = _pixels(value, what, len(components), size)
        wide = name in ("Variance", "Depth")
        if (half and not wide) if isinstance(half, bool) else name in half:
            pixels = _to_half(pixels, name or "the image", notes)
        for i, component in enumerate(components):
            # Contiguous: of strided arrays the library writes the wrong values.
            channels[f"{name}.{component}" if name else component] = np.ascontiguousarray(
                pixels[..., i]
            )
    return channels, (size[0], size[1])


def _pixels(value: Any, what: str, count: int, size: tuple[int, ...]) -> np.ndarray:
    pixels = np.asarray(value)
    if not np.issubdtype(pixels.dtype, np.floating):
        raise ExrError(f"{what} has dtype {pixels.dtype}, expected floating-point values.")
    if count == 1 and pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[-1] != count or 0 in pixels.shape:
        expected = "(height, width, 3)" + (
            ", (height, width, 1) or (height, width)" if "[" in what else ""
        )
        raise ExrError(f"{what} has shape {pixels.shape}, expected {expected}.")
    if pixels.shape[:2] != size:
        raise ExrError(f"{what} is {_text(pixels.shape)} pixels but the image is {_text(size)}.")
    with np.errstate(over="ignore"):
        return pixels.astype(np.float32, copy=False)


def _to_half(pixels: np.ndarray, name: str, notes: list[str]) -> np.ndarray:
    over = int((np.isfinite(pixels) & (np.abs(pixels) > HALF_MAX)).sum())
    if over:
        notes.append(f"{over} values of {name} are beyond half precision and were clipped to 65504")
    clipped = np.where(np.isfinite(pixels), np.clip(pixels, -HALF_MAX, HALF_MAX), pixels)
    return clipped.astype(np.float16)


def _like(like: PathLike | ExrInfo) -> tuple[Part, np.ndarray | None, float | None]:
    """The part whose attributes are kept, its alpha, and its samples per pixel."""
    if isinstance(like, ExrInfo):
        color, alpha = like.roles["color"], like.roles["alpha"]
        index = color.part if color.part is not None and color.file is None else 0
        if not alpha.channels:
            return load(like.path, header_only=True)[index], None, like.spp
        parts = load(like.path)
        return parts[index], parts[index].channels[alpha.channels[0]].pixels, like.spp
    parts = load(like)
    color = find(parts, "color")
    if not isinstance(color, Source):
        return parts[0], None, None
    alpha = alpha_of(parts, color)
    part = parts[color.part]
    return part, None if alpha is None else part.channels[alpha.channels[0]].pixels, None


def _write(target: str, header: dict[str, Any], channels: dict[str, np.ndarray]) -> None:
    """The file; `channels` is empty afterwards."""
    try:
        with replacing(target) as beside:
            with quiet(), on_all_cores():
                OpenEXR.File(header, channels).write(os.fspath(beside))
            names = set(channels)
            channels.clear()  # of a huge image there must not be two copies
            # Read back whole: the library's destructors swallow what goes wrong at the end.
            written = load(beside)[0].channels
            if written.keys() != names:
                raise ExrError(f"what was written reads back as {', '.join(written)}")
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        _fail(target, error)


def _fail(target: str, error: Exception) -> NoReturn:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    reason = reason.replace(os.path.dirname(target) + os.sep, "").rstrip(".")
    raise ExrError(f"{target}: cannot be written ({reason}); nothing was left behind.") from None


def _text(size: Any) -> str:
    return "×".join(map(str, size[:2]))
