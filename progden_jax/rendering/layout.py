"""Where things stand and what looks at them."""

from typing import Any

import numpy as np

Range = tuple[float, float]


def camera(
    rng: np.random.Generator, eye: Any, target: Any, *, fov: Range, blurred: float
) -> dict[str, Any]:
    """Pinhole, or with this probability a lens that is focused near the target."""
    found = {"type": "perspective", "fov": rng.uniform(*fov), "to_world": looking(eye, target)}
    if rng.random() < blurred:
        distance = float(np.linalg.norm(np.subtract(eye, target)))
        focus = distance * rng.uniform(0.7, 1.1)
        found |= {"type": "thinlens", "focus_distance": focus}
        found["aperture_radius"] = distance * rng.uniform(0.006, 0.03)
    return found


def places(
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


def rectangle(at: Any, half_width: float, half_height: float, bsdf: Any) -> dict[str, Any]:
    """By half its sides, facing +z before `at` moves it."""
    to_world = at @ transform().scale([half_width, half_height, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def looking(eye: Any, target: Any) -> Any:
    points = {"origin": eye, "target": target, "up": (0, 1, 0)}
    return transform().look_at(**{k: [float(c) for c in v] for k, v in points.items()})


def at(x: float, y: float, z: float) -> Any:
    return transform().translate([x, y, z])


def turn(degrees: float) -> Any:
    return transform().rotate([0, 1, 0], degrees)


def pitch(degrees: float) -> Any:
    return transform().rotate([1, 0, 0], degrees)


def transform() -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f()
