"""Cones that end early, against dense Jacobians of what they let through, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import dense_jacobian_diagonal
from test_exact import PLAIN, blur, network

import progden_jax as pd
from progden_jax.denoisers import graph
from progden_jax.denoisers.graph import Conv, Input, MaxPool, Relu, Upsample

POOLED = (
    *(Input(), Conv((0,), "a"), Relu(1), MaxPool(2), Conv((3,), "b"), Upsample(4)),
    Conv((5, 2), "last"),
)
LAST = (Input(), Conv((0,), "last"))


@pytest.fixture
def x():
    with jax.enable_x64(True):
        yield jnp.asarray(np.random.default_rng(3).random((4, 7, 3)) + 0.1)


def found(f, x, method):
    return jax.jit(lambda x: pd.divergence(f, x, jnp.ones_like(x), method=method))(x)


def test_pooling_below_the_levels_counts_as_constant(x):
    net = network(POOLED, seed=4)

    def through_the_finest(x):
        shown = net.layered(x)
        near, deep = (
            graph.evaluate(POOLED[:n], shown.params, shown.inputs)[0] for n in (3, len(POOLED) - 1)
        )
        joined = jnp.concatenate([jax.lax.stop_gradient(deep), near], -1)
        output, _ = graph.evaluate(LAST, shown.params, joined)
        return jnp.tanh(output[: x.shape[0], : x.shape[1]])

    expected = dense_jacobian_diagonal(jax.jit(through_the_finest), x)
    method = pd.TruncatedCone(levels=1, radius=None)
    np.testing.assert_allclose(found(net, x, method), expected, rtol=1e-9, atol=1e-12)
    whole = found(net, x, pd.Exact("cone"))
    every = found(net, x, pd.TruncatedCone(levels=2, radius=None))
    np.testing.assert_array_equal(every, whole)
    assert np.abs(whole - expected).max() > 1e-3


def test_windows_of_the_coarsest_level_end_at_the_radius(x):
    net = network(PLAIN, sizes=(5,), seed=5)
    x = x[:3, :6]

    def middle(x):
        shown = net.layered(x)
        return graph.evaluate(PLAIN[:3], shown.params, shown.inputs)[0]

    def end(h):
        return jnp.tanh(graph.evaluate(LAST, net.layered(x).params, h)[0])

    def apart(size):
        return np.abs(np.subtract.outer(np.arange(size), np.arange(size)))

    near = np.maximum(apart(3)[:, None, :, None], apart(6)[None, :, None, :]) <= 1
    before, after = jax.jit(jax.jacobian(middle))(x), jax.jit(jax.jacobian(end))(middle(x))
    expected = np.einsum("ijcklm,ijkl,klmijc->ijc", after, near, before)
    method = pd.TruncatedCone(levels=1, radius=1)
    np.testing.assert_allclose(found(net, x, method), expected, rtol=1e-9, atol=1e-12)
    assert method.cost(net) < pd.TruncatedCone(radius=None).cost(net)
    assert method.cost(net) == pd.TruncatedCone(levels=1, radius=(1,)).cost(net)
    assert pd.TruncatedCone(radius=None).cost(net) == pd.Exact().cost(net, x)["cone"]


def test_the_key_does_not_matter_and_the_error_is_unknown(near_sighted, real_frame):
    """Near-sighted as KPCN is; and a batch is each image alone."""
    frame = jax.tree.map(lambda a: a[40:48, 30:40] if a.ndim else a, real_frame)
    f, method = near_sighted.bind(frame), pd.TruncatedCone(radius=2)
    x, variance = np.asarray(frame.color), np.asarray(frame.variance)
    results = [
        pd.divergence_and_error(f, x, variance, method=method, key=jax.random.key(n))
        for n in (0, 1)
    ]
    np.testing.assert_array_equal(results[0].divergence, results[1].divergence)
    assert np.isinf(results[0].standard_error).all()
    both = jax.vmap(lambda x: pd.divergence(f, x, variance, method=method))(np.stack([x, 2 * x]))
    np.testing.assert_allclose(both[0], results[0].divergence, rtol=1e-4, atol=1e-7)


def test_messages():
    x = jnp.ones((4, 4, 3))
    with pytest.raises(ValueError, match="levels is 0, expected"):
        pd.TruncatedCone(levels=0)
    with pytest.raises(ValueError, match="radius is 0, expected"):
        pd.TruncatedCone(levels=2, radius=(1, 0))
    with pytest.raises(ValueError, match="expected one number per level"):
        pd.TruncatedCone(levels=3, radius=(1, 2))
    with pytest.raises(ValueError, match="f, a function, does not show its layers"):
        pd.divergence(blur, x, x, method=pd.TruncatedCone())
