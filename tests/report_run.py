"""A tiny run folder as `progden evaluate` leaves one, made of random images."""

import json
import sqlite3
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from progden_jax.exr import write_exr

HEIGHT, WIDTH = 16, 24
SCENES = ("#1 attic", '<b>"&</script>', "café 10")
SPPS = (2, 8)
METHODS = ("render", "denoised", "mix MonteCarlo(1)")

# The contract's table, written out so that these tests do not lean on who writes it.
SCHEMA = """
PRAGMA user_version = 1;
CREATE TABLE results(
  key TEXT PRIMARY KEY, scene TEXT NOT NULL, spp INTEGER NOT NULL, method TEXT NOT NULL,
  settings TEXT NOT NULL,
  rmse REAL, smape REAL, relmse REAL, flip REAL, ssim REAL, mse REAL, sure REAL, denoised_mse REAL,
  seconds REAL, render TEXT, reference TEXT, image TEXT, created TEXT NOT NULL)
"""


def make_run(folder: Path, *, rows: bool = True) -> SimpleNamespace:
    """The run's folder, and what it holds: (scene, spp, method) -> image, errors; scene -> reference."""
    rng = np.random.default_rng(3)
    (folder / "images").mkdir(parents=True)
    run = SimpleNamespace(folder=folder, images={}, layers={}, references={}, errors={}, files={})
    with sqlite3.connect(folder / "results.sqlite") as database:
        database.executescript(SCHEMA)
        for index, scene in enumerate(SCENES if rows else ()):
            truth = rng.gamma(2, 0.3 * 4**index, (HEIGHT, WIDTH, 3)).astype("f4")
            run.references[scene] = truth
            paths = {"reference": folder / f"{index}_004096spp.exr"}
            write_exr(paths["reference"], truth)
            for spp in SPPS:
                for place, method in enumerate(METHODS):
                    noise = rng.normal(0, 0.3 / (1 + place) / spp**0.5, truth.shape)
                    _add(
                        run, database, paths, (scene, spp, method), truth + noise.astype("f4"), rng
                    )
    database.close()
    return run


def _add(run, database, paths, row, image, rng) -> None:
    scene, spp, method = row
    truth = run.references[scene]
    key = f"{len(run.images):064x}"
    layers = {}
    if method != "denoised":
        layers = {n: rng.normal(0.2, 0.4, image.shape).astype("f4") for n in ("alpha", "sure")}
    path = run.folder / "images" / f"{key}.exr"
    write_exr(path, image, layers=layers)
    difference = np.asarray(image - truth, np.float64)
    errors = {
        "rmse": np.sqrt(np.mean(difference**2)),
        "smape": np.mean(np.abs(difference) / (np.abs(image) + np.abs(truth) + 0.01)),
        "flip": np.mean(np.abs(difference)) / 10,
        "ssim": 1 - 0.1 * np.mean(np.abs(difference)),
        "mse": np.mean(difference**2) - 0.001,
    }
    run.images[row], run.layers[row], run.errors[row], run.files[row] = image, layers, errors, path
    settings = {"denoiser": "none" if method == "render" else "oidn-hdr", "seed": 0}
    values = {
        "key": key, "scene": scene, "spp": spp, "method": method, "settings": json.dumps(settings),
        **{name: float(value) for name, value in errors.items()},
        "seconds": None, "reference": str(paths["reference"]), "image": f"images/{key}.exr",
        "created": "2026-11-22T00:00:00Z",
    }  # fmt: skip
    marks = ", ".join("?" * len(values))
    database.execute(
        f"INSERT INTO results({', '.join(values)}) VALUES({marks})", [*values.values()]
    )
