"""Fine levels in bands of rows: the same numbers, and less memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import progden_jax as pd
from progden_jax import _bands, _slopes, denoisers, mixers
from progden_jax.denoisers import _stages, graph, unet
from progden_jax.denoisers._network import he_params
from progden_jax.denoisers.nodes import Conv, Input, MaxPool, Relu, Upsample

RNG = np.random.default_rng(0)


def _network(seed=0):
    """OIDN's small U-Net with random weights, biases too."""
    nodes = unet.graph(unet.shapes("small"))
    params = he_params(jax.random.key(seed), nodes, unet.shapes("small"), [1.0] * 3)
    biased = {
        name: {**layer, "bias": jnp.asarray(RNG.normal(size=layer["bias"].shape) / 5, jnp.float32)}
        for name, layer in params.items()
    }
    return nodes, biased


@pytest.mark.parametrize("valid", [None, (75, 41)])
@pytest.mark.parametrize(("height", "rows"), [(96, 16), (96, 24), (80, 32)])
def test_a_network_in_bands_is_the_network(valid, height, rows):
    nodes, params = _network()
    x, along = (jnp.asarray(RNG.normal(size=(height, 48, 3)), jnp.float32) for _ in range(2))
    inside = None
    if valid is not None:
        inside = (jnp.arange(height) < valid[0])[:, None, None] & (jnp.arange(48) < valid[1])[
            :, None
        ]
        x = jnp.where(inside, x, 0)

    def banded(x):
        return _stages.evaluate(nodes, params, x, inside=inside, rows=rows)

    def whole(x):
        return graph.evaluate(nodes, params, x, inside=inside)[0]

    assert "scan" in str(jax.make_jaxpr(banded)(x))
    found, expected = (
        jax.jit(lambda x, f=f: jax.jvp(f, (x,), (along,)))(x) for f in (banded, whole)
    )
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(
            ours, theirs, rtol=1e-4, atol=2e-5 * float(jnp.abs(theirs).max())
        )


def test_derivatives_by_weights_pass_through_bands():
    nodes, params = _network(1)
    x = jnp.asarray(RNG.normal(size=(64, 32, 3)), jnp.float32)

    def slopes(evaluate):
        return jax.jit(jax.grad(lambda p: (evaluate(p) ** 2).sum()))(params)

    found = slopes(lambda p: _stages.evaluate(nodes, p, x, rows=16))
    expected = slopes(lambda p: graph.evaluate(nodes, p, x)[0])
    for layer, parts in expected.items():
        for kind, theirs in parts.items():
            scale = float(jnp.abs(theirs).max())
            np.testing.assert_allclose(found[layer][kind], theirs, rtol=1e-3, atol=1e-4 * scale)


@pytest.mark.parametrize(
    "nodes",
    [
        # A skip at full resolution.
        (
            Input(),
            Conv((0,), "a"),
            Relu(1),
            MaxPool(2),
            Conv((3,), "b"),
            Upsample(4),
            Conv((5, 2), "c"),
        ),
        # No pooling.
        (Input(), Conv((0,), "a"), Relu(1), Conv((2,), "d")),
    ],
)
def test_other_networks_go_as_a_whole(nodes):
    shapes = {"a": (3, 4), "b": (3, 4), "c": (3, 3), "d": (3, 3)}
    params = he_params(jax.random.key(0), nodes, shapes, [1.0] * 3)
    x = jnp.asarray(RNG.normal(size=(32, 16, 3)), jnp.float32)
    found = _stages.evaluate(nodes, params, x, rows=8)
    np.testing.assert_array_equal(found, graph.evaluate(nodes, params, x)[0])


def test_bands_and_what_they_see():
    """The sum over five rows, zero beyond the image; a height that does not divide goes as a whole."""

    def five(x):
        padded = jnp.pad(x, ((2, 2), (0, 0), (0, 0)))
        return sum(padded[i : i + len(x)] for i in range(5))

    for height, bands in ((24, 4), (23, 1), (9, 1)):
        x = jnp.asarray(RNG.integers(0, 9, (height, 2, 3)), jnp.float32)
        seen = []

        def told(x, seen=seen):
            seen.append(len(x))
            return five(x)

        found = _bands.in_bands(told, (x,), height, rows=6, halo=2)
        np.testing.assert_array_equal(found, five(x))
        assert set(seen) == {height if bands == 1 else height // bands + 4}


@pytest.mark.parametrize("rows", [16, 12, 6, 7])
def test_a_bit_per_value_is_kept(rows):
    """Of 8, 4, 2 and 1 rows a byte; forwards, backwards and over batches."""
    x, t = (jnp.asarray(RNG.normal(size=(2, rows, 3, 5)), jnp.float32) for _ in range(2))

    def relu(x):
        return _slopes.where_passes(x > 0, x)

    np.testing.assert_array_equal(relu(x[0]), jnp.maximum(x[0], 0))
    expected = jnp.where(x > 0, t, 0)
    np.testing.assert_array_equal(jax.jvp(jax.vmap(relu), (x,), (t,))[1], expected)
    np.testing.assert_array_equal(jax.vjp(relu, x[0])[1](t[0])[0], expected[0])
    kept = jax.tree.leaves(jax.linearize(relu, x[0])[1])
    assert sum(a.nbytes for a in kept) == 15 * rows / {16: 8, 12: 4, 6: 2, 7: 1}[rows]


def test_a_byte_per_pool_is_kept():
    """Ties go to the first."""
    four = [jnp.asarray(RNG.integers(0, 3, (6, 5, 4)), jnp.float32) for _ in range(4)]
    along = [jnp.asarray(RNG.normal(size=(6, 5, 4)), jnp.float32) for _ in range(4)]
    value, slope = jax.jvp(_slopes.largest, tuple(four), tuple(along))
    which = np.argmax(four, axis=0)
    np.testing.assert_array_equal(value, np.max(four, axis=0))
    np.testing.assert_array_equal(slope, np.take_along_axis(np.stack(along), which[None], 0)[0])
    kept = jax.tree.leaves(jax.linearize(_slopes.largest, *four)[1])
    assert [a.dtype for a in kept] == [np.uint8]


def test_a_pointwise_function_keeps_its_slope():
    x = jnp.asarray(RNG.random((4, 5)) + 0.5, jnp.float32)

    def chained(x, exposure):
        return jnp.log(jnp.exp(jnp.sin(x * exposure)) + x**3)

    value, slope = _slopes.pointwise(chained, x, 2.0), jnp.ones_like(x)
    np.testing.assert_array_equal(value, chained(x, 2.0))
    ours, theirs = (
        jax.jvp(f, (x,), (slope,))[1]
        for f in (lambda x: _slopes.pointwise(chained, x, 2.0), lambda x: chained(x, 2.0))
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    kept = jax.tree.leaves(jax.linearize(lambda x: _slopes.pointwise(chained, x, 2.0), x)[1])
    assert [a.shape for a in kept] == [x.shape]


@pytest.mark.parametrize("name", ["paper", "multiscale"])
def test_a_mixer_in_bands_is_the_mixer(name, monkeypatch):
    """Its own level, of the whole image, where it takes one; rows of different brightness tell."""
    architecture = mixers.build(name)
    params = jax.tree.map(lambda a: a + 0.05, jax.jit(architecture.init)(jax.random.key(0)))
    mixer = mixers.NetworkMixer(params, architecture)
    height = 2 * (16 + 2) * architecture.receptive_radius
    bright = jnp.linspace(0.1, 40, height)[:, None, None]
    x, y = (bright * jnp.asarray(RNG.random((height, 40, 3)), jnp.float32) for _ in range(2))
    variance, divergence = (y - x) ** 2 + 0.01, 0.3 * (y - x) ** 2
    known = (x, y, variance, divergence, pd.sure(x, y, variance, divergence))
    inside = (jnp.arange(height) < height - 3)[:, None, None] & jnp.ones((1, 40, 1), bool)
    call = jax.jit(lambda: mixer(*known, inside=inside))
    expected = call()
    monkeypatch.setattr(mixers, "rows_of", lambda height, width: 8)
    call = jax.jit(lambda: mixer(*known, inside=inside))
    assert "scan" in str(jax.make_jaxpr(lambda: mixer(*known, inside=inside))())
    np.testing.assert_allclose(call()[:-3], expected[:-3], atol=2e-5)


def test_temporaries_of_a_large_image(monkeypatch):
    """Forward pass and one probe of a megapixel, as XLA counts."""
    oidn = denoisers.load("oidn-hdr-small")
    x = jnp.zeros((1024, 1024, 3))

    def evaluate(x):
        f = oidn.bind(pd.Frame(x, x))
        return pd.MonteCarlo(probes=1).evaluate(f, x, x, jax.random.key(0))[:2]

    def temporaries():
        # Another function each time, that is compiled anew.
        compiled = jax.jit(lambda x: evaluate(x)).lower(x).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    banded = temporaries()
    monkeypatch.setattr(_stages, "rows_of", lambda height, width: height)
    jax.clear_caches()
    assert banded < 0.65 * temporaries()
