"""Whether the exact divergence by cones equals the one by unit vectors, in float32 on a real frame.

python -m experiments.divergence.exactness [--size 64] [--denoisers oidn-hdr oidn-hdr-alb-nrm kpcn-16]

"kpcn-WIDTH" is the project's KPCN of that width (80 is the full one) for colour alone, random weights with
logits of order 1. By unit vectors that takes 3·size² tangent passes: --against coloring gives the same truth
in fewer where a network reaches less far than the image.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common

DEMO = Path(pd.__file__).parent / "data" / "demo" / "proc2004_000008spp.exr"


def denoiser_of(name: str) -> Any:
    """One of OIDN's or the project's networks, or a random KPCN."""
    if not name.startswith("kpcn-") or not name[5:].isdigit():
        return pd.denoisers.load(name)
    net = pd.denoisers.KPCN.init(jax.random.key(0), width=int(name[5:]), name=name)
    last = net.params["kernel"]
    sharp = {"kernel": 10 * last["kernel"], "bias": last["bias"]}
    return pd.denoisers.KPCN({**net.params, "kernel": sharp}, name=name)


def diagonal(f: Any, x: jax.Array, method: pd.Method) -> tuple[np.ndarray, float]:
    """∂f_pc/∂x_pc, and the seconds that it took, compilation included."""
    start = time.perf_counter()
    run = jax.jit(lambda f, x: pd.divergence(f, x, jnp.ones_like(x), method=method))
    return np.asarray(run(f, x), np.float64), time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=64, help="edge in pixels, at most 128")
    parser.add_argument(
        "--denoisers", nargs="+", default=["oidn-hdr", "oidn-hdr-alb-nrm", "kpcn-16"]
    )
    parser.add_argument("--against", choices=("basis", "coloring"), default="basis")
    arguments = parser.parse_args()
    frame = pd.read_exr(DEMO)
    start = (frame.size[0] - arguments.size) // 2
    cut = slice(start, start + arguments.size)
    frame = jax.tree.map(lambda a: a[cut, cut] if a.ndim else a, frame)
    print(f"{_common.machine()}\n\n{DEMO.name}, {arguments.size}×{arguments.size}\n", flush=True)
    rows = []
    for name in arguments.denoisers:
        f = denoiser_of(name).bind(frame)
        costs = pd.Exact().cost(f, frame.color)
        found, seconds = diagonal(f, frame.color, pd.Exact("cone"))
        truth, longer = diagonal(f, frame.color, pd.Exact(arguments.against))
        error = np.abs(found - truth)
        rows.append(
            (
                name,
                float(np.sqrt((error**2).mean() / (truth**2).mean())),
                float(error.max() / np.abs(truth).max()),
                float(np.sqrt((truth**2).mean())),
                costs["cone"],
                costs[arguments.against],
                seconds,
                longer,
            )
        )
        print(rows[-1], flush=True)
    header = (
        "network",
        "relative RMSE",
        "largest error / largest value",
        "RMS of the diagonal",
        "cone, passes",
        f"{arguments.against}, passes",
        "cone, s",
        f"{arguments.against}, s",
    )
    print("\n" + _common.markdown(header, rows))


if __name__ == "__main__":
    main()
