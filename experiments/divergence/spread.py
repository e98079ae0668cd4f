"""How far the denoiser's response to one value reaches, beside fireflies and elsewhere.

    python -m experiments.divergence.spread

Columns J e_j of the values with the largest variances ("fireflies") and of others drawn by chance. What a
column adds to the squared error of other pixels is e_ij = (σ_i²/w_i · J_ij · w_j)² with Probing's w. Table
and plot: |J_ij| by distance, and the share of Σ e_ij beyond a distance; structured probes cancel what is
nearer than about √K pixels and no more.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common
from progden_jax._numeric import safe_sqrt
from progden_jax.divergence.probing import weight_and_gain

HERE = Path(__file__).parent
FRAMES = (("proc2003", 128), ("proc2000", 8), ("proc2002", 8), ("proc2001", 8))
EDGES = (0, 0.5, 1.5, 2.5, 4.5, 8.5, 16.5, 32.5, 64.5, 200)
"""Of the rings, in pixels."""
COLORS = {"fireflies": "tab:red", "ordinary": "tab:blue"}


@jax.jit
def columns(f: Any, x: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """f(x), and J e_j for each flat index."""
    value, tangent = jax.linearize(f, x)

    def one(j: jax.Array) -> jax.Array:
        return tangent(jnp.zeros(x.size, x.dtype).at[j].set(1).reshape(x.shape))

    return value, jax.lax.map(one, index)


def chosen(variance: np.ndarray, count: int) -> dict[str, np.ndarray]:
    """Flat indices: the largest variances, and others among the lower 99 %."""
    order = np.argsort(-variance.ravel())
    rest = order[len(order) // 100 :]
    rest = rest[variance.ravel()[rest] > 0]
    return {
        "fireflies": order[:count],
        "ordinary": np.random.default_rng(0).choice(rest, 2 * count, replace=False),
    }


def rings(
    frame: pd.Frame, denoiser: pd.Denoiser, count: int
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Per group and ring: the mean |J_ij| of the same channel over |J_jj|, and the share of Σ e_ij."""
    assert frame.variance is not None
    x, variance = jnp.asarray(frame.color), jnp.asarray(frame.variance)
    height, width, _ = x.shape
    rows, lines = np.mgrid[:height, :width]
    found = {}
    for name, index in chosen(np.asarray(variance), count).items():
        value, jacobian = columns(denoiser.bind(frame), x, jnp.asarray(index))
        weight, gain = (
            np.asarray(a, np.float64)
            for a in weight_and_gain(safe_sqrt(variance), value, "radiance")
        )
        size, energy, number = (np.zeros(len(EDGES) - 1) for _ in range(3))
        for j, column in zip(index, np.asarray(jacobian, np.float64), strict=True):
            y, across, channel = np.unravel_index(j, x.shape)
            ring = np.digitize(np.hypot(rows - y, lines - across), EDGES) - 1
            own = abs(column[y, across, channel])
            spread = (gain * column * weight.ravel()[j]) ** 2
            spread[y, across, channel] = 0
            energy += np.bincount(ring.ravel(), spread.sum(-1).ravel(), len(energy))
            if own > 0:
                relative = np.abs(column[..., channel]) / own
                size += np.bincount(ring.ravel(), relative.ravel(), len(size))
                number += np.bincount(ring.ravel(), minlength=len(size))
        found[name] = size / np.maximum(number, 1), energy / energy.sum()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=_common.VALID)
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--columns", type=int, default=24, help="fireflies per frame")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    denoiser = pd.denoisers.load(arguments.denoiser)
    labels = [f"{max(a, 0):.0f}" for a in np.ceil(EDGES[:-1])]
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    table = []
    for (scene, spp), style in zip(FRAMES, ("-", "--", "-.", ":"), strict=True):
        frame, _ = pd.repair(pd.read_exr(arguments.data / f"{scene}_{spp:06}spp.exr"))
        for name, (size, share) in rings(frame, denoiser, arguments.columns).items():
            beyond = 1 - np.cumsum(share)[:-1]
            label = f"{name}, {scene} at {spp} spp"
            inner = np.asarray(EDGES[1:-1])
            left.plot(inner, size[1:], style, color=COLORS[name], label=label)
            right.plot(inner, beyond, style, color=COLORS[name], label=label)
            table.append((scene, spp, name, *(float(f"{v:.2g}") for v in (*size[1:], *beyond[3:]))))
            print(*table[-1], flush=True)
    left.set(ylabel="mean |J_ij| / |J_jj|, same channel", title="Response by distance")
    right.set(ylabel="share of Σ e_ij further away", title="What structured probes cannot cancel")
    for axis in (left, right):
        axis.set(xscale="log", yscale="log", xlabel="distance in pixels")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    _common.save_figure(HERE / "spread.png", figure)
    header = (
        *("scene", "spp", "values"),
        *(f"from {a} px" for a in labels[1:]),
        *(f"Σ e beyond {a:.0f} px" for a in np.floor(EDGES[4:-1])),
    )
    text = f"{_common.machine()}\n\n{_common.markdown(header, table)}\n"
    _common.write_text(HERE / "spread.md", text)


if __name__ == "__main__":
    main()
