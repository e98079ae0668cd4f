"""Things that stand in scenes: lists of Mitsuba shapes, drawn from a random generator.

A thing stands on y = 0 around the origin and fits, with the transform `at`, where it is to be. Lengths are
in metres.
"""

import os
import tempfile
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from progden_jax.rendering import layout, materials

Shape = Any
"""A dictionary for ``mitsuba.load_dict``, or what that made of one."""

Vector = Sequence[float] | np.ndarray
Points = Float[np.ndarray, "n 3"]

POLE = 1e-3
"""Where surfaces of revolution end beside their axis, so that no face there is without a normal."""


def thing(rng: np.random.Generator, *, size: float, at: Any) -> list[Shape]:
    """Any of the things below, `size` high or wide."""
    make = THINGS[str(rng.choice(list(THINGS)))]
    turn = at @ layout.transform().rotate([0, 1, 0], rng.uniform(0, 360))
    return make(rng, size, turn)


def ball(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    r = size / 2
    to_world = at @ layout.transform().translate([0, r, 0]).scale(r)
    found: list[Shape] = [{"type": "sphere", "to_world": to_world, "bsdf": materials.solid(rng)}]
    if found[0]["bsdf"]["type"] == "dielectric" and rng.random() < 0.4:
        # Hollow: the inner side is glass seen from within.
        hole = at @ layout.transform().translate([0, r, 0]).scale(0.93 * r)
        found.append(found[0] | {"to_world": hole, "flip_normals": True})
    return found


def block(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    sides = size / 2 * rng.uniform(0.5, 1, 3)
    return [box(sides, at, materials.solid(rng))]


def stack(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """Slabs on each other, like books."""
    found, y = [], 0.0
    for _ in range(int(rng.integers(2, 7))):
        sides = size / 2 * np.array([rng.uniform(0.6, 1), rng.uniform(0.05, 0.2), 0.7])
        turned = at @ layout.transform().translate([0, y, 0]).rotate(
            [0, 1, 0], rng.uniform(-20, 20)
        )
        found.append(box(sides, turned, materials.solid(rng)))
        y += 2 * sides[1]
    return found


def vase(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """A profile turned around the y axis."""
    heights = np.linspace(0, 1, 48)
    knots = rng.uniform(0.12, 0.5, 6)
    radius = np.interp(heights, np.linspace(0, 1, 6), knots)
    radius = np.convolve(np.pad(radius, 4, "edge"), np.hanning(11)[1:-1] / 5.0, "valid")
    radius = np.concatenate([[POLE], radius, [POLE]])
    heights = np.concatenate([[0], heights, [1]])
    angle = np.linspace(0, 2 * np.pi, 65)
    points = np.stack(
        [radius[:, None] * np.cos(angle), heights[:, None] + 0 * angle, radius[:, None] * np.sin(angle)], -1
    )  # fmt: skip
    return [mesh(points * size, at, materials.solid(rng))]


def knot(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """A torus, or a tube along a knot on one."""
    p, q = [(1, 0), (2, 3), (3, 2), (2, 5), (3, 4)][int(rng.integers(5))]
    t = np.linspace(0, 2 * np.pi, 241)
    wide = 0.34 if q else 0.38
    r = wide + 0.12 * np.cos(q * t) * (q > 0)
    center = np.stack([r * np.cos(p * t), 0.12 * np.sin(q * t), r * np.sin(p * t)], -1)
    forward = np.gradient(center, axis=0)
    forward[[0, -1]] = forward[0] + forward[-1]
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    side = np.cross(forward, [0, 1, 0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(side, forward)
    thick = rng.uniform(0.04, 0.07) if q else rng.uniform(0.06, 0.12)
    angle = np.linspace(0, 2 * np.pi, 33)[:, None, None]
    points = center + thick * (np.cos(angle) * side + np.sin(angle) * up)
    lift = layout.transform().translate([0, (0.12 * (q > 0) + thick) * size, 0])
    if rng.random() < 0.5:  # on its edge
        outer = (wide + 0.12 * (q > 0) + thick) * size
        lift = layout.transform().translate([0, outer, 0]).rotate([1, 0, 0], 90)
    return [mesh(points * size, at @ lift, materials.solid(rng))]


def rock(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """A sphere with noise on it."""
    polar, angle = np.meshgrid(np.linspace(POLE, np.pi - POLE, 65), np.linspace(0, 2 * np.pi, 129))
    # Across the poles and the seam the heights must be single-valued, so they come from a sum of waves.
    points = np.stack(
        [np.sin(polar) * np.cos(angle), np.cos(polar), np.sin(polar) * np.sin(angle)], -1
    )
    bumps = np.zeros(points.shape[:2])
    for octave in range(1, 5):
        for _ in range(5):
            wave = rng.normal(size=3) * 2**octave * 0.7
            bumps += 0.13 / 2**octave * np.sin(points @ wave + rng.uniform(0, 6.28))
    points = points * (1 + bumps[..., None]) * rng.uniform(0.6, 1, 3)
    points[..., 1] -= points[..., 1].min()
    bsdf = materials.surface(rng, repeat=2) if rng.random() < 0.7 else materials.solid(rng)
    return [mesh(points * (size / 2), at, bsdf)]


def hair_ball(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """A small sphere with hair all over, that hangs as it will."""
    strands = []
    length = rng.uniform(0.3, 0.6)
    droop = rng.uniform(0, 0.3)
    for direction in _directions(rng, int(rng.integers(300, 900))):
        t = np.linspace(0, 1, 6)[:, None]
        wave = 0.04 * np.cumsum(rng.normal(size=(6, 3)), axis=0) * t
        points = direction * (0.25 + length * t * 0.4) + wave
        points[:, 1] -= droop * (t[:, 0] * length) ** 2
        strands.append(points * size + [0, 0.48 * size, 0])
    core = at @ layout.transform().translate([0, 0.48 * size, 0]).scale(0.25 * size)
    bsdf = materials.strand(rng)
    return [
        curves(strands, 0.004 * size * rng.uniform(0.7, 2), at, bsdf),
        {"type": "sphere", "to_world": core, "bsdf": bsdf},
    ]


def tuft(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """Blades of grass."""
    strands = []
    for _ in range(int(rng.integers(40, 160))):
        root = rng.normal(size=2) * 0.12
        lean = root * rng.uniform(0.5, 3) + rng.normal(size=2) * 0.1
        t = np.linspace(0, 1, 5)
        flat = root + lean * (t**2)[:, None]
        strands.append(np.stack([flat[:, 0], t * rng.uniform(0.5, 1), flat[:, 1]], -1) * size)
    return [curves(strands, 0.006 * size * rng.uniform(0.7, 2), at, materials.strand(rng))]


def cage(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """A ball behind thin bars."""
    bars = int(rng.integers(10, 36))
    angles = np.linspace(0, 2 * np.pi, bars, endpoint=False)
    t = np.linspace(0, 1, 4)
    bulge = 0.35 + 0.1 * np.sin(np.pi * t)
    rods = [np.stack([bulge * np.cos(a), t, bulge * np.sin(a)], -1) * size for a in angles.tolist()]
    ring = np.linspace(0, 2 * np.pi, 33)
    for y in (0.02, 0.5, 0.98):
        r = 0.35 + 0.1 * np.sin(np.pi * y)
        rods.append(np.stack([r * np.cos(ring), y + 0 * ring, r * np.sin(ring)], -1) * size)
    bars_shape = curves(rods, 0.008 * size, at, materials.strand(rng), smooth=False)
    return [bars_shape, *ball(rng, 0.6 * size, at)]


THINGS: dict[str, Callable[[np.random.Generator, float, Any], list[Shape]]] = {
    f.__name__: f for f in (ball, block, stack, vase, knot, rock, hair_ball, tuft, cage)
}


def fence(rng: np.random.Generator, start: Vector, end: Vector) -> list[Shape]:
    """Thin upright rods and two rails from one point on the ground to another."""
    start_, end_ = np.asarray(start, float), np.asarray(end, float)
    count = int(np.linalg.norm(end_ - start_) / rng.uniform(0.06, 0.2)) + 2
    height, radius = rng.uniform(0.7, 1.6), rng.uniform(0.004, 0.014)
    up = np.array([0.0, height, 0.0])
    feet = start_ + np.linspace(0, 1, count)[:, None] * (end_ - start_)
    rods = [np.stack([foot, foot + up]) for foot in feet]
    rods += [np.stack([start_ + share * up, end_ + share * up]) for share in (0.15, 0.9)]
    return [curves(rods, radius, layout.transform(), materials.strand(rng), smooth=False)]


def tree(rng: np.random.Generator, size: float, at: Any) -> list[Shape]:
    """A trunk, and leaves strewn in a crown."""
    trunk = {
        "type": "cylinder",
        "p0": [0, 0, 0],
        "p1": [0, 0.55 * size, 0],
        "radius": 0.035 * size,
        "to_world": at,
        "bsdf": materials.surface(rng, repeat=3),
    }
    count = int(rng.integers(800, 2500))
    middle = _directions(rng, count) * rng.random((count, 1)) ** (1 / 3) * [0.3, 0.33, 0.3]
    a, b = (_directions(rng, count) * rng.uniform(0.02, 0.03) for _ in range(2))
    middle[:, 1] += 0.66
    corners = middle + np.stack([a + b, a - b, -a - b, b - a])
    points = corners.transpose(1, 0, 2).reshape(-1, 3) * size
    faces = np.arange(4 * count).reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    green = materials.rgb(rng.uniform([0.05, 0.15, 0.02], [0.35, 0.5, 0.12]))
    bsdf = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": green}}
    return [trunk, _triangles(points, None, faces, at, bsdf)]


def box(half: Vector, at: Any, bsdf: Any) -> Shape:
    """A box that stands on y = 0, by its half sides."""
    x, y, z = (float(v) for v in half)
    return {
        "type": "cube",
        "to_world": at @ layout.transform().translate([0, y, 0]).scale([x, y, z]),
        "bsdf": bsdf,
    }


def mesh(grid: Float[np.ndarray, "n m 3"], at: Any, bsdf: Any) -> Shape:
    """The surface through a grid of points, its texture once along each side."""
    n, m = grid.shape[:2]
    v, u = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij")
    corner = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    quads = corner[:, None] + [0, 1, m, m, 1, m + 1]
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return _triangles(grid.reshape(-1, 3), uv, quads.reshape(-1, 3), at, bsdf)


def curves(
    strands: Sequence[Points], radius: float, at: Any, bsdf: Any, *, smooth: bool = True
) -> Shape:
    """Round strands through (smooth: near) points."""
    ends = 2 if smooth else 0  # a B-spline begins and ends at a point that is there three times
    text = "\n\n".join(
        "\n".join(
            f"{x:.6f} {y:.6f} {z:.6f} {radius:.6f}" for x, y, z in np.pad(s, ((ends, ends), (0, 0)), "edge")
        )
        for s in strands
    )  # fmt: skip
    kind = "bsplinecurve" if smooth else "linearcurve"
    path = _Temporary(".txt")
    Path(path).write_text(text + "\n")
    return {"type": kind, "filename": path, "to_world": at, "bsdf": bsdf}


def _triangles(
    points: Points, uv: np.ndarray | None, faces: np.ndarray, at: Any, bsdf: Any
) -> Shape:
    """A mesh, smooth if it has texture coordinates and flat if not."""
    import mitsuba as mi

    smooth = uv is not None
    found = mi.Mesh("mesh", len(points), len(faces), has_vertex_texcoords=smooth)
    matrix = np.array(at.matrix)
    values = mi.traverse(found)
    values["vertex_positions"] = (
        (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32).ravel()
    )
    values["faces"] = faces.astype(np.uint32).ravel()
    if uv is not None:
        values["vertex_texcoords"] = uv.astype(np.float32).ravel()
    values.update()
    path = _Temporary(".ply")
    found.write_ply(path)
    return {"type": "ply", "filename": path, "face_normals": not smooth, "bsdf": bsdf}


class _Temporary(str):
    """The path of a file that is removed when the path is forgotten.

    Mitsuba loads them itself: a shape that Python has seen costs its scalar variant Python's lock in every
    sample of albedo, normal and depth, which count references to all shapes: longer than the path takes.
    """

    def __new__(cls, suffix: str) -> "_Temporary":
        descriptor, path = tempfile.mkstemp(suffix, "progden_shape_")
        os.close(descriptor)
        made = super().__new__(cls, path)
        weakref.finalize(made, Path(path).unlink, missing_ok=True)
        return made


def _directions(rng: np.random.Generator, count: int) -> Points:
    found = rng.normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=-1, keepdims=True)
