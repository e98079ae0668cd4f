"""Metrics against float64 NumPy written from their definitions, by hand, and at the edges."""

import subprocess
import sys

import dm_pix
import flip_evaluator
import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from code_generation import as_for_users
from hypothesis import given, settings
from hypothesis import strategies as st

from progden_jax import metrics

TRACED = {
    "rmse": metrics.rmse,
    "smape": metrics.smape,
    "relmse": metrics.relmse,
    "ssim": metrics.ssim,
}
JITTED = {name: jax.jit(metric) for name, metric in TRACED.items()}
USERS_SSIM = jax.jit(metrics.ssim, compiler_options=as_for_users())
"""Its last digits at equality are those of fused multiplications and additions."""
SLOPES = {
    name: jax.jit(jax.value_and_grad(metric, argnums=(0, 1))) for name, metric in TRACED.items()
}
ALL = TRACED | {"flip": metrics.flip, "flip_map": metrics.flip_map}


def noisy_pair(shape=(13, 17, 3), seed=0, dtype=np.float32):
    """A textured reference with radiance over four decades, and a noisy image that dips below 0."""
    rng = np.random.default_rng(seed)
    reference = np.exp(rng.normal(-1, 2, shape))
    image = reference * (1 + 0.3 * rng.normal(size=shape)) + 0.01 * rng.normal(size=shape)
    return image.astype(dtype), reference.astype(dtype)


def display(radiance):
    linear = np.clip(radiance, 0, None) / (1 + np.clip(radiance, 0, None))
    return np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)


def odd_window(size):
    return min(11, size if size % 2 else size - 1)


def dense_ssim(image, reference):
    """SSIM one window at a time, with centred sums instead of differences of moments."""
    a, b = display(image.astype(np.float64)), display(reference.astype(np.float64))
    height, width = (odd_window(n) for n in a.shape[:2])
    offsets = [np.arange(n) - n // 2 for n in (height, width)]
    weights = np.exp(-(offsets[0][:, None] ** 2 + offsets[1][None] ** 2) / (2 * 1.5**2))
    weights = (weights / weights.sum())[..., None]
    values = []
    for y in range(a.shape[0] - height + 1):
        for x in range(a.shape[1] - width + 1):
            p, q = (v[y : y + height, x : x + width] for v in (a, b))
            mean_p, mean_q = (weights * p).sum((0, 1)), (weights * q).sum((0, 1))
            var_p = (weights * (p - mean_p) ** 2).sum((0, 1))
            var_q = (weights * (q - mean_q) ** 2).sum((0, 1))
            both = (weights * (p - mean_p) * (q - mean_q)).sum((0, 1))
            luminance = (2 * mean_p * mean_q + 1e-4) / (mean_p**2 + mean_q**2 + 1e-4)
            values.append(luminance * (2 * both + 9e-4) / (var_p + var_q + 9e-4))
    return np.mean(values)


def dense(name, image, reference):
    z, mu = image.astype(np.float64), reference.astype(np.float64)
    if name == "rmse":
        return np.linalg.norm((z - mu).ravel()) / np.sqrt(z.size)
    if name == "smape":
        return sum(
            abs(p - q) / (abs(p) + abs(q) + 0.01) for p, q in zip(z.flat, mu.flat, strict=True)
        ) / (z.size)
    if name == "relmse":
        return np.average(np.square(z - mu) / (0.01 + mu * mu))
    return dense_ssim(image, reference)


@pytest.mark.parametrize("shape", [(13, 17, 3), (11, 11, 3), (1, 1, 3), (1, 9, 3), (6, 25, 3)])
@pytest.mark.parametrize("name", TRACED)
def test_equals_dense_reference(name, shape):
    image, reference = noisy_pair(shape)
    value = JITTED[name](image, reference)
    assert value.shape == ()
    assert value.dtype == jnp.float32
    np.testing.assert_allclose(float(value), dense(name, image, reference), rtol=5e-6)


@pytest.mark.parametrize("name", TRACED)
def test_eager_equals_compiled(name):
    pair = noisy_pair((5, 6, 3))
    value = TRACED[name](*pair)
    assert value.dtype == jnp.float32
    np.testing.assert_allclose(float(value), float(JITTED[name](*pair)), rtol=5e-6)


@pytest.mark.parametrize("name", TRACED)
def test_float64_is_kept_and_exact(name):
    image, reference = noisy_pair(dtype=np.float64)
    with jax.enable_x64(True):
        value = JITTED[name](image, reference)
        assert value.dtype == jnp.float64
        np.testing.assert_allclose(float(value), dense(name, image, reference), rtol=1e-10)


@pytest.mark.parametrize("name", TRACED)
def test_vmap_equals_loop(name):
    pairs = [noisy_pair((12, 14, 3), seed) for seed in range(3)]
    images, references = (jnp.stack(side) for side in zip(*pairs, strict=True))
    mapped = jax.jit(jax.vmap(TRACED[name]))(images, references)
    looped = [float(JITTED[name](*pair)) for pair in pairs]
    np.testing.assert_allclose(mapped, looped, rtol=2e-6)


@pytest.mark.parametrize("name", TRACED)
def test_second_call_does_not_recompile(name):
    traces = []

    def counted(image, reference):
        traces.append(1)
        return TRACED[name](image, reference)

    compiled = jax.jit(counted)
    for seed in range(2):
        compiled(*noisy_pair(seed=seed))
    assert len(traces) == 1


def test_values_by_hand():
    reference = np.zeros((2, 2, 3), np.float32)
    image = reference.copy()
    image[0, 0] = [3, 0, -4]
    assert float(metrics.rmse(image, reference)) == pytest.approx((25 / 12) ** 0.5)
    assert float(metrics.relmse(image, reference)) == pytest.approx(25 / 12 / 0.01)
    assert float(metrics.smape(image, reference)) == pytest.approx((3 / 3.01 + 4 / 4.01) / 12)
    # Flat images leave the luminance term alone: radiance 1 is shown at 0.5 linear.
    white = np.ones((16, 16, 3), np.float32)
    shown = 1.055 * 0.5 ** (1 / 2.4) - 0.055
    expected = 1e-4 / (shown**2 + 1e-4)
    # Float32 variances are differences of moments near 1, off by 1e-7 beside a constant of 9e-4.
    assert float(JITTED["ssim"](white, 0 * white)) == pytest.approx(expected, rel=5e-4)


def test_relmse_is_relative_to_the_second_argument():
    small, large = (np.full((1, 1, 3), v, np.float32) for v in (1.0, 3.0))
    assert float(metrics.relmse(small, large)) == pytest.approx(4 / 9.01)
    assert float(metrics.relmse(large, small)) == pytest.approx(4 / 1.01)


# Few shapes, for each is compiled.
images = hnp.arrays(
    np.float32,
    st.sampled_from([(1, 1, 3), (1, 7, 3), (4, 12, 3)]),
    elements=st.floats(-1, 2**20, width=32, allow_subnormal=False),
)


@settings(deadline=None, max_examples=25)
@given(images)
def test_nothing_differs_at_equality(image):
    for name in ("rmse", "smape", "relmse"):
        assert float(JITTED[name](image, image.copy())) == 0, name
    assert metrics.flip(image, image.copy()) == 0
    assert not metrics.flip_map(image, image.copy()).any()
    assert float(USERS_SSIM(image, image.copy())) == pytest.approx(1, abs=1e-6)


@settings(deadline=None, max_examples=25)
@given(images, st.integers(0, 2**31))
def test_ranges_and_symmetry(image, seed):
    other = np.random.default_rng(seed).permutation(image.ravel()).reshape(image.shape)
    assert float(JITTED["rmse"](image, other)) == float(JITTED["rmse"](other, image)) >= 0
    assert 0 <= float(JITTED["smape"](image, other)) < 1
    assert float(JITTED["relmse"](image, other)) >= 0
    assert -1 - 1e-5 <= float(JITTED["ssim"](image, other)) <= 1 + 1e-5
    assert 0 <= metrics.flip(image, other) <= 1


FLAT = {
    "equal": (0.5, 0.5),
    "black": (0.0, 0.0),
    "flat": (0.25, 0.75),
    "zero against one": (0.0, 1.0),
    "huge": (1e6, 1e6),
    "tiny": (1e-6, 2e-6),
}


@pytest.mark.parametrize("size", [(4, 5, 3), (1, 1, 3), (1, 5, 3)])
@pytest.mark.parametrize(("image", "reference"), FLAT.values(), ids=FLAT)
@pytest.mark.parametrize("name", TRACED)
def test_gradients_are_finite_on_flat_images(name, image, reference, size):
    pair = jnp.full(size, image, jnp.float32), jnp.full(size, reference, jnp.float32)
    value, gradients = SLOPES[name](*pair)
    assert np.isfinite(value)
    for gradient in gradients:
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("name", TRACED)
def test_gradients_match_differences(name):
    image, reference = noisy_pair((7, 8, 3), seed=4, dtype=np.float64)
    direction = np.random.default_rng(1).normal(size=image.shape)
    image = np.abs(image) + 0.05  # away from the kinks of |z| and of the clamp at zero
    step = 1e-6
    difference = (
        dense(name, image + step * direction, reference)
        - dense(name, image - step * direction, reference)
    ) / (2 * step)
    with jax.enable_x64(True):
        _, (gradient, _) = SLOPES[name](jnp.asarray(image), jnp.asarray(reference))
        assert float(jnp.vdot(gradient, direction)) == pytest.approx(difference, rel=1e-5)


def test_rmse_gradient_is_zero_at_equality():
    image, _ = noisy_pair()
    for gradient in SLOPES["rmse"](image, image)[1]:
        assert not np.asarray(gradient).any()


def test_nan_is_not_hidden():
    image, reference = noisy_pair()
    image[3, 4, 1] = np.nan
    for name, metric in JITTED.items():
        assert np.isnan(float(metric(image, reference))), name


def test_ssim_equals_dm_pix_with_its_own_window():
    image, reference = noisy_pair((24, 19, 3))
    expected = jax.jit(dm_pix.ssim)(jnp.asarray(display(image)), jnp.asarray(display(reference)))
    assert float(JITTED["ssim"](image, reference)) == pytest.approx(float(expected), rel=1e-5)


def test_tone_map_stays_on_the_display():
    radiance = jnp.array([-1.0, 0.0, 1e-6, 0.003, 1.0, 1e6], jnp.float32)
    shown = jax.jit(metrics.tone_map)(radiance)
    np.testing.assert_allclose(shown, display(np.asarray(radiance, np.float64)), atol=2e-7)
    assert shown.min() == 0
    assert shown.max() <= 1
    assert np.isfinite(jax.jit(jax.vmap(jax.grad(metrics.tone_map)))(radiance)).all()


def test_flip_is_nvidias_with_the_reference_first():
    image, reference = (np.abs(side) for side in noisy_pair((32, 24, 3)))
    errors, mean, _ = flip_evaluator.evaluate(reference, image, "HDR", applyMagma=False)
    value, error_map = metrics.flip(image, reference), metrics.flip_map(image, reference)
    assert type(value) is float
    assert value == pytest.approx(mean, abs=1e-6)
    assert error_map.shape == (32, 24)
    np.testing.assert_allclose(error_map, errors[..., 0], atol=1e-6)
    assert error_map.mean() == pytest.approx(value, abs=1e-5)
    brighter = 8 * reference
    swapped = metrics.flip(reference, brighter)
    assert abs(metrics.flip(brighter, reference) - swapped) > 5e-3


def test_flip_takes_jax_arrays_and_float64_and_strides():
    image, reference = noisy_pair((8, 9, 3))
    value = metrics.flip(image, reference)
    assert metrics.flip(jnp.asarray(image), jnp.asarray(reference)) == value
    assert metrics.flip(image.astype(np.float64), reference.astype(np.float64)) == value
    mirrored = np.ascontiguousarray(image[:, ::-1]), np.ascontiguousarray(reference[:, ::-1])
    assert metrics.flip(image[:, ::-1], reference[:, ::-1]) == metrics.flip(*mirrored)


def test_flip_counts_negative_values_as_black_and_leaves_its_input_alone():
    image, reference = noisy_pair((8, 9, 3))
    image[0, 0] = -5
    before = image.copy()
    assert metrics.flip(image, reference) == metrics.flip(np.maximum(image, 0), reference)
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("size", [(1, 1, 3), (1, 9, 3), (9, 1, 3), (2, 2, 3)])
def test_flip_of_tiny_images(size):
    reference = np.ones(size, np.float32)
    error_map = metrics.flip_map(0 * reference, reference)
    assert error_map.shape == size[:2]
    assert (error_map > 0.9).all()
    assert metrics.flip(0.99 * reference, reference) < 0.1


def test_flip_with_a_dark_reference():
    """FLIP alone ends the process here, so the guard's two sides must join without a jump."""
    ones = np.ones((6, 5, 3), np.float32)
    assert metrics.flip(0 * ones, 0 * ones) == 0
    assert metrics.flip(ones, 0 * ones) > 0.9
    floor = np.float32(2.0**-23)
    below, above = (metrics.flip(2 * k * floor * ones, k * floor * ones) for k in (0.999, 1.002))
    assert below == pytest.approx(above, abs=1e-3)


def test_why_flip_needs_the_guard():
    program = (
        "import flip_evaluator as f, numpy as np; z = np.zeros((4, 4, 3), np.float32);"
        "f.evaluate(z, z, 'HDR', applyMagma=False); print('survived')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode != 0
    assert "survived" not in done.stdout


def test_flips_exposure_of_the_floor():
    ones = np.ones((3, 3, 3), np.float32)
    _, _, used = flip_evaluator.evaluate(ones, ones, "HDR", applyMagma=False)
    automatic = 23 + used["startExposure"]
    assert automatic == pytest.approx(metrics._FLIP_DARK_EXPOSURE, abs=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["image", "reference"])
def test_flip_refuses_nonfinite_values(which, bad):
    pair = dict(zip(("image", "reference"), noisy_pair(), strict=True))
    pair[which][2, 3] = bad
    with pytest.raises(ValueError, match=rf"{which} has NaN or infinite values in 1 pixels"):
        metrics.flip(**pair)


def test_flip_refuses_what_float32_cannot_hold():
    image, reference = noisy_pair(dtype=np.float64)
    image[0, 0, 0] = 1e39
    with pytest.raises(ValueError, match="image has NaN or infinite values in 1 pixels"):
        metrics.flip(image, reference)


@pytest.mark.parametrize("name", ["flip", "flip_map"])
@pytest.mark.parametrize("transform", [jax.jit, jax.vmap, jax.grad])
def test_flip_is_not_traceable(name, transform):
    pair = [jnp.asarray(side)[None] for side in noisy_pair()]
    with pytest.raises(TypeError, match=r"image is being traced, but FLIP cannot be traced"):
        transform(ALL[name])(*pair)


@pytest.mark.parametrize("name", ALL)
def test_bad_arguments(name):
    metric = ALL[name]
    image, reference = noisy_pair()
    with pytest.raises(ValueError, match=r"image has shape \(13, 16, 3\) but reference has"):
        metric(image[:, :-1], reference)
    with pytest.raises(ValueError, match=r"image has shape \(1, 1, 3\) but reference has"):
        metric(image[:1, :1], reference)
    with pytest.raises(ValueError, match=r"reference has shape \(13, 17, 1\), expected"):
        metric(image, reference[..., :1])
    with pytest.raises(ValueError, match=r"image has shape \(1, 13, 17, 3\).*jax\.vmap"):
        metric(image[None], reference[None])
    with pytest.raises(ValueError, match="image has dtype uint8, expected a floating-point type"):
        metric(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3), np.float32))
    with pytest.raises(ValueError, match="reference is a list"):
        metric(image, reference.tolist())
    with pytest.raises(ValueError, match="at least one pixel"):
        metric(image[:0], reference[:0])
