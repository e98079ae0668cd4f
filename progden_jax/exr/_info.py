"""What a file holds and what would be used of it, for people and for JSON."""

from dataclasses import dataclass

import numpy as np

from progden_jax.exr._file import Channel, Part
from progden_jax.exr._names import Missing, Source


@dataclass(frozen=True)
class Values:
    """Bad values of a channel, counted, and the range of its finite ones (None if there are
    none)."""

    nan: int
    inf: int
    negative: int
    minimum: float | None
    median: float | None
    mean: float | None
    maximum: float | None


@dataclass(frozen=True)
class ChannelInfo:
    """One channel: dtype is half, float, uint or deep; sampling 2 is every second pixel."""

    name: str
    dtype: str
    sampling: tuple[int, int]
    values: Values | None


@dataclass(frozen=True)
class PartInfo:
    """One part: size is (height, width); windows are (xmin, ymin, xmax, ymax), inclusive."""

    index: int
    name: str
    type: str
    compression: str
    size: tuple[int, int]
    data_window: tuple[int, int, int, int]
    display_window: tuple[int, int, int, int]
    channels: tuple[ChannelInfo, ...]


@dataclass(frozen=True)
class RoleInfo:
    """What plays a role, or the reason why nothing does. `file` is None for the input itself;
    `problem` marks a reason that keeps the file from being read as things stand."""

    channels: tuple[str, ...] = ()
    part: int | None = None
    file: str | None = None
    reason: str = ""
    problem: bool = False


@dataclass(frozen=True)
class ExrInfo:
    """A file, and how its channels are used under the settings that it was read with.

    `roles` has color, alpha, variance, albedo, normal and depth. `variance` says where the variance
    of the mean comes from, or why there is none. `spp` is of the whole result (all renders
    together), `spp_from` where it was found. `warnings` are what may make results wrong, `notes`
    what else is good to know. ``dataclasses.asdict`` of it goes straight into JSON.
    """

    path: str
    parts: tuple[PartInfo, ...]
    roles: dict[str, RoleInfo]
    variance: str
    spp: float | None
    spp_from: str
    warnings: tuple[str, ...]
    notes: tuple[str, ...]


def part_info(part: Part, *, statistics: bool) -> PartInfo:
    """The part with, if asked for, the values of its channels counted."""
    return PartInfo(
        part.index,
        part.name,
        part.type,
        part.compression,
        part.size,
        part.data_window,
        part.display_window,
        tuple(
            ChannelInfo(c.name, c.dtype, c.sampling, _values(c) if statistics else None)
            for c in part.channels.values()
        ),
    )


def role_info(found: Source | Missing | None) -> RoleInfo:
    """The role's source in the form that goes to users; None is a role left out on request."""
    if isinstance(found, Source):
        return RoleInfo(found.channels, found.part, found.file)
    if found is None:
        return RoleInfo(reason="left out on request")
    reason = f"{found.reason}; {found.remedy}" if found.remedy else found.reason
    return RoleInfo(reason=reason, problem=found.problem)


def _values(channel: Channel) -> Values | None:
    if channel.pixels is None:
        return None
    pixels = channel.pixels.astype(np.float64)
    finite = pixels[np.isfinite(pixels)]
    ranges: tuple[float | None, ...] = (None,) * 4
    if finite.size:
        ranges = tuple(float(f(finite)) for f in (np.min, np.median, np.mean, np.max))
    return Values(
        int(np.isnan(pixels).sum()),
        int(np.isinf(pixels).sum()),
        int((pixels < 0).sum()),
        *ranges,
    )
