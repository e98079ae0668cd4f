"""NFOR: its regression against one written out, its limits, derivatives, canvases, tiles and halves."""

import functools

import dense_nfor
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import progden_jax as pd
from progden_jax.denoisers import NFOR, _regression, prefiltering
from progden_jax.denoisers._patches import Windows
from progden_jax.denoisers._regression import regress

SMALL = NFOR(radius=2, patch=1, inputs=("albedo", "depth"))
SIZE = (11, 19)


@functools.partial(jax.jit, static_argnames="bandwidths")
def run(image, features, guide, variance, ridge, bandwidths=(0.5, 1.0)):
    inside = jnp.ones(image.shape[:2], bool)
    windows = Windows(radius=3, patch=1)
    return regress(
        image,
        features,
        guide,
        variance,
        inside,
        windows=windows,
        bandwidths=bandwidths,
        ridge=ridge,
    )


@pytest.fixture(scope="module", autouse=True)
def small_groups():
    """So that images of several blocks are several groups, in both directions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_regression, "_GROUP", 2)
        yield


@pytest.fixture(scope="module")
def noisy():
    """Features far from zero, an image, its variance, and an independent image of the same."""
    rng = np.random.default_rng(0)
    features = 2 + 0.5 * rng.normal(size=(*SIZE, 3))
    image = rng.gamma(2, 1, (*SIZE, 3))
    variance = 0.3 * image**2 * rng.random(image.shape)
    guide = image + np.sqrt(variance) * rng.normal(size=image.shape)
    return [a.astype(np.float32) for a in (image, features, guide, variance)]


def test_regression_is_the_dense_one(noisy):
    found = run(*noisy, 1e-3)
    for image, bandwidth in zip(found.image, (0.5, 1.0), strict=True):
        expected = dense_nfor.regression(*noisy, radius=3, patch=1, bandwidth=bandwidth, ridge=1e-3)
        assert np.abs(expected - noisy[0]).max() > 0.1
        np.testing.assert_allclose(image, expected, atol=2e-5)


def test_leverage_is_the_response_to_ones_own_input(noisy):
    """The regression is linear in the image, so a lit pixel shows its column of the matrix."""
    image, *rest = noisy
    leverage = run(image, *rest, 1e-3).leverage
    for pixel in ((0, 0), (5, 7), (7, 8), (10, 18)):
        alone = np.zeros_like(image)
        alone[pixel] = 1
        response = run(alone, *rest, 1e-3).image[:, *pixel]
        np.testing.assert_allclose(response, leverage[:, *pixel, None] * np.ones(3), rtol=1e-3)


def test_what_is_linear_in_the_features_is_reproduced(noisy):
    _, features, guide, _ = noisy
    image = features @ np.array([[1, -2, 0.5], [0.25, 1, 3], [1, 2, -1]], np.float32) + 7
    found = run(image, features, guide, np.full_like(guide, 1e3), 1e-6)
    assert np.median(found.leverage) < 0.1
    np.testing.assert_allclose(found.image, np.stack([image] * 2), atol=1e-3)


def frame_of(height, width, seed=1):
    rng = np.random.default_rng(seed)
    shape = (height, width)
    albedo = np.kron(rng.random((-(-height // 8), -(-width // 8), 1)), np.ones((8, 8, 3)))
    albedo = albedo[:height, :width] + 0.1
    truth = albedo * np.linspace(0.5, 2, width)[None, :, None]
    variance = 0.05 * truth**2
    buffers = {
        "color": truth + np.sqrt(variance) * rng.normal(size=(*shape, 3)),
        "variance": variance,
        "albedo": albedo,
        "normal": rng.normal(size=(*shape, 3)),
        "depth": np.linspace(0, 9, height)[:, None, None] * np.ones((1, width, 1)),
    }
    frame = pd.Frame(**{n: b.astype(np.float32) for n, b in buffers.items()})
    return jax.tree.map(np.asarray, frame), truth


BIG, TRUTH = frame_of(56, 64)
FRAME = jax.tree.map(lambda a: a[:40, :48], BIG)


@jax.jit
def padded(frame, valid):
    return SMALL.bind(frame, valid=valid)(frame.color)


def test_noise_is_removed():
    assert isinstance(SMALL, pd.Denoiser)
    truth = TRUTH[:40, :48].astype(np.float32)
    # Of 25 neighbours, a few of which are the model's.
    assert pd.metrics.rmse(SMALL(FRAME), truth) < 0.5 * pd.metrics.rmse(FRAME.color, truth)


def test_limits():
    """Nothing to remove; nothing to see; nothing but one pixel; any unit of radiance and length."""
    image = np.maximum(FRAME.color, 0)
    clean = SMALL(FRAME.replace(variance=jnp.zeros_like(FRAME.variance)))
    np.testing.assert_allclose(clean, image, rtol=1e-4, atol=1e-6)
    flat = SMALL(FRAME.replace(color=jnp.full_like(FRAME.color, 3)))
    np.testing.assert_allclose(flat, np.full_like(image, 3), rtol=1e-5)
    black = SMALL(FRAME.replace(color=0 * FRAME.color, variance=0 * FRAME.variance))
    assert not np.asarray(black).any()
    one = padded(BIG, (np.int32(1), np.int32(1)))
    np.testing.assert_allclose(one[0, 0], FRAME.color[0, 0], rtol=1e-5)
    assert not np.asarray(one).reshape(-1, 3)[1:].any()
    scaled = SMALL(FRAME.replace(color=1e4 * FRAME.color, variance=1e8 * FRAME.variance))
    np.testing.assert_allclose(scaled, 1e4 * np.asarray(SMALL(FRAME)), rtol=1e-3)


def test_canvas_and_tiles_are_as_the_whole():
    origin = (8, 16)
    junk = jax.tree.map(np.copy, BIG)
    for buffer in jax.tree.leaves(junk):
        buffer[40:], buffer[:, 48:] = 1e3, -5
    valid = tuple(np.int32(n) for n in (40, 48))
    np.testing.assert_allclose(padded(junk, valid)[:40, :48], SMALL(FRAME), atol=1e-5)
    whole = np.asarray(padded(BIG, tuple(np.int32(n) for n in BIG.size)))
    tile = jax.tree.map(lambda a: a[origin[0] : origin[0] + 40, origin[1] :], BIG)
    margin = pd.tiling.margin(SMALL)
    assert margin == 5 + 9
    np.testing.assert_allclose(
        SMALL(tile)[margin:-margin, margin:],
        whole[origin[0] + margin : origin[0] + 40 - margin, origin[1] + margin :],
        atol=1e-5,
    )


def test_derivatives_are_those_of_differences():
    """Through weights and fits, for one bandwidth: a choice would jump; finite without noise."""
    with jax.enable_x64(True):
        small = jax.tree.map(lambda a: jnp.asarray(a[:7, :9], jnp.float64), FRAME)
        denoiser = NFOR(radius=2, patch=1, bandwidths=(1.0,), inputs=("albedo",))
        both = jax.jit(lambda f, x, t: jax.jvp(f, (x,), (t,)))
        x, h = small.color, 1e-6
        step = jnp.asarray(np.random.default_rng(4).normal(size=x.shape))
        f = denoiser.bind(small)
        expected = (both(f, x + h * step, step)[0] - both(f, x - h * step, step)[0]) / (2 * h)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(both(f, x, step)[1], expected, rtol=1e-5, atol=1e-7)
        still = denoiser.bind(small.replace(variance=0 * x))
        for image in (x, 0 * x):
            assert np.isfinite(both(still, image, step)[1]).all()


def test_halves_filter_each_other():
    """Each with weights from the other, whose variance is twice the mean's."""
    small = jax.tree.map(lambda a: a[: SIZE[0], : SIZE[1]], FRAME).replace(normal=None, depth=None)
    difference = 0.1 * np.random.default_rng(5).normal(size=(*SIZE, 3)).astype(np.float32)
    albedo = np.asarray(small.albedo)
    a, b = small.color + difference, small.color - difference
    found = NFOR(radius=3, patch=1, bandwidths=(1.0,)).bind(small, halves=(a, b))(small.color)
    variance = 2 * np.asarray(small.variance)
    expected = np.mean(
        [run(*pair, variance, 1e-3).image[1] for pair in ((a, albedo, b), (b, albedo, a))], 0
    )
    np.testing.assert_allclose(found, np.maximum(expected, 0), atol=2e-5)
    with pytest.raises(ValueError, match=r"halves\[1\] has shape"):
        SMALL.bind(small, halves=(a, b[:3]))


def test_other_images_are_filtered_alike():
    """The image itself as it is, and what is linear in the other."""
    x = FRAME.color
    others = np.stack([x, 2 * x + 1, FRAME.albedo])
    f = SMALL.bind(FRAME)
    found = f.filtered(x, others)
    expected = f(x)
    assert np.asarray(expected > 0).all()
    np.testing.assert_allclose(found[0], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1], 2 * expected + 1, rtol=1e-3)
    np.testing.assert_allclose(found[2], FRAME.albedo, atol=2e-2)
    with pytest.raises(ValueError, match=r"images\[0\] has shape"):
        f.filtered(x, others[:, :3])


def test_prefiltered_features(noisy):
    truth = np.broadcast_to(np.where(np.arange(19) < 9, 0.2, 0.8)[None, :, None], (*SIZE, 3))
    noise = 0.1 * np.random.default_rng(6).normal(size=truth.shape)
    frame = FRAME.replace(albedo=None, normal=None, depth=None)
    small = jax.tree.map(lambda a: a[: SIZE[0], : SIZE[1]], frame)
    small = small.replace(albedo=(truth + noise).astype(np.float32))
    found = prefiltering.prefiltered(small, {"albedo": np.full(truth.shape, 0.01, np.float32)})
    assert np.abs(found.albedo - truth).mean() < 0.4 * np.abs(noise).mean()
    with pytest.raises(
        ValueError, match="a variance of the normal is given, and this frame has none"
    ):
        prefiltering.prefiltered(small, {"normal": small.albedo})
    with pytest.raises(ValueError, match="variances is 'color'"):
        prefiltering.prefiltered(small, {"color": small.color})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": 0}, "radius is 0"),
        ({"patch": 1.5}, "patch is 1.5"),
        ({"bandwidths": ()}, "bandwidths is"),
        ({"bandwidths": (1.0, -1.0)}, "bandwidths is"),
        ({"ridge": 0.0}, "ridge is 0.0"),
        ({"inputs": ("color",)}, "inputs is 'color'"),
        ({"precision": "low"}, "precision is 'low'"),
    ],
)
def test_wrong_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        NFOR(**settings)


def test_by_name():
    assert pd.denoisers.load("nfor") == NFOR()
    assert "nfor" in pd.denoisers.names()
    assert NFOR().receptive_radius == 2 * 9 + 3 + 9
    with pytest.raises(ValueError, match="exposure is 2"):
        pd.denoisers.load("nfor", exposure=2)
    with pytest.raises(ValueError, match="this frame has no variance: give one"):
        NFOR()(FRAME.replace(variance=None))
