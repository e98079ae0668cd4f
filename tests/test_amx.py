"""Convolutions by matrix units against dense sums in float64, and what is said where there are none."""

import itertools
import os
import stat

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from progden_jax import _amx, _amx_convolution, denoisers
from progden_jax._convolution import same_convolution, upsampled_convolution
from progden_jax._slopes import packed, unpacked
from progden_jax._upsampling import folded
from progden_jax.denoisers import _network, layers
from progden_jax.divergence._reach import radii

needs_amx = pytest.mark.skipif(_amx.status() is not None, reason=f"AMX: {_amx.status()}")


def dense(image, kernel):
    """Every tap's product in float64, zeros around."""
    kh, kw = kernel.shape[:2]
    border = ((0, 0), (kh // 2,) * 2, (kw // 2,) * 2, (0, 0))
    padded, kernel = np.pad(np.asarray(image, np.float64), border), np.asarray(kernel, np.float64)
    h, w = image.shape[1:3]
    taps = itertools.product(range(kh), range(kw))
    return sum(padded[:, i : i + h, j : j + w] @ kernel[i, j] for i, j in taps)


def repeated(low):
    return np.repeat(np.repeat(np.asarray(low), 2, axis=1), 2, axis=2)


def drawn(rng, *shape):
    return jnp.asarray(rng.normal(size=shape), jnp.float32)


def off(found, expected):
    return np.sqrt(np.mean((np.asarray(found, np.float64) - expected) ** 2) / np.mean(expected**2))


@needs_amx
@pytest.mark.parametrize(
    ("size", "channels", "outputs", "edge"),
    [
        ((1, 1), 64, 32, 3),
        ((5, 17), 9, 33, 3),
        ((3, 33), 13, 3, 5),
        ((18, 131), 48, 80, 3),
        ((21, 259), 32, 40, 3),
        ((9, 66), 80, 16, 3),
        ((6, 140), 16, 20, 5),
        ((2, 40), 7, 16, 7),
        ((33, 16), 1, 64, 3),
        ((4, 200), 700, 5, 1),
    ],
    ids=str,
)
def test_convolution(size, channels, outputs, edge):
    """Sizes and channels that fill no tile, or half of one; a patch larger than its share of the cache."""
    rng = np.random.default_rng(0)
    image = drawn(rng, 2, *size, channels)
    kernel = drawn(rng, edge, edge, channels, outputs)
    expected = dense(image, kernel)
    for planes, bound in ((1, 1e-2), (2, 2e-5), (3, 5e-7)):
        found = _amx_convolution.convolution(None, None, image, kernel, planes=planes)
        assert off(found, expected) < bound
    assert off(found, expected) < 2 * off(plain(image, kernel), expected)
    by_rows = _amx_convolution.convolution(None, None, image, kernel, planes=3, together=1)
    assert off(by_rows, expected) < 2 * off(plain(image, kernel), expected)
    # Rows are summed first where kernels have three or five, each longer than a step of the units.
    same = edge not in (3, 5) or edge * channels <= 32
    assert (np.asarray(by_rows) == np.asarray(found)).all() == same


def plain(image, kernel):
    return lax.conv_general_dilated(
        *(image, kernel, (1, 1), "SAME"),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision="highest",
    )


@needs_amx
@pytest.mark.parametrize(("below", "skip"), [(20, 0), (20, 9), (48, 32), (64, 3)])
def test_of_pixels_that_are_repeated(below, skip):
    rng = np.random.default_rng(1)
    low, image = drawn(rng, 2, 9, 35, below), drawn(rng, 2, 18, 70, skip)
    kernel = drawn(rng, 3, 3, below + skip, 37)
    expected = dense(np.concatenate([repeated(low), image], -1), kernel)
    assert off(upsampled_convolution(low, image, kernel, "highest"), expected) < 5e-7
    assert 1e-7 < off(upsampled_convolution(low, image, kernel, "high"), expected) < 2e-5
    assert 1e-4 < off(upsampled_convolution(low, image, kernel, "bfloat16"), expected) < 1e-2


@needs_amx
@pytest.mark.parametrize("rows", [16, 12, 10, 7])
def test_bias_relu_gate_and_bounds(rows):
    """A bit of the gate for each of 8, 4, 2 or 1 rows."""
    rng = np.random.default_rng(2)
    image, kernel, bias = drawn(rng, 2, rows, 37, 16), drawn(rng, 3, 3, 16, 35), drawn(rng, 35)
    bits = {16: 8, 12: 4, 10: 2, 7: 1}[rows]
    passes = rng.random((2, rows, 37, 35)) < 0.5
    inside = np.arange(rows * 37).reshape(1, rows, 37) % 37 < 30
    gate = packed(jnp.asarray(passes), bits)
    np.testing.assert_array_equal(unpacked(gate, bits), passes)
    summed = np.asarray(_amx_convolution.convolution(None, None, image, kernel, planes=3)) + bias
    for settings, expected in (
        ({}, summed),
        ({"relu": True}, np.maximum(summed, 0)),
        ({"gate": gate, "bits": bits}, np.where(passes, summed, 0)),
        ({"inside": jnp.asarray(inside, jnp.uint8)}, np.where(inside[..., None], summed, 0)),
    ):
        found = _amx_convolution.convolution(
            None, None, image, kernel, planes=3, bias=bias, **settings
        )
        np.testing.assert_array_equal(found, expected)


@needs_amx
@pytest.mark.parametrize("size", [(1, 5), (18, 131)], ids=str)
def test_an_addend(size):
    """With all else that a convolution takes along, its derivatives, and in a batch."""
    rng = np.random.default_rng(6)
    image, kernel = drawn(rng, 2, *size, 16), drawn(rng, 3, 3, 16, 35)
    bias, plus = drawn(rng, 35), drawn(rng, 2, *size, 35)
    inside = jnp.asarray(rng.random((1, *size)) < 0.7, jnp.uint8)
    settings = {"planes": 3, "bias": bias, "inside": inside, "relu": True}

    def found(image, plus):
        return _amx_convolution.convolution(None, None, image, kernel, plus=plus, **settings)

    def expected(image, plus):
        summed = _amx_convolution.convolution(None, None, image, kernel, planes=3, bias=bias)
        return jnp.where(inside[..., None] != 0, jax.nn.relu(summed + plus), 0)

    np.testing.assert_array_equal(found(image, plus), expected(image, plus))
    along = drawn(rng, *image.shape), drawn(rng, *plus.shape)
    for some in (along, (along[0] * 0, along[1])):
        ours, theirs = (jax.jvp(f, (image, plus), some)[1] for f in (found, expected))
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    back = drawn(rng, *plus.shape)
    ours, theirs = (jax.vjp(f, image, plus)[1](back) for f in (found, expected))
    for our, their in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(our, their, atol=1e-4)
    only = jax.grad(lambda plus: (found(image, plus) * back).sum())(plus)
    np.testing.assert_array_equal(only, theirs[1])
    images, plusses = drawn(rng, 3, *image.shape), drawn(rng, 3, *plus.shape)
    for axes, given in (((0, 0), (images, plusses)), ((None, 0), (image, plusses))):
        at_once = jax.vmap(found, axes)(*given)
        by_each = [found(images[i] if axes[0] == 0 else image, plusses[i]) for i in range(3)]
        np.testing.assert_array_equal(at_once, jnp.stack(by_each))


@needs_amx
def test_an_addend_is_overwritten_where_nobody_needs_it():
    """Not where it is asked for too, nor where it is what is convolved."""
    rng = np.random.default_rng(7)
    image, kernel = drawn(rng, 1, 60, 70, 32), drawn(rng, 3, 3, 32, 32)

    def layer(image, **settings):
        return _amx_convolution.convolution(None, None, image, kernel, planes=3, **settings)

    def block(image):
        first = layer(image)
        return layer(layer(first), plus=first), first

    def residuals(image):
        once, _ = block(image)
        return layer(once, plus=once)

    before = np.array(image)
    last, first = (np.array(a) for a in block(image))
    for f, expected in (
        (block, (last, first)),
        (lambda image: block(image)[0], last),
        (residuals, layer(last) + last),
    ):
        for found in (f(image), jax.jit(f)(image)):
            jax.tree.map(np.testing.assert_array_equal, found, expected)
    np.testing.assert_array_equal(image, before)
    needed = jax.jit(lambda image: block(image)[0]).lower(image).compile().memory_analysis()
    assert needed.temp_size_in_bytes < 2.5 * image.nbytes


@needs_amx
@pytest.mark.parametrize("by", ["inside", "gate"])
@pytest.mark.parametrize("upsampled", [False, True])
@pytest.mark.parametrize("channels", [8, 48])
def test_where_nothing_passes(by, upsampled, channels):
    """Whole blocks and rows of them, which are left out, with what lies there not finite."""
    rng = np.random.default_rng(4)
    image, kernel = drawn(rng, 2, 50, 300, channels), drawn(rng, 3, 3, channels, 40)
    image = image.at[:, 20:, 135:].set(jnp.nan)
    low: tuple = (None, None)
    if upsampled:
        low = drawn(rng, 2, 25, 150, channels), folded(drawn(rng, 3, 3, channels, 40))
    passes = np.zeros((2, 50, 300, 40), bool)
    passes[:, :19, :133] = passes[1, 0, :, 35] = True
    if by == "inside":
        settings = {"inside": jnp.asarray(passes[..., 0], jnp.uint8)}
        passes = np.repeat(passes[..., :1], 40, -1)
    else:
        settings = {"gate": packed(jnp.asarray(passes), 2), "bits": 2}
    summed = _amx_convolution.convolution(*low, image, kernel, planes=3)
    found = _amx_convolution.convolution(*low, image, kernel, planes=3, **settings)
    np.testing.assert_array_equal(found, np.where(passes, summed, 0))
    assert np.isfinite(found).all()


@needs_amx
@pytest.mark.parametrize("precision", ["highest", "bfloat16"])
def test_few_weights_are_left_to_xla(precision):
    """However large the image: their tiles would be mostly empty."""
    image = jnp.zeros((1, 64, 64, 32))
    assert _amx.planes(precision, jnp.zeros((3, 3, 7, 8)), image) == 0
    assert _amx.planes(precision, jnp.zeros((3, 3, 8, 8)), image) > 0
    layer = {"kernel": jnp.zeros((3, 3, 7, 8))}
    assert not layers.rectifies(layer, precision, image)


@needs_amx
@pytest.mark.parametrize("together", [1, 2, 4, 8])
@pytest.mark.parametrize("form", ["3×3", "5×5", "upsampled"])
@pytest.mark.parametrize("channels", [24, 48])
def test_a_part_is_the_same_bits(form, together, channels):
    """Where it begins at rows that fit, a pixel gets what it gets in the whole image."""
    rng = np.random.default_rng(3)
    edge = 5 if form == "5×5" else 3
    low, image = drawn(rng, 1, 35, 75, channels), drawn(rng, 1, 70, 150, channels)
    kernel = drawn(rng, edge, edge, channels * (2 if form == "upsampled" else 1), 40)

    def convolved(rows, columns):
        part = image[:, slice(*rows), slice(*columns)]
        if form != "upsampled":
            return same_convolution(part, kernel, "highest", together)
        halves = (slice(*(n // 2 for n in ends)) for ends in (rows, columns))
        return upsampled_convolution(low[:, *halves], part, kernel, "highest", together)

    whole = convolved((0, 70), (0, 150))
    least = max(together, 2 if form == "upsampled" else 1)
    for first in (least, 3 * least):
        part = convolved((first, first + 34), (50, 120))
        expected = whole[:, first + 2 : first + 32, 52:118]
        np.testing.assert_array_equal(part[:, 2:-2, 2:-2], expected)


def layer_and_images(rng):
    layer = {"kernel": drawn(rng, 3, 3, 12 + 5, 20) / 5, "bias": drawn(rng, 20)}
    return layer, drawn(rng, 3, 4, 12), drawn(rng, 6, 8, 5), jnp.arange(48).reshape(6, 8, 1) % 8 < 7


@needs_amx
@pytest.mark.parametrize("upsampled", [False, True])
def test_derivatives_of_a_rectified_convolution(upsampled):
    """Forward, reverse, second and of what was linearised, by everything, and in batches."""
    layer, low, image, inside = layer_and_images(np.random.default_rng(4))

    def joined(layer, low, image):
        if upsampled:
            return layers.convolve_rectified(layer, low, [image], inside, "highest", 0)
        wide = jnp.repeat(jnp.repeat(low, 2, 0), 2, 1)
        return layers.convolve_rectified(layer, None, [wide, image], inside, "highest", 0)

    def by_xla(layer, low, image):
        both = jnp.concatenate([jnp.repeat(jnp.repeat(low, 2, 0), 2, 1), image], -1)
        value = plain(both[None], layer["kernel"])[0] + layer["bias"]
        return jnp.where(inside, jax.nn.relu(value), 0)

    def everything(f):
        def total(*given):
            return (jnp.sin(f(*given)) ** 2).sum()

        def along(*given):
            return jax.jvp(total, given, given)[1]

        def linearised(*given):
            tangent = jax.linearize(lambda low, image: f(given[0], low, image), *given[1:])[1]
            return (tangent(*given[1:]) ** 2).sum()

        def batches(layer, low, image):
            more = jnp.stack([low, -low]), jnp.stack([image, 2 * image])
            layers = jax.tree.map(lambda a: jnp.stack([a, 2 * a]), layer)
            return (
                jax.vmap(f, (None, 0, 0))(layer, *more),
                jax.vmap(f, (None, None, 0))(layer, low, more[1]),
                jax.vmap(f)(layers, *more),
            )

        every = (0, 1, 2)
        return jax.jit(
            lambda *given: (
                *(jax.grad(g, every)(*given) for g in (total, along, linearised)),
                along(*given),
                jax.jvp(lambda low: f(given[0], low, given[2]), (low,), (low,)),
                jax.jvp(lambda image: f(*given[:2], image), (image,), (image,)),
                batches(*given),
            )
        )(layer, low, image)

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3),
        everything(joined),
        everything(by_xla),
    )


@needs_amx
def test_reach(monkeypatch):
    """What convolutions by matrix units read is known exactly."""
    rng = np.random.default_rng(5)
    kernel, other = drawn(rng, 5, 5, 4, 16), drawn(rng, 3, 3, 20, 16)

    def f(x):
        x = jnp.pad(x, ((0, 0), (0, 0), (0, 1)))[None]
        low = same_convolution(x[:, ::2, ::2], kernel)
        return upsampled_convolution(low, x, other)[0, :, :, :3]

    # An even row reads the row of cells before its own, and that two more: six rows of the image.
    assert radii(f, jnp.zeros((64, 64, 3))) == (6, 6)
    monkeypatch.setattr(_amx, "available", lambda: False)
    assert min(radii(lambda x: f(x), jnp.zeros((64, 64, 3)))) >= 6


@needs_amx
def test_networks_agree_with_xla(real_frame, monkeypatch):
    frame = jax.tree.map(lambda a: jnp.asarray(a[40:76, 30:70]) if a.ndim else a, real_frame)
    f, x = denoisers.load("oidn-hdr-small").bind(frame), jnp.asarray(frame.color)
    found = []
    for by_amx in (True, False):
        if not by_amx:
            monkeypatch.setattr(_amx, "available", lambda: False)
        _network._run_bound.clear_cache()
        found.append(jax.jvp(f, (x,), (x,)))
    _network._run_bound.clear_cache()
    for a, b in zip(*found, strict=True):
        assert 0 < off(a, np.asarray(b, np.float64)) < 5e-6


@pytest.fixture
def fresh():
    """As in a process that has not asked yet."""
    _amx.status.cache_clear()
    yield
    _amx.status.cache_clear()


def test_switched_off(fresh, monkeypatch):
    monkeypatch.setenv("PROGDEN_AMX", "0")
    assert _amx.status() == "switched off by PROGDEN_AMX"
    assert not _amx.available()
    assert _amx.planes("highest", jnp.zeros((3, 3, 32, 32))) == 0


def test_a_cpu_without_it(fresh, monkeypatch):
    monkeypatch.setattr(_amx, "_cpu_flags", lambda: {"sse", "avx512bw"})
    assert "the CPU has no amx_bf16, amx_tile" in str(_amx.status())


@pytest.fixture
def on_any_cpu(fresh, monkeypatch, tmp_path):
    monkeypatch.setattr(_amx, "_cpu_flags", lambda: _amx._NEEDED)
    quick = tuple("-O0" if flag == "-O3" else flag for flag in _amx._FLAGS)
    monkeypatch.setattr(_amx, "_FLAGS", quick)
    monkeypatch.setenv("PROGDEN_CACHE", str(tmp_path / "cache"))
    return tmp_path


def test_no_compiler(on_any_cpu, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(on_any_cpu))
    assert "there is no C++ compiler" in str(_amx.status())


def test_a_compiler_that_fails(on_any_cpu, monkeypatch):
    """Its last words are said, and nothing half made stays."""
    compiler = on_any_cpu / "broken"
    script = '#!/bin/sh\n[ "$1" = --version ] && exit 0\necho "no such flag" >&2\nexit 1\n'
    compiler.write_text(script)
    compiler.chmod(compiler.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("CXX", str(compiler))
    assert "could not compile _amx.cc: no such flag" in str(_amx.status())
    assert os.listdir(on_any_cpu / "cache") == []


@needs_amx
def test_it_is_compiled_once(on_any_cpu, monkeypatch):
    assert _amx._loaded().progden_asks_for_amx()
    (made,) = (on_any_cpu / "cache").iterdir()
    monkeypatch.setattr(_amx, "_compiled", None)
    assert _amx._loaded()._name == str(made)


@needs_amx
def test_a_cache_that_cannot_be_written(on_any_cpu, monkeypatch):
    """It is compiled all the same, and leaves nothing behind."""
    (on_any_cpu / "file").touch()
    monkeypatch.setenv("PROGDEN_CACHE", str(on_any_cpu / "file" / "cache"))
    (on_any_cpu / "scratch").mkdir()
    monkeypatch.setattr(_amx.tempfile, "tempdir", str(on_any_cpu / "scratch"))
    assert _amx._loaded().progden_asks_for_amx()
    assert os.listdir(on_any_cpu / "scratch") == []
