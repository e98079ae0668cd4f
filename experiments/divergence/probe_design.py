"""How the lattice and the scaling of `pd.Probing` were found, on training renders only.

    python -m experiments.divergence.probe_design

Rows of the Jacobian at sampled pixels tell the error of any design in closed form, without a random draw:
(σ_i²/w_i)² Σ_{j≠i} (J_ij w_j c_ij)². Prints the error of scalings w = σ (σ + |f|)^γ, and that of the best
nested and the best free lattices over that of random signs at the same number of probes.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax.divergence.probing import colors

FRAMES = (("proc1003", 8), ("proc1011", 32), ("proc1020", 128), ("proc1030", 8))
EXPONENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
RADIUS = 63


class Rows(NamedTuple):
    """Sampled rows of a Jacobian, squared and without their diagonal, and what belongs to them."""

    squares: np.ndarray
    pixels: np.ndarray
    share: np.ndarray
    variance: np.ndarray
    value: np.ndarray
    truth: float


def sample_rows(frame: pd.Frame, denoiser: pd.Denoiser, count: int) -> Rows:
    """`count` rows, drawn more often where σ is large and weighted back by `share`."""
    assert frame.variance is not None
    variance = np.asarray(frame.variance, np.float64).ravel()
    sigma = np.sqrt(variance)
    chance = 0.4 / sigma.size + 0.4 * sigma / sigma.sum() + 0.2 * variance / variance.sum()
    index = np.random.default_rng(0).choice(sigma.size, size=count, p=chance)

    @jax.jit
    def run(
        denoiser: pd.Denoiser, frame: pd.Frame, index: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        value, transpose = jax.vjp(denoiser.bind(frame), frame.color)

        def row(i: jax.Array) -> jax.Array:
            return transpose(jnp.zeros(value.size).at[i].set(1).reshape(value.shape))[0].ravel()

        return value, jax.lax.map(row, index)

    value, jacobian = (np.asarray(a) for a in run(denoiser, frame, jnp.asarray(index)))
    share = 1 / (chance[index] * count)
    each = np.arange(count)
    truth = float(
        (share * variance[index] ** 2 * jacobian[each, index].astype(np.float64) ** 2).sum()
    )
    squares = jacobian**2
    squares[each, index] = 0
    return Rows(squares, index, share, variance, np.abs(value.astype(np.float64)).ravel(), truth)


def weights(rows: Rows, exponent: float) -> np.ndarray:
    """w² with w = σ (σ + |f|)^exponent."""
    return rows.variance * (np.sqrt(rows.variance) + rows.value) ** (2 * exponent)


def relative_error(rows: Rows, color: np.ndarray, exponent: float) -> float:
    """Relative RMSE with a full set of probes for these colours."""
    w2 = weights(rows, exponent)
    coefficient = rows.share * rows.variance[rows.pixels] ** 2 / np.maximum(w2[rows.pixels], 1e-30)
    total = 0.0
    for factor, square, i in zip(coefficient, rows.squares, rows.pixels, strict=True):
        total += factor * (square @ np.where(color == color[i], w2, 0))
    return float(np.sqrt(total / rows.truth))


def kernel(rows: Rows, shape: tuple[int, int], exponent: float) -> np.ndarray:
    """Mean energy by offset, of the same channel and of another, (2, 127, 127), symmetrised, its sum 1."""
    w2 = weights(rows, exponent)
    coefficient = rows.share * rows.variance[rows.pixels] ** 2 / np.maximum(w2[rows.pixels], 1e-30)
    found = np.zeros((2, 2 * RADIUS + 1, 2 * RADIUS + 1))
    height, width = shape
    for factor, square, i in zip(coefficient, rows.squares, rows.pixels, strict=True):
        y, x, channel = np.unravel_index(i, (height, width, 3))
        energy = np.pad(
            (factor * square * w2).reshape(height, width, 3), ((RADIUS,) * 2, (RADIUS,) * 2, (0, 0))
        )
        around = energy[y : y + 2 * RADIUS + 1, x : x + 2 * RADIUS + 1]
        found[0] += around[..., channel]
        found[1] += (around.sum(-1) - around[..., channel]) / 2
    found = found + found[:, ::-1]
    found = found + found[:, :, ::-1]
    found = found + found.transpose(0, 2, 1)
    return found / found.sum()


class Search:
    """Lattices with colour x + b y + (0, g1, g2)_c modulo K, and what is left by a full set of K probes."""

    def __init__(self, energy: np.ndarray) -> None:
        self.y, self.x = (a.ravel() for a in np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1])
        self.same, self.cross = energy[0].ravel(), energy[1].ravel()
        self.total = 3 * self.same.sum() + 6 * self.cross.sum()
        self.cache: dict[tuple[int, int], tuple[float, np.ndarray]] = {}

    def by_color(self, k: int, b: int) -> tuple[float, np.ndarray]:
        if (k, b) not in self.cache:
            color = (self.x + b * self.y) % k
            cross = np.bincount(color, self.cross, k)
            self.cache[k, b] = (float(self.same[color == 0].sum()), cross)
        return self.cache[k, b]

    def cost(self, k: int, b: int, g1: int, g2: int) -> float:
        same, cross = self.by_color(k, b % k)
        return 3 * same + 2 * float(cross[g1 % k] + cross[g2 % k] + cross[(g2 - g1) % k])

    def relative(self, k: int, cost: float) -> float:
        """The error over that of k probes of random signs."""
        return float(np.sqrt(cost * k / self.total))

    def best(self, k: int) -> tuple[float, int, int, int]:
        """The best lattice for this K alone."""
        every = np.arange(k)
        found = []
        for b in range(k // 2 + 1):
            same, cross = self.by_color(k, b)
            costs = cross[:, None] + cross + cross[(every - every[:, None]) % k]
            least = int(np.argmin(costs))
            found.append((3 * same + 2 * float(costs.flat[least]), b, least // k, least % k))
        return min(found)

    def nested(self, most: int, keep: int = 600) -> tuple[int, int, int]:
        """(b, g1, g2) good modulo every power of two up to `most`: a beam search that adds bit after bit."""
        beam = [(0.0, 0, 0, 0)]
        k = 1
        while k < most:
            k *= 2
            grown = {}
            for score, b, g1, g2 in beam:
                for bits in np.ndindex(2, 2, 2):
                    new = tuple(
                        old + bit * (k // 2) for old, bit in zip((b, g1, g2), bits, strict=True)
                    )
                    value = score + np.log(self.cost(k, *new))
                    grown.setdefault(round(value, 9), (value, *new))
            beam = sorted(grown.values())[:keep]
        return beam[0][1:]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=_common.TRAIN)
    parser.add_argument("--rows", type=int, default=400, help="rows of the Jacobian per frame")
    parser.add_argument("--frames", type=int, default=len(FRAMES))
    arguments = parser.parse_args()
    denoiser = pd.denoisers.load("oidn-hdr")
    energy, table = [], []
    for scene, spp in FRAMES[: arguments.frames]:
        frame = pd.read_exr(arguments.data / f"{scene}_{spp:06}spp.exr")
        rows = sample_rows(frame, denoiser, arguments.rows)
        height, width = frame.size
        color = np.asarray(colors(height, width)).ravel()
        for k in (16, 64, 256):
            errors = [relative_error(rows, color % k, exponent) for exponent in EXPONENTS]
            table.append((scene, spp, k, *errors))
        energy.append(kernel(rows, (height, width), 0.75))
    print("Relative RMSE per pixel by the exponent γ of w = σ (σ + |f|)^γ\n")
    print(_common.markdown(("scene", "spp", "K", *(f"γ = {e}" for e in EXPONENTS)), table))
    search = Search(np.mean(energy, axis=0))
    b, g1, g2 = search.nested(1024)
    print(f"\nNested lattice found: x + {b} y + (0, {g1}, {g2})_c. Error over random signs':\n")
    lines = []
    for k in (2**n for n in range(1, 11)):
        shipped = search.cost(k, 539, 775, 526)
        best = search.relative(k, search.best(k)[0]) if k <= 128 else "-"
        lines.append(
            (k, search.relative(k, search.cost(k, b, g1, g2)), search.relative(k, shipped), best)
        )
    print(
        _common.markdown(("K", "nested, found", "nested, shipped", "best for this K alone"), lines)
    )


if __name__ == "__main__":
    main()
