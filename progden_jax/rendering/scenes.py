"""Procedural scenes: rooms, places outdoors and table tops, all of it drawn from one seed."""

from collections.abc import Callable
from typing import Any

import numpy as np

from progden_jax import _checks
from progden_jax.rendering import _mitsuba, lights, materials, shapes

Shape = shapes.Shape
Range = tuple[float, float]

DEPTH = 9
"""Bounces of a path, and one."""


def scene(
    seed: int,
    kind: str | None = None,
    *,
    size: tuple[int, int] = (128, 128),
    max_depth: int = DEPTH,
) -> dict[str, Any]:
    """A scene for `mitsuba.load_dict`, the same for the same arguments.

    Parameters
    ----------
    seed : any whole number from 0 up.
    kind : one of `KINDS`: "room", "outdoor" or "studio"; by default the seed chooses.
    size : height and width of the film in pixels.
    max_depth : longest path in segments, as Mitsuba's path tracer counts them.

    Raises
    ------
    ValueError
        If an argument is not of these.
    ModuleNotFoundError
        If Mitsuba is not installed.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"seed is {seed!r}, expected a whole number from 0 up.")
    if kind is not None:
        _checks.choice("kind", kind, KINDS)
    for name, value in (("height", size[0]), ("width", size[1]), ("max_depth", max_depth)):
        _checks.positive_int(name, value)
    _mitsuba.load()
    rng = np.random.default_rng(seed)
    chosen = str(rng.choice(list(KINDS)))  # drawn in any case: naming it changes nothing else
    camera, found = KINDS[kind or chosen](rng)
    film = {"type": "hdrfilm", "height": size[0], "width": size[1], "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth},
        "sensor": camera | {"film": film},
        **{f"shape{i:03d}": shape for i, shape in enumerate(found)},
    }


def room(rng: np.random.Generator) -> tuple[dict[str, Any], list[Shape]]:
    """Four walls with furniture, lit by panels, bulbs, a window, or many small lights."""
    w, h, d = rng.uniform(3.4, 6), rng.uniform(2.4, 3.2), rng.uniform(4, 7)
    lighting = rng.choice(["panel", "bulbs", "window", "many"], p=[0.3, 0.25, 0.25, 0.2])
    opening = None
    if lighting == "window":
        opening = (
            rng.uniform(-0.3, 0.1) * d,
            rng.uniform(0.5, 1.1),
            rng.uniform(1.0, 1.4),
            0.75 * h,
        )
    found = _walls(rng, w, h, d, opening)
    # Light that comes back from the walls counts, so the flux for a mean radiance goes by their area.
    flux = rng.uniform(0.18, 0.36) * 1.5 * np.pi * 2 * (w * h + w * d + h * d)
    if lighting == "panel":
        for _ in range(int(rng.integers(1, 3))):
            at = _at(rng.uniform(-0.3, 0.3) * w, h - 0.02, rng.uniform(-0.3, 0.2) * d)
            half = rng.uniform(0.15, 0.8, 2)
            found.append(lights.panel(rng, 0.7 * flux, at, half))
    elif lighting == "bulbs":
        count = int(rng.integers(1, 4))
        for _ in range(count):
            top = rng.uniform(-0.3, 0.3) * w, h, rng.uniform(-0.35, 0.15) * d
            found += lights.hanging(rng, flux / count, top, rng.uniform(0.3, 1.0))
    elif opening is not None:
        found += _daylight(rng, flux, w, opening)
    else:
        found += _string(rng, flux, w, h, d)
    found += _furniture(rng, w, h, d)
    eye = rng.uniform(-0.35, 0.35) * w, rng.uniform(1.0, 1.7), d / 2 - 0.25
    target = rng.uniform(-0.15, 0.15) * w, rng.uniform(0.45, 0.9), -0.15 * d
    return _camera(rng, eye, target, fov=(38, 60), blurred=0.25), found


def outdoor(rng: np.random.Generator) -> tuple[dict[str, Any], list[Shape]]:
    """Ground, buildings, trees, fences and what lies about, by day or under lamps at night."""
    night = rng.random() < 0.2
    sun = not night and rng.random() < 0.7
    sky = lights.sky(rng, sun=sun)
    level = 0.25 if night else rng.uniform(2, 4) if sun else rng.uniform(1, 2)
    sky *= level / lights.irradiance(sky, (0, 1, 0))
    found: list[Shape] = [lights.environment(sky)]
    found.append(
        _rectangle(_at(0, 0, -10) @ _pitch(-90), 40, 40, materials.surface(rng, repeat=30))
    )
    for _ in range(int(rng.integers(1, 4))):
        half = [rng.uniform(1, 3), rng.uniform(1.5, 4), rng.uniform(1, 2)]
        at = _at(rng.uniform(-8, 8), 0, rng.uniform(-14, -7)) @ _turn(rng.uniform(-30, 30))
        facade = materials.surface(rng, repeat=float(rng.integers(1, 4)))
        found.append(shapes.box(half, at, facade))
    for _ in range(int(rng.integers(0, 4))):
        at = _at(rng.uniform(-5, 5), 0, rng.uniform(-8, -1)) @ _turn(rng.uniform(0, 360))
        found += shapes.tree(rng, rng.uniform(2, 5), at)
    for _ in range(int(rng.integers(0, 3))):
        z = rng.uniform(-4, 1.5)
        left, right = sorted(rng.uniform(-5, 5, 2))
        found += shapes.fence(rng, [left, 0, z], [right + 1, 0, z + rng.uniform(-1.5, 1.5)])
    for x, z, r in _places(rng, int(rng.integers(4, 9)), (-2.6, 2.6), (-3, 2.2), (0.25, 0.8)):
        found += shapes.thing(rng, size=2 * r, at=_at(x, 0, z))
    for _ in range(int(rng.integers(0, 10))):
        found += shapes.tuft(
            rng, rng.uniform(0.2, 0.6), _at(rng.uniform(-3, 3), 0, rng.uniform(-3, 3))
        )
    if night:
        for _ in range(int(rng.integers(2, 7))):
            x, y, z = rng.uniform(-3.5, 3.5), rng.uniform(0.8, 2.8), rng.uniform(-4, 2)
            pole = np.array([[x, 0, z], [x, y, z]])
            found.append(
                shapes.curves([pole], 0.02, _at(0, 0, 0), materials.strand(rng), smooth=False)
            )
            found.append(lights.bulb(rng, rng.uniform(15, 40), (x, y + 0.08, z), 0.08))
    eye = rng.uniform(-1.5, 1.5), rng.uniform(0.8, 2.2), rng.uniform(4.5, 6)
    target = rng.uniform(-0.8, 0.8), rng.uniform(0.5, 1.2), -1
    return _camera(rng, eye, target, fov=(38, 60), blurred=0.3), found


def studio(rng: np.random.Generator) -> tuple[dict[str, Any], list[Shape]]:
    """A few things close up before a curved backdrop, under large and small lights: caustics, hair, blur."""
    sweep = np.linspace(0, np.pi / 2, 12)
    y = np.concatenate([[0], 0.6 - 0.6 * np.cos(sweep), [3]])
    z = np.concatenate([[3], -1.2 - 0.6 * np.sin(sweep), [-1.8]])
    x = np.linspace(-4, 4, 9)
    backdrop = np.stack([x + 0 * y[:, None], y[:, None] + 0 * x, z[:, None] + 0 * x], -1)
    found: list[Shape] = [shapes.mesh(backdrop, _at(0, 0, 0), materials.surface(rng, repeat=6))]
    for px, pz, r in _places(
        rng, int(rng.integers(3, 8)), (-0.65, 0.65), (-0.8, 0.7), (0.12, 0.35)
    ):
        found += shapes.thing(rng, size=2 * r, at=_at(px, 0, pz))
    count = int(rng.integers(1, 4))
    share = rng.uniform(0.6, 1.4) * np.pi / count  # irradiance wanted at the origin, from each
    for _ in range(count):
        lamp = np.array([rng.uniform(-2, 2), rng.uniform(1.2, 2.4), rng.uniform(-0.8, 2)])
        distance = float(np.linalg.norm(lamp))
        intensity = share * distance**3 / lamp[1]
        if rng.random() < 0.45:
            radius = rng.uniform(0.03, 0.12)
            found.append(lights.bulb(rng, 4 * np.pi * intensity, lamp, radius))
        else:
            facing = _looking(lamp, (0, 0, 0)) @ _pitch(-90)
            found.append(lights.panel(rng, np.pi * intensity, facing, rng.uniform(0.05, 0.6, 2)))
    if rng.random() < 0.7:
        ambient = materials.rgb(rng.uniform(0.02, 0.3) * lights.warmth(rng))
        found.append({"type": "constant", "radiance": ambient})
    eye = rng.uniform(-0.8, 0.8), rng.uniform(0.5, 1.3), rng.uniform(2.0, 2.8)
    target = rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.3), 0
    return _camera(rng, eye, target, fov=(30, 44), blurred=0.6), found


KINDS: dict[str, Callable[[np.random.Generator], tuple[dict[str, Any], list[Shape]]]] = {
    f.__name__: f for f in (room, outdoor, studio)
}


def _walls(rng: np.random.Generator, w: float, h: float, d: float, opening: Any) -> list[Shape]:
    """Six sides; `opening` (z, bottom, width, top) is a window in the one at +x."""
    wall = materials.surface(rng, repeat=2, bright=True)
    back = wall if rng.random() < 0.6 else materials.surface(rng, repeat=2, bright=True)
    floor = materials.surface(rng, repeat=float(rng.integers(1, 4)))
    white = {"type": "diffuse", "reflectance": rng.uniform(0.6, 0.85)}
    found = [
        _rectangle(_at(0, 0, 0) @ _pitch(-90), w / 2, d / 2, floor),
        _rectangle(_at(0, h, 0) @ _pitch(90), w / 2, d / 2, white),
        _rectangle(_at(0, h / 2, -d / 2), w / 2, h / 2, back),
        _rectangle(_at(0, h / 2, d / 2) @ _turn(180), w / 2, h / 2, wall),
        _rectangle(_at(-w / 2, h / 2, 0) @ _turn(90), d / 2, h / 2, wall),
    ]
    if opening is None:
        return [*found, _rectangle(_at(w / 2, h / 2, 0) @ _turn(-90), d / 2, h / 2, wall)]
    z, bottom, width, top = opening
    low, high = z - width / 2, z + width / 2
    for z0, z1, y0, y1 in (
        (-d / 2, low, 0, h),
        (high, d / 2, 0, h),
        (low, high, 0, bottom),
        (low, high, top, h),
    ):
        at = _at(w / 2, (y0 + y1) / 2, (z0 + z1) / 2) @ _turn(-90)
        found.append(_rectangle(at, (z1 - z0) / 2, (y1 - y0) / 2, wall))
    if rng.random() < 0.4:  # blinds
        for y in np.arange(bottom, top, 0.07):
            slat = _at(w / 2, y, z) @ _transform().rotate([0, 0, 1], 35)
            found.append(shapes.box([0.03, 0.002, width / 2], slat, white))
    return found


def _daylight(rng: np.random.Generator, flux: float, w: float, opening: Any) -> list[Shape]:
    """An overcast sky close behind the window, or a sun with a sky that gives little."""
    z, bottom, width, top = opening
    middle = np.array([w / 2, (bottom + top) / 2, z])
    if rng.random() < 0.5:
        at = _at(w / 2 + 0.15, (bottom + top) / 2, z) @ _transform().rotate([0, 0, 1], -90)
        return [lights.panel(rng, flux, at, ((top - bottom) / 2 + 0.15, width / 2 + 0.15))]
    toward = np.array([rng.uniform(0.7, 1), rng.uniform(0.5, 1), rng.uniform(-0.5, 0.5)])
    toward /= np.linalg.norm(toward)
    distance, area = 12.0, width * (top - bottom) * toward[0]
    sun = lights.bulb(
        rng, 0.5 * flux / area * 4 * np.pi * distance**2, middle + distance * toward, 0.12
    )
    sky = lights.sky(rng, sun=False)
    level = rng.uniform(0.3, 0.6) * flux / (width * (top - bottom))
    return [sun, lights.environment(sky * (level / lights.irradiance(sky, (1, 0, 0))))]


def _furniture(rng: np.random.Generator, w: float, h: float, d: float) -> list[Shape]:
    found: list[Shape] = []
    if rng.random() < 0.75:
        found += _table(rng, rng.uniform(-0.15, 0.15) * w, rng.uniform(-0.15, 0.1) * d)
    if rng.random() < 0.6:  # a cabinet at the back wall
        half = [rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.7), 0.2]
        x = rng.uniform(-0.5, 0.5) * (w - 2 * half[0])
        found.append(shapes.box(half, _at(x, 0, -d / 2 + 0.22), materials.surface(rng)))
        for dx in (-0.5, 0.5):
            top = _at(x + dx * half[0], 2 * half[1], -d / 2 + 0.22)
            found += shapes.thing(rng, size=rng.uniform(0.2, 0.35), at=top)
    for _ in range(int(rng.integers(0, 4))):  # pictures
        half_w, half_h = rng.uniform(0.15, 0.5, 2)
        at = _at(rng.uniform(-0.4, 0.4) * w, rng.uniform(1.3, 1.8), -d / 2 + 0.02)
        if rng.random() < 0.4:
            at = _at(-w / 2 + 0.02, rng.uniform(1.3, 1.8), rng.uniform(-0.4, 0) * d) @ _turn(90)
        glazed = materials.metal(rng, smooth=True) if rng.random() < 0.2 else materials.surface(rng)
        found.append(_rectangle(at, half_w, half_h, glazed))
    if rng.random() < 0.4:  # a rug
        at = _at(0, 0.01, -0.05 * d) @ _turn(rng.uniform(-20, 20)) @ _pitch(-90)
        rug = materials.surface(rng, repeat=2)
        found.append(_rectangle(at, rng.uniform(0.6, 1.2), rng.uniform(0.5, 1), rug))
    if rng.random() < 0.35:  # rods from wall to wall, as of a rail
        z = rng.uniform(-0.35, 0.05) * d
        found += shapes.fence(rng, [-w / 2, 0, z], [rng.uniform(-0.2, 0.5) * w, 0, z])
    span = 0.42 * w
    for x, z, r in _places(
        rng, int(rng.integers(3, 8)), (-span, span), (-0.42 * d, 0.15 * d), (0.15, 0.5)
    ):
        found += shapes.thing(rng, size=2 * r, at=_at(x, 0, z))
    return found


def _table(rng: np.random.Generator, x: float, z: float) -> list[Shape]:
    half_x, half_z, height = rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.5), 0.72
    at = _at(x, 0, z) @ _turn(rng.uniform(-25, 25))
    found: list[Shape] = []
    top = materials.glass(rng) if rng.random() < 0.15 else materials.surface(rng)
    found.append(shapes.box([half_x, 0.02, half_z], at @ _at(0, height, 0), top))
    legs = materials.strand(rng)
    x_, z_ = 0.9 * half_x, 0.85 * half_z
    feet = np.array([[x_, 0, z_], [x_, 0, -z_], [-x_, 0, z_], [-x_, 0, -z_]])
    posts = list(np.linspace(feet, feet * [1, 0, 1] + [0, height, 0], 2, axis=1))
    found.append(shapes.curves(posts, 0.025, at, legs, smooth=False))
    spans = (-0.8 * half_x, 0.8 * half_x), (-0.6 * half_z, 0.6 * half_z)
    for px, pz, r in _places(rng, int(rng.integers(2, 6)), *spans, (0.08, 0.2)):
        found += shapes.thing(rng, size=2 * r, at=at @ _at(px, height + 0.04, pz))
    return found


def _string(rng: np.random.Generator, flux: float, w: float, h: float, d: float) -> list[Shape]:
    """Many small lights on sagging wires under the ceiling."""
    found: list[Shape] = []
    wires, count = int(rng.integers(2, 5)), int(rng.integers(6, 14))
    material = materials.strand(rng)
    for z in rng.uniform(-0.45, 0.2, wires) * d:
        t = np.linspace(0, 1, count)
        sag = rng.uniform(0.2, 0.6)
        y = h - 0.1 - sag * 4 * t * (1 - t)
        wire = np.stack([(t - 0.5) * w, y, z + 0 * t], -1)
        found.append(shapes.curves([wire], 0.004, _at(0, 0, 0), material, smooth=False))
        found += [lights.bulb(rng, flux / (wires * count), p - [0, 0.03, 0], 0.02) for p in wire]
    return found


def _camera(
    rng: np.random.Generator, eye: Any, target: Any, *, fov: Range, blurred: float
) -> dict[str, Any]:
    """Pinhole, or with this probability a lens that is focused near the target."""
    camera = {"type": "perspective", "fov": rng.uniform(*fov), "to_world": _looking(eye, target)}
    if rng.random() < blurred:
        distance = float(np.linalg.norm(np.subtract(eye, target)))
        focus = distance * rng.uniform(0.7, 1.1)
        camera |= {"type": "thinlens", "focus_distance": focus}
        camera["aperture_radius"] = distance * rng.uniform(0.006, 0.03)
    return camera


def _places(
    rng: np.random.Generator, count: int, xs: Range, zs: Range, radii: Range
) -> list[tuple[float, float, float]]:
    """Up to `count` discs (x, z, radius) that do not overlap."""
    found: list[tuple[float, float, float]] = []
    for _ in range(8 * count):
        x, z, r = rng.uniform(*xs), rng.uniform(*zs), rng.uniform(*radii)
        if all(np.hypot(x - a, z - b) > r + c for a, b, c in found):
            found.append((x, z, r))
        if len(found) == count:
            break
    return found


def _rectangle(at: Any, half_width: float, half_height: float, bsdf: Any) -> Shape:
    to_world = at @ _transform().scale([half_width, half_height, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def _looking(eye: Any, target: Any) -> Any:
    points = {"origin": eye, "target": target, "up": (0, 1, 0)}
    return _transform().look_at(**{k: [float(c) for c in v] for k, v in points.items()})


def _at(x: float, y: float, z: float) -> Any:
    return _transform().translate([x, y, z])


def _turn(degrees: float) -> Any:
    return _transform().rotate([0, 1, 0], degrees)


def _pitch(degrees: float) -> Any:
    return _transform().rotate([1, 0, 0], degrees)


def _transform() -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f()
