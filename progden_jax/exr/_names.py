"""How renderers name channels: the tables behind the conventions, and names taken apart.

A channel is LAYER.COMPONENT, the layer possibly with a view layer before it
("ViewLayer.Denoising Albedo.R"). In files of several parts a channel without a layer belongs to the
layer that its part is named after. Names are compared without case, blanks and underscores.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from progden_jax.exr._file import Part

MOMENT = "m2_"
"""How Mitsuba's moment integrator begins the layers of second moments."""

ROLES = ("color", "variance", "albedo", "normal", "depth")
AUXILIARY = ("albedo", "normal", "depth")

# Layers by role, the better first; equal right within one line. Sources: section 9 of the design.
LAYERS: dict[str, tuple[frozenset[str], ...]] = {
    "color": (
        frozenset({"noisyimage"}),  # Cycles: with denoising on, Combined is already denoised
        frozenset({""}),
        frozenset({"rgba", "rgb", "beauty", "combined", "ci", "c", "color", "colour"}),
    ),
    "variance": (
        frozenset(
            {"variance", "colorvariance", "rgbavariance", "beautyvariance", "combinedvariance"}
        ),
        frozenset({"mse"}),  # RenderMan's statistic of that name, a variance of the mean
    ),
    "std": (frozenset({"std", "stddev", "stdev", "standarddeviation", "sigma"}),),
    "albedo": (
        frozenset({"denoisingalbedo", "denoisealbedo"}),
        frozenset({"albedo", "alb", "visiblediffuse", "optixalbedo"}),
        frozenset({"diffusealbedo", "diffcol", "diffusecolor", "basecolor"}),
        frozenset({"diffuse"}),
    ),
    "normal": (
        frozenset({"denoisingnormal", "denoisenormal"}),
        frozenset({"ns", "shnormal", "shadingnormal"}),
        frozenset({"normal", "normals", "nrm", "nn", "visiblenormals", "optixnormals"}),
        frozenset({"n", "ng", "geonormal", "geometricnormal"}),
    ),
    "depth": (
        frozenset({"denoisingdepth", "denoisedepth"}),
        frozenset({"depth", "zdepth"}),
        frozenset({"z"}),
    ),
}
RGB = (("R", "G", "B"), ("r", "g", "b"), ("red", "green", "blue"), ("Red", "Green", "Blue"))
XYZ = (("X", "Y", "Z"), ("x", "y", "z"))
COMPONENTS = {
    "color": (*RGB, ("Y",), ("y",)),
    "variance": (*RGB, ("Y",), ("y",)),
    "std": (*RGB, ("Y",), ("y",)),
    "albedo": RGB,
    "normal": (*XYZ, *RGB),
    "depth": (("Z",), ("z",), ("T",), ("V",), ("Y",), ("R",), ("r",)),
}
# Beside these, a layer called "diffuse" is light that was reflected, not a colour of surfaces.
LIGHT = frozenset({"specular", "diffusedirect", "diffuseindirect", "direct", "indirect", "diffdir"})


@dataclass(frozen=True)
class Source:
    """The channels of one part (of the file at `file`, or of the input itself) that play a role."""

    part: int
    layer: str
    channels: tuple[str, ...]
    file: str | None = None

    @property
    def text(self) -> str:
        """For messages: 'Albedo.R/G/B'."""
        where = f"{self.file}: " if self.file else ""
        names = [c.rpartition(".") for c in self.channels]
        same = {(layer, dot) for layer, dot, _ in names}
        if len(same) > 1:
            return where + ", ".join(self.channels)
        layer, dot, _ = names[0]
        return f"{where}{layer}{dot}" + "/".join(c for _, _, c in names)


@dataclass(frozen=True)
class Missing:
    """Why no channels play a role. `problem`: the reader cannot go on without an answer, and
    `remedy` says how to give it (empty: by naming the layer)."""

    reason: str
    problem: bool = False
    remedy: str = ""


def plain(layer: str) -> str:
    """The layer's own name as it is compared: 'ViewLayer.Denoising Albedo' -> 'denoisingalbedo'."""
    name = layer.rpartition(".")[2]
    return name.lower().replace(" ", "").replace("_", "")


def layers(parts: Iterable[Part], *, several: bool) -> dict[tuple[int, str], dict[str, str]]:
    """Components of every layer: (part, layer) -> {component: channel name}."""
    found: dict[tuple[int, str], dict[str, str]] = {}
    for part in parts:
        for name, channel in part.channels.items():
            if channel.dtype in ("uint", "deep"):
                continue
            layer, _, component = name.rpartition(".")
            layer = layer.lstrip(".")  # V-Ray: an empty layer name
            if not layer and several:
                layer = part.name
            # Of ".R" and "R" the plain one is the picture.
            components = found.setdefault((part.index, layer), {})
            if component not in components or not name.startswith("."):
                components[component] = name
    return found


def complete(
    components: dict[str, str], wanted: Sequence[tuple[str, ...]]
) -> tuple[str, ...] | None:
    """The channel names of the first set in `wanted` that is all there, a lone Y being grey."""
    for names in wanted:
        if all(name in components for name in names):
            if names[0] in ("Y", "y") and {"X", "x"} & set(components):
                continue
            return tuple(components[name] for name in names)
    return None


def is_pbrt(parts: list[Part]) -> bool:
    """Whether the file looks like pbrt-v4's G-buffer film, whose Variance.* is of the samples."""
    names = {name for part in parts for name in part.channels}
    return names >= {"dzdx", "dzdy"} or any(n.startswith("RelativeVariance.") for n in names)
