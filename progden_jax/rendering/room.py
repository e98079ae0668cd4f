"""Rooms: four walls with furniture."""

from typing import Any

import numpy as np

from progden_jax.rendering import layout, lights, materials, shapes
from progden_jax.rendering.shapes import Shape


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
            at = layout.at(rng.uniform(-0.3, 0.3) * w, h - 0.02, rng.uniform(-0.3, 0.2) * d)
            half = rng.uniform(0.15, 0.8, 2)
            found.append(lights.panel(rng, 0.7 * flux, at, half))
    elif lighting == "bulbs":
        count = int(rng.integers(1, 4))
        for _ in range(count):
            top = rng.uniform(-0.3, 0.3) * w, h, rng.uniform(-0.35, 0.15) * d
            found += lights.hanging(rng, flux / count, top, rng.uniform(0.3, 1.0))
    elif opening is not None:
        found += _daylight(rng, flux, w, h, opening)
    else:
        found += _string(rng, flux, w, h, d)
    found += _furniture(rng, w, h, d)
    eye = rng.uniform(-0.35, 0.35) * w, rng.uniform(1.0, 1.7), d / 2 - 0.25
    target = rng.uniform(-0.15, 0.15) * w, rng.uniform(0.45, 0.9), -0.15 * d
    return layout.camera(rng, eye, target, fov=(38, 60), blurred=0.25), found


def _walls(rng: np.random.Generator, w: float, h: float, d: float, opening: Any) -> list[Shape]:
    """Six sides; `opening` (z, bottom, width, top) is a window in the one at +x."""
    wall = materials.surface(rng, repeat=2, bright=True)
    back = wall if rng.random() < 0.6 else materials.surface(rng, repeat=2, bright=True)
    floor = materials.surface(rng, repeat=float(rng.integers(1, 4)))
    white = {"type": "diffuse", "reflectance": rng.uniform(0.6, 0.85)}
    found = [
        layout.rectangle(layout.at(0, 0, 0) @ layout.pitch(-90), w / 2, d / 2, floor),
        layout.rectangle(layout.at(0, h, 0) @ layout.pitch(90), w / 2, d / 2, white),
        layout.rectangle(layout.at(0, h / 2, -d / 2), w / 2, h / 2, back),
        layout.rectangle(layout.at(0, h / 2, d / 2) @ layout.turn(180), w / 2, h / 2, wall),
        layout.rectangle(layout.at(-w / 2, h / 2, 0) @ layout.turn(90), d / 2, h / 2, wall),
    ]
    if opening is None:
        return [
            *found,
            layout.rectangle(layout.at(w / 2, h / 2, 0) @ layout.turn(-90), d / 2, h / 2, wall),
        ]
    z, bottom, width, top = opening
    low, high = z - width / 2, z + width / 2
    for z0, z1, y0, y1 in (
        (-d / 2, low, 0, h),
        (high, d / 2, 0, h),
        (low, high, 0, bottom),
        (low, high, top, h),
    ):
        at = layout.at(w / 2, (y0 + y1) / 2, (z0 + z1) / 2) @ layout.turn(-90)
        found.append(layout.rectangle(at, (z1 - z0) / 2, (y1 - y0) / 2, wall))
    if rng.random() < 0.4:  # blinds
        for y in np.arange(bottom, top, 0.07):
            slat = layout.at(w / 2, y, z) @ layout.transform().rotate([0, 0, 1], 35)
            found.append(shapes.box([0.03, 0.002, width / 2], slat, white))
    return found


def _daylight(
    rng: np.random.Generator, flux: float, w: float, h: float, opening: Any
) -> list[Shape]:
    """An overcast sky close behind the window, or a sun, which needs a lamp inside for the shadows."""
    z, bottom, width, top = opening
    middle = np.array([w / 2, (bottom + top) / 2, z])
    if rng.random() < 0.6:
        at = layout.at(w / 2 + 0.15, (bottom + top) / 2, z) @ layout.transform().rotate(
            [0, 0, 1], -90
        )
        return [lights.panel(rng, flux, at, ((top - bottom) / 2 + 0.15, width / 2 + 0.15))]
    toward = np.array([rng.uniform(0.7, 1), rng.uniform(0.5, 1), rng.uniform(-0.5, 0.5)])
    toward /= np.linalg.norm(toward)
    distance, area = 12.0, width * (top - bottom) * toward[0]
    sun = lights.bulb(
        rng, 0.2 * flux / area * 4 * np.pi * distance**2, middle + distance * toward, 0.12
    )
    sky = lights.sky(rng, sun=False)
    level = rng.uniform(0.1, 0.3) * flux / (width * (top - bottom))
    outside = lights.environment(sky * (level / lights.irradiance(sky, (1, 0, 0))))
    lamp = lights.panel(rng, 0.7 * flux, layout.at(0, h - 0.02, z), rng.uniform(0.15, 0.5, 2))
    return [sun, outside, lamp]


def _furniture(rng: np.random.Generator, w: float, h: float, d: float) -> list[Shape]:
    found: list[Shape] = []
    if rng.random() < 0.75:
        found += _table(rng, rng.uniform(-0.15, 0.15) * w, rng.uniform(-0.15, 0.1) * d)
    if rng.random() < 0.6:  # a cabinet at the back wall
        half = [rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.7), 0.2]
        x = rng.uniform(-0.5, 0.5) * (w - 2 * half[0])
        found.append(shapes.box(half, layout.at(x, 0, -d / 2 + 0.22), materials.surface(rng)))
        for dx in (-0.5, 0.5):
            top = layout.at(x + dx * half[0], 2 * half[1], -d / 2 + 0.22)
            found += shapes.thing(rng, size=rng.uniform(0.2, 0.35), at=top)
    for _ in range(int(rng.integers(0, 4))):  # pictures
        half_w, half_h = rng.uniform(0.15, 0.5, 2)
        at = layout.at(rng.uniform(-0.4, 0.4) * w, rng.uniform(1.3, 1.8), -d / 2 + 0.02)
        if rng.random() < 0.4:
            at = layout.at(
                -w / 2 + 0.02, rng.uniform(1.3, 1.8), rng.uniform(-0.4, 0) * d
            ) @ layout.turn(90)
        glazed = materials.metal(rng, smooth=True) if rng.random() < 0.2 else materials.surface(rng)
        found.append(layout.rectangle(at, half_w, half_h, glazed))
    if rng.random() < 0.4:  # a rug
        at = layout.at(0, 0.01, -0.05 * d) @ layout.turn(rng.uniform(-20, 20)) @ layout.pitch(-90)
        rug = materials.surface(rng, repeat=2)
        found.append(layout.rectangle(at, rng.uniform(0.6, 1.2), rng.uniform(0.5, 1), rug))
    if rng.random() < 0.35:  # rods from wall to wall, as of a rail
        z = rng.uniform(-0.35, 0.05) * d
        found += shapes.fence(rng, [-w / 2, 0, z], [rng.uniform(-0.2, 0.5) * w, 0, z])
    span = 0.42 * w
    for x, z, r in layout.places(
        rng, int(rng.integers(3, 8)), (-span, span), (-0.42 * d, 0.15 * d), (0.15, 0.5)
    ):
        found += shapes.thing(rng, size=2 * r, at=layout.at(x, 0, z))
    return found


def _table(rng: np.random.Generator, x: float, z: float) -> list[Shape]:
    half_x, half_z, height = rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.5), 0.72
    at = layout.at(x, 0, z) @ layout.turn(rng.uniform(-25, 25))
    found: list[Shape] = []
    top = materials.glass(rng) if rng.random() < 0.15 else materials.surface(rng)
    found.append(shapes.box([half_x, 0.02, half_z], at @ layout.at(0, height, 0), top))
    legs = materials.strand(rng)
    x_, z_ = 0.9 * half_x, 0.85 * half_z
    feet = np.array([[x_, 0, z_], [x_, 0, -z_], [-x_, 0, z_], [-x_, 0, -z_]])
    posts = list(np.linspace(feet, feet * [1, 0, 1] + [0, height, 0], 2, axis=1))
    found.append(shapes.curves(posts, 0.025, at, legs, smooth=False))
    spans = (-0.8 * half_x, 0.8 * half_x), (-0.6 * half_z, 0.6 * half_z)
    for px, pz, r in layout.places(rng, int(rng.integers(2, 6)), *spans, (0.08, 0.2)):
        found += shapes.thing(rng, size=2 * r, at=at @ layout.at(px, height + 0.04, pz))
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
        found.append(shapes.curves([wire], 0.004, layout.at(0, 0, 0), material, smooth=False))
        found += [lights.bulb(rng, flux / (wires * count), p - [0, 0.03, 0], 0.02) for p in wire]
    return found
