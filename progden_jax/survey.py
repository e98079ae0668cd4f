"""What windows of a frame must know of the whole of it; repairs, on the host and in bands of rows."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from progden_jax._numeric import adopted
from progden_jax.frame import Frame, Repairs, repair

BUFFERS = ("color", "variance", "albedo", "normal", "depth")

_BAND = 256
_REPAIR_RADIUS = 2
"""`repair` looks at the 5×5 around a bad pixel."""


class Survey(NamedTuple):
    """A frame on the host with its bad values repaired, and what depends on all of it.

    Attributes
    ----------
    buffers : name -> (H, W, C), of those that the frame has.
    repairs : counts of bad pixels.
    mean_variance : over pixels and channels; 0 without a variance.
    level : mean over pixels and channels of the radiance above 0.
    """

    buffers: dict[str, np.ndarray]
    repairs: Repairs
    mean_variance: np.floating
    level: np.floating

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.buffers["color"].shape[:2]
        return height, width


def survey(frame: Frame) -> Survey:
    """See `Survey`. Finite buffers are not copied."""
    buffers = {
        name: np.asarray(getattr(frame, name))
        for name in BUFFERS
        if getattr(frame, name) is not None
    }
    given, copied = dict(buffers), set()
    counts = np.zeros(len(Repairs._fields), np.int64)
    noise, light = 0.0, 0.0
    height = frame.size[0]
    for top in range(0, height, _BAND):
        bottom = min(top + _BAND, height)
        band = {name: buffer[top:bottom] for name, buffer in given.items()}
        if _negative_color(band) or not _sound(band):
            first, last = max(top - _REPAIR_RADIUS, 0), min(bottom + _REPAIR_RADIUS, height)
            around = {name: buffer[first:last] for name, buffer in given.items()}
            fixed, _ = _repair(frame_of(around))
            _, found = _repair(frame_of(band))
            counts += np.asarray(jax.device_get(list(found)), np.int64)
            if not _sound(band):
                for name in given:
                    if name not in copied:
                        buffers[name] = buffers[name].copy()
                        copied.add(name)
                    mended = np.asarray(getattr(fixed, name))
                    buffers[name][top:bottom] = mended[top - first : bottom - first]
        if "variance" in buffers:
            noise += float(buffers["variance"][top:bottom].sum(dtype=np.float64))
        light += float(np.maximum(buffers["color"][top:bottom], 0).sum(dtype=np.float64))
    scalar, size = buffers["color"].dtype.type, buffers["color"].size
    repairs = Repairs(*(jnp.asarray(n, jnp.int32) for n in counts))
    return Survey(buffers, repairs, scalar(noise / size), scalar(light / size))


def _negative_color(band: dict[str, np.ndarray]) -> bool:
    return bool((band["color"] < 0).any())


def _sound(band: dict[str, np.ndarray]) -> bool:
    variance = band.get("variance")
    finite = all(np.isfinite(buffer).all() for buffer in band.values())
    return finite and (variance is None or not (variance < 0).any())


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
