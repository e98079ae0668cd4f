"""What windows of a frame must know of the whole of it; repairs, on the host and in bands of rows."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from progden_jax._numeric import adopted
from progden_jax.frame import Frame, Repairs, repair

BUFFERS = ("color", "variance", "albedo", "normal", "depth")

_BAND = 64
"""Rows, which stay in the cache for a second look."""

_NOT_NEGATIVE = ("color", "variance")

_REPAIR_RADIUS = 2
"""`repair` looks at the 5×5 around a bad pixel."""


class Patches(NamedTuple):
    """Pixels of a buffer that were repaired, by rows: where they are, (n,) each, and their values, (n, C)."""

    rows: np.ndarray
    columns: np.ndarray
    values: np.ndarray


class Survey(NamedTuple):
    """A frame on the host, how its bad values are repaired, and what depends on all of it.

    Attributes
    ----------
    buffers : name -> (H, W, C), of those that the frame has, as they came.
    patches : of the buffers that have bad values: a huge frame is not copied for a few of them.
    repairs : counts of bad pixels.
    mean_variance : over pixels and channels; 0 without a variance.
    level : mean over pixels and channels of the radiance above 0.
    """

    buffers: dict[str, np.ndarray]
    patches: dict[str, Patches]
    repairs: Repairs
    mean_variance: np.floating
    level: np.floating

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.buffers["color"].shape[:2]
        return height, width

    def repaired(self, name: str) -> np.ndarray:
        """A whole buffer; the frame's own where nothing in it is bad."""
        return self.window(name, (0, 0), self.size)

    def window(self, name: str, origin: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
        """A window of a buffer repaired, see `crop`."""
        part = crop(self.buffers[name], origin, shape)
        if name not in self.patches:
            return part
        rows, columns, values = self.patches[name]
        begin, end = np.searchsorted(rows, (origin[0], origin[0] + shape[0]))
        rows, columns = rows[begin:end] - origin[0], columns[begin:end] - origin[1]
        hit = (columns >= 0) & (columns < shape[1])
        if hit.any():
            part = part.copy()
            part[rows[hit], columns[hit]] = values[begin:end][hit]
        return part


def survey(frame: Frame) -> Survey:
    """See `Survey`."""
    buffers = {
        name: np.asarray(getattr(frame, name))
        for name in BUFFERS
        if getattr(frame, name) is not None
    }
    changes: dict[str, list[Patches]] = {}
    counts = np.zeros(len(Repairs._fields), np.int64)
    noise, light = 0.0, 0.0
    height = frame.size[0]
    for top in range(0, height, _BAND):
        bottom = min(top + _BAND, height)
        band = {name: buffer[top:bottom] for name, buffer in buffers.items()}
        sums = _sums(band)
        if sums is None:
            first, last = max(top - _REPAIR_RADIUS, 0), min(bottom + _REPAIR_RADIUS, height)
            around = {name: buffer[first:last] for name, buffer in buffers.items()}
            fixed, _ = _repair(frame_of(around))
            _, found = _repair(frame_of(band))
            counts += np.asarray(jax.device_get(list(found)), np.int64)
            for name, given in band.items():
                mended = np.asarray(getattr(fixed, name))[top - first : bottom - first]
                rows, columns = np.nonzero((mended != given).any(-1))
                if rows.size:
                    values = mended[rows, columns]
                    changes.setdefault(name, []).append(Patches(rows + top, columns, values))
                band[name] = mended
            lit = {name: np.maximum(band[name], 0) for name in _NOT_NEGATIVE if name in band}
            sums = {name: float(values.sum(dtype=np.float64)) for name, values in lit.items()}
        light += sums["color"]
        noise += sums.get("variance", 0.0)
    scalar, size = buffers["color"].dtype.type, buffers["color"].size
    repairs = Repairs(*(jnp.asarray(n, jnp.int32) for n in counts))
    patches = {
        name: Patches(*map(np.concatenate, zip(*found, strict=True)))
        for name, found in changes.items()
    }
    return Survey(buffers, patches, repairs, scalar(noise / size), scalar(light / size))


def _sums(band: dict[str, np.ndarray]) -> dict[str, float] | None:
    """Of each buffer; None where one has a value that may be bad."""
    with np.errstate(over="ignore", invalid="ignore"):
        # NumPy sums pairwise. Whatever is not finite shows in the sum.
        sums = {name: float(buffer.sum()) for name, buffer in band.items()}
    lowest = [band[name].min() for name in _NOT_NEGATIVE if name in band]
    return sums if all(map(math.isfinite, sums.values())) and min(lowest) >= 0 else None


def frame_of(buffers: Mapping[str, Any]) -> Frame:
    """A frame of buffers by name."""
    others = {name: buffer for name, buffer in buffers.items() if name != "color"}
    return Frame(buffers["color"], others.pop("variance", None), **others)


_repair = jax.jit(repair)


def exposure_of(color: np.ndarray, denoiser: Any) -> Any:
    """What the denoiser makes of a whole frame's repaired colour."""
    return denoiser.exposure_of(Frame(adopted(color), None), None)


def crop(buffer: np.ndarray | Array, origin: tuple[int, int], shape: tuple[int, int]) -> Any:
    """A window of an image, with zeros where it reaches beyond it; no copy where it does not."""
    part = np.asarray(buffer)[origin[0] : origin[0] + shape[0], origin[1] : origin[1] + shape[1]]
    if part.shape[:2] == tuple(shape):
        return part
    widths = [(0, n - m) for n, m in zip(shape, part.shape[:2], strict=True)]
    return np.pad(part, [*widths, (0, 0)])
