"""OpenEXR files as plain parts and channels, complete or an error: the library itself reports
damage by printing a warning and leaving the part out."""

import contextlib
import io
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR

from progden_jax._devices import cores

MAGIC = b"\x76\x2f\x31\x01"
_LISTED = 40


class ExrError(ValueError):
    """A file that cannot be read or written as asked; the message says what to do about it."""


@dataclass(frozen=True)
class Channel:
    """One channel, of dtype half, float, uint, deep or (of a header alone) unread. `pixels` is
    (rows, columns), smaller than the part if it is subsampled; None if deep or unread."""

    name: str
    dtype: str
    sampling: tuple[int, int]
    pixels: np.ndarray | None


@dataclass(frozen=True)
class Part:
    """One part of a file. Windows are (xmin, ymin, xmax, ymax), inclusive, in pixels."""

    index: int
    name: str
    type: str
    compression: str
    data_window: tuple[int, int, int, int]
    display_window: tuple[int, int, int, int]
    channels: dict[str, Channel]
    header: dict[str, Any]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the data window."""
        x0, y0, x1, y1 = self.data_window
        return y1 - y0 + 1, x1 - x0 + 1

    @property
    def deep(self) -> bool:
        """Whether pixels hold lists of samples in depth instead of one value."""
        return self.type.startswith("deep")

    @property
    def label(self) -> str:
        """How messages name the part."""
        return f"part {self.index}" + (f" {self.name!r}" if self.name else "")


def load(path: str | os.PathLike[str], *, header_only: bool = False) -> list[Part]:
    """Every part of the file, checked to be complete.

    Raises
    ------
    ExrError
        If the path is missing, a folder, unreadable, not OpenEXR, truncated or damaged.
    """
    path = os.fspath(path)
    _check_readable(path)
    with quiet() as printed:
        try:
            headers = _parts(path, header_only=True)
            if header_only:
                parts = headers
            else:
                with on_all_cores():
                    parts = _parts(path, header_only=False)
        except (RuntimeError, ValueError, TypeError, MemoryError) as error:
            reason = printed() or str(error)
            raise ExrError(
                f"{path}: its header is damaged, cut off or of an unknown kind ({reason})."
            ) from None
        if len(parts) < len(headers):
            read = {p.header.get("name", "") for p in parts}
            lost = [
                h.header.get("name", "") for h in headers if h.header.get("name", "") not in read
            ]
            what = "its pixels are" if len(headers) == 1 else f"part {', '.join(lost) or '?'} is"
            raise ExrError(
                f"{path}: {what} cut off, damaged or larger than memory ({printed()}). "
                "The render or the copy may not have finished; make the file again."
            )
    if not parts:
        raise ExrError(f"{path}: the file holds no image.")
    types = [_type(h.header) for h in headers]
    return [_part(i, p, types[i], header_only) for i, p in enumerate(parts)]


def holdings(parts: list[Part]) -> str:
    """What the parts hold, for messages: 'R, G, B, Albedo.R/G/B'."""
    texts = []
    for part in parts:
        layers: dict[str, list[str]] = {}
        for name in part.channels:
            layer, dot, component = name.rpartition(".")
            layers.setdefault(layer + dot, []).append(component)
        names = [
            layer + "/".join(_ordered(components)) if layer else ", ".join(_ordered(components))
            for layer, components in sorted(layers.items(), key=lambda item: item[0] != "")
        ]
        more = f" and {len(names) - _LISTED} layers more" if len(names) > _LISTED else ""
        text = ", ".join(names[:_LISTED]) + more or "nothing"
        texts.append(f"{part.label}: {text}" if len(parts) > 1 else text)
    return "; ".join(texts)


@contextlib.contextmanager
def quiet() -> Iterator[Callable[[], str]]:
    """Keep OpenEXR's own prints from the user; yields a function that returns the last of them.

    The core library writes to file descriptor 2, past Python's streams; the bindings print to
    sys.stdout. What anyone else writes meanwhile (a progress bar's thread) is passed on at the end.
    """
    with _lock, tempfile.TemporaryFile() as errors, contextlib.ExitStack() as stack:
        try:
            saved = os.dup(2)
        except OSError:  # a closed stream needs no silence
            saved = None
        prints = io.StringIO()

        def caught() -> tuple[list[str], list[str]]:
            # pread, because the descriptor shares its offset with whoever still writes.
            raw = os.pread(errors.fileno(), 1 << 20, 0).decode(errors="surrogateescape")
            return prints.getvalue().splitlines(keepends=True), raw.splitlines(keepends=True)

        def printed() -> str:
            own = [line for lines in caught() for line in lines if _own(line)]
            texts = [re.sub(r"^.*?(\(EXR_ERR_\w+\)|part \d+ -) *", "", line) for line in own]
            return texts[-1].strip().rstrip(".") if texts else ""

        def pass_on() -> None:
            out, err = ("".join(x for x in lines if not _own(x)) for lines in caught())
            if saved is not None:
                os.dup2(saved, 2)
                os.close(saved)
                os.write(2, err.encode(errors="surrogateescape"))
            if out:
                sys.stdout.write(out)

        stack.callback(pass_on)
        stack.enter_context(contextlib.redirect_stdout(prints))
        if saved is not None:
            os.dup2(errors.fileno(), 2)
        yield printed


_lock = threading.Lock()


def _own(line: str) -> bool:
    return "(EXR_ERR_" in line or line.startswith("Warning: Exception raised reading")


def _check_readable(path: str) -> None:
    if not os.path.exists(path):
        folder = os.path.dirname(path) or "."
        where = "" if os.path.isdir(folder) else f" (nor does the folder {folder})"
        raise ExrError(f"{path}: there is no such file{where}.")
    if os.path.isdir(path):
        raise ExrError(f"{path}: this is a folder, expected one EXR file.")
    try:
        with open(path, "rb") as file:
            start = file.read(len(MAGIC))
    except OSError as error:
        raise ExrError(f"{path}: cannot be read ({error.strerror}).") from None
    if not start:
        raise ExrError(f"{path}: the file is empty.")
    if start != MAGIC:
        guess = next(
            (kind for magic, kind in _OTHER_FORMATS.items() if start.startswith(magic)), ""
        )
        kind = f"; it looks like {guess}" if guess else ""
        raise ExrError(
            f"{path}: this is not an OpenEXR file{kind}. Denoising needs linear radiance: "
            "have the renderer write EXR."
        )


_OTHER_FORMATS = {
    b"\x89PNG": "PNG",
    b"\xff\xd8": "JPEG",
    b"#?": "Radiance HDR",
    b"PF": "PFM",
    b"Pf": "PFM",
    b"II*": "TIFF",
    b"MM": "TIFF",
}


def _parts(path: str, *, header_only: bool) -> list[Any]:
    return OpenEXR.File(path, separate_channels=True, header_only=header_only).parts


@contextlib.contextmanager
def on_all_cores() -> Iterator[None]:
    """Pixels are compressed and decompressed on all cores in this block; the library by itself uses one.

    Only here: a process that is forked has none of the library's threads, and would wait for them forever.
    By one thread at a time, as under `quiet`. A count that the user has set stays.
    """
    if not hasattr(OpenEXR, "set_global_thread_count") or OpenEXR.global_thread_count():
        yield  # before 3.5, or the user's
        return
    OpenEXR.set_global_thread_count(min(len(cores()), _MOST_THREADS))
    try:
        yield
    finally:
        OpenEXR.set_global_thread_count(0)


_MOST_THREADS = 16


def _type(header: dict[str, Any]) -> str:
    return str(header.get("type", "scanlineimage")).rpartition(".")[2]


def _part(index: int, part: Any, kind: str, header_only: bool) -> Part:
    header = dict(part.header)
    channels = {}
    for listed in header["channels"]:
        pixels, dtype = None, "unread"
        if kind.startswith("deep"):
            dtype = "deep"
        elif not header_only:
            pixels = np.asarray(part.channels[listed.name].pixels)
            dtype = _DTYPES[pixels.dtype.name]
        sampling = (int(listed.xSampling), int(listed.ySampling))
        channels[listed.name] = Channel(listed.name, dtype, sampling, pixels)
    return Part(
        index=index,
        name=str(header.get("name", "")),
        type=kind,
        compression=_lower(header.get("compression")),
        data_window=_window(header["dataWindow"]),
        display_window=_window(header["displayWindow"]),
        channels=channels,
        header=header,
    )


_DTYPES = {"float16": "half", "float32": "float", "uint32": "uint"}


def _lower(compression: Any) -> str:
    return str(compression).rpartition(".")[2].removesuffix("_COMPRESSION").lower()


def _window(window: Any) -> tuple[int, int, int, int]:
    (x0, y0), (x1, y1) = window
    return int(x0), int(y0), int(x1), int(y1)


def _ordered(components: list[str]) -> list[str]:
    """Alphabetical in the file; people read R, G, B."""
    order = {c: i for i, c in enumerate(("r", "g", "b", "a"))}
    return sorted(components, key=lambda c: (order.get(c.lower(), 9), c))
