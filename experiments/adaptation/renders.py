"""Middles of the validation scenes with normal noise of known variance, as Stein's estimate assumes it.

    python -m experiments.adaptation.renders FOLDER [--crop 64]

Each is the reference, which so is the truth, plus normal noise whose variance is that of the render averaged
over 5×5 pixels.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax._windows import box_sum
from progden_jax.frame import centre

SPP = (32, 128, 512)
POOL = 5


def main() -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("output", type=Path, help="a folder, made if missing")
    parser.add_argument("--spp", type=int, nargs="+", default=SPP)
    parser.add_argument("--crop", type=int, default=64, help="edge in pixels")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    names = _common.scenes(arguments.data, arguments.scenes)
    for name, spp, frame, reference in _common.series(arguments.data, names, arguments.spp):
        frame, reference = (centre(f, arguments.crop) for f in (frame, reference))
        frame, reference = as_normal(frame, reference, seed=spp)
        for count, image in ((spp, frame), (_common.REFERENCE_SPP, reference)):
            path = arguments.output / f"{name}_{count:06}spp.exr"
            pd.write_exr(path, image, overwrite=True)


def as_normal(frame: pd.Frame, reference: pd.Frame, *, seed: int) -> tuple[pd.Frame, pd.Frame]:
    """The reference with noise of the frame's variance, pooled, and the reference as the truth."""
    assert frame.variance is not None
    inside = jnp.ones_like(frame.variance)
    variance = np.asarray(box_sum(frame.variance, POOL) / box_sum(inside, POOL))
    noise = np.random.default_rng(seed).normal(size=variance.shape) * np.sqrt(variance)
    color = (np.asarray(reference.color) + noise).astype(np.float32)
    return frame.replace(color=color, variance=variance), reference.replace(
        variance=np.zeros_like(variance)
    )


if __name__ == "__main__":
    main()
