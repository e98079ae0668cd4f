"""From a file to a `Frame`: which channels, which variance, how many samples."""

import logging
from collections.abc import Sequence
from typing import Unpack

import numpy as np

from progden_jax._numeric import adopted
from progden_jax.exr._channels import require
from progden_jax.exr._file import ExrError, load
from progden_jax.exr._info import ExrInfo, RoleInfo, part_info, role_info
from progden_jax.exr._map import ChannelMap
from progden_jax.exr._names import AUXILIARY, Missing, Source
from progden_jax.exr._render import Meaning, PathLike, Render, Settings, open_render
from progden_jax.exr._variance import with_variance
from progden_jax.frame import Frame

_log = logging.getLogger(__name__)


def read_exr(
    path: PathLike,
    *,
    variance_of: Meaning | None = None,
    spp: float | None = None,
    variance_from: PathLike | Sequence[PathLike] = (),
    channels: ChannelMap | str | None = None,
    part: int | str | None = None,
    auxiliary: bool = True,
) -> Frame:
    """The render in an OpenEXR file, its values as they are: float32, (H, W, ...), linear.

    The frame covers the data window. Colour, variance, albedo, normal and depth are found by the
    names that renderers use (section 9 of the design); a frame without variance has None there.
    Warnings go to the logger; `progden_jax.exr.read_exr_with_info` returns them.

    Parameters
    ----------
    path : the file; scanline or tiled, half or float, any compression, one or several parts.
    variance_of : what the variance channels hold: the variance of the pixel "mean" (the default);
        of the "samples" (pbrt), divided by spp here; "std", the standard deviation of the mean; or
        "second-moment", means of squares m2 as Mitsuba's moment integrator writes them, from which
        max(m2 − m1², 0)/(spp − 1), an unbiased variance of the mean but for the clipping. Files
        that look like pbrt's have no default: say it.
    spp : samples per pixel; by default the file's attribute samplesPerPixel, else its name,
        NAME_64spp.exr.
    variance_from : other renders of the same view, independent and of equal spp, each (H, W). Two
        or more whose mean is the colour are its parts (half buffers): variance
        Σ (x_i − mean)²/(n(n − 1)), for two (A − B)²/4. Otherwise they are other seeds with the
        input's spp: the colour becomes the mean of the input and all of them, with the variance of
        that mean. Both are unbiased and left raw: with n renders a pixel's variance is itself off
        by about sqrt(2/(n − 1)), 140 % for two.
    channels : role -> layer, channel names or another file, or None to leave the role out, for
        color, variance, albedo, normal, depth; or the text that `progden_jax.exr.parse_channel_map` takes.
    part : name or index of the part that the colour is taken from, other roles too where it has
        them.
    auxiliary : False leaves albedo, normal and depth out.

    Raises
    ------
    ExrError
        If the file is damaged, or what is asked for is missing or ambiguous.
    """
    frame, info = read_exr_with_info(
        path,
        variance_of=variance_of,
        spp=spp,
        variance_from=variance_from,
        channels=channels,
        part=part,
        auxiliary=auxiliary,
    )
    for warning in info.warnings:
        _log.warning("%s: %s", info.path, warning)
    return frame


def read_exr_with_info(path: PathLike, **settings: Unpack[Settings]) -> tuple[Frame, ExrInfo]:
    """The frame of `read_exr`, which takes the same settings, and what was used as what.

    The channels' value ranges are left out (None); `describe_exr` has them.
    """
    render = open_render(path, settings)
    for role, found in render.roles.items():
        if role == "color" or (isinstance(found, Missing) and found.problem):
            require(found, role, render.path, render.parts)
    # Pixels go as soon as they are in an image, for of a huge file there must not be two copies.
    if render.variance_of != "second-moment":
        render.keep_only(("color", "variance", *AUXILIARY))
    color = render.image("color")
    if render.variance_of != "second-moment":
        render.keep_only(("variance", *AUXILIARY))
    color, variance, text, spp = with_variance(render, color)
    buffers = {"color": adopted(color), "variance": None if variance is None else adopted(variance)}
    for i, role in enumerate(AUXILIARY):
        render.keep_only(AUXILIARY[i:])
        if isinstance(render.roles[role], Source):
            buffers[role] = adopted(render.image(role))
    return Frame(**buffers, spp=spp), _info(render, text, spp, statistics=False)


def read_layers(path: PathLike) -> dict[str, np.ndarray]:
    """The image and the named layers of a file as `write_exr` makes it, float32.

    Returns
    -------
    Layer -> (H, W, 3), the image itself under "", or (H, W, 1) for layers of one channel Y.

    Raises
    ------
    ExrError
        If the file is damaged.
    """
    part = load(path)[0]
    found: dict[str, np.ndarray] = {}
    for layer in dict.fromkeys(name.rpartition(".")[0] for name in part.channels):
        for components in ("RGB", "Y"):
            names = [f"{layer}.{c}" if layer else c for c in components]
            planes = [part.channels[n].pixels for n in names if n in part.channels]
            full = [p for p in planes if p is not None and p.shape == part.size]
            if len(full) == len(components):
                found.setdefault(layer, np.stack(full, axis=-1).astype(np.float32, copy=False))
    return found


def describe_exr(path: PathLike, **settings: Unpack[Settings]) -> ExrInfo:
    """What the file holds, with bad values counted, and what `read_exr` would use as what.

    Takes the settings of `read_exr`. What that would refuse as missing or ambiguous is
    reported here, in the roles' and the variance's reasons.

    Raises
    ------
    ExrError
        If the file is damaged, or a setting is wrong in itself.
    """
    render = open_render(path, settings)
    spp: float | None = render.spp
    color = render.roles["color"]
    if isinstance(color, Source):
        try:
            _, _, text, spp = with_variance(render, render.image("color"))
        except ExrError as error:
            text = f"unusable: {str(error).removeprefix(f'{render.path}: ')}"
    else:
        text = "none without a colour"
    for role in AUXILIARY:
        if isinstance(color, Source) and isinstance(render.roles[role], Source):
            try:
                render.image(role)
            except ExrError as error:
                render.roles[role] = Missing(str(error).removeprefix(f"{render.path}: "), True)
    return _info(render, text, spp, statistics=True)


def _info(render: Render, variance: str, spp: float | None, *, statistics: bool) -> ExrInfo:
    roles: dict[str, RoleInfo] = {}
    for name, found in render.roles.items():
        roles[name] = role_info(found)
        if name == "alpha" and found is None:
            roles[name] = RoleInfo(reason="no channel A")
    if spp is not None:
        spp = int(spp) if float(spp).is_integer() else float(spp)
    return ExrInfo(
        path=render.path,
        parts=tuple(part_info(part, statistics=statistics) for part in render.parts),
        roles=roles,
        variance=variance,
        spp=spp,
        spp_from=render.spp_from if spp is not None else "",
        warnings=tuple(dict.fromkeys(render.warnings)),
        notes=tuple(dict.fromkeys(render.notes)),
    )
