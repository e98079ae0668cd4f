"""SURE, the features, the mixing network's definition, and the closed-form α."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from code_generation import as_for_users
from conftest import drawn
from hypothesis import given, settings
from hypothesis import strategies as st

import progden_jax as pd
from progden_jax.mixing import f_act


def test_sure_is_unbiased_for_a_linear_filter():
    """Shrinking towards 0 by 0.7: the mean of SURE over many noisy images is the true error."""
    rng = np.random.default_rng(0)
    truth = rng.random((8, 8, 3))
    variance = 0.05 * (0.5 + rng.random(truth.shape))
    draws = 4000
    x = truth + np.sqrt(variance) * rng.normal(size=(draws, *truth.shape))
    risk = np.asarray(
        pd.sure(
            x, 0.7 * x, np.broadcast_to(variance, x.shape), np.broadcast_to(0.7 * variance, x.shape)
        )
    )
    error = (0.7 * x - truth) ** 2
    difference = (risk - error).mean((1, 2, 3))
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(draws)
    assert difference.std() / np.sqrt(draws) < 0.01 * error.mean()


def test_sure_by_hand_and_not_clipped():
    x, y, v, d = (np.full((1, 1, 3), value, np.float32) for value in (1.0, 1.5, 2.0, 0.25))
    np.testing.assert_allclose(pd.sure(x, y, v, d), np.full((1, 1, 3), 0.25 + 0.5 - 2.0))


def test_features_by_hand(images):
    images.x[0, 0] = -1
    risk = np.asarray(pd.sure(images.x, images.y, images.variance, images.divergence))
    features = np.asarray(pd.mixing_features(images.x, images.y, images.variance, risk))
    assert features.shape == (13, 18, 18)
    squared = (images.y - images.x) ** 2
    expected = [
        np.maximum(images.x, 0),
        np.maximum(images.y, 0),
        np.arctan(images.variance),
        np.arctan(risk),
        np.arctan(squared),
        np.arctan(risk + images.variance - squared),
    ]
    np.testing.assert_allclose(features, np.concatenate(expected, -1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(features[..., 15:], np.arctan(2 * images.divergence), atol=1e-5)


def test_features_are_symmetric_under_the_swap(images):
    """(x, σ²) with (y, SURE): the other six channels stay (the paper's swap training rests on it)."""
    risk = np.asarray(pd.sure(images.x, images.y, images.variance, images.divergence))
    one = np.asarray(pd.mixing_features(images.x, images.y, images.variance, risk))
    other = np.asarray(pd.mixing_features(images.y, images.x, risk, images.variance))
    order = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8, *range(12, 18)]
    np.testing.assert_allclose(other, one[..., order], rtol=1e-6, atol=1e-6)


def test_network_has_the_contract_shape():
    net = pd.MixingNet()
    form = jax.eval_shape(net.init, jax.random.key(0), jnp.zeros((8, 9, 18)))["params"]
    params = drawn(form)
    shapes = {k: (v["kernel"].shape, v["bias"].shape) for k, v in params.items()}
    assert shapes == {
        "conv_in": ((5, 5, 18, 48), (48,)),
        **{f"block{b}_conv{c}": ((3, 3, 48, 48), (48,)) for b in (1, 2) for c in (1, 2)},
        "conv_out": ((3, 3, 48, 9), (9,)),
    }
    assert sum(p.size for p in jax.tree.leaves(params)) == 108_681
    features = np.random.default_rng(1).normal(size=(2, 8, 9, 18)).astype(np.float32)
    apply = jax.jit(net.apply)
    alpha = np.asarray(apply({"params": params}, features))
    assert alpha.shape == (2, 8, 9, 3)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    np.testing.assert_allclose(alpha[1], apply({"params": params}, features[1]), atol=1e-5)
    with pytest.raises(ValueError, match="features has shape"):
        net.apply({"params": params}, features[..., :17])


def test_network_against_a_plain_convolution():
    """Order of layers, padding and residuals, in float64 by sums over taps."""
    net = pd.MixingNet(width=5)
    features = np.random.default_rng(0).normal(size=(6, 7, 18))
    form = jax.eval_shape(net.init, jax.random.key(3), jnp.zeros((6, 7, 18)))["params"]
    params = jax.tree.map(lambda p: p + np.float32(0.05), drawn(form))

    def conv(x, name):
        kernel, bias = params[name]["kernel"], params[name]["bias"]
        r = kernel.shape[0] // 2
        padded = np.pad(x, ((r, r), (r, r), (0, 0)))
        return bias + sum(
            padded[i : i + x.shape[0], j : j + x.shape[1]] @ kernel[i, j]
            for i in range(2 * r + 1)
            for j in range(2 * r + 1)
        )

    h = np.maximum(conv(features, "conv_in"), 0)
    for b in ("block1", "block2"):
        h = np.maximum(h + conv(np.maximum(conv(h, b + "_conv1"), 0), b + "_conv2"), 0)
    x1, x2, x3 = np.split(conv(h, "conv_out"), 3, axis=-1)
    expected = np.clip((x1 - x2) / np.maximum(x3, 1e-6), 0, 1)
    found = jax.jit(net.apply)({"params": params}, features.astype(np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_activation_and_its_gradient_at_the_singularity():
    x = jnp.asarray([0.5, -1.0, 0.0, 2.0])
    np.testing.assert_allclose(f_act(x, jnp.zeros(4), jnp.ones(4)), [0.5, 0, 0, 1])
    for x3 in (0.0, 1e-6, -1.0, 1e-9):
        gradients = jax.grad(lambda a, b, c: f_act(a, b, c), argnums=(0, 1, 2))(0.0, 0.0, x3)
        assert all(np.isfinite(g) for g in gradients)


@pytest.mark.parametrize("confidence", [0.0, 1.0])
def test_closed_form_against_the_definition(images, confidence):
    window, r = 5, 2
    expected = np.zeros_like(images.x, np.float64)
    largest = images.variance.astype(np.float64)
    for i in range(13):
        for j in range(18):
            around = images.variance[max(i - r, 0) : i + r + 1, max(j - r, 0) : j + r + 1]
            largest[i, j] = np.maximum(largest[i, j], around.mean((0, 1)))
    for i in range(13):
        for j in range(18):
            area = np.s_[max(i - r, 0) : i + r + 1, max(j - r, 0) : j + r + 1]
            top = (images.variance[area] - images.divergence[area]).sum((0, 1))
            bottom = ((images.y[area] - images.x[area]) ** 2).sum((0, 1))
            squared = (images.y[area].astype(float) - images.x[area]) ** 2
            excess = squared - images.variance[area] + images.divergence[area]
            error = np.sqrt(np.minimum(excess**2, 4 * squared * largest[area]).sum((0, 1)))
            bias = bottom - top - confidence * error
            expected[i, j] = 1 - np.clip(bias / bottom, 0, 1)
    found = pd.closed_form_alpha(
        images.x,
        images.y,
        images.variance,
        images.divergence,
        window=window,
        confidence=confidence,
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_closed_form_is_the_best_constant_mix():
    """On normal noise with a linear filter it finds the α of least error to within sampling error."""
    rng = np.random.default_rng(0)
    truth = np.ones((200, 200, 3))
    sigma, shrink, offset = 0.3, 0.2, 0.5
    x = truth + sigma * rng.normal(size=truth.shape)
    y = shrink * x + offset
    variance = np.full_like(x, sigma**2)
    alpha = pd.closed_form_alpha(x, y, variance, shrink * variance, window=199)[100, 100]
    ((a, b),) = [(((truth - x) * (y - x)).mean((0, 1)), ((y - x) ** 2).mean((0, 1)))]
    np.testing.assert_allclose(alpha, a / b, atol=0.02)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), level=st.floats(-6, 6), flat=st.booleans())
def test_closed_form_is_a_weight_with_finite_gradients(seed, level, flat):
    rng = np.random.default_rng(seed)
    x = (10**level * rng.random((7, 6, 3))).astype(np.float32)
    y = x if flat else (10**level * rng.random(x.shape)).astype(np.float32)
    variance = (rng.random(x.shape) * x**2).astype(np.float32)
    divergence = (rng.normal(size=x.shape) * variance).astype(np.float32)
    alpha, gradient = jax.value_and_grad(
        lambda y: pd.closed_form_alpha(x, y, variance, divergence, window=3, confidence=1.0).sum()
    )(y)
    assert np.isfinite(alpha)
    assert np.isfinite(gradient).all()
    alpha = np.asarray(pd.closed_form_alpha(x, y, variance, divergence, window=3))
    assert ((alpha >= 0) & (alpha <= 1)).all()


@pytest.mark.parametrize("confidence", [0.0, 0.7])
def test_gradient_of_the_compiled_closed_form(confidence):
    """Reverse mode through a jitted call against forward mode in float64; a compiler once got this wrong."""
    rng = np.random.default_rng(0)
    x = rng.gamma(1, 1, (16, 16, 3))
    variance = 0.1 * x**2 * (rng.random(x.shape) > 0.3)
    arrays = (x, 0.5 * x + 0.5, variance, 0.2 * variance, rng.normal(size=x.shape))

    def total(s, x, y, variance, divergence, direction):
        y = y + s * direction
        settings = {"confidence": confidence, "window": 7}
        return pd.closed_form_alpha(x, y, variance, divergence, **settings).sum()

    @jax.jit
    def both(s, *arrays):
        forward = jax.jvp(lambda s: total(s, *arrays), (s,), (jnp.ones_like(s),))[1]
        return forward, jax.grad(total)(s, *arrays)

    with jax.enable_x64(True):
        forward, reverse = both(np.float64(0), *arrays)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)

    # As users compile it: in two programs, as `jax.grad` of a jitted function is, and in one.
    compiled = functools.partial(jax.jit, compiler_options=as_for_users())
    given = [np.float32(a) for a in (0, *arrays)]
    linear = compiled(lambda s, *arrays: jax.vjp(lambda s: total(s, *arrays), s)[1])
    apart = compiled(lambda pull, by: pull(by)[0])(linear(*given), np.float32(1))
    for found in (apart, compiled(jax.grad(total))(*given)):
        np.testing.assert_allclose(found, forward, rtol=2e-3)


def test_confidence_vanishes_with_the_noise(images):
    """With the denoiser's bias fixed, α tends to 0 as the variance does, with and without it."""
    y = images.x + 0.1
    for confidence in (0.0, 1.0):
        means = []
        for scale in (1.0, 1e-2, 1e-4, 1e-6):
            variance = scale * (0.1 + images.variance)
            alpha = pd.closed_form_alpha(
                images.x, y, variance, 0.1 * variance, window=5, confidence=confidence
            )
            means.append(float(alpha.mean()))
        assert means == sorted(means, reverse=True)
        assert means[-1] < 0.01


def test_messages(images):
    with pytest.raises(ValueError, match="divergence has shape"):
        pd.sure(images.x, images.y, images.variance, images.divergence[:4])
    with pytest.raises(ValueError, match="y has shape"):
        pd.mixing_features(images.x, images.y[:, :4], images.variance, images.variance)
    with pytest.raises(ValueError, match="confidence is -1, expected a number of standard errors"):
        pd.ClosedForm(confidence=-1)
    with pytest.raises(ValueError, match="window is 2, expected an odd"):
        pd.ClosedForm(window=2)
