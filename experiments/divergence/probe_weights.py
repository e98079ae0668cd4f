"""How the weight of `pd.Probing` and its probes for outliers were found, on training renders only.

    python -m experiments.divergence.probe_weights

Columns of the Jacobian, the 48 of largest σ and 160 drawn by chance per frame, tell the error of any weights
in closed form: Σ_j Σ_{i≠j} (σ_i²/w_i · J_ij · w_j · c_ij)². Prints it over that of Gaussian differences.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.divergence.spread import columns
from progden_jax.divergence.probing import MOST_PROBES, colors, deflated, walsh, weight_and_gain

FRAMES = (
    *(("proc1000", 8), ("proc1003", 8), ("proc1009", 128), ("proc1018", 8), ("proc1020", 128)),
    *(("proc1024", 8), ("proc1027", 128), ("proc1030", 8), ("proc1033", 8), ("proc1036", 8)),
    *(("proc1042", 8), ("proc1045", 8)),
)
LARGEST, DRAWN = 48, 160
PROBES = (4, 16, 64, 256)

Weight = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Columns(NamedTuple):
    """Sampled columns of a Jacobian, squared and without their diagonal, and what belongs to them."""

    squares: np.ndarray
    places: np.ndarray
    share: np.ndarray
    sigma: np.ndarray
    value: np.ndarray
    shape: tuple[int, ...]
    gaussian: float
    """Squared error of one Gaussian difference."""


def sample(frame: pd.Frame, denoiser: pd.Denoiser) -> Columns:
    """Columns drawn more often where σ is large and weighted back by `share`."""
    assert frame.variance is not None
    variance = np.asarray(frame.variance, np.float64).ravel()
    sigma = np.sqrt(variance)
    order = np.argsort(-sigma)
    rest = order[LARGEST:]
    chance = 0.3 / rest.size + 0.4 * sigma[rest] / sigma[rest].sum()
    chance += 0.3 * variance[rest] / variance[rest].sum()
    drawn = np.random.default_rng(0).choice(rest.size, size=DRAWN, p=chance)
    index = np.concatenate([order[:LARGEST], rest[drawn]])
    share = np.concatenate([np.ones(LARGEST), 1 / (chance[drawn] * DRAWN)])
    value, found = columns(denoiser.bind(frame), jnp.asarray(frame.color), jnp.asarray(index))
    squares = np.square(np.asarray(found, np.float64)).reshape(len(index), -1)
    each = np.arange(len(index))
    own = squares[each, index].copy()
    gaussian = share * variance[index] * (squares @ variance + variance[index] * own)
    squares[each, index] = 0
    return Columns(
        *(squares, index, share, sigma, np.asarray(value, np.float64).ravel()),
        *(np.shape(frame.color), float(gaussian.sum())),
    )


def mixing() -> np.ndarray:
    """Σ_{k<n} h_k(a) h_k(b) by n − 1 and the exclusive or of the colours a and b."""
    every = jnp.arange(MOST_PROBES)[:, None, None]
    table = np.stack([np.asarray(walsh(k, every)).ravel() for k in range(max(PROBES))])
    return np.cumsum(table, axis=0, dtype=np.float64)


@jax.jit
def _total(
    squares: jax.Array, pairs: jax.Array, color: jax.Array, own: jax.Array, received: jax.Array
) -> jax.Array:
    return (squares * pairs[color[None] ^ own[:, None]]) @ received


def relative_error(
    found: Columns, weight: np.ndarray, probes: int, sums: np.ndarray, outliers: np.ndarray
) -> float:
    """The error over that of as many Gaussian differences, `outliers` having probes of their own."""
    w2 = np.where(weight > 0, weight, 0.0) ** 2
    w2[outliers] = 0
    w2 /= np.sqrt(w2).mean() ** 2
    received = np.where(w2 > 0, found.sigma**4 / np.maximum(w2, 1e-30), 0)
    scale = received.max()
    left = probes - len(outliers)
    color = np.asarray(colors(*found.shape[:2])).ravel()
    column = _total(
        *(jnp.asarray(a, jnp.float32) for a in (found.squares, (sums[left - 1] / left) ** 2)),
        *(jnp.asarray(color), jnp.asarray(color[found.places])),
        jnp.asarray(received / scale, jnp.float32),
    )
    total = (found.share * w2[found.places] * np.asarray(column, np.float64)).sum() * scale
    return float(np.sqrt(total * probes / found.gaussian))


def shipped(sigma: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Probing's own weight."""
    found = weight_and_gain(
        jnp.asarray(sigma, jnp.float32), jnp.asarray(value, jnp.float32), "radiance"
    )
    return np.asarray(found[0], np.float64)


CANDIDATES: dict[str, Weight] = {
    "σ": lambda s, f: s,
    "σ (σ + |f|)^¾, before": lambda s, f: s * (s + np.abs(f)) ** 0.75,
    "σ (0.3 σ + |f|)^¾": lambda s, f: s * (0.3 * s + np.abs(f)) ** 0.75,
    "σ (0.01 σ + |f|)": lambda s, f: s * (0.01 * s + np.abs(f)),
    "σ (0.1 σ + |f|)": lambda s, f: s * (0.1 * s + np.abs(f)),
    "σ (0.3 σ + |f|)": lambda s, f: s * (0.3 * s + np.abs(f)),
    "the same as shipped, limited": shipped,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=_common.TRAIN)
    parser.add_argument("--frames", type=int, default=len(FRAMES))
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    denoiser, sums = pd.denoisers.load("oidn-hdr"), mixing()
    none = np.zeros(0, int)
    errors: dict[str, list[list[float]]] = {}
    for scene, spp in FRAMES[: arguments.frames]:
        frame, _ = pd.repair(pd.read_exr(arguments.data / f"{scene}_{spp:06}spp.exr"))
        found = sample(frame, denoiser)
        line = {
            name: [
                relative_error(found, w(found.sigma, found.value), k, sums, none) for k in PROBES
            ]
            for name, w in CANDIDATES.items()
        }
        line["and probes for outliers"] = []
        for k in PROBES:
            index, number = deflated(jnp.asarray(frame.variance), k)
            outliers, weight = np.asarray(index)[: int(number)], shipped(found.sigma, found.value)
            line["and probes for outliers"].append(relative_error(found, weight, k, sums, outliers))
        for name, row in line.items():
            errors.setdefault(name, []).append(row)
        print(
            scene, spp, {name: np.round(row, 3).tolist() for name, row in line.items()}, flush=True
        )
    header = ("w", *(f"K = {k}" for k in PROBES), *(f"median, {k}" for k in PROBES))
    rows = [
        (name, *np.exp(np.log(e).mean(0)).tolist(), *np.median(e, axis=0).tolist())
        for name, e in errors.items()
    ]
    print(f"\nGeometric mean over {arguments.frames} frames, and median\n")
    print(_common.markdown(header, rows))


if __name__ == "__main__":
    main()
