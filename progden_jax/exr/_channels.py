"""Which channels of a file play which role, by convention; ambiguity is said, never guessed away."""

from collections.abc import Iterable

from progden_jax.exr._file import ExrError, Part, holdings
from progden_jax.exr._names import (
    AUXILIARY,
    COMPONENTS,
    LAYERS,
    LIGHT,
    MOMENT,
    RGB,
    XYZ,
    Missing,
    Source,
    complete,
    layers,
    plain,
)


def find(
    parts: list[Part], role: str, *, near: Source | None = None, only: int | None = None
) -> Source | Missing:
    """The source of a role by convention.

    `near` is the colour's, whose part, view layer and data window decide between candidates; `only`
    limits the search to one part.
    """
    searched = parts if only is None else [parts[only]]
    groups = layers(searched, several=len(parts) > 1)
    ranked: dict[int, list[Source]] = {}
    for (index, layer), components in groups.items():
        rank = _rank(role, layer, groups)
        channels = complete(components, COMPONENTS[role])
        if rank is not None and channels is not None:
            ranked.setdefault(rank, []).append(Source(index, layer, channels))
    if role == "depth":
        _add_lone_depth(ranked, groups)
    skipped: list[Source] = []
    if near is not None:
        window = parts[near.part].data_window
        skipped = [s for ss in ranked.values() for s in ss if parts[s.part].data_window != window]
        ranked = {rank: [s for s in ss if s not in skipped] for rank, ss in ranked.items()}
        ranked = _nearest(ranked, near)
    best = next((ranked[rank] for rank in sorted(ranked) if ranked[rank]), [])
    if len(best) == 1:
        return best[0] if role != "color" else _not_chroma(best[0], groups)
    if best:
        return _ambiguity(role, best, parts)
    if skipped:
        where = parts[skipped[0].part].label
        return Missing(f"{skipped[0].text} is in {where}, whose data window is not the colour's")
    if role == "color":
        return _only_color(groups, parts, deep=any(part.deep for part in searched))
    return Missing("no channels of a known name")


def _rank(role: str, layer: str, groups: Iterable[tuple[int, str]]) -> int | None:
    name, tiers = plain(layer), LAYERS[role]
    rank = next((i for i, names in enumerate(tiers) if name in names), None)
    if rank is None or layer.startswith(MOMENT):
        return None
    if role == "albedo" and name == "diffuse" and LIGHT & {plain(other) for _, other in groups}:
        return None
    # Cycles' compositor output stands beside the view layer that it was made from.
    return rank + (len(tiers) if layer.lower().startswith("composite.") else 0)


def _add_lone_depth(
    ranked: dict[int, list[Source]], groups: dict[tuple[int, str], dict[str, str]]
) -> None:
    """Depth without a layer of its own: a channel depth, Z beside R, G, B, Mitsuba's NAME.T."""
    known = frozenset().union(*LAYERS["depth"])
    pictures = frozenset().union(*LAYERS["color"])
    for (index, layer), components in groups.items():
        if plain(layer) in known or layer.startswith(MOMENT):
            continue
        for component, channel in components.items():
            if component.lower() in ("depth", "zdepth"):
                rank = 1
            elif (
                component in ("Z", "z")
                and plain(layer) in pictures
                and not {"X", "x"} & set(components)
            ):
                rank = 2
            elif component == "T":
                rank = 3
            else:
                continue
            ranked.setdefault(rank, []).append(Source(index, layer, (channel,)))


def _nearest(ranked: dict[int, list[Source]], near: Source) -> dict[int, list[Source]]:
    """The candidates closest to the colour: below its layer, in its view layer, in its part."""
    view = near.layer.rpartition(".")[0]

    def below(source: Source) -> bool:
        return bool(near.layer) and source.layer.startswith(near.layer + ".")

    def beside(source: Source) -> bool:
        return source.layer.rpartition(".")[0] == view and (bool(view) or source.part == near.part)

    def within(source: Source) -> bool:
        return source.part == near.part

    for close in (below, beside, within):
        kept = {rank: [s for s in sources if close(s)] for rank, sources in ranked.items()}
        if any(kept.values()):
            return kept
    return ranked


def _not_chroma(source: Source, groups: dict[tuple[int, str], dict[str, str]]) -> Source | Missing:
    if len(source.channels) == 1 and {"RY", "BY"} & set(groups[source.part, source.layer]):
        return Missing(
            "luminance and chroma (Y, RY, BY) instead of R, G, B", True, "write the render as RGB"
        )
    return source


def _ambiguity(role: str, best: list[Source], parts: list[Part]) -> Missing:
    in_parts = len({s.part for s in best}) > 1
    names = ", ".join(s.text + (f" in {parts[s.part].label}" if in_parts else "") for s in best)
    first = best[0].layer or "/".join(best[0].channels)
    part = f", or the part with part={best[0].part} (--part {best[0].part})" if in_parts else ""
    none = "" if role == "color" else f", or leave it out with {role}=none"
    return Missing(
        f"several layers with equal right: {names}",
        True,
        f'choose with channels={{"{role}": "{first}"}} (--channels "{role}={first}"){part}{none}',
    )


def _only_color(
    groups: dict[tuple[int, str], dict[str, str]], parts: list[Part], *, deep: bool
) -> Source | Missing:
    """A single RGB layer of unknown name is the picture; several are a question."""
    others = frozenset().union(
        *(n for role, tiers in LAYERS.items() if role != "color" for n in tiers)
    )
    found = []
    for (index, layer), components in groups.items():
        channels = complete(components, RGB)
        if channels is not None and plain(layer) not in others and not layer.startswith(MOMENT):
            found.append(Source(index, layer, channels))
    if len(found) > 1:
        return _ambiguity("color", found, parts)
    if deep and not found:
        return Missing("deep data (many values per pixel)", True, "flatten it to an image first")
    return found[0] if found else Missing("no channels of a known name", True)


def alpha_of(parts: list[Part], color: Source) -> Source | None:
    """The opacity that belongs to the colour: A of its layer, of Combined in its view layer, or the
    part's own."""
    groups = layers(parts, several=len(parts) > 1)
    combined = f"{color.layer.rpartition('.')[0]}.Combined"
    for layer in (color.layer, combined, ""):
        for name in ("A", "a", "alpha", "Alpha"):
            channel = groups.get((color.part, layer), {}).get(name)
            if channel is not None:
                return Source(color.part, layer, (channel,))
    return None


def second_moments(parts: list[Part], near: Source | None) -> Source | Missing:
    """Mitsuba's m2_NAME.R/G/B, the mean of squares of what NAME (or the colour) is the mean of."""
    auxiliary = frozenset().union(*(names for role in AUXILIARY for names in LAYERS[role]))
    rgb, xyz = [], []
    for (index, layer), components in layers(parts, several=len(parts) > 1).items():
        here = near is None or parts[index].data_window == parts[near.part].data_window
        if not (layer.startswith(MOMENT) and here) or plain(layer) in auxiliary:
            continue
        channels = complete(components, COMPONENTS["color"])
        if channels is not None:
            rgb.append(Source(index, layer, channels))
        elif complete(components, XYZ) is not None:
            xyz.append(layer)
    own = [s for s in rgb if near and s.layer.removeprefix(MOMENT) == near.layer]
    rgb = own or rgb
    if len(rgb) > 1:
        return _ambiguity("variance", rgb, parts)
    if rgb:
        return rgb[0]
    if xyz:
        return Missing(
            f"the second moments {xyz[0]}.X/Y/Z are of CIE XYZ, which does not give the variance "
            "of RGB",
            True,
            "nest the integrators as moment > aov > path, which also writes those of R, G, B",
        )
    return Missing("no second moments (m2_NAME.R/G/B)", True)


def require(found: Source | Missing | None, role: str, path: str, parts: list[Part]) -> Source:
    """The source, or an error that lists what the file holds and the flag that settles it."""
    if isinstance(found, Source):
        return found
    if found is None:
        raise ExrError(f"{path}: {role} is needed, but channels (--channels) leaves it out.")
    name = f'name them with channels={{"{role}": "LAYER"}} (--channels "{role}=LAYER")'
    raise ExrError(
        f"{path}: {role}: {found.reason}; {found.remedy or name}. The file holds {holdings(parts)}."
    )
