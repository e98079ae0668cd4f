"""How much better `pd.Probing` could get by a colouring that fits the image, or the Jacobian itself.

    python -m experiments.divergence.coloring_limit

The whole Jacobian of OIDN HDR on the middle of training renders tells the expected error of any colouring
with random signs in closed form: Σ (σ_i²/w_i · J_ij · w_j)² over pairs i ≠ j of one colour. Local search
makes that small for the Jacobian itself, which nobody has, and for what can be known of it beforehand: its
mean by distance, by whether the channel is the same, and by the levels of both values.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.divergence.probe_weights import Columns, mixing, relative_error, shipped
from experiments.divergence.spread import columns
from progden_jax.divergence.probing import colors, deflated
from progden_jax.frame import centre

FRAMES = (("proc1011", 8), ("proc1003", 32), ("proc1020", 128))
PROBES = (4, 16, 64, 256)
SWEEPS = 5


def jacobian(denoiser: pd.Denoiser, frame: pd.Frame) -> tuple[np.ndarray, np.ndarray]:
    """f(x), flat, and J_ij² as (i, j)."""
    x = jnp.asarray(frame.color)
    value, found = columns(denoiser.bind(frame), x, jnp.arange(x.size))
    squares = np.square(np.asarray(found)).reshape(x.size, x.size).T
    return np.asarray(value).ravel(), squares


def local_search(energy: np.ndarray, start: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Colours 0 to count − 1 such that Σ energy_ij over pairs of one colour is small; energy is symmetric.

    One value after the other, in random order, takes the colour that costs least.
    """
    color, rng = start.copy(), np.random.default_rng(seed)
    cost = np.zeros((count, len(color)), np.float32)
    for c in range(count):
        cost[c] = energy[color == c].sum(0)
    cost = np.asfortranarray(cost)
    for _ in range(SWEEPS):
        for i in rng.permutation(len(color)):
            best, own = int(cost[:, i].argmin()), color[i]
            if cost[best, i] < 0.9999 * cost[own, i]:
                cost[own] -= energy[i]
                cost[best] += energy[i]
                color[i] = best
    return color


def expected(squares: np.ndarray, level: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """J² by its mean: of J_ij² (level_j / level_i)², by distance and by whether the channel is the same."""
    row, column, channel = np.unravel_index(np.arange(len(level)), shape)
    distance = np.hypot(*(np.subtract.outer(n, n).astype(np.float32) for n in (row, column)))
    kind = 2 * distance.round().astype(np.int32) + np.not_equal.outer(channel, channel)
    del distance
    scaled = squares * (level[None, :] / level[:, None]) ** 2
    count = np.bincount(kind.ravel())
    mean = np.bincount(kind.ravel(), weights=scaled.ravel()) / np.maximum(count, 1)
    return mean.astype(np.float32)[kind] * (level[:, None] / level[None, :]) ** 2


def balanced(squares: np.ndarray, variance: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The weight under which each value gives as much error as it takes: the best one for random signs."""
    seen = weight > 0
    w = np.where(seen, weight, 1)
    for _ in range(60):
        gives = squares.T @ np.where(seen, variance / w, 0) ** 2
        takes = variance**2 * (squares @ np.where(seen, w, 0) ** 2)
        w = np.where(seen, (takes / np.maximum(gives, 1e-30)) ** 0.25, 1)
    return np.where(seen, w, 0).astype(np.float32)


def errors(frame: pd.Frame, denoiser: pd.Denoiser) -> dict[str, list[float]]:
    """Per design the error of `PROBES` probes over that of as many Gaussian differences."""
    shape = np.shape(frame.color)
    value, squares = jacobian(denoiser, frame)
    # In units of the render, so that fourth powers stay within float32.
    variance = np.asarray(frame.variance, np.float32).ravel()
    weight = shipped(np.sqrt(variance), value).astype(np.float32)
    level = np.abs(value) + np.sqrt(variance) / 10
    weight, level = (a / np.exp(np.log(a[weight > 0]).mean()) for a in (weight, level))
    variance = variance / np.exp(np.log(variance[variance > 0]).mean())

    own = np.diag(squares).copy()
    gaussian = float((variance * (squares @ variance + variance * own)).sum(dtype=np.float64))
    np.fill_diagonal(squares, 0)
    every = np.arange(len(own))
    # Columns as `probe_weights` samples them, here all of them.
    found = Columns(
        *(np.ascontiguousarray(squares.T), every, np.ones(len(own))),
        *(np.sqrt(variance), value, shape, gaussian),
    )

    def relative(w: np.ndarray, color: np.ndarray, count: int) -> float:
        received = np.where(w > 0, variance / np.where(w > 0, w, 1), 0) ** 2
        total = 0.0
        for c in range(count):
            same = np.flatnonzero(color == c)
            total += float(received[same] @ (squares[np.ix_(same, same)] @ w[same] ** 2))
        return (total * count / gaussian) ** 0.5

    def energy(squares: np.ndarray, w: np.ndarray) -> np.ndarray:
        received = np.where(w > 0, variance / np.where(w > 0, w, 1), 0) ** 2
        one_way = received[:, None] * squares * (w**2)[None, :]
        return one_way + one_way.T

    lattice = np.asarray(colors(*shape[:2])).ravel()
    best = balanced(squares, variance, weight)
    sums = mixing()
    designs = {
        "by distance and level": (expected(squares, level, shape), weight),
        "by J itself": (squares, weight),
        "by J itself, weight too": (squares, best),
    }
    table: dict[str, list[float]] = {"shipped": [], **{name: [] for name in designs}}
    for count in PROBES:
        index, number = deflated(jnp.asarray(frame.variance), count)
        outliers = np.asarray(index)[: int(number)]
        table["shipped"].append(relative_error(found, weight, count, sums, outliers))
    for name, (known, w) in designs.items():
        cost = energy(known, w)
        for count in PROBES:
            color = local_search(cost, lattice % count, count)
            table[name].append(relative(w, color, count))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=_common.TRAIN)
    parser.add_argument("--frames", type=int, default=len(FRAMES))
    parser.add_argument("--size", type=int, default=64, help="edge of the middle, pixels")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    denoiser = pd.denoisers.load("oidn-hdr")
    rows: list[tuple[object, ...]] = []
    for scene, spp in FRAMES[: arguments.frames]:
        frame, _ = pd.repair(pd.read_exr(arguments.data / f"{scene}_{spp:06}spp.exr"))
        found = errors(centre(frame, arguments.size), denoiser)
        rows += [(scene, spp, name, *(f"{e:.3f}" for e in row)) for name, row in found.items()]
        print(rows[-len(found) :], flush=True)
    print(_common.markdown(("scene", "spp", "colouring", *(f"K = {k}" for k in PROBES)), rows))


if __name__ == "__main__":
    main()
