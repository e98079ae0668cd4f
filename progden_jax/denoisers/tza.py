"""TZA, the tensor archive in which Open Image Denoise keeps its weights: read and write.

Little-endian. Header: magic u16 0x41D7, version u8 2 and u8 minor, table offset u64. Table: count u32,
then per tensor: name length u16, name, rank u8, dimensions u32, one layout character per dimension,
type character ('f' float32, 'h' float16), offset u64 of its data.
"""

import os
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from progden_jax._files import replacing

_MAGIC = 0x41D7
_VERSION = 2
_ALIGNMENT = 64
_TYPES = {"f": np.dtype("<f4"), "h": np.dtype("<f2")}
_LAYOUTS = {1: "x", 4: "oihw"}


def parse_tza(data: bytes, *, source: str = "data") -> dict[str, np.ndarray]:
    """The tensors of an archive by name, as stored: convolution kernels (out, in, h, w).

    Raises
    ------
    ValueError
        If `data` is no TZA archive of version 2, or is cut short; the message names `source`.
    """
    try:
        magic, major, _, table = struct.unpack_from("<HBBQ", data, 0)
        if magic != _MAGIC:
            raise ValueError(
                f"{source} is not a TZA archive: it begins with {data[:2].hex()}, not d741."
            )
        if major != _VERSION:
            raise ValueError(f"{source} is a TZA archive of version {major}, expected {_VERSION}.")
        (count,) = struct.unpack_from("<I", data, table)
        position = table + 4
        tensors = {}
        for _ in range(count):
            (length,) = struct.unpack_from("<H", data, position)
            name = data[position + 2 : position + 2 + length].decode("ascii")
            position += 2 + length
            (rank,) = struct.unpack_from("<B", data, position)
            shape = struct.unpack_from(f"<{rank}I", data, position + 1)
            position += 1 + 4 * rank
            layout = data[position : position + rank].decode("ascii")
            kind = chr(data[position + rank])
            (offset,) = struct.unpack_from("<Q", data, position + rank + 1)
            position += rank + 9
            if kind not in _TYPES or layout != _LAYOUTS.get(rank):
                raise ValueError(
                    f"{source}: tensor {name} has layout {layout!r} and type {kind!r}; "
                    "expected 'x' or 'oihw', and 'f' or 'h'."
                )
            values = np.frombuffer(data, _TYPES[kind], int(np.prod(shape)), offset)
            tensors[name] = values.reshape(shape)
    except (struct.error, UnicodeDecodeError, IndexError) as error:
        raise ValueError(
            f"{source} is a TZA archive that is damaged or cut short ({error})."
        ) from error
    except ValueError as error:
        if str(error).startswith(source):
            raise
        raise ValueError(
            f"{source} is a TZA archive that is damaged or cut short ({error})."
        ) from error
    return tensors


def read_tza(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The tensors of the archive at `path` by name; see `parse_tza`."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read the weights {os.fspath(path)}: {error.strerror}.") from error
    return parse_tza(data, source=os.fspath(path))


def write_tza(path: str | os.PathLike[str], tensors: Mapping[str, np.ndarray]) -> None:
    """Write tensors of rank 1 or of rank 4 (out, in, h, w), float16 or float32, that OIDN can load.

    Written beside `path` and renamed, so an interrupted write leaves no broken file.
    """
    kinds = {dtype: kind for kind, dtype in _TYPES.items()}
    blobs, table, position = [], [struct.pack("<I", len(tensors))], struct.calcsize("<HBBQ")
    for name, tensor in tensors.items():
        array = np.ascontiguousarray(tensor)
        kind, layout = kinds.get(array.dtype.newbyteorder("<")), _LAYOUTS.get(array.ndim)
        if kind is None or layout is None:
            raise ValueError(
                f"tensor {name} has shape {array.shape} and dtype {array.dtype}; TZA takes rank 1 or 4 "
                "and float16 or float32."
            )
        padding = -position % _ALIGNMENT
        blobs.append(bytes(padding) + array.astype(_TYPES[kind]).tobytes())
        encoded = name.encode("ascii")
        table.append(struct.pack("<H", len(encoded)) + encoded)
        table.append(struct.pack(f"<B{array.ndim}I", array.ndim, *array.shape))
        table.append(layout.encode() + kind.encode() + struct.pack("<Q", position + padding))
        position += len(blobs[-1])
    header = struct.pack("<HBBQ", _MAGIC, _VERSION, 0, position)
    with replacing(path) as temporary:
        temporary.write_bytes(b"".join([header, *blobs, *table]))
