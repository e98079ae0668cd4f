"""Synthetic EXR files for the tests: through OpenEXR itself, and byte by byte where it cannot."""

import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

RNG = np.random.default_rng(7)
SHARED = Path(__file__).parents[2] / "shared" / "data" / "valid"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data/valid")
HEIGHT, WIDTH = 6, 5


def plane(dtype="float32", size=(HEIGHT, WIDTH)) -> np.ndarray:
    """Values that half precision holds exactly, so that types can be mixed in exact tests."""
    values = RNG.integers(1, 2000, size).astype(dtype)
    return values if dtype == "uint32" else values / np.asarray(64, dtype)


def planes(names: str, dtype="float32", size=(HEIGHT, WIDTH)) -> dict[str, np.ndarray]:
    """Channels by a short notation: "R G B Albedo.R/G/B" -> one random plane for each."""
    channels = {}
    for word in names.replace("~", "\0").split():
        layer, dot, components = word.replace("\0", " ").rpartition(".")
        for component in components.split("/"):
            channels[layer + dot + component] = plane(dtype, size)
    return channels


def window(x0, y0, x1, y1):
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def write(path, channels, compression="ZIP", **header) -> Path:
    """One part with these channels (arrays, in any mix of half, float and uint)."""
    # A copy: the library changes the mapping that it is given.
    OpenEXR.File(_header(compression, header), dict(channels)).write(str(path))
    return Path(path)


def write_parts(path, parts: dict[str, dict[str, np.ndarray]], **headers) -> Path:
    """Several parts: name -> channels; `headers`: part name -> attributes."""
    OpenEXR.File(
        [
            OpenEXR.Part(_header("ZIP", headers.get(name, {})), dict(channels), name)
            for name, channels in parts.items()
        ]
    ).write(str(path))
    return Path(path)


def read_channels(path, part=0):
    """Channel -> pixels, and the header, by the library directly."""
    found = OpenEXR.File(str(path), separate_channels=True).parts[part]
    return {name: channel.pixels for name, channel in found.channels.items()}, found.header


def stack(channels, names: str) -> np.ndarray:
    """The named channels (notation of `planes`) as one float32 image."""
    layer, dot, components = names.rpartition(".")
    return np.stack(
        [channels[layer + dot + c].astype(np.float32) for c in components.split("/")], axis=-1
    )


def write_raw(path, channels, size, attributes=()) -> Path:
    """An uncompressed scanline file, byte by byte: name -> (float plane, sampling)."""
    height, width = size

    def attribute(name, kind, data):
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    ordered = sorted(channels.items())
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, sampling, sampling)
        for name, (_, sampling) in ordered
    )
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = struct.pack("<ii", 20000630, 2) + attribute("channels", "chlist", listed + b"\0")
    header += attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", box) + attribute("displayWindow", "box2i", box)
    header += attribute("lineOrder", "lineOrder", b"\0")
    header += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0, 0))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1))
    header += b"".join(attribute(*a) for a in attributes) + b"\0"
    chunks = []
    for y in range(height):
        lines = [p[y // s].astype("<f4").tobytes() for _, (p, s) in ordered if y % s == 0]
        data = b"".join(lines)
        chunks.append(struct.pack("<ii", y, len(data)) + data)
    offset = len(header) + 8 * height
    table = b""
    for chunk in chunks:
        table += struct.pack("<Q", offset)
        offset += len(chunk)
    Path(path).write_bytes(header + table + b"".join(chunks))
    return Path(path)


def _header(compression, attributes):
    kind = {"type": OpenEXR.scanlineimage}
    return {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), **kind, **attributes}
