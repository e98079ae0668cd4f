"""Light: skies, lamps and panels, each given the flux or irradiance that exposes the picture well."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from progden_jax.rendering import materials, shapes, textures

Shape = shapes.Shape
Sky = Float[np.ndarray, "h w 3"]

HEIGHT, WIDTH = 256, 512  # the sun covers a few of these pixels


def warmth(rng: np.random.Generator) -> np.ndarray:
    """RGB of luminance near 1, from candle to overcast sky."""
    warm, cold = np.array([1.5, 0.9, 0.4]), np.array([0.75, 1.0, 1.4])
    share = rng.random()
    return share * warm + (1 - share) * cold


def sky(rng: np.random.Generator, *, sun: bool) -> Sky:
    """Radiance from everywhere, of no particular scale: sky with clouds, ground, maybe a sun.

    Rows go from the zenith down, columns once around, from -z over +x.
    """
    directions = _directions()
    up = directions[..., 1]
    horizon, zenith = 1.4 * warmth(rng), np.array([0.35, 0.6, 1.1]) * rng.uniform(0.3, 1)
    blend = np.clip(up, 0, 1)[..., None] ** rng.uniform(0.3, 0.8)
    clouds = np.tile(textures.clouds(rng), (HEIGHT // textures.SIZE, WIDTH // textures.SIZE))
    found = horizon * (1 - blend) + zenith * blend
    cover = np.clip(clouds - rng.uniform(0.3, 0.8), 0, None)[..., None] * 3
    found = found + cover * np.clip(up, 0, 1)[..., None]
    ground = np.array(materials.color(rng, value=(0.1, 0.3), saturation=(0.1, 0.5)))
    found = np.where(up[..., None] < 0, ground, found)
    if sun:
        height = np.radians(rng.uniform(12, 65))
        around = rng.uniform(0, 2 * np.pi)
        toward = [np.cos(height) * np.sin(around), np.sin(height), -np.cos(height) * np.cos(around)]
        disc = np.clip((directions @ toward - np.cos(np.radians(1.0))) * 1e4, 0, 1)
        tint = np.array([1.0, 0.95, 0.85]) if height > 0.5 else np.array([1.0, 0.75, 0.45])
        sunlight = disc[..., None] * tint
        ratio = rng.uniform(1, 5) * irradiance(found, (0, 1, 0)) / irradiance(sunlight, (0, 1, 0))
        found = found + sunlight * ratio
    return found


def irradiance(sky: Sky, normal: Sequence[float]) -> float:
    """Of a surface with this normal under an open sky, mean over the channels."""
    cosine = np.clip(_directions() @ np.asarray(normal, float), 0, None)
    polar = (np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi
    solid_angle = np.sin(polar)[:, None] * (np.pi / HEIGHT) * (2 * np.pi / WIDTH)
    return float((sky.mean(-1) * cosine * solid_angle).sum())


def environment(sky: Sky) -> Shape:
    import mitsuba as mi

    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(sky, np.float32))}


def panel(rng: np.random.Generator, flux: float, at: Any, half: shapes.Vector) -> Shape:
    """A rectangle of these half sides that shines along -y."""
    import mitsuba as mi

    area = 4 * half[0] * half[1]
    to_world = at @ mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale([half[0], half[1], 1])
    return {
        "type": "rectangle",
        "to_world": to_world,
        "bsdf": {"type": "diffuse", "reflectance": 0.2},
        "emitter": _emitter(rng, flux, area),
    }


def bulb(rng: np.random.Generator, flux: float, center: shapes.Vector, radius: float) -> Shape:
    return {
        "type": "sphere",
        "center": [float(c) for c in center],
        "radius": float(radius),
        "bsdf": {"type": "diffuse", "reflectance": 0.2},
        "emitter": _emitter(rng, flux, 4 * np.pi * radius**2),
    }


def hanging(
    rng: np.random.Generator, flux: float, ceiling: shapes.Vector, length: float
) -> list[Shape]:
    """A bulb on a wire, half of the time under a shade."""
    import mitsuba as mi

    x, y, z = ceiling
    radius = rng.uniform(0.02, 0.06)
    low = y - length
    wire = np.array([[x, y, z], [x, low + radius, z]])
    found = [
        bulb(rng, flux, (x, low, z), radius),
        shapes.curves([wire], 0.006, mi.ScalarTransform4f(), materials.strand(rng), smooth=False),
    ]
    if rng.random() < 0.5:
        t = np.linspace(0, 1, 9)
        r = 0.05 + 0.16 * t
        angle = np.linspace(0, 2 * np.pi, 49)
        cone = np.stack(
            [r[:, None] * np.cos(angle), -0.2 * t[:, None] + 0 * angle, r[:, None] * np.sin(angle)], -1
        )  # fmt: skip
        at = mi.ScalarTransform4f().translate([x, low + 0.15, z])
        found.append(shapes.mesh(cone, at, materials.metal(rng)))
    return found


def _emitter(rng: np.random.Generator, flux: float, area: float) -> dict[str, Any]:
    radiance = flux / (np.pi * area) * warmth(rng)
    return {"type": "area", "radiance": materials.rgb(radiance)}


def _directions() -> Float[np.ndarray, "h w 3"]:
    polar = (np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi
    around = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi
    polar, around = np.meshgrid(polar, around, indexing="ij")
    return np.stack(
        [np.sin(polar) * np.sin(around), np.cos(polar), -np.sin(polar) * np.cos(around)], -1
    )
