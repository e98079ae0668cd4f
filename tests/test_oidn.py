"""OIDN's networks in JAX against the native library, and the archive format of its weights."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import narrow_oidn
from native_oidn import denoise as native
from native_oidn import run_filter

import progden_jax as pd
from progden_jax.denoisers import graph, oidn, unet
from progden_jax.denoisers.tza import parse_tza, read_tza, write_tza

PARITY = 1e-5
NETWORKS = [
    # name, OIDN's quality, clean auxiliary buffers
    ("oidn-hdr", "balanced", False),
    ("oidn-hdr-alb", "balanced", False),
    ("oidn-hdr-alb-nrm", "balanced", False),
    ("oidn-hdr-calb-cnrm", "balanced", True),
    ("oidn-hdr-calb-cnrm-large", "high", True),
    ("oidn-hdr-small", "fast", False),
    ("oidn-hdr-alb-small", "fast", False),
    ("oidn-hdr-alb-nrm-small", "fast", False),
    ("oidn-hdr-calb-cnrm-small", "fast", True),
]


def crop(frame: pd.Frame, height: int, width: int) -> pd.Frame:
    return jax.tree.map(lambda a: a[20 : 20 + height, 30 : 30 + width] if a.ndim else a, frame)


def relative_rmse(image, reference) -> float:
    image, reference = np.asarray(image), np.asarray(reference)
    return float(np.sqrt(((image - reference) ** 2).mean() / (reference**2).mean()))


def test_every_shipped_name_is_tested():
    assert {name for name, _, _ in NETWORKS} == set(oidn.NAMES)
    assert set(oidn.NAMES) <= set(pd.denoisers.names())


@pytest.mark.parametrize(("name", "quality", "clean"), NETWORKS)
def test_parity_with_the_native_library(real_frame, name, quality, clean):
    denoiser = pd.denoisers.load(name)
    frame = crop(real_frame, 75, 50)
    auxiliary = [getattr(frame, role) for role in denoiser.inputs]
    expected = native(frame.color, *auxiliary, quality=quality, clean_aux=clean)
    assert relative_rmse(denoiser(frame), expected) < PARITY


@pytest.mark.parametrize("size", [(1, 1), (33, 1), (17, 15)])
def test_parity_at_odd_sizes(real_frame, size):
    frame = crop(real_frame, *size)
    assert relative_rmse(pd.denoisers.load("oidn-hdr")(frame), native(frame.color)) < PARITY


def test_parity_on_hard_values(real_frame):
    frame = crop(real_frame, 40, 40)
    color = np.array(frame.color) * 1e3
    color[3, 4], color[10, 10], color[20, :5] = np.nan, -2.0, 0.0
    mine = pd.denoisers.load("oidn-hdr")(pd.Frame(color, frame.variance))
    assert relative_rmse(mine, native(color)) < PARITY
    black = np.zeros_like(color)
    np.testing.assert_allclose(
        pd.denoisers.load("oidn-hdr")(pd.Frame(black, black)), native(black), atol=1e-7
    )


def test_given_exposure_replaces_the_automatic_one(real_frame):
    frame = crop(real_frame, 40, 40)
    automatic = float(oidn.autoexposure(frame.color))
    same = pd.denoisers.load("oidn-hdr", exposure=automatic)(frame)
    np.testing.assert_allclose(same, pd.denoisers.load("oidn-hdr")(frame), rtol=1e-5, atol=1e-6)
    other = pd.denoisers.load("oidn-hdr", exposure=10 * automatic)(frame)
    assert relative_rmse(other, same) > 1e-3


def test_autoexposure_against_a_plain_loop():
    rng = np.random.default_rng(0)
    color = rng.gamma(0.5, 2.0, (37, 50, 3)).astype(np.float32)
    color[:16, :16] = 0
    luminance = color.astype(np.float64) @ [0.212671, 0.715160, 0.072169]
    logs = []
    for i in range(3):
        for j in range(4):
            bin = luminance[i * 37 // 3 : (i + 1) * 37 // 3, j * 50 // 4 : (j + 1) * 50 // 4]
            if bin.mean() > 1e-8:
                logs.append(np.log2(bin.mean()))
    expected = 0.18 / 2 ** np.mean(logs)
    np.testing.assert_allclose(oidn.autoexposure(jnp.asarray(color)), expected, rtol=1e-5)
    canvas = np.pad(color, ((0, 11), (0, 14), (0, 0)), constant_values=9)
    np.testing.assert_allclose(
        oidn.autoexposure(jnp.asarray(canvas), valid=(37, 50)), expected, rtol=1e-5
    )


@pytest.mark.parametrize("role", ["albedo", "normal"])
@pytest.mark.parametrize("quality", ["balanced", "high"])
def test_prefilter_parity(real_frame, role, quality):
    import pyoidn

    frame = crop(real_frame, 50, 61)
    expected = run_filter(
        np.asarray(getattr(frame, role), np.float32),
        quality=pyoidn.OIDN_QUALITY_HIGH if quality == "high" else pyoidn.OIDN_QUALITY_BALANCED,
        **{role: getattr(frame, role)},
    )
    filtered = pd.denoisers.prefilter(frame, quality=quality)
    assert relative_rmse(getattr(filtered, role), expected) < PARITY


def test_weights_written_here_are_loaded_by_oidn(real_frame, tmp_path):
    frame = crop(real_frame, 40, 40)
    denoiser = pd.denoisers.load("oidn-hdr")
    changed = jax.tree.map(lambda a: np.float32(np.float16(a * 0.97)), denoiser.params)
    mine = pd.denoisers.OIDN(changed, name="changed")
    pd.denoisers.save_tza(tmp_path / "mine.tza", mine)
    again = pd.denoisers.load(tmp_path / "mine.tza")
    np.testing.assert_array_equal(again(frame), mine(frame))
    color = np.asarray(frame.color)
    theirs = run_filter(color, weights=(tmp_path / "mine.tza").read_bytes(), color=color)
    assert relative_rmse(mine(frame), theirs) < PARITY
    assert relative_rmse(mine(frame), denoiser(frame)) > 1e-2


def test_archive_round_trip_is_exact(tmp_path):
    rng = np.random.default_rng(0)
    tensors = {
        "a.weight": rng.random((4, 3, 3, 3)).astype(np.float16),
        "a.bias": rng.random(4).astype(np.float32),
    }
    write_tza(tmp_path / "w.tza", tensors)
    read = read_tza(tmp_path / "w.tza")
    assert list(read) == list(tensors)
    for name, tensor in tensors.items():
        assert read[name].dtype == tensor.dtype
        np.testing.assert_array_equal(read[name], tensor)
    assert [p.name for p in tmp_path.iterdir()] == ["w.tza"]


def test_archives_that_are_none(tmp_path):
    whole = oidn._blob("rt_hdr_small")
    for cut in (0, 5, 20, len(whole) // 2, len(whole) - 3):
        with pytest.raises(ValueError, match="damaged or cut short"):
            parse_tza(whole[:cut], source="x.tza")
    with pytest.raises(ValueError, match="x.tza is not a TZA archive"):
        parse_tza(b"\x76\x2f\x31\x01" + bytes(40), source="x.tza")
    with pytest.raises(ValueError, match=re.escape("cannot read the weights")):
        pd.denoisers.load(tmp_path / "missing.tza")
    with pytest.raises(ValueError, match="TZA takes rank 1 or 4"):
        write_tza(tmp_path / "w.tza", {"a": np.zeros((2, 2), np.float32)})
    assert not list(tmp_path.iterdir())


def test_messages(real_frame):
    with pytest.raises(ValueError, match="expected one of oidn-hdr, "):
        pd.denoisers.load("oidn")
    with pytest.raises(ValueError, match="expected a number above 0"):
        pd.denoisers.load("oidn-hdr", exposure=0.0)
    bare = pd.Frame(real_frame.color, None)
    with pytest.raises(ValueError, match="this frame has no albedo: choose a network with fewer"):
        pd.denoisers.load("oidn-hdr-alb")(bare)
    with pytest.raises(ValueError, match="quality is 'best', expected one of 'fast'"):
        pd.denoisers.for_frame(bare, quality="best")
    with pytest.raises(ValueError, match="the layers .*; expected those of OIDN's U-Net"):
        unet.from_tensors({"a.weight": np.zeros((1, 1, 3, 3)), "a.bias": np.zeros(1)})


def test_for_frame_leaves_out_what_says_nothing(real_frame):
    choose = pd.denoisers.for_frame
    assert choose(real_frame).name == "oidn-hdr-alb-nrm"
    assert choose(real_frame, quality="fast").name == "oidn-hdr-alb-nrm-small"
    assert choose(real_frame, quality="high").name == "oidn-hdr-alb-nrm"
    assert choose(real_frame, quality="high", clean_aux=True).name == "oidn-hdr-calb-cnrm-large"
    assert choose(real_frame.replace(normal=None)).name == "oidn-hdr-alb"
    assert choose(real_frame.replace(albedo=None)).name == "oidn-hdr"
    flat = real_frame.replace(albedo=jnp.full_like(real_frame.albedo, 0.5))
    assert choose(flat).name == "oidn-hdr"


def test_canvas_changes_nothing(real_frame):
    """One program serves images of nearby sizes: padding with a traced true size is exact."""
    denoiser = narrow_oidn(("albedo", "normal"))
    frame = crop(real_frame, 45, 61)
    padded = jax.tree.map(
        lambda a: np.pad(a, ((0, 35), (0, 19), (0, 0)), constant_values=3.0) if a.ndim else a, frame
    )

    @jax.jit
    def run(frame, valid):
        return denoiser.bind(frame, valid=valid)(frame.color)

    y = run(padded, (np.int32(45), np.int32(61)))
    assert relative_rmse(y[:45, :61], denoiser(frame)) < 2e-6
    assert not np.asarray(y[45:]).any()
    assert not np.asarray(y[:, 61:]).any()


def test_derivative_against_differences_in_float64(real_frame):
    """The directional derivative of the network in float64; the exposure is a constant of it."""
    with jax.enable_x64(True):
        frame = jax.tree.map(lambda a: a.astype(jnp.float64), crop(real_frame, 20, 30))
        denoiser = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), narrow_oidn())
        f = denoiser.bind(frame)
        direction = jnp.asarray(np.random.default_rng(0).normal(size=frame.color.shape))
        direction = direction * frame.color
        _, tangent = jax.jvp(f, (frame.color,), (direction,))
        step = 1e-7
        ahead, behind = f(frame.color + step * direction), f(frame.color - step * direction)
        difference = (ahead - behind) / (2 * step)
        assert tangent.dtype == jnp.float64
        assert relative_rmse(tangent, difference) < 1e-5


def test_pooling_sends_ties_to_the_first():
    gradient = jax.grad(lambda x: graph.max_pool(x).sum())(jnp.ones((4, 4, 1)))
    np.testing.assert_array_equal(gradient[..., 0], np.tile([[1, 0], [0, 0]], (2, 2)))


@pytest.mark.parametrize("size", ["small", "large"])
def test_receptive_radius_is_never_exceeded(size):
    denoiser = narrow_oidn(width=1, size=size)
    theirs = pd.denoisers.load({"small": "oidn-hdr", "large": "oidn-hdr-calb-cnrm-large"}[size])
    radius, aligned = theirs.receptive_radius, theirs.aligned_radius
    assert (denoiser.receptive_radius, denoiser.aligned_radius) == (radius, aligned)
    params = jax.tree.map(np.ones_like, denoiser.params)
    image = np.ones((2 * 16 * (radius // 16 + 1) + 16, 16, 3), np.float32)
    reached, needed = 0, []
    f = jax.jit(jax.grad(lambda x, p: graph.evaluate(denoiser.nodes, params, x)[0][p, 0, 0]))
    for p in range(len(image) // 2 - 8, len(image) // 2 + 8):
        rows = np.flatnonzero(np.asarray(f(image, p)).any((1, 2)))
        reached = max(reached, p - rows.min(), rows.max() - p)
        # The widest margins that leave out pixels which matter, of tiles cut at multiples of 16.
        needed += [p - rows.min() // 16 * 16 - 15, (rows.max() // 16 + 1) * 16 - 16 - p]
    assert radius - 16 < reached <= radius
    assert max(needed) == aligned < radius
