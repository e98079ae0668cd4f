"""Transfer functions against float64 Python, their inverses, their joints and their derivatives."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from progden_jax import transfer

NAMES = ["log", "pu", "arctan"]
FORWARD = {name: jax.jit(transfer.by_name(name).forward) for name in NAMES}
INVERSE = {name: jax.jit(transfer.by_name(name).inverse) for name in NAMES}
RADIANCE = np.concatenate([[0.0], np.geomspace(1e-6, 65504, 400)])
# Where pu changes its piece, before and after.
Y0, Y1 = 1.57945760e-6, 0.0322087631
X0, X1 = 0.00223151711, 0.370974749


def scalar_pu(y):
    if y < Y0:
        return 1412.83765 * y
    if y < Y1:
        return 1.64593172 * math.pow(y, 0.431384981) - 0.00294139609
    return 0.192653254 * math.log(y + 0.00626026094) + 0.998620152


SCALAR = {
    "log": lambda y: math.log1p(y) / math.log(65505),
    "pu": lambda y: scalar_pu(y) / scalar_pu(65504),
    "arctan": math.atan,
}


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-6), ("float64", 1e-14)])
@pytest.mark.parametrize("name", NAMES)
def test_forward_equals_scalar_reference(name, dtype, tolerance):
    with jax.enable_x64(dtype == "float64"):
        y = RADIANCE.astype(dtype)
        x = FORWARD[name](y)
        assert x.dtype == dtype
        expected = [SCALAR[name](float(v)) for v in y]
        np.testing.assert_allclose(x, expected, rtol=tolerance, atol=0)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("name", NAMES)
def test_dtype_and_shape_are_kept(name, dtype):
    with jax.enable_x64(dtype == "float64"):
        chosen = transfer.by_name(name)
        y = jax.ShapeDtypeStruct((2, 3, 4), dtype)
        for function in (chosen.forward, chosen.inverse):
            assert jax.eval_shape(function, y) == y


# The log's slope at 65504 is 1/65504 of an output near 1: rounding there is worth 11 ulp of y.
@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 5e-6), ("float64", 1e-13)])
@pytest.mark.parametrize("name", ["log", "pu"])
def test_round_trip(name, dtype, tolerance):
    with jax.enable_x64(dtype == "float64"):
        y = RADIANCE.astype(dtype)
        np.testing.assert_allclose(INVERSE[name](FORWARD[name](y)), y, rtol=tolerance, atol=0)


@pytest.mark.parametrize("name", ["log", "pu"])
@settings(deadline=None)
@given(y=st.floats(2**-20, 65504, width=32))
def test_round_trip_of_any_radiance(name, y):
    back = INVERSE[name](FORWARD[name](np.float32(y)))
    assert float(back) == pytest.approx(y, rel=5e-6)


def test_arctan_round_trip_loses_digits_as_documented():
    v = jnp.asarray([0.0, 1e-6, 1e-3, 1.0, 30.0, -2.0], jnp.float32)
    np.testing.assert_allclose(transfer.arctan_inverse(transfer.arctan(v)), v, rtol=1e-5)
    large = transfer.arctan_inverse(transfer.arctan(jnp.float32(1e4)))
    assert 1e-6 < abs(float(large) / 1e4 - 1) < 1e-3
    huge = transfer.arctan_inverse(transfer.arctan(jnp.asarray([1e8, 1e20, jnp.inf, -1e8])))
    assert len(set(np.abs(huge).tolist())) == 1
    assert huge[0] == pytest.approx(1.3245e7, rel=1e-3)
    assert huge[3] == -huge[0]


@pytest.mark.parametrize("dtype", ["float16", "bfloat16", "float32", "float64"])
def test_arctan_inverse_keeps_the_sign_to_the_end(dtype):
    with jax.enable_x64(dtype == "float64"):
        x = jnp.asarray([-2.0, -math.pi / 2, math.pi / 2, 2.0], dtype)
        ends = np.asarray(transfer.arctan_inverse(x), np.float64)
        assert np.isfinite(ends).all()
        assert (ends[:2] < -100).all()
        assert (ends[2:] > 100).all()


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite_and_right(name):
    chosen = transfer.by_name(name)
    radiance = [0.0, 1e-12, 1e-6, Y0, 1e-3, Y1, 1.0, 65504, 1e6]
    y = jnp.asarray(radiance, jnp.float32)

    @jax.jit
    @jax.vmap
    def slopes(y):
        forward = jax.grad(chosen.forward)
        return forward(y), jax.grad(chosen.inverse)(chosen.forward(y)), jax.grad(forward)(y)

    assert np.isfinite(slopes(y)).all()
    with jax.enable_x64(True):
        values = np.array([1e-7, 1e-3, 0.5, 40.0])
        for value, slope, back in zip(values, *slopes(values)[:2], strict=True):
            step = 1e-5 * value
            ends = SCALAR[name](value + step) - SCALAR[name](value - step)
            assert float(slope) == pytest.approx(ends / (2 * step), rel=1e-6)
            assert float(back * slope) == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("name", ["log", "pu"])
def test_slope_at_zero_is_that_of_its_right_side(name):
    slope = jax.jit(jax.grad(FORWARD[name]))
    assert float(slope(jnp.float32(0))) == pytest.approx(float(slope(jnp.float32(1e-8))), rel=1e-5)


# The constants have nine digits; y1 and x1, of eight decimals, leave the largest gap.
@pytest.mark.parametrize(
    ("function", "joint", "gap"),
    [
        (transfer.pu, Y0, 2e-9),
        (transfer.pu, Y1, 2e-8),
        (transfer.pu_inverse, X0, 1e-12),
        (transfer.pu_inverse, X1, 4e-9),
    ],
    ids=["y0", "y1", "x0", "x1"],
)
def test_pu_is_continuous_at_its_joints(function, joint, gap):
    with jax.enable_x64(True):
        below = float(function(jnp.float64(np.nextafter(joint, 0))))
        at = float(function(jnp.float64(joint)))
    assert below == pytest.approx(at, abs=gap, rel=0)


def test_pu_thresholds_belong_together():
    with jax.enable_x64(True):
        assert float(transfer.pu(jnp.float64(Y0))) == pytest.approx(X0, abs=2e-9)
        assert float(transfer.pu(jnp.float64(Y1))) == pytest.approx(X1, abs=2e-8)


@pytest.mark.parametrize("name", NAMES)
def test_forward_rises(name):
    with jax.enable_x64(True):
        y = np.concatenate([-np.geomspace(10, 1e-6, 50), np.geomspace(1e-7, 1e6, 500)])
        x = FORWARD[name](y)
        assert (np.diff(x) > 0).all()
        assert (np.diff(INVERSE[name](x)) > 0).all()


@pytest.mark.parametrize("name", ["log", "pu"])
def test_half_range_becomes_zero_to_one(name):
    ends = FORWARD[name](np.float32([0, 65504]))
    np.testing.assert_allclose(ends, [0, 1], atol=1e-6)
    back = INVERSE[name](np.float32([0, 1]))
    np.testing.assert_allclose(back, [0, 65504], rtol=1e-5)


def test_scale_of_pu():
    assert pytest.approx(1 / scalar_pu(65504), rel=1e-15) == transfer.PU_HDR_SCALE
    y = jnp.float32(2)
    assert float(transfer.pu_hdr(y)) == pytest.approx(scalar_pu(2) / scalar_pu(65504), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_negative_values_stay_finite_and_come_back(name):
    y = np.float32([-1e-3, -0.5, -1.0, -20.0])
    x = np.asarray(FORWARD[name](y))
    assert (x < 0).all()
    np.testing.assert_allclose(INVERSE[name](x), y, rtol=1e-5)
    assert np.isfinite(jax.jit(jax.vmap(jax.grad(FORWARD[name])))(y)).all()


@pytest.mark.parametrize("name", NAMES)
def test_nan_is_not_hidden(name):
    for function in (FORWARD[name], INVERSE[name]):
        assert np.isnan(function(np.float32(np.nan)))


@pytest.mark.parametrize("name", NAMES)
def test_jit_and_vmap_equal_eager(name):
    chosen = transfer.by_name(name)
    y = jnp.asarray(RADIANCE[:400], jnp.float32).reshape(20, 20)
    for function in (chosen.forward, chosen.inverse):
        values = y if function is chosen.forward else chosen.forward(y)
        eager = function(values)
        # XLA fuses multiply and add under jit; the inverses' exponentials amplify that rounding.
        np.testing.assert_allclose(jax.jit(function)(values), eager, rtol=5e-6)
        np.testing.assert_allclose(jax.vmap(function)(values), eager, rtol=5e-6)


def test_unknown_name():
    with pytest.raises(ValueError, match=r"transfer is 'gamma', expected one of 'log', 'pu'"):
        transfer.by_name("gamma")


@pytest.mark.parametrize(
    "function",
    [f for name in NAMES for f in transfer.by_name(name)[1:]] + [transfer.pu, transfer.pu_inverse],
)
def test_integers_are_refused(function):
    with pytest.raises(ValueError, match=r"has dtype uint8, expected floating-point linear"):
        function(np.array([0, 255], np.uint8))


def test_srgb_against_the_standard():
    y = np.linspace(0, 1, 1001)
    expected = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    found = jax.jit(transfer.srgb)(np.float32(y))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(transfer.srgb_inverse)(found), y, rtol=1e-4, atol=1e-7)
    gradient = jax.jit(jax.vmap(jax.grad(transfer.srgb)))(np.float32([0, 1e-3, 0.0031308, 1]))
    assert np.isfinite(gradient).all()
