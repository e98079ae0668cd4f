"""An open file under the user's settings: which channels play which role, and their pixels."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypedDict

import numpy as np

from progden_jax._numeric import aligned_empty
from progden_jax.exr import _channels, _statistics
from progden_jax.exr._file import ExrError, Part, holdings, load
from progden_jax.exr._map import ChannelMap, check_roles, mapped, parse_channel_map
from progden_jax.exr._names import AUXILIARY, Missing, Source

PathLike = str | os.PathLike[str]
Meaning = Literal["mean", "samples", "std", "second-moment"]


class Settings(TypedDict, total=False):
    """The keyword arguments of `read_exr`."""

    variance_of: Meaning | None
    spp: float | None
    variance_from: PathLike | Sequence[PathLike]
    channels: ChannelMap | str | None
    part: int | str | None
    auxiliary: bool


@dataclass
class Render:
    """An open file under the user's settings."""

    path: str
    parts: list[Part]
    roles: dict[str, Source | Missing | None]
    variance_of: Meaning | None
    variance_from: tuple[str, ...]
    settings: Settings
    spp: float | None = None
    spp_from: str = ""
    files: dict[str, list[Part]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def image(self, role: str) -> np.ndarray:
        """The role's pixels, (H, W, 3) or (H, W, 1) for depth, grey repeated."""
        source, color = self.roles[role], self.roles["color"]
        assert isinstance(source, Source)
        assert isinstance(color, Source)
        size, expected = self.part_of(source).size, self.part_of(color).size
        if size != expected:
            raise ExrError(
                f"{self.path}: {role} ({source.text}) is {size_text(size)} pixels but color is "
                f"{size_text(expected)}: name a {role} of that size with channels (--channels), or "
                f"leave it out with {role}=none."
            )
        return self.pixels(source, 1 if role == "depth" else 3)

    def part_of(self, source: Source) -> Part:
        """The part that holds the source's channels."""
        return (self.files[source.file] if source.file else self.parts)[source.part]

    def pixels(self, source: Source, count: int) -> np.ndarray:
        """The source's channels in float32, (H, W, count), a single one repeated."""
        part, path = self.part_of(source), source.file or self.path
        planes = [_plane(part, name, path, self.notes) for name in source.channels]
        image = aligned_empty((*part.size, count))
        for i in range(count):
            image[..., i] = planes[i if len(planes) > 1 else 0]
        return image

    def keep_only(self, roles: Iterable[str]) -> None:
        """Drop the pixels of all channels that none of these roles is read from."""
        kept = [s for role in roles if isinstance(s := self.roles[role], Source)]
        for file, parts in {None: self.parts, **self.files}.items():
            for part in parts:
                names = {
                    n for s in kept if (s.file, s.part) == (file, part.index) for n in s.channels
                }
                for name, channel in part.channels.items():
                    if name not in names:
                        part.channels[name] = replace(channel, pixels=None)


def open_render(path: PathLike, settings: Settings) -> Render:
    """Load the file and find every role; ambiguities stay `Missing`, wrong settings raise."""
    meaning, others, channels = _checked(settings)
    path = os.fspath(path)
    parts = load(path)
    only = _part_index(settings.get("part"), path, parts)
    render = Render(path, parts, {}, meaning, others, settings)

    def role(name: str, find: Callable[[], Source | Missing]) -> Source | Missing | None:
        if name in channels:
            return mapped(channels[name], name, path, parts, render.files, part=only)
        return find()

    color = role("color", lambda: _channels.find(parts, "color", only=only))
    if color is None:
        raise ExrError(f"{path}: channels (--channels): color=none leaves nothing to denoise.")
    near = color if isinstance(color, Source) and color.file is None else None
    render.roles["color"] = color
    render.roles["alpha"] = near and _channels.alpha_of(parts, near)
    if others:
        render.roles["variance"] = Missing("taken from other renders")
    else:
        render.roles["variance"] = role("variance", lambda: _find_variance(parts, near, meaning))
    for name in AUXILIARY:
        render.roles[name] = None
        if settings.get("auxiliary", True):
            render.roles[name] = role(
                name, lambda name=name: _channels.find(parts, name, near=near)
            )
    if (spp := settings.get("spp")) is not None:
        render.spp, render.spp_from = spp, "the caller (--spp)"
    else:
        header = parts[near.part if near else 0].header
        view = near.layer.rpartition(".")[0] if near else ""
        stem = os.path.splitext(os.path.basename(path))[0]
        render.spp, render.spp_from = _statistics.find_spp(stem, header, view)
    return render


def _checked(settings: Settings) -> tuple[Meaning | None, tuple[str, ...], ChannelMap]:
    """variance_of, variance_from and the channel map, all settings right in themselves."""
    unknown = settings.keys() - Settings.__annotations__.keys()
    if unknown:
        raise TypeError(f"unknown settings {sorted(unknown)}; known: {[*Settings.__annotations__]}")
    meaning, others = settings.get("variance_of"), settings.get("variance_from") or ()
    if isinstance(others, (str, os.PathLike)):
        others = (others,)
    if meaning is not None and meaning not in _statistics.MEANINGS:
        raise ExrError(
            f"variance_of (--variance-of) is {meaning!r}, expected one of "
            f"{', '.join(_statistics.MEANINGS)}."
        )
    if meaning is not None and others:
        raise ExrError(
            "variance_of (--variance-of) says how to read variance channels, variance_from "
            "(--variance-from) takes other renders instead: give one of them."
        )
    _statistics.check_spp(settings.get("spp"))
    channels = settings.get("channels") or {}
    if isinstance(channels, str):
        channels = parse_channel_map(channels)
    check_roles(channels)
    return meaning, tuple(os.fspath(other) for other in others), channels


def _find_variance(
    parts: list[Part], near: Source | None, meaning: Meaning | None
) -> Source | Missing:
    found: Source | Missing = Missing("")
    if meaning == "second-moment":
        found = _channels.second_moments(parts, near)
    else:
        if meaning == "std":
            found = _channels.find(parts, "std", near=near)
        if isinstance(found, Missing) and not found.problem:
            found = _channels.find(parts, "variance", near=near)
    if isinstance(found, Missing) and meaning is not None:
        return Missing(found.reason, True, found.remedy)
    return found


def _part_index(part: int | str | None, path: str, parts: list[Part]) -> int | None:
    if part is None:
        return None
    for p in parts:
        if part in (p.index, p.name) or (isinstance(part, str) and part == str(p.index)):
            return p.index
    raise ExrError(f"{path}: part (--part) is {part!r}; the file holds {holdings(parts)}.")


def _plane(part: Part, name: str, path: str, notes: list[str]) -> np.ndarray:
    """One channel in float32 at full size."""
    channel = part.channels[name]
    if channel.pixels is None:
        raise ExrError(
            f"{path}: {name} is deep (many values per pixel); flatten it to an image first."
        )
    if channel.dtype == "uint":
        raise ExrError(f"{path}: {name} holds whole numbers (uint32), no radiance or feature.")
    pixels = channel.pixels.astype(np.float32, copy=False)
    if channel.sampling != (1, 1):
        x, y = channel.sampling
        height, width = part.size
        pixels = pixels.repeat(y, axis=0).repeat(x, axis=1)[:height, :width]
        if pixels.shape != (height, width):
            raise ExrError(f"{path}: {name} is subsampled {x}×{y} and does not cover the image.")
        notes.append(f"{name} is subsampled {x}×{y}; its pixels were repeated")
    return pixels


def size_text(size: tuple[int, ...]) -> str:
    """Height×width, for messages."""
    return "×".join(map(str, size[:2]))
