"""What the page knows of a run besides pictures, as one JSON document."""

import base64
import datetime
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from progden_jax import __version__
from progden_jax.evaluation.database import Row

METRICS = {
    "rmse": "RMSE",
    "smape": "SMAPE",
    "relmse": "relMSE",
    "flip": "FLIP",
    "dssim": "1 − SSIM",
    "mse": "MSE",
    "sure": "SURE",
    "denoised_mse": "MSE of denoised",
    "risk": "estimate of MSE",
    "seconds": "seconds",
}
"""What tables and plots show, by its name in the document; of all of them less is better."""

CONFIDENCE = 0.95
_COLORMAPS = {"error": "inferno", "flip": "magma", "alpha": "cividis", "signed": "RdBu_r"}


class Pictures(NamedTuple):
    """Names of image files for one row; None where there is none."""

    image: str | None = None
    reference: str | None = None
    flip: str | None = None
    alpha: str | None = None
    sure: str | None = None


def newest(rows: Sequence[Row]) -> list[Row]:
    """One row of each scene, spp and method: the last, should inputs have changed between runs."""
    return list({(row.scene, row.spp, row.method): row for row in rows}.values())


def document(
    rows: Sequence[Row],
    pictures: Mapping[str, Pictures],
    *,
    title: str,
    exposures: Mapping[str, float],
) -> dict[str, Any]:
    """The document that the page is made from, of JSON's types only.

    Parameters
    ----------
    rows : one of each scene, spp and method.
    pictures : row's key -> its images.
    exposures : scene -> stops that make it well visible.
    """
    scenes = sorted({row.scene for row in rows})
    methods = _methods(rows)
    return {
        "title": title,
        "version": __version__,
        "created": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "scenes": [{"name": s, "exposure": float(exposures.get(s, 0.0))} for s in scenes],
        "methods": [{"name": m, "settings": settings} for m, settings in methods.items()],
        "metrics": [{"name": n, "label": label} for n, label in METRICS.items() if _any(rows, n)],
        "rows": [
            {
                "scene": scenes.index(row.scene),
                "spp": row.spp,
                "method": list(methods).index(row.method),
                "values": {n: value for n in METRICS if (value := _value(row, n)) is not None},
                "pictures": {
                    n: v for n, v in pictures.get(row.key, Pictures())._asdict().items() if v
                },
            }
            for row in sorted(rows, key=lambda row: (row.scene, row.spp))
        ],
        "confidence": CONFIDENCE,
        "quantiles": [
            float(special.stdtrit(degrees, 0.5 + CONFIDENCE / 2))
            for degrees in range(1, len(scenes))
        ],
        "colormaps": {name: _colormap(of) for name, of in _COLORMAPS.items()},
    }


def _methods(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Method -> settings, in the order of the run but for the render, which comes first."""
    found = {row.method: row.settings for row in rows}
    return dict(sorted(found.items(), key=lambda item: item[0] != "render"))


def _value(row: Row, name: str) -> float | None:
    value = row.ssim if name == "dssim" else getattr(row, name)
    if value is None or not math.isfinite(value):
        return None
    return 1 - value if name == "dssim" else float(value)


def _any(rows: Sequence[Row], name: str) -> bool:
    return any(_value(row, name) is not None for row in rows)


def _colormap(name: str) -> str:
    """256 colours, three bytes each, in base64."""
    from matplotlib import colormaps

    colors = colormaps[name](np.arange(256), bytes=True)[:, :3]
    return base64.b64encode(np.ascontiguousarray(colors).tobytes()).decode()
