"""Does an exact divergence change the mix, at inference or in training?

progden sweep experiments/mc_vs_exact/sweep.yaml -o runs/mc_vs_exact-inference
python -m experiments.mc_vs_exact.plot runs/mc_vs_exact-inference
python -m experiments.mc_vs_exact.train                                            # into runs/mc_vs_exact
progden sweep experiments/mc_vs_exact/trained.yaml -o runs/mc_vs_exact-trained
python -m experiments.mc_vs_exact.plot runs/mc_vs_exact-trained
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments import _common, _plots
from progden_jax.evaluation import Row
from progden_jax.exr import read_layers

EXACT = "exact"
NAMES = {"default": "shipped", "closed-form": "closed form"}


class Compared(NamedTuple):
    """An image, and how far it is from what the exact divergence gives.

    `image` is the RMS difference over that one's RMSE, `alpha` the RMS difference of α.
    """

    row: Row
    exact: Row
    image: float
    alpha: float

    @property
    def mixer(self) -> str:
        """The folder that it was trained into, or a name."""
        path = str(self.row.settings.get("mixer", self.row.settings["image"]))
        return NAMES.get(
            path, path if self.row.settings["image"] != "mix" else Path(path).parent.name
        )

    @property
    def method(self) -> str:
        """That it was made with at inference."""
        settings = self.row.settings
        if settings["estimator"] == EXACT:
            return EXACT
        return f"{settings['probes']} probe{'s' * (settings['probes'] > 1)}"


def compared(rows: Sequence[Row]) -> list[Compared]:
    """Each mix beside the exact one of its mixer, on the same render; other images need none."""
    found = [
        Compared(row, row, 0.0, 0.0)
        for row in rows
        if row.settings["image"] in ("denoised", "oracle")
    ]
    by_render: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in _plots.kept(rows):
        if row.settings["image"] == "mix":
            by_render[row.settings["mixer"], row.scene, row.spp].append(row)
    for (mixer, scene, spp), own in by_render.items():
        exact = next((row for row in own if row.settings["estimator"] == EXACT), None)
        if exact is None:
            raise ValueError(f"{mixer} has no exact divergence for {scene} at {spp} spp.")
        right = read_layers(str(exact.image))
        assert exact.rmse
        for row in sorted(own, key=lambda row: row is not exact):
            layers = read_layers(str(row.image))
            image, alpha = (_common.rms(layers[name] - right[name]) for name in ("", "alpha"))
            found.append(Compared(row, exact, image / exact.rmse, alpha))
    return found


def table(found: Sequence[Compared]) -> str:
    """Geometric means over renders and seeds of errors over the denoiser's, and what probes change.

    What was trained alike but for its seed has one line.
    """
    base = {(c.row.scene, c.row.spp): c.row for c in found if c.mixer == "denoised"}
    groups: dict[tuple[str, str], list[Compared]] = defaultdict(list)
    for one in found:
        groups[one.mixer.partition("-seed-")[0], one.method].append(one)
    lines = []
    for names, own in groups.items():
        cells: list[Any] = list(names)
        for metric in _plots.METRICS:
            ratios = [
                getattr(c.row, metric) / getattr(base[c.row.scene, c.row.spp], metric) for c in own
            ]
            cells.append(f"{np.exp(np.mean(np.log(ratios))):.4f}")
        for metric in ("rmse", "smape"):
            changes = [abs(getattr(c.row, metric) / getattr(c.exact, metric) - 1) for c in own]
            cells.append(f"{np.median(changes):.3%}, {np.max(changes):.2%}")
        cells.append(f"{np.median([c.image for c in own]):.1%}")
        cells.append(f"{np.median([c.alpha for c in own]):.3f}")
        cells.append(len({(c.row.scene, c.row.spp) for c in own}))
        lines.append(cells)
    header = (
        *("mixer", "divergence", *(f"{m} over the denoiser's" for m in _plots.METRICS.values())),
        *("change of RMSE: median, largest", "of SMAPE", "image", "α", "renders"),
    )
    return _common.markdown(header, lines)


def write(path: Path, found: Sequence[Compared]) -> None:
    """Every image."""
    lines = [
        (
            *(c.mixer, c.row.scene, c.row.spp, c.method, c.row.settings.get("seed", "")),
            *(getattr(c.row, metric) for metric in _plots.METRICS),
            *(c.image, c.alpha),
        )
        for c in found
    ]
    header = ("mixer", "scene", "spp", "method", "seed", *_plots.METRICS, "image", "alpha")
    _common.write_csv(path, header, lines)


def draw(rows: Sequence[Row], output: Path) -> str:
    """A table, and a CSV called by which configuration this is of."""
    denoiser, rows = _plots.of_one_denoiser(rows)
    found = compared(rows)
    shipped = {"default", "closed-form"}.issuperset(
        r.settings.get("mixer", "default") for r in rows
    )
    write(output / f"{'inference' if shipped else 'trained'}.csv", found)
    sides = ", ".join(sorted({f"{row.crop}×{row.crop}" for row in rows if row.crop}))
    return f"## {denoiser}, {sides or 'all'} pixels\n\n{table(found)}"


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
