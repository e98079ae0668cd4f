"""The chain for one frame: composition, transformations, hard values, compilations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import counting_compilations

import progden_jax as pd
from progden_jax import mixers
from progden_jax._canvas import canvas_size

# Most frames here are padded to 48×48 pixels and have the same buffers, so that one program serves them.


@pytest.fixture
def denoiser(near_sighted):
    return near_sighted


def crop(frame, height, width):
    return jax.tree.map(lambda a: a[:height, :width] if a.ndim else a, frame)


def same(result, expected):
    """Equal to rounding, at every pixel, on the scale of the image's largest value."""
    for name in ("image", "alpha", "denoised", "divergence"):
        a, b = np.asarray(getattr(result, name)), np.asarray(getattr(expected, name))
        scale = np.abs(b).max() + 1e-12
        np.testing.assert_allclose(a / scale, b / scale, atol=2e-4, err_msg=name)


def test_it_composes_the_public_parts(real_frame, denoiser):
    frame, key, method = crop(real_frame, 40, 45), jax.random.key(3), pd.MonteCarlo(probes=1)
    result = pd.progressive_denoise(frame, denoiser, key=key)
    x, variance = frame.color, frame.variance

    @jax.jit
    def compose(denoiser):
        f = denoiser.bind(frame)
        y = f(x)
        divergence = pd.divergence(f, x, variance, method=method, key=key)
        risk = pd.sure(x, y, variance, divergence)
        alpha = mixers.default_for(denoiser)(x, y, variance, divergence, risk)
        return y, divergence, risk, pd.t_bound(alpha, x, y, variance)

    y, divergence, risk, alpha = compose(denoiser)
    expected = pd.Result(x + alpha * (y - x), alpha, y, risk, divergence, result.repairs)
    same(result, expected)
    np.testing.assert_allclose(result.sure, risk, rtol=1e-2, atol=1e-5)


def test_jit_and_vmap_agree_with_the_canvas(real_frame, denoiser):
    """Eager calls pad to a canvas and traced ones do not: the pixels' probes are the same."""
    frame = crop(real_frame, 41, 45)
    assert canvas_size(41) != 41
    plain = pd.progressive_denoise(frame, denoiser)
    batch = jax.tree.map(lambda a: np.stack([a, a]), frame)
    both = jax.jit(jax.vmap(pd.progressive_denoise, (0, None)))(batch, denoiser)
    same(jax.tree.map(lambda a: a[1], both), plain)


def test_nearby_sizes_share_programs_and_calls_repeat(real_frame, denoiser):
    first = pd.progressive_denoise(crop(real_frame, 38, 46), denoiser)
    with counting_compilations() as compiled:
        again = pd.progressive_denoise(crop(real_frame, 38, 46), denoiser)
    assert compiled == []
    np.testing.assert_array_equal(again.image, first.image)
    with counting_compilations() as compiled:
        pd.progressive_denoise(crop(real_frame, 34, 47), denoiser)
        pd.progressive_denoise(crop(real_frame, 48, 33), denoiser)
    assert [name for name in compiled if "progressive" in name] == []


def test_canvas_sizes_waste_little():
    for n in range(1, 5000):
        assert n <= canvas_size(n) <= max(16, n * 1.25 + 15)
        assert canvas_size(n) % 16 == 0
        assert canvas_size(canvas_size(n)) == canvas_size(n)
    assert len({canvas_size(n) for n in range(512, 1024)}) <= 9


def test_gradient_in_weights_and_colour(real_frame):
    frame = crop(real_frame, 16, 16)
    denoiser = pd.denoisers.KPCN.init(jax.random.key(0), layers=1, width=4, layer_size=3)

    def loss(denoiser, color):
        result = pd.progressive_denoise(frame.replace(color=color), denoiser)
        return (result.image**2).mean() + result.sure.mean()

    weights, color = jax.jit(jax.grad(loss, argnums=(0, 1)))(denoiser, frame.color)
    leaves = jax.tree.leaves(weights)
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert np.isfinite(color).all()
    assert any(np.asarray(leaf).any() for leaf in leaves)
    assert np.asarray(color).any()


def test_gradient_against_differences(real_frame, denoiser):
    with jax.enable_x64(True):
        frame = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a), jnp.float64), crop(real_frame, 16, 16)
        )
        params = jax.tree.map(lambda a: np.asarray(a, np.float64), denoiser.params)

        def loss(shift):
            # Away from the box that kernels of a fresh network are near to.
            tilted = params["kernel"]["bias"] + shift * np.linspace(0, 1, 25)
            changed = pd.denoisers.KPCN(params | {"kernel": params["kernel"] | {"bias": tilted}})
            return (pd.progressive_denoise(frame, changed).image ** 2).mean()

        # One program for the value and its derivative: compiling is what takes time here.
        both = jax.jit(jax.value_and_grad(loss))
        _, gradient = both(0.0)
        difference = (both(1e-6)[0] - both(-1e-6)[0]) / 2e-6
        np.testing.assert_allclose(gradient, difference, rtol=1e-4)


# On one canvas, so that one program serves them all.
@pytest.mark.parametrize("size", [(1, 1), (1, 13), (16, 1), (2, 2)])
def test_tiny_images(real_frame, denoiser, size):
    result = pd.progressive_denoise(crop(real_frame, *size), denoiser)
    assert result.image.shape == (*size, 3)
    assert all(np.isfinite(a).all() for a in result[:5])


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_any_radiance_comes_through(real_frame, denoiser, scale):
    frame = crop(real_frame, 40, 40)
    frame = frame.replace(color=scale * frame.color, variance=scale**2 * frame.variance)
    result = pd.progressive_denoise(frame, denoiser)
    assert all(np.isfinite(a).all() for a in result[:5])
    low = np.minimum(frame.color, result.denoised)
    high = np.maximum(frame.color, result.denoised)
    slack = 1e-5 * np.abs(high)
    assert ((result.image >= low - slack) & (result.image <= high + slack)).all()


def test_bad_pixels_are_counted_and_the_result_is_finite(real_frame, denoiser):
    frame = crop(real_frame, 40, 40)
    color, variance = np.array(frame.color), np.array(frame.variance)
    color[0, 0], color[5, 5, 1], color[6, 6], color[9, 9] = np.nan, np.inf, -np.inf, -0.5
    variance[0, 0], variance[3, 3], variance[4, 4] = np.nan, np.inf, -1.0
    albedo = np.array(frame.albedo, np.float32)
    albedo[2, 2] = np.nan
    bad = frame.replace(color=color, variance=variance, albedo=albedo)
    result = pd.progressive_denoise(bad, denoiser)
    assert all(np.isfinite(a).all() for a in result[:5])
    assert [int(n) for n in result.repairs] == [3, 2, 2, 1, 1]
    far = np.s_[20:, 20:]
    np.testing.assert_allclose(
        pd.denoise(bad, denoiser).image[far], denoiser(pd.repair(bad)[0])[far], rtol=1e-4
    )


def test_zero_variance_keeps_the_render(real_frame, denoiser):
    frame = crop(real_frame, 40, 40)
    result = pd.progressive_denoise(
        frame.replace(variance=jnp.zeros_like(frame.variance)), denoiser
    )
    np.testing.assert_array_equal(result.image, frame.color)
    np.testing.assert_array_equal(result.alpha, 0)


@pytest.mark.parametrize("level", [0.0, 0.7])
def test_black_and_constant_images(real_frame, denoiser, level):
    frame = crop(real_frame, 40, 40)
    color = jnp.full_like(frame.color, level)
    result = pd.progressive_denoise(
        frame.replace(color=color, variance=jnp.zeros_like(color)), denoiser
    )
    np.testing.assert_array_equal(result.image, color)


def test_the_mix_tends_to_the_render_as_noise_falls(real_frame, denoiser):
    frame = crop(real_frame, 48, 48)
    away = [
        float(
            jnp.abs(
                pd.progressive_denoise(frame.replace(variance=frame.variance * s), denoiser).image
                - frame.color
            ).mean()
        )
        for s in (1.0, 1e-4, 1e-8)
    ]
    assert away[0] > away[1] > away[2]
    assert away[2] < 1e-3 * away[0]


def test_any_function_is_a_denoiser(real_frame):
    frame = crop(real_frame, 20, 24)
    smooth = pd.FunctionDenoiser(
        lambda x: 0.5 * x + 0.25 * (jnp.roll(x, 1, 0) + jnp.roll(x, -1, 0))
    )
    result = pd.progressive_denoise(frame, smooth, method=pd.MonteCarlo(probes=4))
    # Its divergence is half the variance, but for the noise of the probes.
    ratio = float(result.divergence.sum() / frame.variance.sum())
    assert 0.3 < ratio < 0.7
    assert isinstance(smooth, pd.Denoiser)
    assert isinstance(pd.denoisers.load("oidn-hdr-small"), pd.Denoiser)


def test_messages(real_frame, denoiser):
    with pytest.raises(ValueError, match="the frame has no variance"):
        pd.progressive_denoise(pd.Frame(real_frame.color, None), denoiser)
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), crop(real_frame, 16, 16))
    with pytest.raises(ValueError, match="map over a batch with jax.vmap"):
        pd.progressive_denoise(batch, denoiser)
    with pytest.raises(ValueError, match="has no albedo"):
        pd.progressive_denoise(
            real_frame.replace(albedo=None), pd.denoisers.load("oidn-hdr-alb-small")
        )
