"""The weights that come with the package: small, with their origin, giving what they gave when recorded."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from code_generation import as_for_users

import progden_jax as pd
from progden_jax import _safetensors, combiner, mixers
from progden_jax.denoisers import files

FILES = {path.stem: path for path in files.FOLDER.glob("*.safetensors")}
RECORDED: dict[str, list[float]] = {
    "combiner-nfor": [0.059181, 0.0297499, 0.0496217, 0.111435, 0.0455019, 0.091846],
    "combiner-unet-hdr": [0.0586476, 0.029701, 0.0496433, 0.110193, 0.045045, 0.090962],
    "kpcn-hdr-alb-nrm-var": [0.0613193, 0.0309585, 0.0516322, 0.111086, 0.0454345, 0.0920812],
    "mixer-any": [0.750312, 0.658193, 0.752285, 0.962325, 0.604492, 0.810068],
    "mixer-kpcn-hdr-alb-nrm-var": [0.806405, 0.729846, 0.773302, 0.97302, 0.586443, 0.790449],
    "mixer-nfor": [0.791165, 0.727367, 0.782395, 0.988043, 0.693127, 0.881235],
    "mixer-oidn-hdr": [0.895476, 0.832945, 0.884234, 0.987992, 0.712064, 0.913414],
    "mixer-oidn-hdr-alb-nrm": [0.881646, 0.821827, 0.8716, 0.879978, 0.134119, 0.49366],
    "mixer-unet-hdr": [0.739653, 0.603126, 0.712924, 0.731417, 0.222536, 0.483584],
    "mixer-unet-hdr-alb-nrm": [0.731805, 0.589889, 0.69435, 0.686729, 0.20667, 0.446441],
    "mixer-unet-hdr-alb-nrm-var": [0.735371, 0.590675, 0.70172, 0.715338, 0.226268, 0.498093],
    "mixer-unet-hdr-var": [0.747695, 0.604639, 0.717251, 0.720164, 0.263551, 0.538978],
    "residual-hdr-alb-nrm-dep": [0.0627269, 0.0316737, 0.0523986, 0.110373, 0.0451014, 0.092738],
    "unet-hdr": [0.0606872, 0.0305358, 0.0520162, 0.10864, 0.0451267, 0.0947322],
    "unet-hdr-alb-nrm": [0.0604504, 0.030121, 0.05028, 0.105741, 0.045027, 0.0887024],
    "unet-hdr-alb-nrm-var": [0.0601977, 0.0298604, 0.0503183, 0.106858, 0.0443251, 0.0892673],
    "unet-hdr-var": [0.0601802, 0.0300378, 0.0501791, 0.106606, 0.0457324, 0.0862292],
}
"""Means of red, green and blue, then one pixel: of a denoised crop, also a blurred one with a combiner behind
it, or of a mixer's α on that."""


@pytest.fixture(scope="module")
def crop(real_frame):
    return jax.tree.map(lambda a: a[40:72, 30:62], real_frame.replace(spp=None))


@pytest.fixture(scope="module")
def mixed():
    """α of any mixer, by one program for all of an architecture."""
    return jax.jit(lambda mixer, *images: mixer(*images), compiler_options=as_for_users())


@pytest.fixture(scope="module")
def denoised():
    """The image of any denoiser, by one program for all of a kind."""
    return jax.jit(
        lambda denoiser, frame: denoiser.bind(frame)(frame.color), compiler_options=as_for_users()
    )


def blur(x):
    return sum(jnp.roll(x, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9


BLUR = pd.FunctionDenoiser(blur)


def output(name: str, frame: pd.Frame, mixed, denoised) -> jax.Array:
    if name.startswith("combiner-"):
        return denoised(combiner.load(name.removeprefix("combiner-"), BLUR), frame)
    if not name.startswith("mixer-"):
        return denoised(pd.denoisers.load(name), frame)
    x, variance = frame.color, frame.variance
    y = blur(x)
    divergence = variance / 9
    risk = pd.sure(x, y, variance, divergence)
    mixer = pd.load_mixer(name.removeprefix("mixer-"))
    return mixed(mixer, x, y, variance, divergence, risk)


def test_every_file_is_recorded_and_found_by_name():
    assert set(FILES) == set(RECORDED)
    named = {*files.shipped(), *(f"mixer-{n}" for n in mixers.names() if n != mixers.CLOSED_FORM)}
    named |= {f"combiner-{n}" for n in combiner.names()}
    assert named == set(FILES)


@pytest.mark.parametrize("name", sorted(FILES))
def test_small_and_with_its_origin(name):
    assert FILES[name].stat().st_size < 1_000_000
    metadata = _safetensors.read(FILES[name])[1]
    config = json.loads(metadata["config"])
    assert config["data"]
    assert isinstance(config["seed"], int)
    assert 0 < int(metadata["steps"]) <= config["steps"]
    assert len(metadata["commit"]) >= 7


@pytest.mark.parametrize("name", sorted(FILES))
def test_outputs_are_those_recorded(name, crop, mixed, denoised):
    found = np.asarray(output(name, crop, mixed, denoised))
    summary = [*found.mean((0, 1)), *found[9, 21]]
    np.testing.assert_allclose(summary, RECORDED[name], rtol=1e-3, atol=1e-5)
