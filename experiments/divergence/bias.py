"""Whether each estimator's mean over many keys is the exact divergence.

    python -m experiments.divergence.bias

Per pixel z = (mean over keys − exact) / its standard error; their RMS is about 1 where there is no bias. The
same of the image's mean. On the middle of a frame that fireflies rule and of one without any; a few minutes.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax.frame import centre

FRAMES = (("proc2002", 8), ("proc2003", 128))
METHODS: dict[str, pd.Method] = {
    "differences, 4": pd.FiniteDifference(probes=4),
    "differences, 4, ε = 0.1": pd.FiniteDifference(probes=4, epsilon=0.1),
    "gaussian, 4": pd.MonteCarlo(probes=4, distribution="gaussian"),
    "rademacher, 4": pd.MonteCarlo(probes=4),
    "probing, 1": pd.Probing(probes=1),
    "probing, 4": pd.Probing(probes=4),
    "probing, 16": pd.Probing(probes=16),
}


def scores(found: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """RMS of z over pixels, z of the image's mean, and |mean − exact| over the exact one's RMS."""
    count = len(found)
    mean, error = found.mean(0), found.std(0, ddof=1) / np.sqrt(count)
    # What comes out exact, or is 0, has rounding for its spread.
    known = error > 1e-5 * np.abs(truth)
    z = (mean - truth)[known] / error[known]
    means = found.mean((1, 2, 3))
    whole = (means.mean() - truth.mean()) / (means.std(ddof=1) / np.sqrt(count))
    away = np.sqrt(np.square(mean - truth).mean() / np.square(truth).mean())
    return float(np.sqrt(np.square(z).mean())), float(whole), float(away)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=_common.VALID)
    parser.add_argument("--keys", type=int, default=64)
    parser.add_argument("--size", type=int, default=32, help="edge of the crop in pixels")
    parser.add_argument("--denoiser", default="oidn-hdr")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    denoiser = pd.denoisers.load(arguments.denoiser)
    keys = jax.random.split(jax.random.key(7), arguments.keys)
    rows = []
    for scene, spp in FRAMES:
        path = arguments.data / f"{scene}_{spp:06}spp.exr"
        frame, _ = pd.repair(centre(pd.read_exr(path), arguments.size))
        assert frame.variance is not None
        x, variance = jnp.asarray(frame.color), jnp.asarray(frame.variance)
        f = denoiser.bind(frame)
        truth = np.asarray(pd.divergence(f, x, variance, method=pd.Exact("cone")), np.float64)
        for name, method in METHODS.items():
            one = [pd.divergence(f, x, variance, method=method, key=key) for key in keys]
            rows.append((scene, spp, name, *scores(np.asarray(one, np.float64), truth)))
            print(*rows[-1], flush=True)
    header = ("scene", "spp", "method, K", "RMS z per pixel", "z of the mean", "error of the mean")
    table = _common.markdown(header, rows)
    note = f"{arguments.keys} keys, {arguments.denoiser}, {arguments.size}×{arguments.size}"
    text = f"{_common.machine()}; {note}\n\n{table}\n"
    _common.write_text(Path(__file__).with_suffix(".md"), text)


if __name__ == "__main__":
    main()
