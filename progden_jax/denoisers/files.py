"""Files of denoisers' weights: which are shipped, saving and loading."""

import os
from collections.abc import Mapping
from pathlib import Path

from progden_jax import _safetensors
from progden_jax.denoisers import unet
from progden_jax.denoisers.oidn import INPUTS, OIDN
from progden_jax.denoisers.own import KPCN, LogNetwork, UNet
from progden_jax.denoisers.residual import ResidualNet
from progden_jax.denoisers.tza import write_tza

ARCHITECTURES: dict[str, type[UNet] | type[KPCN] | type[ResidualNet]] = {
    "unet": UNet,
    "kpcn": KPCN,
    "residual": ResidualNet,
}
"""The project's own networks, by the name that weight files use."""

FOLDER = Path(__file__).parents[1] / "weights"
"""Weights that come with the package: NAME.safetensors, NAME beginning with the architecture."""


def shipped() -> dict[str, Path]:
    """The project's own networks that come with the package, by name."""
    files = sorted(FOLDER.glob(f"*{_safetensors.ENDING}"))
    return {file.stem: file for file in files if file.stem.split("-")[0] in ARCHITECTURES}


def save(
    path: str | os.PathLike[str],
    denoiser: LogNetwork,
    *,
    dtype: str = "float16",
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write one of the project's own networks so that `load` gives it back; whole or not at all.

    Parameters
    ----------
    path : ends in .safetensors.
    dtype : "float16" halves the file and rounds the weights to three digits, or "float32".
    metadata : further text to keep with it, such as data, seed and steps of the training.

    Raises
    ------
    ValueError
        If the denoiser is none of the project's own, a weight is not finite in `dtype`, or metadata uses
        a name that the file needs.
    """
    names: dict[type, str] = {kind: name for name, kind in ARCHITECTURES.items()}
    if type(denoiser) not in names:
        raise ValueError(
            f"the denoiser is a {type(denoiser).__name__}, expected a "
            f"{' or a '.join(kind.__name__ for kind in names)}: OIDN's weights go to a .tza file (save_tza)."
        )
    own = {"architecture": names[type(denoiser)], "inputs": ",".join(denoiser.inputs)}
    if clash := {*own, "format", "dtype"} & set(metadata or {}):
        raise ValueError(f"metadata has {', '.join(sorted(clash))}, which the file itself tells.")
    _safetensors.write(path, denoiser.params, own | dict(metadata or {}), dtype=dtype)


def load_own(
    path: str | os.PathLike[str], *, name: str | None = None, precision: str = "highest"
) -> UNet | KPCN | ResidualNet:
    """The network that `save` wrote.

    Raises
    ------
    ValueError
        If there is no such file, or it holds something else.
    """
    params, metadata = _safetensors.read(path)
    architecture = metadata.get("architecture", "nothing")
    if architecture not in ARCHITECTURES:
        raise ValueError(
            f"{os.fspath(path)} holds the weights of {architecture!r}, expected a denoiser: "
            f"{' or '.join(ARCHITECTURES)}."
        )
    inputs = tuple(role for role in metadata.get("inputs", "").split(",") if role)
    try:
        return ARCHITECTURES[architecture](
            params, inputs, name=name or Path(path).stem, precision=precision
        )
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from error


def save_tza(
    path: str | os.PathLike[str], denoiser: OIDN | UNet, *, dtype: str = "float16"
) -> None:
    """Write a U-Net's weights as a .tza archive; OIDN's own library takes those in float16 only.

    An archive holds weights alone. Read back, by `load` or by OIDN, they count as those of a network between
    OIDN's own transfer functions, with albedo and normal by their number of input channels (3, 6 or 9).
    So an `OIDN` comes through whole; a `UNet`, whose transfer functions differ, runs in OIDN but gives
    other images there. Its weights serve to look at, or to train on from there.

    Raises
    ------
    ValueError
        If the denoiser is no U-Net, or takes the variance, of which OIDN knows nothing.
    """
    if not isinstance(denoiser, OIDN | UNet):
        raise ValueError(
            f"the denoiser is a {type(denoiser).__name__}; a .tza file holds OIDN's U-Net only: "
            "write a .safetensors file with `save`."
        )
    if denoiser.inputs not in INPUTS.values():
        raise ValueError(
            f"{denoiser.name} takes {' and '.join(denoiser.inputs)} besides the colour; OIDN's networks take "
            "nothing, albedo, or albedo and normal: write a .safetensors file with `save`."
        )
    write_tza(path, unet.to_tensors(denoiser.params, dtype))
