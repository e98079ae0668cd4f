"""Patterns that repeat without a seam, as heights in [0, 1] and as colours."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

Height = Float[np.ndarray, "n n"]
Color = Sequence[float]

SIZE = 256


def noise(
    rng: np.random.Generator, *, falloff: float = 2.0, stretch: tuple[float, float] = (1, 1)
) -> Height:
    """Gaussian noise with amplitudes that fall as frequency to the power of -falloff."""
    fy, fx = np.meshgrid(np.fft.fftfreq(SIZE), np.fft.rfftfreq(SIZE), indexing="ij")
    frequency = np.hypot(fy * SIZE * stretch[0], fx * SIZE * stretch[1])
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(SIZE, SIZE))) * frequency**-falloff
    return _unit(np.fft.irfft2(spectrum, s=(SIZE, SIZE)))


def checker(rng: np.random.Generator) -> Height:
    n = int(rng.integers(1, 5)) * 2
    x, y = _grid()
    return (np.floor(x * n) + np.floor(y * n)) % 2


def stripes(rng: np.random.Generator) -> Height:
    n, sharp = int(rng.integers(2, 12)), rng.uniform(1, 12)
    x, y = _grid()
    phase = (x if rng.random() < 0.5 else y) * n + 0.3 * noise(rng) * rng.random()
    return 0.5 + 0.5 * np.tanh(sharp * np.sin(2 * np.pi * phase))


def bricks(rng: np.random.Generator) -> Height:
    """Rows, every other one shifted by half, of unlike stones between low joints."""
    rows = int(rng.integers(2, 6)) * 2
    columns = max(1, rows // int(rng.integers(1, 4)))
    x, y = _grid()
    row = np.floor(y * rows).astype(int)
    across = x * columns + 0.5 * (row % 2)
    column = np.floor(across).astype(int) % columns
    joint = rng.uniform(0.03, 0.08)
    # Distances to the nearest edge, in units of a row's height.
    edge_x = np.minimum(across % 1, 1 - across % 1) * rows / columns
    edge_y = np.minimum(y * rows % 1, 1 - y * rows % 1)
    stones = rng.uniform(0.55, 1, (rows, columns))[row, column]
    return np.clip(np.minimum(edge_x, edge_y) / joint, 0, 1) * stones * (0.85 + 0.15 * noise(rng))


def planks(rng: np.random.Generator) -> Height:
    """Boards with grain along them."""
    boards = int(rng.integers(3, 9))
    x, _ = _grid()
    board = np.floor(x * boards).astype(int)
    gap = np.clip(np.minimum(x * boards % 1, 1 - x * boards % 1) / 0.04, 0, 1)
    grain = noise(rng, falloff=1.6, stretch=(12, 1))
    return gap * (0.5 * grain + 0.5 * rng.uniform(0.4, 1, boards)[board])


def cells(rng: np.random.Generator) -> Height:
    """Distance to the nearest of some points, on a torus."""
    points = rng.random((int(rng.integers(12, 60)), 2))
    x, y = _grid()
    nearest = np.full((SIZE, SIZE), np.inf)
    for px, py in points:
        dx, dy = (np.minimum(d, 1 - d) for d in (np.abs(x - px), np.abs(y - py)))
        nearest = np.minimum(nearest, dx * dx + dy * dy)
    return _unit(np.sqrt(nearest))


def marble(rng: np.random.Generator) -> Height:
    x, y = _grid()
    a, b = (int(k) for k in rng.integers(1, 4, 2))
    veins = np.abs(np.sin(np.pi * (a * x + b * y) * 2 + 9 * noise(rng, falloff=1.8)))
    return veins ** rng.uniform(0.3, 1.5)


def clouds(rng: np.random.Generator) -> Height:
    return noise(rng, falloff=rng.uniform(1.2, 2.2))


PATTERNS: dict[str, Callable[[np.random.Generator], Height]] = {
    f.__name__: f for f in (checker, stripes, bricks, planks, cells, marble, clouds)
}


def colored(height: Height, colors: Sequence[Color]) -> Float[np.ndarray, "n n 3"]:
    """The heights on a scale from the first colour to the last, linear between them."""
    stops = np.linspace(0, 1, len(colors))
    channels = [np.interp(height, stops, [c[i] for c in colors]) for i in range(3)]
    return np.stack(channels, -1).astype(np.float32)


def normals(height: Height, *, depth: float) -> Float[np.ndarray, "n n 3"]:
    """The heights, `depth` times a texture's width, as a normal map: unit normals in [0, 1]."""
    slopes = [
        (np.roll(height, 1, axis) - np.roll(height, -1, axis)) * (depth * SIZE / 2)
        for axis in (1, 0)
    ]
    n = np.stack([*slopes, np.ones_like(height)], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return (0.5 * n + 0.5).astype(np.float32)


def _grid() -> tuple[Height, Height]:
    axis = (np.arange(SIZE) + 0.5) / SIZE
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return x, y


def _unit(values: Height) -> Height:
    low, high = values.min(), values.max()
    return (values - low) / (high - low)
