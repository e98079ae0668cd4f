"""Cones that end early, against dense Jacobians of what they let through, in float64."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import dense_jacobian_diagonal, divergence_and_error
from test_exact import PLAIN, blur, network

import progden_jax as pd
from progden_jax.denoisers import graph
from progden_jax.denoisers.graph import Conv, Input, MaxPool, Relu, Upsample
from progden_jax.divergence import windows

POOLED = (
    *(Input(), Conv((0,), "a"), Relu(1), MaxPool(2), Conv((3,), "b"), Upsample(4)),
    Conv((5, 2), "last"),
)
LAST = (Input(), Conv((0,), "last"))


@pytest.fixture(scope="module")
def pooled():
    """A network, x and a variance, and the divergence without pooling, with some whole windows, and exact."""
    net, rng = network(POOLED, seed=4), np.random.default_rng(3)
    methods = {
        "short": pd.TruncatedCone(levels=1, radius=None, whole=0),
        "some": pd.TruncatedCone(levels=1, radius=None, whole=0.2),
        "whole": pd.Exact("cone"),
    }
    with jax.enable_x64(True):
        x = jnp.asarray(rng.random((4, 7, 3)) + 0.1)
        variance = jnp.asarray(rng.random(x.shape))

        @jax.jit
        def all_of(x):
            return [pd.divergence(net, x, variance, method=m) for m in methods.values()]

        found = dict(zip(methods, map(np.asarray, all_of(x)), strict=True))
    return SimpleNamespace(net=net, x=x, variance=np.asarray(variance), methods=methods, **found)


def test_pooling_below_the_levels_counts_as_constant(pooled):
    def through_the_finest(x):
        shown = pooled.net.layered(x)
        near, deep = (
            graph.evaluate(POOLED[:n], shown.params, shown.inputs)[0] for n in (3, len(POOLED) - 1)
        )
        joined = jnp.concatenate([jax.lax.stop_gradient(deep), near], -1)
        output, _ = graph.evaluate(LAST, shown.params, joined)
        return jnp.tanh(output[: x.shape[0], : x.shape[1]])

    with jax.enable_x64(True):
        diagonal = dense_jacobian_diagonal(jax.jit(through_the_finest), pooled.x)
    expected = pooled.variance * np.asarray(diagonal)
    np.testing.assert_allclose(pooled.short, expected, rtol=1e-9, atol=1e-12)
    assert np.abs(pooled.whole - expected).max() > 1e-3


@pytest.mark.parametrize("levels", [2, 3])
def test_with_all_levels_windows_are_those_of_the_exact_divergence(pooled, levels):
    plan, full = (
        windows.plan(POOLED, pooled.net.params, **limits) for limits in ({"levels": levels}, {})
    )
    assert (plan.period, plan.levels) == (full.period, full.levels) == (2, full.levels)
    for ours, theirs in zip(plan.windows, full.windows, strict=True):
        assert ours is not None
        assert theirs is not None
        assert ours.size == theirs.size
        np.testing.assert_array_equal(ours.origin, theirs.origin)


def test_the_largest_variances_get_whole_windows(pooled):
    """Two of each of the four phases of the padded image."""
    largest = pooled.variance.max(-1)
    chosen = np.zeros(largest.shape, bool)
    for phase in np.ndindex(2, 2):
        part = tuple(slice(first, None, 2) for first in phase)
        chosen[part] = largest[part] >= np.sort(largest[part].ravel())[-2]  # ⌈0.2·8⌉
    np.testing.assert_allclose(pooled.some[chosen], pooled.whole[chosen], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(pooled.some[~chosen], pooled.short[~chosen])
    assert not np.allclose(pooled.short[chosen], pooled.whole[chosen], rtol=1e-3)
    short, some = (pooled.methods[name].cost(pooled.net, pooled.x) for name in ("short", "some"))
    exact = pd.Exact().cost(pooled.net, pooled.x)["cone"]
    assert some == pytest.approx(short + exact / 4)


def test_windows_of_the_coarsest_level_end_at_the_radius():
    net = network(PLAIN, sizes=(5,), seed=5)
    values = np.random.default_rng(3).random((3, 6, 3)) + 0.1

    def middle(x):
        shown = net.layered(x)
        return graph.evaluate(PLAIN[:3], shown.params, shown.inputs)[0]

    def end(h):
        return jnp.tanh(graph.evaluate(LAST, net.layered(x).params, h)[0])

    def apart(size):
        return np.abs(np.subtract.outer(np.arange(size), np.arange(size)))

    near = np.maximum(apart(3)[:, None, :, None], apart(6)[None, :, None, :]) <= 1
    method = pd.TruncatedCone(levels=1, radius=1, whole=0)
    with jax.enable_x64(True):
        x = jnp.asarray(values)
        before, after = jax.jit(jax.jacobian(middle))(x), jax.jit(jax.jacobian(end))(middle(x))
        found = jax.jit(lambda x: pd.divergence(net, x, jnp.ones_like(x), method=method))(x)
    expected = np.einsum("ijcklm,ijkl,klmijc->ijc", after, near, before)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    cost = method.cost(net, x)
    assert cost == pd.TruncatedCone(levels=1, radius=(1,), whole=0).cost(net, x)
    assert cost < pd.TruncatedCone(radius=None, whole=0).cost(net, x)
    assert pd.TruncatedCone(radius=None, whole=0).cost(net, x) == pd.Exact().cost(net, x)["cone"]


def test_the_key_does_not_matter_and_the_error_is_unknown():
    """And a batch is each image alone."""
    f, method = network(PLAIN, sizes=(3, 3), seed=5), pd.TruncatedCone(radius=1)
    x = jnp.asarray(np.random.default_rng(0).random((2, 6, 7, 3)), jnp.float32)
    results = [
        divergence_and_error(f, x[0], x[1], method=method, key=jax.random.key(n)) for n in (0, 1)
    ]
    np.testing.assert_array_equal(results[0].divergence, results[1].divergence)
    assert np.isinf(results[0].standard_error).all()
    batch = jax.jit(jax.vmap(lambda x, variance: pd.divergence(f, x, variance, method=method)))
    both = batch(x, x[::-1])
    np.testing.assert_allclose(both[0], results[0].divergence, rtol=1e-4, atol=1e-7)


def test_messages():
    x = jnp.ones((4, 4, 3))
    with pytest.raises(ValueError, match="levels is 0, expected"):
        pd.TruncatedCone(levels=0)
    with pytest.raises(ValueError, match="radius is 0, expected"):
        pd.TruncatedCone(levels=2, radius=(1, 0))
    with pytest.raises(ValueError, match="expected one number per level"):
        pd.TruncatedCone(levels=3, radius=(1, 2))
    with pytest.raises(ValueError, match="whole is 2, expected a share"):
        pd.TruncatedCone(whole=2)
    with pytest.raises(ValueError, match="f, a function, does not show its layers"):
        pd.divergence(blur, x, x, method=pd.TruncatedCone())
