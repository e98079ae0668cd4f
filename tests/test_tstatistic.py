"""The t-bound against a dense float64 program of its definition, and its limits."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, ndtr

import progden_jax as pd
from progden_jax import _program, _windows


def dense_t_bound(alpha, x, y, variance, a=2.0, c=4.2, window=11, shift=True, sigmoid="normal"):
    """Pixel by pixel, in float64, as the definition reads."""
    alpha, x, y, variance = (np.asarray(v, np.float64) for v in (alpha, x, y, variance))
    height, width, _ = x.shape
    r = window // 2
    s = max(100 * math.sqrt(min(max(variance.mean(), 0), 1)), 1e-3)
    d = alpha * (y - x)
    result = np.zeros_like(alpha)
    for i in range(height):
        for j in range(width):
            numerator = noise = 0.0
            for channel in range(3):
                best, best_d = -1.0, 0.0
                for k in range(i - r, i + r + 1):
                    for m in range(j - r, j + r + 1):
                        if not (0 <= k < height and 0 <= m < width):
                            continue
                        distance = (k - i) ** 2 + (m - j) ** 2
                        kappa = math.exp(-distance / (2 * s * s)) / (s * math.sqrt(2 * math.pi))
                        numerator += kappa * d[k, m, channel]
                        noise += kappa**2 * variance[k, m, channel]
                        if variance[k, m, channel] > best:
                            best, best_d = variance[k, m, channel], d[k, m, channel]
                if shift:
                    numerator += best_d / 3
                    noise += best / 9
            t = abs(numerator) / (math.sqrt(max(noise, 0)) + 1e-6)
            S = ndtr if sigmoid == "normal" else expit
            result[i, j] = alpha[i, j] * (1 - S(a * (t - c)))
    return result


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"sigmoid": "logistic"},
        {"window": 3, "a": 1.0, "c": 2.0},
        {"window": 1},
        {"shift": False},
        {"shift": False, "window": 5},
    ],
)
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 0.1, 10.0])
def test_against_the_definition(images, scale, settings):
    """Over noise levels from where the kernel is one pixel to where it is flat."""
    variance = scale * images.variance
    alpha = np.random.default_rng(0).random(images.x.shape).astype(np.float32)
    # Differences of a few standard deviations of the window's mean, where the bound is neither 0 nor 1.
    y = images.x + np.float32(math.sqrt(scale)) * (images.y - images.x)
    expected = dense_t_bound(alpha, images.x, y, variance, **settings)
    with jax.enable_x64(True):
        wide = [jnp.asarray(v, jnp.float64) for v in (alpha, images.x, y, variance)]
        np.testing.assert_allclose(pd.t_bound(*wide, **settings), expected, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(
        pd.t_bound(alpha, images.x, y, variance, **settings), expected, rtol=1e-3, atol=1e-5
    )


def test_ties_go_to_the_first_in_raster_order():
    rng = np.random.default_rng(1)
    keys = rng.integers(0, 3, (12, 15, 2)).astype(np.float32)
    payload = rng.random(keys.shape).astype(np.float32)
    highest, there = _windows.argmax_payload(jnp.asarray(keys), jnp.asarray(payload), 5)
    for i in range(12):
        for j in range(15):
            for c in range(2):
                window = keys[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3, c]
                row, column = np.unravel_index(window.argmax(), window.shape)
                assert highest[i, j, c] == window.max()
                assert there[i, j, c] == payload[max(i - 2, 0) + row, max(j - 2, 0) + column, c]


@pytest.mark.parametrize("window", [1, 3, 5, 7, 11, 15, 21])
def test_box_sums(window):
    values = np.random.default_rng(2).random((9, 30, 3))
    r = window // 2
    padded = np.pad(values, ((r, r), (r, r), (0, 0)))
    expected = sum(padded[i : i + 9, j : j + 30] for i in range(window) for j in range(window))
    np.testing.assert_allclose(
        _windows.box_sum(jnp.asarray(values, jnp.float32), window), expected, rtol=1e-5
    )


@pytest.mark.parametrize("shift", [True, False])
def test_padding_outside_counts_as_outside(images, shift):
    alpha = np.full_like(images.x, 0.8)
    expected = pd.t_bound(alpha, images.x, images.y, images.variance, shift=shift)
    pad = [(0, 6), (0, 5), (0, 0)]
    inside = np.pad(np.ones((13, 18, 1), bool), pad)
    padded = [np.pad(v, pad) for v in (alpha, images.x, images.y, images.variance)]
    np.testing.assert_allclose(
        pd.t_bound(*padded, inside=inside, shift=shift)[:13, :18], expected, rtol=1e-5, atol=1e-7
    )


def test_converges_to_the_render_as_variance_falls(images):
    """With bias fixed and noise falling, α falls to 0 and the mix to x: the paper's constraint."""
    alpha = np.ones_like(images.x)
    y = images.x + 0.1
    means = [
        float(pd.t_bound(alpha, images.x, y, images.variance * s + s).mean())
        for s in (1.0, 1e-2, 1e-4, 1e-6)
    ]
    assert means == sorted(means, reverse=True)
    assert means[-1] < 1e-6


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    level=st.floats(-6, 6),
    size=st.sampled_from([(1, 1), (2, 13), (9, 1)]),
)
def test_the_bound_only_lowers_and_the_mix_stays_between(seed, level, size):
    rng = np.random.default_rng(seed)
    x = (10**level * rng.gamma(1, 1, (*size, 3))).astype(np.float32)
    y = (10**level * rng.gamma(1, 1, x.shape)).astype(np.float32)
    variance = (x**2 * rng.random(x.shape) ** 8).astype(np.float32)
    alpha = rng.random(x.shape).astype(np.float32)
    bounded = np.asarray(pd.t_bound(alpha, x, y, variance))
    assert ((bounded >= 0) & (bounded <= alpha)).all()
    mix = x + bounded * (y - x)
    slack = 1e-6 * np.maximum(np.abs(x), np.abs(y))
    assert ((mix >= np.minimum(x, y) - slack) & (mix <= np.maximum(x, y) + slack)).all()


def test_gradients_are_finite(images):
    def total(alpha, x, y, variance):
        return pd.t_bound(alpha, x, y, variance).sum()

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))
    alpha = np.full_like(images.x, 0.5)
    for scale in np.float32([0.0, 1e-8, 1.0]):
        gradients = slopes(alpha, images.x, images.y, scale * images.variance)
        assert all(np.isfinite(g).all() for g in gradients), scale


def test_gradient_against_differences(images):
    with jax.enable_x64(True):
        x, y, variance = (
            jnp.asarray(v, jnp.float64) for v in (images.x, images.y, 0.1 + images.variance)
        )
        y = x + 0.05 * (y - x)
        alpha = jnp.full_like(x, 0.5)
        jax.test_util.check_grads(
            lambda a, y: pd.t_bound(a, x, y, variance), (alpha, y), order=1, modes=["fwd", "rev"]
        )


def test_messages(images):
    alpha = np.ones_like(images.x)
    with pytest.raises(ValueError, match="window is 4, expected an odd whole number"):
        pd.t_bound(alpha, images.x, images.y, images.variance, window=4)
    with pytest.raises(ValueError, match="sigmoid is 'erf', expected one of 'normal', 'logistic'"):
        pd.t_bound(alpha, images.x, images.y, images.variance, sigmoid="erf")
    with pytest.raises(ValueError, match="alpha has shape"):
        pd.t_bound(alpha[:5], images.x, images.y, images.variance)


def test_a_bound_is_checked_when_it_is_made():
    for chosen, match in (
        ({"a": 0.0}, "a is 0.0, expected a steepness"),
        ({"c": float("nan")}, "c is nan, expected a finite number"),
        ({"window": 4}, "window is 4, expected an odd"),
        ({"sigmoid": "tanh"}, "sigmoid is 'tanh', expected one of 'normal', 'logistic'"),
    ):
        with pytest.raises(ValueError, match=match):
            pd.Bound(**chosen)


def test_the_chain_takes_other_bounds_in_one_program(images):
    """Every a and c by one program; without a bound α is the mixer's."""
    frame = pd.Frame(images.x, images.variance)
    denoiser = pd.FunctionDenoiser(lambda x: 0.6 * x + 0.1)
    free = pd.progressive_denoise(frame, denoiser, bound=False)
    before = _program.progressive._cache_size()
    for bound in (pd.Bound(), pd.Bound(a=1.0, c=0.5), pd.Bound(c=-3.0)):
        found = pd.progressive_denoise(frame, denoiser, bound=bound)
        expected = bound(free.alpha, frame.color, free.denoised, frame.variance)
        np.testing.assert_allclose(found.alpha, expected, rtol=1e-5, atol=1e-6)
    assert _program.progressive._cache_size() == before + 1


def test_nothing_is_skipped_that_a_bound_would_not_hold_back():
    frame = pd.Frame(np.ones((32, 32, 3), np.float32), np.zeros((32, 32, 3), np.float32))
    denoiser = pd.FunctionDenoiser(lambda x: 0.6 * x)
    for bound, pixels in ((True, 32 * 32), (pd.Bound(window=13), 0)):
        result = pd.progressive_denoise(frame, denoiser, bound=bound, outputs=["image"])
        assert result.skipped.pixels == pixels
