"""The user's own word on which channels play which role: it beats every convention."""

import difflib
import os
import re
from collections.abc import Mapping, Sequence

from progden_jax.exr._channels import find
from progden_jax.exr._file import ExrError, Part, holdings, load
from progden_jax.exr._names import COMPONENTS, ROLES, Source, complete, layers

ChannelMap = Mapping[str, str | Sequence[str] | None]

_EXAMPLE = "color=Beauty,albedo=DiffCol,normal=N.X/N.Y/N.Z,variance=none"


def parse_channel_map(text: str) -> dict[str, str]:
    """The map written in `text`, as `--channels` takes it: ROLE=WHAT, separated by commas.

    Parameters
    ----------
    text : roles are color, variance, albedo, normal and depth. WHAT is a layer ("Beauty"); channel
        names joined by slashes ("N.X/N.Y/N.Z", one for grey or depth); another file of equal size
        ("albedo.exr", "aovs.exr:DiffCol"); or "none" to leave the role out. Names that hold a comma
        need the mapping that `read_exr` takes.

    Raises
    ------
    ExrError
        If an entry is no ROLE=WHAT, or a role is unknown or given twice.
    """
    entries: dict[str, str] = {}
    for entry in text.split(","):
        role, equals, value = (word.strip() for word in entry.partition("="))
        if not (role and equals and value):
            raise ExrError(
                f"--channels: {entry.strip()!r} is not of the form ROLE=LAYER; example: {_EXAMPLE}."
            )
        if role in entries:
            raise ExrError(f"--channels: {role} is given twice.")
        entries[role] = value
    check_roles(entries)
    return entries


def check_roles(channels: ChannelMap) -> None:
    """Raise unless every key is a role."""
    for role in channels:
        if role not in ROLES:
            close = difflib.get_close_matches(str(role).lower(), [*ROLES, "colour"], 1, 0.6)
            hint = f" Did you mean {close[0].replace('colour', 'color')}?" if close else ""
            raise ExrError(
                f"channels (--channels): {role!r} is no role; the roles are "
                f"{', '.join(ROLES)}.{hint}"
            )


def mapped(
    value: str | Sequence[str] | None,
    role: str,
    path: str,
    parts: list[Part],
    files: dict[str, list[Part]],
    *,
    part: int | None,
) -> Source | None:
    """What the map's `value` names, None where it leaves the role out.

    Files that it names are loaded into `files`. Of several parts that hold the channels, the one
    numbered `part` is meant.
    """
    if value is None or value == "none":
        return None
    if not isinstance(value, str):
        return _named(tuple(value), role, path, parts, part)
    match = re.fullmatch(r"(.*\.exr)(?::(.*))?", value, re.IGNORECASE)
    if match:
        return _elsewhere(match[1], match[2], role, path, files)
    groups = layers(parts, several=len(parts) > 1)
    for same in (
        lambda layer: layer == value,
        lambda layer: layer.lower() == value.lower(),
        lambda layer: layer.lower().endswith("." + value.lower()),
    ):
        keys = [key for key in groups if same(key[1])]
        keys = [key for key in keys if key[0] == part] or keys
        if not keys:
            continue
        fitting = [
            Source(i, layer, channels)
            for i, layer in keys
            if (channels := _components(groups[i, layer], role)) is not None
        ]
        if len(fitting) > 1:
            raise _settle_part(value, role, path, [s.part for s in fitting], parts)
        if fitting:
            return fitting[0]
        raise ExrError(
            f"{path}: channels (--channels): layer {value!r} holds {', '.join(groups[keys[0]])}, "
            "from "
            f'which no {role} can be made; name its channels, as in "{role}=A.x/A.y/A.z".'
        )
    return _named(tuple(value.split("/")), role, path, parts, part)


def _components(components: dict[str, str], role: str) -> tuple[str, ...] | None:
    found = complete(components, COMPONENTS[role])
    if found is None and len(components) == 1:
        found = tuple(components.values())
    return found


def _named(
    names: tuple[str, ...], role: str, path: str, parts: list[Part], part: int | None
) -> Source:
    names = tuple(name.strip() for name in names)
    expected = (1,) if role == "depth" else (1, 3)
    if len(names) not in expected:
        raise ExrError(
            f"{path}: channels (--channels): {role} is given {len(names)} channels "
            f"({', '.join(names)}), expected {' or '.join(map(str, expected))}."
        )
    holders = [p.index for p in parts if all(name in p.channels for name in names)]
    holders = [i for i in holders if i == part] or holders
    if len(holders) > 1:
        raise _settle_part("/".join(names), role, path, holders, parts)
    if holders:
        return Source(holders[0], names[0].rpartition(".")[0], names)
    existing = [name for p in parts for name in p.channels]
    known = [*existing, *dict.fromkeys(layer for _, layer in layers(parts, several=True) if layer)]
    lost = next((name for name in names if name not in existing), "/".join(names))
    lower = {name.lower(): name for name in known}
    close = [lower[m] for m in difflib.get_close_matches(lost.lower(), lower, 3, 0.5)]
    close = [name for name in close if name.rpartition(".")[0] not in close]
    hint = f" Close: {', '.join(close)}." if close else ""
    raise ExrError(
        f"{path}: channels (--channels): {role}={'/'.join(names)}: there is no layer or channel "
        f"{lost!r}.{hint} The file holds {holdings(parts)}."
    )


def _settle_part(
    value: str, role: str, path: str, holders: list[int], parts: list[Part]
) -> ExrError:
    places = ", ".join(parts[i].label for i in dict.fromkeys(holders))
    return ExrError(
        f"{path}: channels (--channels): {role}={value} fits several layers, in {places}; write "
        f"the layer's full name, or choose the part with part={holders[0]} (--part {holders[0]})."
    )


def _elsewhere(
    file: str, layer: str | None, role: str, path: str, files: dict[str, list[Part]]
) -> Source:
    """A source in another file: as named from here, else beside the input."""
    if not os.path.isabs(file) and not os.path.exists(file):
        beside = os.path.join(os.path.dirname(path), file)
        file = beside if os.path.exists(beside) else file
    if file not in files:
        files[file] = load(file)
    parts = files[file]
    if layer:
        source = mapped(layer, role, file, parts, files, part=None)
        assert source is not None
    else:
        source = find(parts, role)
        if not isinstance(source, Source):
            source = find(parts, "color")
        if not isinstance(source, Source):
            raise ExrError(
                f"{file}: channels (--channels): which of its channels are the {role}? Write "
                f'"{role}={file}:LAYER". The file holds {holdings(parts)}.'
            )
        if role == "depth":
            source = Source(source.part, source.layer, source.channels[:1])
    return Source(source.part, source.layer, source.channels, file)
