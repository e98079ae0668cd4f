"""Post-correction from two halves of a render, and adaptation by SURE."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

import progden_jax as pd
from progden_jax import adaptation, subaverages
from progden_jax.adaptation import _blocks, _noise, combination

SMALL = adaptation.PostCorrection(window=3, layers=2, width=4, patch=8, steps=1)


@functools.partial(jax.tree_util.register_dataclass, data_fields=("gain", "rest"), meta_fields=())
@dataclasses.dataclass(frozen=True)
class Blur:
    """y = gain · (mean over 3×3) + rest: a linear filter with two weights."""

    gain: jax.Array
    rest: jax.Array

    def __call__(self, frame):
        return self.bind(frame)(frame.color)

    def bind(self, frame):
        del frame

        def f(x):
            padded = jnp.pad(x, ((1, 1), (1, 1), (0, 0)), "wrap")
            height, width = x.shape[:2]
            shifted = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
            return self.gain * sum(shifted) / 9 + self.rest

        return f


image_of = jax.jit(lambda denoiser, frame: denoiser(frame))
"""Compiled whole: run eagerly, each operation becomes a program."""

BLUR = Blur(jnp.float32(1), jnp.float32(0))


def frame_of(seed, *, size=(24, 26), sigma=0.3, level=1.0):
    """A render of a smooth image with normal noise, and the image."""
    rng = np.random.default_rng(seed)
    rows, columns = np.meshgrid(*(np.linspace(0, 3, n) for n in size), indexing="ij")
    truth = np.stack([level + 0.5 * np.sin(rows + c) * np.cos(columns) for c in range(3)], -1)
    variance = np.full(truth.shape, sigma**2, np.float32)
    noisy = (truth + sigma * rng.normal(size=truth.shape)).astype(np.float32)
    albedo = rng.random(truth.shape).astype(np.float32)
    depth = 1 + rng.random((*size, 1)).astype(np.float32)
    return pd.Frame(noisy, variance, albedo=albedo, normal=0.5 - albedo, depth=depth), truth


def controls(shape, seed=0):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(*shape, 9)),
        0.3 + rng.random((*shape, 5)),
        0.1 + rng.random((*shape, 1)),
    )


def dense(guides, bandwidths, center, scales, window):
    """Eqs. 10 and 11 as they are written, pixel by pixel."""
    y, z, albedo, normal, depth = np.split(guides.astype(np.float64), [3, 6, 9, 12], axis=-1)
    height, width = guides.shape[:2]
    result = np.zeros_like(y)
    if scales is None:
        scales = np.broadcast_to(np.repeat([1.0, 0.0, 0.0], 3), (height, width, 9))
    for c in np.ndindex(height, width):
        total, weights = np.zeros(3), 0.0
        for i in np.ndindex(height, width):
            if max(abs(i[0] - c[0]), abs(i[1] - c[1])) > window // 2:
                continue
            far = [((b[c] - b[i]) ** 2).sum() for b in (y, z, albedo, normal, depth)]
            far[:2] = np.log(1 + np.asarray(far[:2]))
            weight = np.exp(
                -sum(d / (g**2 + 1e-4) for d, g in zip(far, bandwidths[c], strict=True))
            )
            if i == c:
                weight = center[c][0]
            by_z, by_albedo, by_normal = np.split(scales[c], 3)
            value = (
                y[i]
                + by_z * (z[c] - z[i])
                + by_albedo * (albedo[c] - albedo[i])
                + by_normal * (normal[c] - normal[i])
            )
            total += weight * value
            weights += weight
        result[c] = total / weights
    return result


@functools.partial(jax.jit, static_argnames="window")
def combined(guides, bandwidths, center, scales, window):
    weigh = combination.bilateral(bandwidths, center, window=window)
    return combination.combine(guides, weigh, scales=scales, window=window)


@pytest.fixture(scope="module")
def guides():
    """Of 6×7 pixels: the 5×5 window reaches over each border."""
    rng = np.random.default_rng(3)
    return rng.gamma(1.0, 0.5, (6, 7, combination.CHANNELS))


@pytest.mark.parametrize("refined", [True, False])
def test_the_kernel_is_the_papers(guides, refined):
    scales, bandwidths, center = controls(guides.shape[:2])
    scales = scales if refined else None
    found = combined(*map(np.float32, (guides, bandwidths, center)), scales, 5)
    np.testing.assert_allclose(
        found, dense(guides, bandwidths, center, scales, 5), rtol=2e-4, atol=2e-5
    )


def test_the_kernels_derivatives_are_those_of_differences(guides):
    """In float64, along a random direction in everything at once."""
    with jax.enable_x64(True):
        scales, bandwidths, center = controls(guides.shape[:2])
        inputs = tuple(map(jnp.asarray, (guides, bandwidths, center, scales)))
        rng = np.random.default_rng(0)
        along = tuple(rng.normal(size=a.shape) for a in inputs)
        weight = jnp.asarray(rng.normal(size=(*guides.shape[:2], 3)))

        @jax.jit
        @functools.partial(jax.value_and_grad, argnums=range(4))
        def value(*inputs):
            return (weight * combined(*inputs, 5)).sum()

        slope = sum((g * d).sum() for g, d in zip(value(*inputs)[1], along, strict=True))
        step = 1e-5
        ends = [
            value(*(a + s * d for a, d in zip(inputs, along, strict=True)))[0]
            for s in (step, -step)
        ]
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-7)


def test_predicted_weights_are_one_output_per_offset(guides):
    """As from all weights at once: a convolution of 9 outputs, a softplus, and a weighted mean."""
    rng = np.random.default_rng(1)
    features = rng.normal(size=(6, 7, 2)).astype(np.float32)
    kernel, bias = (
        rng.normal(size=(3, 3, 2, 9)).astype(np.float32),
        np.arange(9, dtype=np.float32) / 9,
    )

    @jax.jit
    def found(guides):
        weigh = combination.predicted(*map(jnp.asarray, (features, kernel, bias)))
        return combination.combine(guides, weigh, window=3)

    padded = np.pad(features, ((1, 1), (1, 1), (0, 0)))
    logits = bias + sum(
        padded[i : i + 6, j : j + 7] @ kernel[i, j] for i in range(3) for j in range(3)
    )
    weights = np.log1p(np.exp(logits.astype(np.float64)))
    y, z = guides[..., :3], guides[..., 3:6]
    expected = np.zeros_like(y)
    for row, column in np.ndindex(6, 7):
        total = 0.0
        for offset, (i, j) in enumerate(np.ndindex(3, 3)):
            p, q = row + i - 1, column + j - 1
            if 0 <= p < 6 and 0 <= q < 7:
                w = weights[row, column, offset]
                expected[row, column] += w * (y[p, q] + z[row, column] - z[p, q])
                total += w
        expected[row, column] /= total
    np.testing.assert_allclose(found(guides.astype(np.float32)), expected, rtol=1e-4, atol=1e-5)


def test_weights_do_not_all_exist_at_once():
    """In the derivative neither: all 361 would be as large as 361 planes."""

    @jax.jit
    def gradient(*inputs):
        return jax.grad(lambda *a: (combined(*a, 19) ** 2).sum(), (1, 2, 3))(*inputs)

    forms = [jax.ShapeDtypeStruct((64, 64, n), np.float32) for n in (13, 5, 1, 9)]
    used = gradient.lower(*forms).compile().memory_analysis().temp_size_in_bytes
    assert used < 0.6 * 361 * 64 * 64 * 4


def test_limits_of_the_kernel(guides):
    """Where y is z and only z's scale is 1, or all is one colour, or there is one pixel, nothing changes."""
    _, bandwidths, center = controls(guides.shape[:2])
    same = np.concatenate([guides[..., 3:6], guides[..., 3:]], -1).astype(np.float32)
    found = combined(same, np.float32(bandwidths), np.float32(center), None, 5)
    np.testing.assert_allclose(found, same[..., :3], rtol=1e-5, atol=1e-6)
    flat = np.ones_like(same)
    tiny = np.zeros_like(np.float32(bandwidths))
    found = combined(flat, tiny, np.float32(center), np.float32(controls((6, 7))[0]), 5)
    np.testing.assert_allclose(found, 1, rtol=1e-6)
    apart = combined(np.float32(guides) * 1e3, tiny, np.float32(center), None, 5)
    np.testing.assert_allclose(apart, np.float32(guides[..., :3]) * 1e3, rtol=1e-5, atol=1e-3)


def test_weights_that_vanish_have_derivatives(guides):
    """Fireflies far from all else, and a network that gives their centres next to nothing."""
    _, bandwidths, center = controls(guides.shape[:2])
    far = 1e3 * np.float32(guides)
    lost = np.full_like(np.float32(center), 1e-38)

    @jax.jit
    def slopes(bandwidths, center):
        return jax.grad(lambda *a: (combined(far, *a, None, 5) ** 2).sum(), (0, 1))(
            bandwidths, center
        )

    for found in slopes(1e-2 * np.float32(bandwidths), lost):
        assert np.isfinite(found).all()
    alone = combined(far, 1e-2 * np.float32(bandwidths), lost, None, 5)
    np.testing.assert_allclose(alone, far[..., :3], rtol=1e-5, atol=1e-3)


def test_one_pixel_is_its_own_mean():
    frame = pd.Frame(np.full((1, 1, 3), 2.0, np.float32), np.ones((1, 1, 3), np.float32))
    seen = combination.guides_of(frame, frame.color, combination.units_of(frame))
    params = drawn(jax.eval_shape(SMALL.init, jax.random.key(0)))
    np.testing.assert_allclose(jax.jit(SMALL.apply)(params, seen[None]), 1, rtol=1e-6)


def test_the_networks_are_those_of_table_1():
    outputs = {name: setting.outputs for name, setting in adaptation.SETTINGS.items()}
    assert outputs == {"A": 361, "B": 6, "C": 370, "D": 15}
    form = jax.eval_shape(adaptation.SETTINGS["D"].init, jax.random.key(0))
    count = sum(leaf.size for leaf in jax.tree.leaves(form))
    assert len(form) == 9
    assert round(count / 1e6, 2) == 0.02, "the paper's 0.02 million"


def test_halves_of_two_renders():
    (a, _), (b, _) = frame_of(0), frame_of(1)
    found = adaptation.halves(a, b)
    for half, given in zip(found.both(), (a, b), strict=True):
        for name in ("color", "albedo", "normal", "depth", "variance"):
            np.testing.assert_allclose(
                getattr(half, name), getattr(given, name), rtol=1e-5, atol=1e-6
            )
    np.testing.assert_allclose(found.frame.variance, a.variance / 2, rtol=1e-6)
    plain = adaptation.halves(a.replace(variance=None), b)
    np.testing.assert_allclose(
        plain.frame.variance, ((a.color - b.color) / 2) ** 2, rtol=1e-4, atol=1e-7
    )


def test_split_halves_are_uncorrelated():
    frame, truth = frame_of(0)
    a, b = (np.asarray(h.color) - truth for h in adaptation.split(frame, jax.random.key(0)).both())
    variance = 2 * 0.3**2
    squares = [(a**2).mean(), (b**2).mean()]
    np.testing.assert_allclose(squares, variance, rtol=4 * np.sqrt(2 / a.size))
    # The standard error of a mean of products of independent values.
    assert abs((a * b).mean()) < 4 * variance / np.sqrt(a.size)


@pytest.fixture(scope="module")
def corrected():
    """A biased denoiser, too bright by half, corrected with few small steps."""
    frame, truth = frame_of(2, sigma=0.1)
    bright = Blur(jnp.float32(1), jnp.float32(0.5))
    settings = dataclasses.replace(SMALL, steps=30, rate=0.01)
    halves = adaptation.split(frame, jax.random.key(5))
    return (
        halves,
        bright,
        settings,
        adaptation.post_correct(halves, bright, correction=settings),
        truth,
    )


def test_post_correction_lowers_loss_and_error(corrected):
    halves, bright, _, found, truth = corrected
    assert found.losses[-5:].mean() < found.losses[:5].mean()
    before, after = (
        ((np.asarray(i) - truth) ** 2).mean() for i in (image_of(bright, halves.frame), found.image)
    )
    assert after < 0.1 * before


def test_the_corrected_image_is_a_denoisers(corrected):
    """The same image, with a divergence that makes SURE tell its error; the pipeline takes it."""
    halves, _, _, found, truth = corrected

    @jax.jit
    def evaluate(frame, denoiser):
        f, x, variance = denoiser.bind(frame), frame.color, frame.variance
        y, divergence, _, _ = pd.MonteCarlo(1).evaluate(f, x, variance, jax.random.key(1))
        return y, pd.sure(x, y, variance, divergence)

    y, risk = map(np.asarray, evaluate(halves.frame, found.denoiser))
    np.testing.assert_allclose(y, found.image, rtol=1e-4, atol=1e-5)
    error = ((y - truth) ** 2).mean()
    assert abs(risk.mean() - error) < 4 * risk.std() / np.sqrt(risk.size)
    result = jax.eval_shape(pd.progressive_denoise, halves.frame, found.denoiser)
    assert result.image.shape == y.shape
    with pytest.raises(ValueError, match="belong to the frame"):
        found.denoiser(frame_of(0, size=(8, 8))[0])


def test_post_correction_goes_on_from_weights_and_follows_its_key(corrected):
    halves, bright, settings, first, _ = corrected
    weights = first.denoiser.params
    again = adaptation.post_correct(
        halves, bright, correction=settings, start=weights, progress=lambda *_: False
    )
    assert len(again.losses) == 1
    assert again.losses[0] < 1.2 * first.losses[-5:].mean() < first.losses[0]
    stop = adaptation.post_correct(halves, bright, correction=settings, progress=lambda n, _: n < 3)
    np.testing.assert_array_equal(stop.losses, first.losses[:3])
    with pytest.raises(ValueError, match="other shapes"):
        adaptation.post_correct(halves, bright, start=first.denoiser.params)


@pytest.mark.parametrize(("unit", "fireflies"), [(1e-3, ()), (1e2, ((3, 4), (15, 20)))])
def test_post_correction_learns_in_any_unit_and_beside_fireflies(corrected, unit, fireflies):
    """By its own rate: neither so low that nothing is learned, nor so high that the network dies."""
    halves, bright, settings, _, truth = corrected
    color, variance = (np.array(a) for a in (halves.frame.color, halves.frame.variance))
    calm = np.ones(halves.frame.size, bool)
    for row, column in fireflies:
        color[row, column], variance[row, column] = 300, 300**2
        calm[row - 2 : row + 3, column - 2 : column + 3] = False
    frame = halves.frame.replace(color=unit * color, variance=unit**2 * variance)
    scaled = dataclasses.replace(bright, rest=np.float32(unit) * bright.rest)
    found = adaptation.post_correct(
        adaptation.split(frame, jax.random.key(5)),
        scaled,
        correction=dataclasses.replace(settings, rate=None, steps=80),
    )
    before, after = (
        ((np.asarray(i) / unit - truth)[calm] ** 2).mean()
        for i in (image_of(scaled, frame), found.image)
    )
    assert after < 0.2 * before
    # 0.01 times the noise over the mean, at which log(1 + ·) has half of it. The fireflies' own RMS is 17.
    usual = 0.01 * 0.1 / np.asarray(halves.frame.color).mean() / 2
    assert 0.9 * usual < found.rate < (3 if fireflies else 1.1) * usual


def test_patches_cover_the_image():
    from progden_jax.adaptation.by_halves import _corners

    corners = _corners((20, 7), 8)
    assert corners.tolist() == [[0, 0], [8, 0], [12, 0]]


SURE = adaptation.Adaptation(steps=40, rate=0.02, block=4, every=5, crop=16)


@pytest.fixture(scope="module")
def adapted():
    frame, truth = frame_of(4)
    dim = Blur(jnp.float32(0.6), jnp.float32(0))
    return frame, truth, dim, adaptation.adapt(frame, dim, adaptation=SURE)


def test_adaptation_lowers_the_true_error(adapted):
    frame, truth, dim, found = adapted
    before, after = (
        ((np.asarray(image_of(f, frame)) - truth) ** 2).mean() for f in (dim, found.adapted)
    )
    assert after < 0.2 * before
    assert found.step > 0
    assert found.before - found.after > 2 * found.error
    assert found.risks[-1] < found.risks[0]


def test_adaptation_follows_its_key_and_can_be_stopped(adapted):
    frame, _, dim, found = adapted
    again = adaptation.adapt(frame, dim, adaptation=SURE)
    assert jax.tree.leaves(again.adapted) == jax.tree.leaves(found.adapted)
    other = adaptation.adapt(frame, dim, adaptation=SURE, key=jax.random.key(1))
    assert jax.tree.leaves(other.adapted) != jax.tree.leaves(found.adapted)
    stopped = adaptation.adapt(frame, dim, adaptation=SURE, progress=lambda n, _: n < 7)
    assert stopped.steps.tolist() == [0, 5, 7]
    np.testing.assert_array_equal(stopped.risks[:2], found.risks[:2])


def test_what_is_right_already_stays(adapted):
    """Zero variance: SURE is (y − x)², 0 for the identity; no step is surely better."""
    frame, *_ = adapted
    frame = frame.replace(variance=jnp.zeros_like(frame.variance))

    identity = pd.FunctionDenoiser(jax.tree_util.Partial(lambda w, x: w * x, jnp.float32(1)))
    found = adaptation.adapt(frame, identity, adaptation=dataclasses.replace(SURE, steps=1))
    assert found.step == 0
    assert jax.tree.leaves(found.adapted) == [1]


def test_only_some_weights(adapted):
    frame, _, dim, _ = adapted
    some = dataclasses.replace(SURE, steps=5, only=("rest",))
    found = adaptation.adapt(frame, dim, adaptation=some)
    assert found.adapted.gain == dim.gain
    assert found.adapted.rest != dim.rest
    with pytest.raises(ValueError, match="only names conv9, expected some of gain, rest"):
        adaptation.adapt(frame, dim, adaptation=dataclasses.replace(some, only=("conv9",)))


def test_a_correction_is_fitted_by_sure(corrected):
    """To one image, no halves; where a step makes nothing better, the denoiser stays as it is."""
    halves, bright, _, _, truth = corrected
    settings = dataclasses.replace(SURE, steps=60, rate=None, every=20)
    frame = halves.frame
    found = adaptation.correct_by_sure(frame, bright, correction=SMALL, adaptation=settings)
    assert isinstance(found.adapted, adaptation.PostCorrected)
    assert jax.tree.leaves(found.adapted.denoiser) == jax.tree.leaves(bright)
    before, after = (
        ((np.asarray(image_of(f, frame)) - truth) ** 2).mean() for f in (bright, found.adapted)
    )
    assert after < 0.1 * before
    assert found.after < found.before
    hardly = dataclasses.replace(settings, steps=1, confidence=1e3)
    same = adaptation.correct_by_sure(frame, bright, correction=SMALL, adaptation=hardly)
    assert same.step == 0
    assert jax.tree.leaves(same.adapted) == jax.tree.leaves(bright)
    settings = dataclasses.replace(settings, steps=1)
    again = adaptation.correct_by_sure(
        frame, bright, correction=SMALL, adaptation=settings, start=found.adapted.params
    )
    assert isinstance(again.adapted, adaptation.PostCorrected)
    assert again.risks[0] == pytest.approx(found.risks.min(), rel=1e-4)
    assert again.risks[0] < found.risks[0]
    with pytest.raises(ValueError, match="other shapes"):
        adaptation.correct_by_sure(frame, bright, start=found.adapted.params)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Constant:
    """The same share of the denoised image everywhere."""

    logit: jax.Array

    def __call__(self, x, y, variance, divergence, sure, *, inside=None, level=None):
        return jnp.broadcast_to(jax.nn.sigmoid(self.logit), x.shape)


def test_a_mixer_is_adapted_by_the_risk_of_the_mix(adapted):
    """Behind a good denoiser of a noisy image α has to rise."""
    frame, *_ = adapted
    mixer = Constant(jnp.float32(-1))
    settings = dataclasses.replace(SURE, steps=20, rate=0.1)
    found = adaptation.adapt_mixer(frame, BLUR, mixer, adaptation=settings)
    assert isinstance(found.adapted, Constant)
    assert found.adapted.logit > 0
    with pytest.raises(ValueError, match="has no weights to adapt"):
        adaptation.adapt_mixer(frame, BLUR, pd.ClosedForm())


def test_blocks_hold_what_they_should():
    kinds = _blocks.kinds((40, 60), 8, np.random.default_rng(0))
    assert kinds.shape == (5, 8)
    assert np.bincount(kinds.ravel()).tolist() == [24, 10, 6]
    values = _blocks.spread(kinds, (40, 60)).astype(float)
    np.testing.assert_array_equal(_blocks.means(values, kinds.shape), kinds)


def test_noise_that_channels_share():
    """Its correlation is found, and the divergence has the terms between channels."""
    rng = np.random.default_rng(0)
    noise = np.sqrt(0.6) * rng.normal(size=(64, 64, 1)) + np.sqrt(0.4) * rng.normal(
        size=(64, 64, 3)
    )
    sigma = np.asarray([0.1, 0.2, 0.4])
    frame = pd.Frame(
        np.float32(1 + sigma * noise), np.float32(np.broadcast_to(sigma**2, noise.shape))
    )
    found = jax.jit(_noise.correlation)(frame)
    assert abs(found - 0.6) < 0.02
    mixing = np.float32(rng.normal(size=(3, 3)))
    shared = jnp.float32(0.6)

    @jax.jit
    def evaluate(x, variance, key):
        def f(x):
            return x @ mixing.T

        return _noise.evaluate(f, x, variance, shared, key, probes=4)

    value, divergence, *_ = evaluate(frame.color, frame.variance, jax.random.key(0))
    np.testing.assert_allclose(value, np.asarray(frame.color) @ mixing.T, rtol=1e-5, atol=1e-5)
    covariance = np.outer(sigma, sigma) * np.where(np.eye(3) == 1, 1, 0.6)
    divergence = np.asarray(divergence, np.float64)
    error = divergence.std((0, 1)) / 64
    assert (abs(divergence.mean((0, 1)) - (covariance * mixing).sum(1)) < 4 * error).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: adaptation.adapt(f.replace(variance=None), BLUR), "has no variance"),
        (lambda f: adaptation.adapt(f, pd.FunctionDenoiser(jnp.tanh)), "has no weights"),
        (
            lambda f: adaptation.split(f.replace(variance=None), jax.random.key(0)),
            "has no variance",
        ),
        (lambda f: adaptation.halves(f, frame_of(0, size=(4, 4))[0]), "b.color has shape"),
        (
            lambda f: adaptation.halves(f.replace(spp=8.0), f.replace(spp=24.0)),
            "the halves have 8 and 24 samples per pixel, expected equal ones",
        ),
        (lambda f: adaptation.paired(subaverages.averaged([f] * 3)), "there are 3 sub-averages"),
        (lambda f: adaptation.adapt(pd.Frame(f.color[:1, :1], f.color[:1, :1]), BLUR), "too few"),
        (lambda f: adaptation.PostCorrection(window=4), "window is 4"),
        (lambda f: adaptation.PostCorrection(rate=0), "rate is 0"),
        (lambda f: adaptation.Adaptation(rate=-1), "rate is -1"),
        (lambda f: adaptation.Adaptation(confidence=-1), "confidence is -1"),
        (lambda f: adaptation.Adaptation(steps=0), "steps is 0"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(frame_of(0, size=(6, 6))[0])
