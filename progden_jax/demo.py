"""The main job on a small series that comes with the package: one 128×128 scene of the validation
set (proc2004: a mirror ball, thin rods, a checkered box under a small light) at 8, 32 and 128
samples per pixel, with its reference of 4096."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from progden_jax import denoisers, pipeline
from progden_jax.exr import read_exr, read_exr_with_info, write_exr

FOLDER = Path(__file__).parent / "data" / "demo"
SHEET = "sheet.png"
TITLE = "Progressive denoising of a 128×128 render with OIDN's network (colour, albedo, normal)"

Image = Float[np.ndarray, "h w 3"]


class Step(NamedTuple):
    """The series at one number of samples; images are (H, W, 3) linear radiance, α in [0, 1]."""

    spp: int
    noisy: Image
    denoised: Image
    mixed: Image
    alpha: Image


def renders() -> dict[int, Path]:
    """Samples per pixel -> file, the fewest first, without the reference."""
    return dict(sorted(_series().items())[:-1])


def reference() -> Image:
    """The render of the most samples, (H, W, 3)."""
    return np.asarray(read_exr(max(_series().items())[1]).color)


def outputs() -> tuple[str, ...]:
    """Names of the files that the demo leaves in its folder."""
    return (*(_output(spp) for spp in renders()), SHEET)


def run(folder: Path) -> Iterator[Step]:
    """Denoise the series, write each result to `folder` (replacing what is there), and yield it.

    Raises
    ------
    ExrError
        If `folder` cannot be written.
    """
    for spp, path in renders().items():
        frame, info = read_exr_with_info(path)
        result = pipeline.progressive_denoise(frame, denoisers.for_frame(frame))
        image, denoised, alpha, sure = (
            np.asarray(a) for a in (result.image, result.denoised, result.alpha, result.sure)
        )
        layers = {"denoised": denoised, "alpha": alpha, "sure": sure}
        write_exr(folder / _output(spp), image, layers=layers, like=info, overwrite=True)
        yield Step(spp, np.asarray(frame.color), denoised, image, alpha)


def _output(spp: int) -> str:
    return f"denoised_{spp:03d}spp.exr"


def _series() -> dict[int, Path]:
    found = {int(m[1]): p for p in FOLDER.glob("*.exr") if (m := re.search(r"_(\d+)spp$", p.stem))}
    if len(found) < 2:
        raise FileNotFoundError(f"{FOLDER} lacks the demo's renders: install progden_jax again.")
    return found
