"""What the tests of `evaluate` and `sweep` share: small renders, and a report that remembers."""

from pathlib import Path

import numpy as np

import progden_jax as pd

TOY = f"{Path(__file__).with_name('toy_denoisers.py')}:blur"
SPP, REFERENCE = (4, 16), 1024


def write_series(folder: Path, scenes: int = 2, size: int = 16) -> Path:
    """Gamma noise on a smooth image; every sample has the standard deviation of half its mean."""
    folder.mkdir()
    rng = np.random.default_rng(5)
    for scene in range(scenes):
        truth = 0.5 + np.linspace(0, 1 + scene, size)[:, None, None] * np.ones((size, size, 3))
        for spp in (*SPP, REFERENCE):
            samples = rng.gamma(4 * spp, 1 / (4 * spp), truth.shape)
            frame = pd.Frame(
                (truth * samples).astype(np.float32), (truth**2 / (4 * spp)).astype(np.float32)
            )
            pd.write_exr(folder / f"scene{scene}_{spp:06}spp.exr", frame)
    return folder


class Remembers:
    """A report that keeps what it is told, and may do something after each job."""

    def __init__(self, then=lambda number: None):
        self.numbers, self.rows, self.failures, self._then = (), [], [], then

    def started(self, missing, present):
        self.numbers = (missing, present)

    def added(self, job, rows):
        self.rows.append(rows)
        self._then(len(self.rows))

    def failed(self, job, reason):
        self.failures.append(reason)
