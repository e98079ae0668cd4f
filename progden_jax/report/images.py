"""HDR images as script files, the only files that a page opened from file:// may read back.

One image is one file `images/ID.js` that hands its pixels to the page: half floats times a power of two,
each a difference from the left neighbour, high bytes before low bytes, deflated, in base64.
"""

import base64
import hashlib
import json
import math
import threading
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

# Tried on a 1920×1080 render at 32 spp, in MB of the script file: halves deflated as they are 7.7, their high
# bytes before the low ones 6.6, differences of them 6.4 (5.0 where it is smooth), RGBE 4.3, which has no
# negative values and two digits. Chromium decodes 6.4 MB in 0.16 s on one busy core, most of it inflating.
_LEVEL = 6
_LARGEST = 15


def to_half(image: Float[np.ndarray, "h w c"]) -> tuple[Float[np.ndarray, "h w c"], float]:
    """The image in half precision, and the power of two that it has to be multiplied by.

    The largest finite value comes out between 2¹⁴ and 2¹⁵, so that neither fireflies nor the small
    values of a SURE map at many samples are lost. NaN and infinities stay.
    """
    finite = np.abs(image[np.isfinite(image)])
    largest = float(finite.max(initial=0))
    # Below 2⁻⁹⁰ nothing is visible, and the page's single precision would lose it.
    exponent = max(math.frexp(largest)[1], -90) - _LARGEST if largest > 0 else 0
    half = np.ldexp(image.astype(np.float64), -exponent).astype(np.float16)
    return half, math.ldexp(1.0, exponent)


def encode(half: Float[np.ndarray, "h w c"]) -> bytes:
    """Half floats as bytes that deflate well, deflated: the inverse of the page's `decode`."""
    bits = np.ascontiguousarray(np.moveaxis(half, -1, 0)).view(np.uint16).reshape(-1)
    differences = np.diff(bits, prepend=np.uint16(0))
    planes = np.stack([differences >> 8, differences & 255]).astype(np.uint8)
    return zlib.compress(planes.tobytes(), _LEVEL)


class ImageFiles:
    """Writes images into a folder, each content once; safe to call from several threads."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._known: set[str] = set()
        self._lock = threading.Lock()

    def add(self, image: Float[np.ndarray, "h w c"]) -> str:
        """The name by which the page asks for this image, of one or three channels."""
        half, scale = to_half(image)
        height, width, channels = half.shape
        about = {"width": width, "height": height, "channels": channels, "scale": scale}
        name = hashlib.sha256(json.dumps(about).encode() + half.tobytes()).hexdigest()[:24]
        with self._lock:
            if name in self._known:
                return name
            self._known.add(name)
        text = base64.b64encode(encode(half)).decode()
        script = f'progden.image("{name}",{json.dumps(about)},"{text}");\n'
        (self._folder / f"{name}.js").write_text(script, encoding="ascii")
        return name
