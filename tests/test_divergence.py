"""Estimators of the divergence against known diagonals, dense Jacobians and their own statistics."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    counting_compilations,
    dense_jacobian_diagonal,
    divergence,
    divergence_and_error,
)

import progden_jax as pd
from progden_jax.divergence import _random

METHODS = {
    "differences": pd.FiniteDifference(probes=8, epsilon=1e-2),
    "rademacher": pd.MonteCarlo(probes=8),
    "gaussian": pd.MonteCarlo(probes=8, distribution="gaussian"),
    "probing": pd.Probing(probes=8, replicates=4),
    "adaptive": pd.Probing(probes=8, replicates=4, tolerance=1e-6, tile=4),
}
SWEEP = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())


def blur(x):
    """A linear filter of known diagonal: 0.3 at home, the rest spread over neighbours and channels."""
    near = sum(jnp.roll(x, shift, axis) for shift in (-1, 1) for axis in (0, 1))
    return 0.3 * x + 0.1 * near + 0.05 * jnp.roll(x, 1, 2)


def curved(x):
    return jnp.tanh(blur(x)) * (1 + 0.1 * x)


def inputs():
    x = np.random.default_rng(0).gamma(2.0, 0.5, (6, 7, 3)).astype(np.float32)
    return jnp.asarray(x), jnp.asarray(np.float32(0.01) * x**2)


@pytest.fixture
def x():
    return inputs()[0]


@pytest.fixture
def variance():
    return inputs()[1]


@functools.cache
def estimates(method, count=400):
    """Divergences of `curved` and their standard errors for many keys, one after the other."""
    keys = jax.random.split(jax.random.key(1), count)

    @jax.jit
    def run(x, variance, keys):
        def one(key):
            return pd.divergence_and_error(curved, x, variance, method=method, key=key)

        return jax.lax.map(one, keys)

    return jax.tree.map(lambda a: np.asarray(a, np.float64), run(*inputs(), keys))


@pytest.fixture(scope="module")
def truth():
    x, variance = inputs()
    return np.asarray(variance) * dense_jacobian_diagonal(curved, np.asarray(x))


@SWEEP
def test_unbiased_within_standard_error(method, truth):
    """The mean over many keys is the exact value within five standard errors, at every pixel."""
    found = estimates(method).divergence
    error = found.std(0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(found.mean(0) - truth) < 5 * error + 2e-5 * np.abs(truth)).all()
    # And the test has power: the standard error is small beside the value.
    assert np.median(error / np.abs(truth)) < 0.1


def test_rademacher_variance_is_the_closed_form(x, variance):
    """Var = σ_i² Σ_{j≠i} J_ij² σ_j² per probe; Gaussian probes add 2 σ_i⁴ J_ii²."""
    n = x.size
    jacobian = np.asarray(jax.jit(jax.jacfwd(curved))(x)).reshape(n, n)
    sigma2 = np.asarray(variance).ravel()
    off = jacobian**2 @ sigma2 - np.diag(jacobian) ** 2 * sigma2
    expected = {
        "rademacher": sigma2 * off,
        "gaussian": sigma2 * off + 2 * sigma2**2 * np.diag(jacobian) ** 2,
    }
    for distribution, value in expected.items():
        samples = estimates(pd.MonteCarlo(probes=1, distribution=distribution), 4000).divergence
        measured = samples.reshape(-1, n).var(0, ddof=1)
        np.testing.assert_allclose(measured.sum(), value.sum(), rtol=0.03)
        np.testing.assert_allclose(measured, value, rtol=0.5)


@SWEEP
def test_standard_error_tells_the_spread(method):
    found = estimates(method)
    spread = found.divergence.var(0, ddof=1).mean()
    np.testing.assert_allclose((found.standard_error**2).mean(), spread, rtol=0.1)


def test_standard_error_of_one_probe_is_unknown(x, variance):
    found = divergence_and_error(blur, x, variance, method=pd.MonteCarlo(probes=1))
    assert np.isinf(found.standard_error).all()
    assert np.isfinite(found.divergence).all()


@SWEEP
def test_jit_vmap_and_chunks_agree_with_the_plain_call(method, x, variance):
    key = jax.random.key(5)
    plain = pd.divergence_and_error(curved, x, variance, method=method, key=key)

    @jax.jit
    def run(x, variance):
        def one(x, variance, *, method):
            return pd.divergence_and_error(curved, x, variance, method=method, key=key)

        # All at once for the batch, in chunks with a rest for one.
        together, chunked = (
            functools.partial(one, method=dataclasses.replace(method, chunk=n)) for n in (8, 3)
        )
        batch = jax.vmap(together)(jnp.stack([x, 2 * x]), jnp.stack([variance, variance]))
        return jax.tree.map(lambda a: a[0], batch), chunked(x, variance)

    for found in run(x, variance):
        np.testing.assert_allclose(found.divergence, plain.divergence, rtol=2e-3, atol=2e-7)
        np.testing.assert_allclose(found.standard_error, plain.standard_error, rtol=2e-3, atol=2e-7)


@SWEEP
def test_dtype_is_kept(method, x, variance):
    found = functools.partial(pd.divergence, blur, method=method)
    assert jax.eval_shape(found, x, variance).dtype == jnp.float32
    with jax.enable_x64(True):
        wide = [np.asarray(a, np.float64) for a in (x, variance)]
        assert jax.eval_shape(found, *wide).dtype == jnp.float64


@SWEEP
def test_gradient_through_the_divergence(method, x, variance):
    """SURE as a training loss: derivatives with respect to a denoiser's parameter, in float64.

    Without variance the divergence is zero, and derivatives are finite.
    """
    with jax.enable_x64(True):
        x, variance = (jnp.asarray(np.asarray(a), jnp.float64) for a in (x, variance))

        # One program for the value and its derivative: compiling is what takes time here.
        @jax.jit
        @functools.partial(jax.value_and_grad, argnums=(0, 1), has_aux=True)
        def loss(weight, variance):
            def f(x):
                return jnp.tanh(weight * blur(x))

            estimate = pd.divergence(f, x, variance, method=method)
            return pd.sure(x, f(x), variance, estimate).mean(), estimate

        _, (gradient, _) = loss(1.3, variance)
        ends = [loss(1.3 + step, variance)[0][0] for step in (1e-5, -1e-5)]
        np.testing.assert_allclose(gradient, (ends[0] - ends[1]) / 2e-5, rtol=1e-5)

        (_, estimate), gradients = loss(1.3, np.zeros_like(variance))
        assert not np.asarray(estimate).any()
        assert all(np.isfinite(g).all() for g in gradients)


def homogeneous(x):
    """Of degree 1."""
    return jnp.sqrt(blur(x) ** 2 + x**2)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_directional_derivatives_do_not_depend_on_scale(scale, x, variance):
    method = pd.MonteCarlo(probes=4)
    expected = divergence(homogeneous, x, variance, method=method)
    scaled = divergence(homogeneous, scale * x, scale**2 * variance, method=method)
    np.testing.assert_allclose(scaled / scale**2, expected, rtol=1e-5)


def test_differences_lose_their_probe_where_derivatives_do_not():
    """At value 10 and σ 1e-3 a step of 1e-4·b is a tenth of float32's spacing: it rounds to nothing."""
    x = jnp.full((16, 16, 3), 10.0, jnp.float32)
    variance = jnp.full_like(x, 1e-6)
    exact = divergence(lambda x: 0.5 * x, x, variance, method=pd.MonteCarlo(probes=1))
    np.testing.assert_allclose(exact, 0.5 * variance, rtol=1e-5)
    differences = divergence(lambda x: 0.5 * x, x, variance, method=pd.FiniteDifference())
    assert float(differences.mean()) < 0.05 * 0.5e-6


@pytest.mark.parametrize("draw", [_random.normal, _random.signs])
def test_random_numbers_belong_to_pixels(draw):
    key = jax.random.key(4)
    small = draw(key, 2, jnp.zeros((5, 6, 3)))
    large = draw(key, 2, jnp.zeros((9, 16, 3)))
    np.testing.assert_array_equal(large[:5, :6], small)
    assert not np.array_equal(draw(key, 3, jnp.zeros((5, 6, 3))), small)


def test_random_numbers_have_their_moments_and_do_not_follow_one_another():
    """In standard errors: values, products of neighbours, of probes and keys, of four at a rectangle."""
    like = jnp.zeros((128, 128, 3))
    keys = [jax.random.key(0), jax.random.key(1), jax.random.key(1, impl="rbg")]
    keys += list(jax.random.split(jax.random.key(0), 2))
    draw = jax.jit(_random.signs)
    drawn = np.stack([[np.asarray(draw(key, probe, like)) for probe in range(4)] for key in keys])
    assert set(np.unique(drawn)) == {-1, 1}
    found = [drawn, drawn[:, 1:] * drawn[:, :-1], drawn[1:] * drawn[:-1]]
    for rows, columns in ((0, 1), (1, 0), (1, 1), (3, 8), (64, 32)):
        cut = drawn[:, :, rows:, columns:], drawn[:, :, : 128 - rows, : 128 - columns]
        across = drawn[:, :, rows:, : 128 - columns] * drawn[:, :, : 128 - rows, columns:]
        found += [cut[0] * cut[1]]
        if rows and columns:
            found += [cut[0] * cut[1] * across]
    found += [drawn[..., :2] * drawn[..., 1:], drawn.prod(-1)]
    for values in found:
        sums = values.sum(tuple(range(2, values.ndim))) / np.sqrt(np.prod(values.shape[2:]))
        assert np.abs(sums).max() < 5
    values = np.asarray(_random.normal(keys[0], 0, like), np.float64).ravel()
    for power, moment, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96), (6, 15, 10170)):
        error = (values**power).mean() - moment
        assert abs(error) < 5 * np.sqrt(variance / values.size)


def test_a_pytree_function_compiles_once(x, variance):
    method = pd.MonteCarlo(probes=3)

    def scaled_blur(weight, x):
        return weight * blur(x)

    first = pd.divergence(
        jax.tree_util.Partial(scaled_blur, jnp.float32(1)), x, variance, method=method
    )
    second = jax.tree_util.Partial(scaled_blur, jnp.float32(2))
    with counting_compilations() as compiled:
        twice = pd.divergence(second, x, variance, method=method)
    assert compiled == []
    np.testing.assert_allclose(twice, 2 * first, rtol=1e-5)


def test_messages(x, variance):
    method = pd.MonteCarlo()
    with pytest.raises(ValueError, match=r"x has shape \(6, 7\), expected \(height, width, 3\)"):
        pd.divergence(blur, x[..., 0], variance, method=method)
    with pytest.raises(ValueError, match="variance has shape"):
        pd.divergence(blur, x, variance[:3], method=method)
    with pytest.raises(ValueError, match="method is 'exact', expected an estimator"):
        pd.divergence(blur, x, variance, method="exact")
    with pytest.raises(ValueError, match="f is a float, expected a function"):
        pd.divergence(1.0, x, variance, method=method)
    with pytest.raises(ValueError, match="it must give one image of the same shape"):
        pd.divergence(lambda x: x[..., :1], x, variance, method=method)
    with pytest.raises(ValueError, match="probes is 0, expected a whole number of at least 1"):
        pd.MonteCarlo(probes=0)
    with pytest.raises(ValueError, match="expected one of 'rademacher', 'gaussian'"):
        pd.MonteCarlo(distribution="uniform")
    with pytest.raises(ValueError, match="epsilon is 0, expected a number above 0"):
        pd.FiniteDifference(epsilon=0)
