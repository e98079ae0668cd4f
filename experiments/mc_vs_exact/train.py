"""Train a mixer with the exact divergence, and with probes, all with the same budget.

python -m experiments.mc_vs_exact.train

On centre crops, which the exact divergence is affordable for, and with OIDN's small network. Goes on where it
was killed; the divergences are kept in the user's cache folder.
"""

from pathlib import Path
from typing import Any

import progden_jax as pd
from experiments import _training
from progden_jax.frame import centre
from progden_jax.training.index import index

DENOISER = "oidn-hdr-small"
SPP = (8, 128)
CROP = 48
"""Side in pixels."""

BUDGET: dict[str, Any] = {"steps": 300, "denoiser": DENOISER, "spp": SPP}

METHODS: dict[str, dict[str, Any]] = {
    "exact": {"method": "exact", "draws": 1},
    "probes-1": {"probes": 1, "draws": 1},
    "probes-1-drawn-4-times": {"probes": 1, "draws": 4},
    "probes-4": {"probes": 4, "draws": 1},
}


def runs(seeds: list[int]) -> dict[str, dict[str, Any]]:
    """Folder -> what differs."""
    return {
        f"{name}-seed-{seed}": {**fields, "seed": seed}
        for seed in seeds
        for name, fields in METHODS.items()
    }


def crop_all(data: Path, folder: Path, size: int, spp: tuple[int, ...]) -> None:
    """Centre crops of the renders and references of a folder, those that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in index([data], spp=spp):
        for path in (item.path, item.reference):
            target = folder / path.name
            if not target.exists():
                pd.write_exr(target, centre(pd.read_exr(path), size))


def main() -> None:
    parser = _training.parser(__doc__, "mc_vs_exact")
    parser.add_argument(
        "--crop", type=int, default=CROP, help="side of the crops, a multiple of 16"
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    crops = arguments.output / f"crops-{arguments.crop}"
    given = _training.changes(arguments.set)
    crop_all(arguments.data, crops, arguments.crop, given.get("spp", SPP))
    fixed = {**BUDGET, "crop": arguments.crop, "data": [str(crops)]}
    chosen = {
        name: _training.configuration("multiscale", {**fixed, **fields, **given})
        for name, fields in runs(arguments.seeds).items()
    }
    _training.train_all(chosen, arguments.output)


if __name__ == "__main__":
    main()
