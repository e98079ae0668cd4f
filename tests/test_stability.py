"""What extreme numbers do to the divergence: scale, zeros, fireflies, small steps, coarse formats."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import dense_jacobian_diagonal
from jax import lax

import progden_jax as pd
from experiments.stability import rounding
from progden_jax.denoisers import oidn
from progden_jax.divergence import evaluate

METHODS = {
    "differences": pd.FiniteDifference(probes=3),
    "rademacher": pd.MonteCarlo(probes=3),
    "gaussian": pd.MonteCarlo(probes=3, distribution="gaussian"),
    "radiance": pd.Probing(probes=3),
    "sigma": pd.Probing(probes=3, scale="sigma"),
    "unit": pd.Probing(probes=3, scale="unit"),
    "basis": pd.Exact("basis"),
}
SWEEP = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
FIREFLY = 1e6


@functools.partial(jax.jit, static_argnames="method")
def run_bent(x, variance, method):
    return pd.divergence(bent, x, variance, method=method)


def blur(x):
    """3×3, zero outside the image, each channel by itself."""
    padded = jnp.pad(x, ((1, 1), (1, 1), (0, 0)))
    h, w = x.shape[:2]
    return sum(padded[i : i + h, j : j + w] / (2 + i + j) for i in range(3) for j in range(3))


def bent(x):
    """Homogeneous of degree 1 and not linear, as a network of ReLUs without biases is."""
    return jnp.maximum(blur(x) - 1.5 * x, 0.1 * x)


@pytest.fixture(scope="module")
def x():
    return jnp.asarray(np.random.default_rng(0).gamma(2.0, 0.5, (9, 11, 3)), jnp.float32)


@pytest.fixture(scope="module")
def small(real_frame):
    """A 16×16 crop of a render, OIDN's small network bound to it, and one that is bound in bfloat16."""
    window = np.s_[40:56, 30:46]
    frame = pd.Frame(real_frame.color[window], real_frame.variance[window])
    name = "oidn-hdr-small"
    return (
        frame,
        pd.denoisers.load(name).bind(frame),
        pd.denoisers.load(name, precision="bfloat16").bind(frame),
    )


def relative_rmse(a, b) -> float:
    a, b = (np.asarray(v, np.float64) for v in (a, b))
    return float(np.sqrt(((a - b) ** 2).mean() / (b**2).mean()))


@SWEEP
def test_a_power_of_two_in_radiance_is_the_square_of_it_in_the_divergence(method, x):
    """Bit for bit: nothing is added to a scale-free product."""
    expected = np.asarray(run_bent(x, 0.01 * x**2, method))
    for power in (-20, -7, 20):
        scale = 2.0**power
        found = np.asarray(run_bent(scale * x, scale**2 * (0.01 * x**2), method)) / scale**2
        np.testing.assert_array_equal(found, expected)


def test_oidn_at_radiances_from_1e_minus_6_to_1e6(small):
    """With OIDN's own exposure derivatives scale as radiance does; with a fixed one they stay finite."""
    frame, f, _ = small
    # Of the frame's mean luminance, so that none is below what OIDN's exposure counts as black.
    unit = frame.color / frame.color.mean()
    variance = frame.variance / frame.color.mean() ** 2
    exposure = oidn.autoexposure(unit)

    def run(exposure, scale):
        bound = dataclasses.replace(f, exposure=exposure)
        arguments = (bound, unit * scale, variance * scale**2)
        return pd.divergence_and_error(*arguments, method=METHODS["rademacher"])

    expected = run(exposure, 1).divergence
    for scale in (1e-6, 1e-3, 1e6):
        found = run(oidn.autoexposure(unit * scale), scale).divergence
        assert relative_rmse(found / scale**2, expected) < 1e-4
        fixed = run(exposure, scale)
        assert np.isfinite(fixed.divergence).all()
        assert np.isfinite(fixed.standard_error).all()


@pytest.mark.parametrize("name", ["rademacher", "radiance"])
def test_pixels_without_variance_have_no_divergence_and_finite_gradients(name, x):
    """Zeros in variance and colour, beside a firefly, through value and derivatives."""
    dark = np.random.default_rng(1).random(x.shape[:2]) < 0.3
    color = jnp.asarray(np.where(dark[..., None], 0, x)).at[4, 5].set(FIREFLY)
    variance = 0.01 * color**2

    def estimate(weight, color, variance):
        def f(x):
            return jnp.log1p(weight * blur(x))

        return pd.divergence(f, color, variance, method=METHODS[name])

    def loss(*arguments):
        found = estimate(*arguments)
        return found.sum(), found

    run = jax.jit(jax.grad(loss, (0, 1, 2), has_aux=True))
    gradients, found = run(1.3, color, variance)
    found = np.asarray(found)
    assert np.isfinite(found).all()
    assert not found[dark].any()
    assert (found[~dark] != 0).any()
    for gradient in gradients:
        assert np.isfinite(gradient).all()


@SWEEP
def test_fireflies_leave_pixels_out_of_their_reach_alone(method, x):
    """What f, and Probing's weight by f, cannot carry further than two pixels keeps every bit there."""
    variance = 0.01 * x**2
    clean = np.asarray(run_bent(x, variance, method))
    color, wild = x.at[4, 5].set(FIREFLY), variance.at[4, 5].set(FIREFLY**2)
    found = np.asarray(run_bent(color, wild, method))
    far = np.ones(x.shape[:2], bool)
    far[2:7, 3:8] = False
    np.testing.assert_array_equal(found[far], clean[far])
    assert (found[~far] != clean[~far]).any()
    if isinstance(method, pd.Exact):
        truth = np.asarray(wild, np.float64) * dense_jacobian_diagonal(bent, np.asarray(color))
        np.testing.assert_allclose(found, truth, rtol=1e-5)


def error_of_differences(f, x, variance, epsilons):
    """RMS over pixels of one difference minus the derivative along the same Gaussian vector."""

    @jax.jit
    def run(x, variance):
        exact = pd.MonteCarlo(probes=1, distribution="gaussian")
        truth = pd.divergence(f, x, variance, method=exact)
        steps = [pd.FiniteDifference(probes=1, epsilon=epsilon) for epsilon in epsilons]
        found = [pd.divergence(f, x, variance, method=method) for method in steps]
        return [jnp.sqrt(((each - truth) ** 2).mean()) for each in found]

    return np.asarray(run(x, variance))


def test_differences_lose_digits_as_their_step_falls():
    """x + εb is rounded to a unit u in the last place, uniformly: ½ b r/ε is lost, r of RMS u/√12."""
    x = jnp.full((48, 48, 3), 1.5, jnp.float32)
    epsilons = np.asarray([1e-5, 1e-4, 1e-3])
    lost = error_of_differences(lambda x: 0.5 * x, x, jnp.full_like(x, 0.01), epsilons.tolist())
    unit = np.spacing(np.float32(1.5))
    np.testing.assert_allclose(lost, 0.5 * 0.1 * unit / np.sqrt(12) / epsilons, rtol=0.3)


def test_large_steps_see_curvature():
    """b (f(x + εb) − f(x))/ε − b² f' = ε b³ f''/2: noise that grows with the step; E b⁶ = 15."""
    x = jnp.ones((48, 48, 3), jnp.float32)
    lost = error_of_differences(jnp.square, x, x, [0.01, 0.1])
    np.testing.assert_allclose(lost, np.asarray([0.01, 0.1]) * np.sqrt(15), rtol=0.1)


def test_bfloat16_inside_the_network(small):
    """Inputs, outputs and derivatives stay float32; the image is off by what 8 bits of mantissa explain."""
    frame, f, coarse = small
    fine, found = (
        evaluate(g, frame.color, frame.variance, method=METHODS["rademacher"]) for g in (f, coarse)
    )
    assert found.value.dtype == found.divergence.dtype == jnp.float32
    assert 1e-4 < relative_rmse(found.value, fine.value) < 0.03
    assert 1e-3 < relative_rmse(found.divergence, fine.divergence) < 0.3
    with pytest.raises(ValueError, match="precision is 'half', expected one of .*'bfloat16'"):
        pd.denoisers.load("oidn-hdr-small", precision="half")


def test_tf32_is_emulated_in_value_and_tangent():
    """Inputs and kernel lose what lies below 10 bits of mantissa, also inside a nested jit."""
    kernel = np.full((1, 1, 3, 3), 1 + 2.0**-12, np.float32)

    @jax.jit
    def f(x):
        names = ("NHWC", "HWIO", "NHWC")
        return lax.conv_general_dilated(x[None], kernel, (1, 1), "SAME", dimension_numbers=names)[0]

    x = jnp.full((2, 2, 3), 1 + 2.0**-10 + 2.0**-13, jnp.float32)
    for value in jax.jvp(rounding.tf32(f), (x,), (x,)):
        np.testing.assert_array_equal(value, np.float32(3 * (1 + 2.0**-10)))
    assert float(f(x)[0, 0, 0]) > 3 * (1 + 2.0**-10)


def test_linearising_keeps_masks_and_no_arrays_of_zeros(small):
    """A tangent pass reads what is kept: for a ReLU a byte per value at most, not five."""
    frame, f, _ = small
    kept = jax.tree.leaves(jax.eval_shape(lambda x: jax.linearize(f, x)[1], frame.color))
    images = [a.shape[1:] if a.shape[:1] == (1,) else a.shape for a in kept]
    inside = [a for a, shape in zip(kept, images, strict=True) if len(shape) == 3 < shape[-1]]
    assert len(inside) >= 16
    assert {a.dtype for a in inside} <= {np.dtype(bool), np.dtype(np.uint8)}
