"""The variance of the mean that a file, or several renders, give under the user's settings."""

import os

import numpy as np

from progden_jax.exr import _channels, _names, _statistics
from progden_jax.exr._channels import require
from progden_jax.exr._file import ExrError
from progden_jax.exr._map import ChannelMap, parse_channel_map
from progden_jax.exr._names import Missing, Source
from progden_jax.exr._render import Render, Settings, open_render, size_text


def with_variance(
    render: Render, color: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, str, float | None]:
    """Colour, variance of the mean, where it comes from in words, and the samples per pixel."""
    if render.variance_from:
        return _from_others(render, color)
    source = render.roles["variance"]
    if not isinstance(source, Source):
        return color, None, _why_no_variance(render, source), render.spp
    raw, meaning, spp = render.image("variance"), render.variance_of, render.spp
    if meaning is None and _names.is_pbrt(render.parts):
        known = f"--variance-of samples; {spp:g} spp by {render.spp_from}" if spp else ""
        raise ExrError(
            f"{render.path}: this looks like pbrt-v4's, whose {source.text} is the variance of the "
            'samples, not of their mean: pass variance_of="samples" '
            f'({known or "with spp=N; --variance-of samples --spp N"}), or variance_of="mean" '
            "(--variance-of mean) if it has been divided by the samples already."
        )
    if meaning in (None, "mean"):
        return color, raw, f"{source.text}, of the mean", spp
    if meaning == "std":
        return color, _statistics.from_std(raw), f"{source.text}, standard deviation, squared", spp
    if spp is None:
        raise ExrError(
            f'{render.path}: variance_of="{meaning}" (--variance-of {meaning}) needs the samples '
            "per pixel, which neither an attribute samplesPerPixel nor a name like NAME_64spp.exr "
            "tells: pass spp=N (--spp N)."
        )
    if spp == 1:
        render.warnings.append("with 1 sample per pixel the spread of samples says nothing")
    given = f"{spp:g} spp by {render.spp_from}"
    if meaning == "samples":
        return color, _statistics.from_samples(raw, spp), f"{source.text}, of samples, {given}", spp
    first = _first_moments(render, source)
    variance, negative = _statistics.from_moments(render.pixels(first, 3), raw, spp)
    if any(_half(render, moments) for moments in (first, source)):
        render.warnings.append(
            "moments in half precision lose the variance where samples differ by less than about "
            "3 % of their mean: have the renderer write float"
        )
    if negative:
        render.notes.append(f"{negative} variances that rounding had made negative are 0")
    return color, variance, f"{source.text}, second moments, {given}", spp


def _first_moments(render: Render, second: Source) -> Source:
    """The means that belong to the second moments: their own layer if it is there, or the
    colour."""
    names = tuple(name.removeprefix(_names.MOMENT) for name in second.channels)
    part = render.part_of(second)
    if names != second.channels and all(name in part.channels for name in names):
        return Source(second.part, "", names, second.file)
    color = render.roles["color"]
    assert isinstance(color, Source)
    return color


def _half(render: Render, source: Source) -> bool:
    channels = render.part_of(source).channels
    return any(channels[name].dtype == "half" for name in source.channels)


def _from_others(
    render: Render, color: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str, float | None]:
    renders, spps = [], []
    settings: Settings = {
        "channels": _color_only(render.settings.get("channels")),
        "part": render.settings.get("part"),
        "auxiliary": False,
    }
    for path in render.variance_from:
        other = open_render(path, settings)
        require(other.roles["color"], "color", other.path, other.parts)
        image = other.image("color")
        if image.shape != color.shape:
            raise ExrError(
                f"{path}: variance_from (--variance-from): {size_text(image.shape)} pixels, but "
                f"{render.path} has {size_text(color.shape)}: they must be renders of the same "
                "view."
            )
        renders.append(image)
        spps.append(other.spp)
    halves = _statistics.are_halves(color, renders)
    everything = renders if halves else [color, *renders]
    paths = list(render.variance_from) if halves else [render.path, *render.variance_from]
    _refuse_twins(everything, paths)
    known = {s for s in ([] if halves else [render.spp]) + spps if s is not None}
    if len(known) > 1 and render.settings.get("spp") is None:
        raise ExrError(
            f"{render.path}: variance_from (--variance-from): the renders have "
            f"{', '.join(f'{s:g}' for s in sorted(known))} samples per pixel; renders of equal "
            "spp are needed."
        )
    mean, variance = _statistics.from_renders(everything)
    count = len(everything)
    render.warnings += _statistics.uncertainty(count)
    if halves:
        return color, variance, f"{count} buffers of which the colour is the mean", render.spp
    spp = None if render.spp is None else render.spp * count
    render.notes.append(f"the colour is the mean of the input and {count - 1} other renders")
    return mean, variance, f"{count} renders, the input among them", spp


def _color_only(channels: ChannelMap | str | None) -> ChannelMap:
    """The map's entry for the colour: all that other renders are read for."""
    channels = parse_channel_map(channels) if isinstance(channels, str) else channels or {}
    return {role: value for role, value in channels.items() if role == "color"}


def _refuse_twins(renders: list[np.ndarray], paths: list[str]) -> None:
    for i, a in enumerate(renders):
        for j in range(i):
            if _varies(a) and np.array_equal(a, renders[j], equal_nan=True):
                raise ExrError(
                    f"{paths[i]}: variance_from (--variance-from): the same image as {paths[j]}: "
                    "independent renders are needed, with another seed each."
                )


def _varies(image: np.ndarray) -> bool:
    finite = image[np.isfinite(image)]
    return bool(finite.size and finite.min() < finite.max())


def _why_no_variance(render: Render, found: Missing | None) -> str:
    if found is None:
        return "none, left out on request"
    hints = []
    color = render.roles["color"]
    near = color if isinstance(color, Source) and color.file is None else None
    moments = _channels.second_moments(render.parts, near)
    if isinstance(moments, Source):
        hints.append(
            f'second moments are here, {moments.text}: variance_of="second-moment" with spp=N '
            "(--variance-of second-moment --spp N)"
        )
    elif moments.remedy:
        hints.append(f"{moments.reason}; {moments.remedy}")
    if isinstance(std := _channels.find(render.parts, "std", near=near), Source):
        hints.append(f'{std.text} is here: variance_of="std" (--variance-of std)')
    base, suffix = os.path.splitext(render.path)
    if all(os.path.exists(base + half + suffix) for half in "AB"):
        a, b = (os.path.basename(base) + half + suffix for half in "AB")
        hints.append(f"half buffers lie beside it: variance_from=[...] (--variance-from {a} {b})")
    if os.path.exists(base + "Variance" + suffix):
        file = os.path.basename(base) + "Variance" + suffix
        hints.append(f"a variance lies beside it: --channels variance={file}")
    hints = hints or [
        "have the renderer write Variance.R/G/B, name the layer with --channels variance=LAYER, "
        "or give renders of other seeds with variance_from=[...] (--variance-from)"
    ]
    return f"none ({found.reason}); progressive denoising needs one: {'; '.join(hints)}"
