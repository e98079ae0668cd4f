"""BSDFs of Mitsuba, drawn from a random generator."""

import colorsys
from typing import Any

import numpy as np

from progden_jax.rendering import textures

Spec = dict[str, Any]

METALS = ("Au", "Ag", "Al", "Cu", "Cr", "W")
GLASSES = ("bk7", "water", "diamond", "acrylic glass")


def color(
    rng: np.random.Generator,
    *,
    value: tuple[float, float] = (0.15, 0.85),
    saturation: tuple[float, float] = (0.0, 0.75),
) -> list[float]:
    """Linear RGB."""
    hsv = rng.random(), rng.uniform(*saturation), rng.uniform(*value)
    return [float(c) for c in colorsys.hsv_to_rgb(*hsv)]


def rgb(values: Any) -> Spec:
    return {"type": "rgb", "value": [float(v) for v in values]}


def surface(rng: np.random.Generator, *, repeat: float = 1.0, bright: bool = False) -> Spec:
    """What walls and floors are made of: a pattern's colours, mostly with its relief.

    `repeat` is how often the pattern lies along the surface; `bright` is for what is to light a room.
    """
    height = textures.PATTERNS[str(rng.choice(list(textures.PATTERNS)))](rng)
    value = (0.45, 0.85) if bright else (0.12, 0.75)
    base = color(rng, value=value, saturation=(0, 0.5))
    shade = rng.uniform(0.5, 0.9) if bright else rng.uniform(0.2, 0.8)
    darker = [c * shade for c in base]
    colors = [darker, base] if rng.random() < 0.7 else [darker, color(rng, value=value), base]
    kind = rng.choice(["diffuse", "rough", "glossy"], p=[0.55, 0.25, 0.2])
    reflectance = bitmap(textures.colored(height, colors), repeat)
    if kind == "diffuse":
        bsdf: Spec = {"type": "diffuse", "reflectance": reflectance}
    else:
        alpha = rng.uniform(0.15, 0.4) if kind == "rough" else rng.uniform(0.03, 0.12)
        bsdf = plastic(reflectance, alpha)
    relief = rng.random()
    if relief < 0.35:
        bsdf = _normal_mapped(bsdf, height, repeat, depth=rng.uniform(0.01, 0.04))
    elif relief < 0.6:
        bsdf = _bumped(bsdf, height, repeat, depth=rng.uniform(0.01, 0.04))
    return {"type": "twosided", "inner": bsdf}


def solid(rng: np.random.Generator) -> Spec:
    """What things are made of: matte, plastic, metal, glass, painted or patterned."""
    kind = rng.choice(
        ["matte", "plastic", "metal", "mirror", "glass", "frosted", "paint", "pattern"],
        p=[0.16, 0.16, 0.15, 0.06, 0.13, 0.04, 0.15, 0.15],
    )
    if kind == "glass":
        return glass(rng)
    if kind == "frosted":
        return {"type": "roughdielectric", "alpha": rng.uniform(0.05, 0.3), "int_ior": "bk7"}
    if kind == "pattern":
        return surface(rng, repeat=float(rng.integers(1, 4)))
    if kind in ("metal", "mirror"):
        return metal(rng, smooth=kind == "mirror")
    if kind == "matte":
        bsdf: Spec = {"type": "diffuse", "reflectance": rgb(color(rng))}
    elif kind == "plastic":
        bsdf = plastic(rgb(color(rng, saturation=(0.3, 0.95))), rng.uniform(0.02, 0.4))
    else:
        bsdf = {
            "type": "principled",
            "base_color": rgb(color(rng, saturation=(0.2, 0.9))),
            "roughness": rng.uniform(0.15, 0.7),
            "metallic": rng.uniform(0, 0.9),
            "specular": 0.5,
            "clearcoat": rng.uniform(0, 1),
            "sheen": rng.uniform(0, 0.5),
        }
    if rng.random() < 0.2:
        bsdf = _bumped(bsdf, textures.clouds(rng), 2.0, depth=rng.uniform(0.01, 0.05))
    return {"type": "twosided", "inner": bsdf}


def plastic(reflectance: Spec, alpha: float) -> Spec:
    return {"type": "roughplastic", "diffuse_reflectance": reflectance, "alpha": float(alpha)}


def metal(rng: np.random.Generator, *, smooth: bool = False) -> Spec:
    name = str(rng.choice(METALS))
    if smooth:
        return {"type": "twosided", "inner": {"type": "conductor", "material": name}}
    alphas = {"alpha_u": rng.uniform(0.02, 0.35), "alpha_v": rng.uniform(0.02, 0.35)}
    if rng.random() < 0.6:
        alphas["alpha_v"] = alphas["alpha_u"]
    return {"type": "twosided", "inner": {"type": "roughconductor", "material": name, **alphas}}


def glass(rng: np.random.Generator) -> Spec:
    bsdf: Spec = {"type": "dielectric", "int_ior": str(rng.choice(GLASSES))}
    if rng.random() < 0.4:
        bsdf["specular_transmittance"] = rgb(color(rng, value=(0.8, 1.0), saturation=(0.1, 0.5)))
    return bsdf


def strand(rng: np.random.Generator) -> Spec:
    """Of hair, wires and blades of grass."""
    if rng.random() < 0.3:
        return metal(rng)
    return {"type": "twosided", "inner": plastic(rgb(color(rng, saturation=(0.3, 0.9))), 0.2)}


def bitmap(pixels: np.ndarray, repeat: float = 1.0, *, raw: bool = False) -> Spec:
    import mitsuba as mi

    to_uv = mi.ScalarTransform4f().scale([repeat, repeat, 1])
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32)),
        "raw": raw,
        "to_uv": to_uv,
    }


def _bumped(bsdf: Spec, height: textures.Height, repeat: float, *, depth: float) -> Spec:
    relief = bitmap(height[..., None], repeat, raw=True)
    return {"type": "bumpmap", "relief": relief, "scale": depth, "inner": bsdf}


def _normal_mapped(bsdf: Spec, height: textures.Height, repeat: float, *, depth: float) -> Spec:
    map_ = bitmap(textures.normals(height, depth=depth * repeat), repeat, raw=True)
    return {"type": "normalmap", "normalmap": map_, "inner": bsdf}
