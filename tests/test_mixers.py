"""Learned mixers: architectures, weights files, padding; and the convolution that they train with."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn
from jax import lax

import progden_jax as pd
from progden_jax import _program, mixers
from progden_jax._convolution import same_convolution, upsampled_convolution
from progden_jax.cli import main
from progden_jax.mixers import multiscale
from progden_jax.mixing import f_act


@pytest.fixture(scope="module")
def mixer() -> pd.NetworkMixer:
    """A network of 4 channels with biases in which a border would show."""
    architecture = mixers.build("paper", {"width": 4})
    params = jax.jit(architecture.init)(jax.random.key(1))
    params = jax.tree.map(lambda p: np.asarray(p) + 0.05, params)
    return pd.NetworkMixer(params, architecture, metadata={"denoiser": "blur"})


@pytest.fixture(scope="module", params=["paper", "multiscale"])
def either(request, mixer) -> pd.NetworkMixer:
    """Of every architecture one, with weights that leave no layer out."""
    if request.param == "paper":
        return mixer
    architecture = mixers.build("multiscale", {"width": 4, "blocks": 1})
    return pd.NetworkMixer(noisy(drawn(form(architecture)), 0.2), architecture)


def form(architecture):
    return jax.eval_shape(architecture.init, jax.random.key(0))


def fresh(architecture):
    """Weights as `init` gives them in the last layer, the one that matters for how a mixer begins."""
    last = jax.jit(lambda key: architecture.init(key)["conv_out"])(jax.random.key(0))
    return {**drawn(form(architecture)), "conv_out": last}


def noisy(params, spread):
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda p: np.float32(p + spread * rng.normal(size=p.shape)), params)


def test_weights_round_trip(mixer, tmp_path, images):
    path = tmp_path / "mine.safetensors"
    mixers.save_mixer(path, mixer, steps="3")
    loaded = pd.load_mixer(path)
    assert loaded.architecture == mixer.architecture
    assert loaded.metadata["denoiser"] == "blur"
    assert loaded.metadata["steps"] == "3"
    jax.tree.map(np.testing.assert_array_equal, loaded.params, mixer.params)
    mixers.save_mixer(path, mixer, dtype="float16")
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6),
        pd.load_mixer(path).params,
        mixer.params,
    )


def test_weights_that_will_not_do(mixer, tmp_path, capsys):
    path = tmp_path / "mine.safetensors"
    with pytest.raises(ValueError, match="expected one of closed-form"):
        pd.load_mixer("guess")
    with pytest.raises(ValueError, match="cannot read the weights"):
        pd.load_mixer(path)
    for text in ({"kind": "denoiser"}, {"kind": "mixer"}):
        mixers._safetensors.write(path, mixer.params, text, dtype="float32")
        with pytest.raises(ValueError, match="holds no mixer|'architecture'"):
            pd.load_mixer(path)
    wider = pd.NetworkMixer(mixer.params, mixers.build("paper", {"width": 5}))
    mixers.save_mixer(path, wider)
    with pytest.raises(ValueError, match="not those of the architecture Paper\\(width=5"):
        pd.load_mixer(path)
    with pytest.raises(ValueError, match="has no setting 'depth', expected some of width, sure"):
        mixers.build("paper", {"depth": 3})
    with pytest.raises(ValueError, match="architecture is 'huge', expected one of 'paper'"):
        mixers.build("huge")
    with pytest.raises(ValueError, match="space is 'cubic'"):
        mixers.build("paper", {"space": "cubic"})
    render = str(tmp_path / "a.exr")
    pd.write_exr(render, np.ones((4, 4, 3), np.float32))
    assert main(["denoise", render, "-o", str(tmp_path / "b.exr"), "--mixer", "guess"]) == 2
    assert "--mixer: mixer is 'guess', expected one of closed-form" in capsys.readouterr().err


def test_default_mixers(mixer, tmp_path, monkeypatch):
    """A file in the package's folder is the default for the denoiser that it is named after."""
    monkeypatch.setattr(mixers, "_FOLDER", tmp_path)
    mixers._shipped.cache_clear()
    blur = pd.FunctionDenoiser(lambda x: x / 2)
    assert mixers.names() == ("closed-form",)
    assert pd.load_mixer("closed-form") == pd.ClosedForm()
    for name in ("any", "nfor", "oidn-hdr"):
        mixers.save_mixer(tmp_path / f"mixer-{name}.safetensors", mixer)
    assert mixers.names() == ("closed-form", "any", "nfor", "oidn-hdr")
    named = pd.denoisers.load("oidn-hdr")
    assert mixers.default_for(named).architecture == mixer.architecture
    assert mixers.default_for(named) is pd.load_mixer("oidn-hdr")
    assert mixers.default_for(blur) is pd.load_mixer("any")
    for name, expected in (("nfor+combiner", "nfor"), ("oidn-hdr+combiner", "any")):
        assert mixers.default_for(SimpleNamespace(name=name)) is pd.load_mixer(expected)
    mixers._shipped.cache_clear()


def test_padding_is_as_the_border_of_the_image(either, images):
    """With `inside`, α is what it is for the image alone, whatever stands in the padding."""
    known = [images.x, images.y, images.variance, images.divergence, images.divergence]
    rng = np.random.default_rng(0)
    padded = []
    for image in known:
        big = rng.normal(size=(16, 24, 3)).astype(np.float32)
        big[:13, :18] = image
        padded.append(big)
    inside = np.zeros((16, 24, 1), bool)
    inside[:13, :18] = True
    run = jax.jit(lambda arrays, inside: either(*arrays, inside=inside))
    alone, found = run(known, None), run(padded, inside)[:13, :18]
    assert float(jnp.mean((alone > 0) & (alone < 1))) > 0.05
    np.testing.assert_allclose(found, alone, rtol=1e-4, atol=1e-5)


def test_in_the_pipeline(either, images):
    """Through jit, as an argument; one program for all weights, equal to the parts put together."""
    denoiser = pd.FunctionDenoiser(lambda x: 0.5 * x + 0.1)
    frame = pd.Frame(images.x, images.variance)
    result = pd.progressive_denoise(frame, denoiser, mixer=either)
    size = _program.progressive._cache_size()
    other = pd.NetworkMixer(jax.tree.map(lambda p: 2 * p, either.params), either.architecture)
    changed = pd.progressive_denoise(frame, denoiser, mixer=other)
    assert _program.progressive._cache_size() == size
    assert not np.allclose(changed.alpha, result.alpha)
    y, divergence, risk = result.denoised, result.divergence, result.sure
    alpha = jax.jit(
        lambda m: pd.t_bound(
            m(images.x, y, images.variance, divergence, risk), images.x, y, images.variance
        )
    )(either)
    np.testing.assert_allclose(result.alpha, alpha, rtol=1e-4, atol=1e-5)


def test_activation_has_a_gradient_at_the_start(images):
    """f_act of a fresh network is neither 0 nor 1 anywhere, so every pixel teaches it; nothing is NaN."""
    architecture = mixers.build("paper", {"width": 4})

    @jax.jit
    def start(key):
        params = architecture.init(key)
        risk = pd.sure(images.x, images.y, images.variance, images.divergence)

        def total(params):
            alpha = architecture.apply(
                params, images.x, images.y, images.variance, images.divergence, risk
            )
            return alpha.sum(), alpha

        return jax.grad(total, has_aux=True)(params)

    found, alpha = start(jax.random.key(0))
    assert ((alpha > 0) & (alpha < 1)).mean() > 0.9
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    # At the singularity itself the slope is that of the floor, 1e-6.
    slope = jax.grad(lambda a: f_act(a, jnp.zeros(()), jnp.zeros(())))(jnp.asarray(5e-7))
    np.testing.assert_allclose(slope, 1e6, rtol=1e-5)


def test_multiscale_starts_as_the_closed_form(images):
    """And follows neither exposure nor the order of colours; its gradients are finite where nothing is.

    In batches of two, so that one program does it all.
    """
    architecture = mixers.build("multiscale", {"width": 3, "blocks": 1})
    known = (images.x, images.y, images.variance, images.divergence)

    @jax.jit
    def run(params, x, y, variance, divergence):
        def total(params, *known):
            alpha = architecture.apply(params, *known, divergence)
            return alpha.sum(), alpha

        return jax.grad(total, (0, 1, 2, 3), has_aux=True)(params, x, y, variance, divergence)

    def scaled(scale):
        x, y, variance, divergence = known
        return (scale * x, scale * y, scale**2 * variance, scale**2 * divergence)

    def both(*pairs):
        return [np.stack(pair).astype(np.float32) for pair in zip(*pairs, strict=True)]

    params = fresh(architecture)
    closed = jax.jit(functools.partial(pd.closed_form_alpha, window=15))(*known)
    closed = np.clip(closed, 0.01, 0.99)
    _, alphas = run(params, *both(known, [2 * k for k in known]))
    np.testing.assert_allclose(alphas[0], closed, rtol=1e-3)

    params = noisy(params, 0.3)
    mixer = jax.jit(pd.NetworkMixer(params, architecture).__call__)
    alone = mixer(*known, images.divergence)
    assert np.abs(alone - closed).max() > 0.1
    for scales in ((1, 1e-3), (1, 1e4)):
        _, alphas = run(params, *both(*map(scaled, scales)))
        np.testing.assert_allclose(alphas[0], alone, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(alphas[1], alone, rtol=1e-3, atol=1e-4)
    nothing = both((np.zeros_like(images.x),) * 2, (np.full_like(images.x, 1e6),) * 2)
    zeros = np.zeros_like(nothing[0])
    gradients, alphas = run(params, *nothing, zeros, zeros)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))
    np.testing.assert_array_equal(alphas, 0)


def test_multiscale_ablations(images, tmp_path):
    """Each group hidden changes α, none the weights' shapes; without its start α begins at one half."""
    known = (images.x, images.y, images.variance, images.divergence, images.divergence)
    whole = mixers.build("multiscale", {"width": 3, "blocks": 1})
    params = noisy(drawn(form(whole)), 0.3)
    run = jax.jit(lambda mixer, *known: mixer(*known))
    alpha = run(pd.NetworkMixer(params, whole), *known)
    for group in multiscale.GROUPS:
        # As a configuration has it, and a weights file.
        settings = {"width": 3, "blocks": 1, "without": [group]}
        path = tmp_path / f"{group}.safetensors"
        mixers.save_mixer(path, pd.NetworkMixer(params, mixers.build("multiscale", settings)))
        loaded = pd.load_mixer(path)
        assert loaded.architecture.without == (group,)
        assert np.abs(run(loaded, *known) - alpha).max() > 0.01

    @jax.jit
    def features(*known):
        without = {group: (group,) for group in multiscale.GROUPS} | {"nothing": ()}
        return {name: multiscale.features(*known, without=w)[:2] for name, w in without.items()}

    found = features(*known[:4])
    for shown, closed in found.values():
        assert shown.shape[-1] == multiscale.CHANNELS
        np.testing.assert_array_equal(closed, found["nothing"][1])
    zeros = {group: int((np.asarray(f) == 0).all((0, 1)).sum()) for group, (f, _) in found.items()}
    assert zeros == {"scales": 21, "divergence": 9, "relative": 15, "nothing": 0}

    bare = mixers.build("multiscale", {"width": 3, "blocks": 1, "start": "none"})
    start = np.asarray(run(pd.NetworkMixer(fresh(bare), bare), *known))
    assert set(np.unique(start)) <= {0.0, 0.5}
    with pytest.raises(ValueError, match="without is 'colour', expected one of 'scales'"):
        mixers.build("multiscale", {"without": ["colour"]})
    with pytest.raises(ValueError, match="start is 'half', expected one of 'closed-form', 'none'"):
        mixers.build("multiscale", {"start": "half"})


def plain_convolution(x, kernel):
    numbers = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=numbers)


def derivatives(convolution, x, kernel):
    """Forward and reverse mode, second derivatives and batches."""

    def total(x, kernel):
        return (jnp.sin(jax.vmap(convolution, (0, None))(x, kernel)) ** 2).sum()

    def along(x, kernel):
        return jax.jvp(total, (x, kernel), (x, kernel))[1]

    # The arguments are given: as constants XLA would fold them through all of it.
    return jax.jit(
        lambda x, kernel: (
            jax.grad(total, (0, 1))(x, kernel),
            along(x, kernel),
            jax.grad(along, (0, 1))(x, kernel),
            jax.vmap(jax.grad(lambda x, k: convolution(x, k).sum(), 1), (0, None))(x, kernel),
        )
    )(x, kernel)


def assert_near(found, expected):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), found, expected
    )


@pytest.mark.parametrize(
    "shape",
    [(1, 1, 3, 2), (3, 5, 3, 2), (3, 5, 2, 5), (3, 7, 24, 24), (5, 3, 13, 24), (3, 5, 43, 24)],
    ids=["1x1", "output taps", "input taps", "wide", "points, rows filled up", "points"],
)
def test_convolution_and_its_derivatives(shape, monkeypatch):
    """In each form that the derivative by the kernel has, of more than one strip."""
    monkeypatch.setattr("progden_jax._kernel_products._STRIP", 16)
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(2, 2, 6, 8, shape[2])), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=shape) / shape[2], jnp.float32)
    expected = derivatives(plain_convolution, x, kernel)
    assert_near(derivatives(same_convolution, x, kernel), expected)


@pytest.mark.parametrize("skip", [0, 3])
def test_upsampled_convolution_and_its_derivatives(skip):
    """Each pixel repeated over 2×2 beside a skip of so many channels, also where one of both is constant."""
    rng = np.random.default_rng(0)
    low = jnp.asarray(rng.normal(size=(2, 1, 3, 4, 5)), jnp.float32)
    fine = jnp.asarray(rng.normal(size=(2, 1, 6, 8, skip)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(3, 3, 5 + skip, 2)) / 5, jnp.float32)

    def repeated(inputs, kernel):
        low, fine = inputs
        wide = jnp.repeat(jnp.repeat(low, 2, axis=-3), 2, axis=-2)
        return plain_convolution(jnp.concatenate([wide, fine], -1), kernel)

    def folded(inputs, kernel):
        return upsampled_convolution(*inputs, kernel)

    expected = derivatives(repeated, (low, fine), kernel)
    assert_near(derivatives(folded, (low, fine), kernel), expected)
    inputs = np.asarray(low)[0], np.asarray(fine)[0]
    for moving in (0, 1):

        def along(convolution, moving=moving):
            def one(part):
                return convolution((part, inputs[1]) if moving == 0 else (inputs[0], part), kernel)

            part = inputs[moving]
            return jax.jit(lambda part: jax.jvp(one, (part,), (part,)))(part)

        assert_near(along(folded), along(repeated))
