"""What the sweeps of this folder found, as tables.

    python -m experiments.adaptation.tables RUN...

Of every way to adapt the relMSE of the denoised image, of the mixes and of the best mix there is, means over
scenes, and how the estimated error of the denoised image compares with the true one.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from experiments import _common
from progden_jax import evaluation
from progden_jax.evaluation import Row
from progden_jax.mixers import CLOSED_FORM

IMAGES = ("denoised", "mix", "closed form", "oracle")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, nargs="+", help="folders that `progden sweep` wrote")
    runs = parser.parse_args().run
    # A render that several runs have counts once.
    print(table(list({row.key: row for run in runs for row in evaluation.rows(run)}.values())))


def table(rows: list[Row]) -> str:
    """Per number of samples and way to adapt a line."""
    renders = {(r.scene, r.spp): r.relmse for r in rows if r.settings["image"] == "render"}
    found: dict[tuple[int, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row.settings["image"] != "render":
            found[row.spp, adaptation(row)][image(row)].append(row)
    lines = []
    for (spp, how), images in sorted(found.items(), key=lambda item: item[0][0]):
        shown = images["denoised"]
        noisy = [renders[r.scene, spp] for r in shown if (r.scene, spp) in renders]
        errors = (mean([r.relmse for r in images[name]]) for name in IMAGES)
        sure, true = (mean([getattr(r, n) for r in shown]) for n in ("sure", "denoised_mse"))
        seconds = [r.seconds for r in shown if r.seconds is not None]
        took = float(np.median(seconds)) if seconds else ""
        lines.append((spp, len(shown), how, mean(noisy), *errors, sure, true, took))
    header = ("spp", "scenes", "adaptation", "render", *IMAGES, "SURE", "true MSE", "seconds")
    return _common.markdown(header, lines)


def adaptation(row: Row) -> str:
    """The way to adapt, in words: what distinguishes the methods of a sweep."""
    told = row.settings
    kind = told.get("adaptation", "none")
    if kind == "sure":
        return "SURE" if told["adaptation.covariance"] else "SURE, channels as if independent"
    if kind == "post-correct":
        names = {(False, False): "A", (False, True): "B", (True, False): "C", (True, True): "D"}
        setting = names[told["correction.refined"], told["correction.bilateral"]]
        return f"post-correction {setting}"
    return kind


def image(row: Row) -> str:
    """Which of `IMAGES`."""
    closed = row.settings["image"] == "mix" and row.settings["mixer"] == CLOSED_FORM
    return "closed form" if closed else row.settings["image"]


def mean(values: list[float | None]) -> float | str:
    """Over what there is; nothing of nothing."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else ""


if __name__ == "__main__":
    main()
