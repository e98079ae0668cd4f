"""Procedural scenes: rooms, places outdoors and table tops, all of it drawn from one seed."""

from collections.abc import Callable
from typing import Any

import numpy as np

from progden_jax import _checks
from progden_jax.rendering import _mitsuba, layout, lights, materials, shapes
from progden_jax.rendering.room import room
from progden_jax.rendering.shapes import Shape

DEPTH = 9
"""Bounces of a path, and one."""


def scene(
    seed: int,
    kind: str | None = None,
    *,
    size: tuple[int, int] = (128, 128),
    max_depth: int = DEPTH,
) -> dict[str, Any]:
    """A scene for ``mitsuba.load_dict``, the same for the same arguments.

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


def outdoor(rng: np.random.Generator) -> tuple[dict[str, Any], list[Shape]]:
    """Ground, buildings, trees, fences and what lies about, by day or under lamps at night."""
    night = rng.random() < 0.2
    sun = not night and rng.random() < 0.7
    sky = lights.sky(rng, sun=sun)
    level = 0.25 if night else rng.uniform(2, 4) if sun else rng.uniform(1, 2)
    sky *= level / lights.irradiance(sky, (0, 1, 0))
    found: list[Shape] = [lights.environment(sky)]
    found.append(
        layout.rectangle(
            layout.at(0, 0, -10) @ layout.pitch(-90), 40, 40, materials.surface(rng, repeat=30)
        )
    )
    for _ in range(int(rng.integers(1, 4))):
        half = [rng.uniform(1, 3), rng.uniform(1.5, 4), rng.uniform(1, 2)]
        at = layout.at(rng.uniform(-8, 8), 0, rng.uniform(-14, -7)) @ layout.turn(
            rng.uniform(-30, 30)
        )
        facade = materials.surface(rng, repeat=float(rng.integers(1, 4)))
        found.append(shapes.box(half, at, facade))
    for _ in range(int(rng.integers(0, 4))):
        at = layout.at(rng.uniform(-5, 5), 0, rng.uniform(-8, -1)) @ layout.turn(
            rng.uniform(0, 360)
        )
        found += shapes.tree(rng, rng.uniform(2, 5), at)
    for _ in range(int(rng.integers(0, 3))):
        z = rng.uniform(-4, 1.5)
        left, right = sorted(rng.uniform(-5, 5, 2))
        found += shapes.fence(rng, [left, 0, z], [right + 1, 0, z + rng.uniform(-1.5, 1.5)])
    for x, z, r in layout.places(rng, int(rng.integers(4, 9)), (-2.6, 2.6), (-3, 2.2), (0.25, 0.8)):
        found += shapes.thing(rng, size=2 * r, at=layout.at(x, 0, z))
    for _ in range(int(rng.integers(0, 10))):
        found += shapes.tuft(
            rng, rng.uniform(0.2, 0.6), layout.at(rng.uniform(-3, 3), 0, rng.uniform(-3, 3))
        )
    if night:
        for _ in range(int(rng.integers(2, 7))):
            x, y, z = rng.uniform(-3.5, 3.5), rng.uniform(0.8, 2.8), rng.uniform(-4, 2)
            pole = np.array([[x, 0, z], [x, y, z]])
            found.append(
                shapes.curves([pole], 0.02, layout.at(0, 0, 0), materials.strand(rng), smooth=False)
            )
            found.append(lights.bulb(rng, rng.uniform(15, 40), (x, y + 0.08, z), 0.08))
    eye = rng.uniform(-1.5, 1.5), rng.uniform(0.8, 2.2), rng.uniform(4.5, 6)
    target = rng.uniform(-0.8, 0.8), rng.uniform(0.5, 1.2), -1
    return layout.camera(rng, eye, target, fov=(38, 60), blurred=0.3), found


def studio(rng: np.random.Generator) -> tuple[dict[str, Any], list[Shape]]:
    """A few things close up before a curved backdrop, under large and small lights: caustics, hair, blur."""
    sweep = np.linspace(0, np.pi / 2, 12)
    y = np.concatenate([[0], 0.6 - 0.6 * np.cos(sweep), [3]])
    z = np.concatenate([[3], -1.2 - 0.6 * np.sin(sweep), [-1.8]])
    x = np.linspace(-4, 4, 9)
    backdrop = np.stack([x + 0 * y[:, None], y[:, None] + 0 * x, z[:, None] + 0 * x], -1)
    found: list[Shape] = [
        shapes.mesh(backdrop, layout.at(0, 0, 0), materials.surface(rng, repeat=6))
    ]
    for px, pz, r in layout.places(
        rng, int(rng.integers(3, 8)), (-0.65, 0.65), (-0.8, 0.7), (0.12, 0.35)
    ):
        found += shapes.thing(rng, size=2 * r, at=layout.at(px, 0, pz))
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
            facing = layout.looking(lamp, (0, 0, 0)) @ layout.pitch(-90)
            found.append(lights.panel(rng, np.pi * intensity, facing, rng.uniform(0.05, 0.6, 2)))
    if rng.random() < 0.7:
        ambient = materials.rgb(rng.uniform(0.02, 0.3) * lights.warmth(rng))
        found.append({"type": "constant", "radiance": ambient})
    eye = rng.uniform(-0.8, 0.8), rng.uniform(0.5, 1.3), rng.uniform(2.0, 2.8)
    target = rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.3), 0
    return layout.camera(rng, eye, target, fov=(30, 44), blurred=0.6), found


KINDS: dict[str, Callable[[np.random.Generator], tuple[dict[str, Any], list[Shape]]]] = {
    f.__name__: f for f in (room, outdoor, studio)
}
