"""The exact divergence: unit vectors, colouring and cones against dense Jacobians in float64."""

import copy
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import dense_jacobian_diagonal, divergence, divergence_and_error, narrow_oidn

import progden_jax as pd
from progden_jax.denoisers import graph, unet
from progden_jax.denoisers.graph import (
    Add,
    Affine,
    Conv,
    Filter,
    Input,
    Layered,
    LeakyRelu,
    MaxPool,
    Pointwise,
    Relu,
    Upsample,
)
from progden_jax.divergence import _sweep, windows
from progden_jax.divergence.exact import TIME_PER_PASS


def blur(x):
    padded = jnp.pad(x, ((2, 2), (1, 1), (0, 0)))
    near = sum(
        (0.5 + i + 0.3 * j) * padded[i : i + x.shape[0], j : j + x.shape[1]]
        for i in range(5)
        for j in range(3)
    )
    return jnp.tanh(near + x[..., ::-1])


class Network:
    """A random network of a graph's layers as a bound denoiser, with pointwise curves around it."""

    def __init__(self, nodes, widths, sizes, seed=0, auxiliary=0):
        rng = np.random.default_rng(seed)
        self.nodes, self.params = nodes, {}
        channels = {}
        for index, node in enumerate(nodes):
            if isinstance(node, Input):
                channels[index] = 3 + auxiliary
            elif isinstance(node, Conv):
                taken = sum(channels[s] for s in node.sources)
                size, width = sizes[node.layer], widths[node.layer]
                self.params[node.layer] = {
                    "kernel": rng.normal(size=(size, size, taken, width)) / np.sqrt(taken * size),
                    "bias": 0.1 * rng.normal(size=width),
                }
                channels[index] = width
            elif isinstance(node, Pointwise) and node.channels:
                channels[index] = node.channels
            else:
                channels[index] = width = channels[graph.sources(node)[0]]
                if isinstance(node, LeakyRelu):
                    self.params[node.layer] = {"slope": rng.uniform(-0.5, 0.5, width)}
                if isinstance(node, Affine):
                    scale, shift = rng.normal(1, 0.3, width), rng.normal(size=width)
                    self.params[node.layer] = {"scale": scale, "shift": shift}
        self.params = jax.tree.map(np.float32, self.params)
        self.alignment = 1 << max(graph.levels(nodes))
        self.auxiliary = auxiliary

    @property
    def layers(self):
        return self.nodes, self.params

    def layered(self, x):
        height, width = x.shape[:2]
        encoded, slope = jax.jvp(jnp.sqrt, (x,), (jnp.ones_like(x),))
        extra = jnp.broadcast_to(
            jnp.sin(jnp.arange(self.auxiliary)), (*x.shape[:2], self.auxiliary)
        )
        inputs = jnp.concatenate([encoded, extra.astype(x.dtype)], -1)
        pad = [(0, -n % self.alignment) for n in (height, width)]
        params = jax.tree.map(lambda p: p.astype(x.dtype), self.params)
        return Layered(self.nodes, params, jnp.pad(inputs, [*pad, (0, 0)]), None, slope, jnp.tanh)

    def __call__(self, x):
        shown = self.layered(x)
        output, _ = graph.evaluate(shown.nodes, shown.params, shown.inputs)
        return jnp.tanh(output[: x.shape[0], : x.shape[1]])


def u_net(depth, pairs):
    """A U-Net of so many levels with one or two convolutions each, every skip joined."""
    nodes, skips, names = [Input()], [0], itertools.count()

    def conv(*sources):
        nodes.extend([Conv(sources, f"c{next(names)}"), Relu(len(nodes))])
        return len(nodes) - 1

    x = 0
    for _ in range(depth):
        for _ in range(pairs):
            x = conv(x)
        nodes.append(MaxPool(x))
        x = len(nodes) - 1
        skips.append(x)
    skips.pop()
    x = conv(x)
    for skip in reversed(skips):
        nodes.append(Upsample(x))
        x = conv(len(nodes) - 1, skip)
        x = conv(x)
    nodes.append(Conv((x,), "last"))
    return tuple(nodes)


PLAIN = (Input(), Conv((0,), "in"), Relu(1), Conv((2,), "last"))


def deep_residual(blocks):
    """As of Wong and Wong 2019, but for a ReLU before the second block and a curve before the last sum."""
    nodes = [Input(), Conv((0,), "in"), LeakyRelu(1, "prelu")]
    start = 2

    def then(make, *arguments):
        nodes.append(make(len(nodes) - 1, *arguments))

    def conv(layer):
        nodes.append(Conv((len(nodes) - 1,), layer))

    for block in range(blocks):
        first = len(nodes) - 1
        if block:
            then(Relu)
        conv(f"a{block}")
        then(Affine, f"norm a{block}")
        then(LeakyRelu, f"prelu {block}")
        conv(f"b{block}")
        then(Affine, f"norm b{block}")
        nodes.append(Add((first, len(nodes) - 1)))
    conv("out")
    then(Pointwise, jnp.tanh)
    nodes.append(Add((start, len(nodes) - 1)))
    conv("last")
    return tuple(nodes)


def kernel_predicting(size, *, then=()):
    """A network that predicts kernels of size×size, for the colour, and what follows."""
    nodes = [Input(), Conv((0,), "a"), Relu(1), Conv((2,), "b"), Relu(3), Conv((4,), "kernel")]
    nodes += [Pointwise(0, jnp.expm1, channels=3), Filter(image=6, logits=5, size=size), *then]
    return tuple(nodes)


def network(nodes, sizes=(3,), seed=0, auxiliary=0):
    layers = [n.layer for n in nodes if isinstance(n, Conv)]
    rng = np.random.default_rng(seed)
    # Nodes that are added must have one width.
    widths = (
        dict.fromkeys(layers, 5)
        if any(isinstance(n, Add) for n in nodes)
        else {layer: int(rng.integers(3, 7)) for layer in layers}
    )
    widths["last"] = 3
    widths |= {nodes[n.logits].layer: n.size**2 for n in nodes if isinstance(n, Filter)}
    return Network(
        nodes,
        widths,
        {layer: sizes[i % len(sizes)] for i, layer in enumerate(layers)},
        seed,
        auxiliary,
    )


NETWORKS = {
    "u-net, 2 levels, auxiliary": network(u_net(2, 1), seed=1, auxiliary=4),
    "plain, 5×5 and 3×3": network(PLAIN, sizes=(5, 3), seed=5),
    "deep residual": network(deep_residual(2), sizes=(3, 1), seed=7),
    "kernels": network(
        kernel_predicting(3, then=[Conv((7, 0), "last"), Filter(8, 5, 3)]), seed=9, auxiliary=2
    ),
    "kernels of pooled pixels": network(
        (
            *(Input(), Conv((0,), "a"), Relu(1), MaxPool(2), Conv((3,), "kernel")),
            *(Filter(3, 4, 3), Upsample(5), Conv((6, 0), "last")),
        ),
        seed=10,
    ),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_cone_is_the_dense_diagonal_in_float64(name, monkeypatch):
    """At an odd size with several cells, borders included; some as large images are computed, too."""
    f = NETWORKS[name]
    with jax.enable_x64(True):
        x = jnp.asarray(np.random.default_rng(8).random((5, 11, 3)) + 0.1)
        expected = dense_jacobian_diagonal(f, x)
        for chunk in (None, 3) if name.startswith(("plain", "u-net")) else (None,):
            if chunk is not None:
                monkeypatch.setattr(_sweep, "WORTH_SLICES", 0)
            method = pd.Exact("cone", chunk=chunk)
            found = jax.jit(lambda x, m=method: pd.divergence(f, x, jnp.ones_like(x), method=m))(x)
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        assert np.abs(expected).max() > 1e-3


@pytest.mark.parametrize(
    ("algorithm", "reach", "chunk"),
    [("basis", None, 5), ("coloring", (2, 1), 1), ("coloring", None, 1), ("coloring", None, 5)],
)
def test_any_function_in_float64(algorithm, reach, chunk):
    with jax.enable_x64(True):
        x = jnp.asarray(np.random.default_rng(0).normal(size=(7, 9, 3)))
        variance = jnp.abs(x)
        method = pd.Exact(algorithm, reach=reach, chunk=chunk)
        found = divergence_and_error(blur, x, variance, method=method)
        expected = np.asarray(variance) * dense_jacobian_diagonal(blur, x)
        np.testing.assert_allclose(found.divergence, expected, rtol=1e-12, atol=1e-14)
        assert not np.asarray(found.standard_error).any()


def test_coloring_needs_its_whole_reach():
    """One pixel less than the reach gives another answer: the test above can fail."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(7, 9, 3)), jnp.float32)
    one = jnp.ones_like(x)
    short = divergence(blur, x, one, method=pd.Exact("coloring", reach=(1, 1)))
    assert np.abs(short - dense_jacobian_diagonal(blur, x)).max() > 1e-3


def test_cone_equals_basis_on_oidns_layers(real_frame):
    """At an odd size with two cells, borders included, in float32."""
    frame = jax.tree.map(lambda a: a[40:45, 30:47] if a.ndim else a, real_frame)
    f = narrow_oidn(("albedo", "normal")).bind(frame)
    found = [
        np.asarray(pd.divergence(f, frame.color, frame.variance, method=pd.Exact(algorithm)))
        for algorithm in ("cone", "basis")
    ]
    error = np.sqrt(((found[0] - found[1]) ** 2).mean() / (found[1] ** 2).mean())
    assert error < 1e-5


@pytest.mark.parametrize("algorithm", ["coloring", "cone"])
def test_gradient_in_the_weights_and_batches(algorithm):
    """Along a random direction of all weights, against differences; a batch under vmap is each image alone.

    "basis" is "coloring" with more colours.
    """
    nodes = (Input(), Conv((0,), "a"), Relu(1), MaxPool(2), Upsample(3), Conv((4, 0), "last"))
    net, rng = network(nodes, sizes=(1, 3), seed=2), np.random.default_rng(3)
    method = pd.Exact(algorithm, chunk=2, reach=(3, 1))
    with jax.enable_x64(True):
        x = jnp.asarray(rng.random((2, 3, 4, 3)) + 0.1)
        towards = jax.tree.map(lambda p: jnp.asarray(rng.normal(size=p.shape)), net.params)

        def mean(step, x):
            moved = copy.copy(net)
            moved.params = jax.tree.map(lambda p, d: p + step * d, net.params, towards)
            return pd.divergence(moved, x, jnp.ones_like(x), method=method).mean()

        @jax.jit
        def run(step):
            gradient = jax.grad(lambda s: jax.vmap(mean, (None, 0))(s, x)[0])(step)
            return jax.vmap(mean, (None, 0))(step, x), gradient

        batch, gradient = run(0.0)
        h = 1e-6
        difference = (run(h)[0][0] - run(-h)[0][0]) / (2 * h)
        np.testing.assert_allclose(gradient, difference, rtol=1e-6)
        assert abs(gradient) > 1e-2
        compiled = jax.jit(lambda x: net(x))
        expected = [dense_jacobian_diagonal(compiled, one).mean() for one in np.asarray(x)]
        np.testing.assert_allclose(batch, expected, rtol=1e-10)


def test_auto_takes_the_cheapest(real_frame):
    frame = jax.tree.map(lambda a: a[:24, :24] if a.ndim else a, real_frame)
    f = pd.denoisers.load("oidn-hdr").bind(frame)
    costs = pd.Exact().cost(f, frame.color)
    assert set(costs) == {"basis", "coloring", "cone"}
    assert costs["basis"] == 24 * 24 * 3
    assert 180 < costs["cone"] < 200
    assert pd.Exact().cost(blur, frame.color) == {"basis": 24 * 24 * 3, "coloring": 3 * 3 * 2}
    by_rows = functools.partial(jax.lax.map, jnp.tanh)
    assert pd.Exact().cost(by_rows, frame.color) == {"basis": 24 * 24 * 3}
    assert pd.Exact(reach=(2, 1)).cost(blur, frame.color)["coloring"] == 27
    x = np.asarray(frame.color)[:8, :9]
    found = divergence(blur, x, np.ones_like(x), method=pd.Exact(reach=(2, 1)))
    expected = dense_jacobian_diagonal(blur, x)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


def test_auto_takes_the_quicker_not_the_one_with_fewer_operations():
    """Between as many colours as the cone has passes and what those take in time, colours are quicker."""
    x = jnp.ones((48, 48, 3))
    f = pd.denoisers.load("oidn-hdr-small").bind(pd.Frame(x, x))
    cone = pd.Exact().cost(f, x)["cone"]
    quicker = math.ceil(math.sqrt(cone / 3))
    slower = math.ceil(math.sqrt(TIME_PER_PASS["cone"] * cone / 3))
    assert quicker < slower
    for period, expected in ((quicker, "coloring"), (slower - 1, "coloring"), (slower, "cone")):
        method = pd.Exact(reach=(period - 1, 1))
        assert method.cost(f, x)["coloring"] == 3 * period**2
        assert method.time(f, x)["cone"] == TIME_PER_PASS["cone"] * cone
        assert method.choose(f, x) == expected


def test_windows_of_oidn_are_those_of_the_design():
    params = pd.denoisers.load("oidn-hdr").params
    nodes = unet.graph(params)
    plan = windows.plan(nodes, params)
    sizes = {
        node.layer: window.size
        for node, window in zip(plan.nodes, plan.windows, strict=True)
        if isinstance(node, Conv)
    }
    encoder = {f"enc_conv{n}": 5 for n in (1, 2, 3, 4, "5a", "5b")}
    decoder = {f"dec_conv{n}": 5 for n in ("4b", "3b", "1a")}
    decoder |= {"dec_conv4a": 7, "dec_conv3a": 7, "dec_conv2a": 6, "dec_conv2b": 4, "dec_conv1b": 3}
    assert sizes == {"enc_conv0": 3, **encoder, **decoder, "dec_conv0": 1}


def test_exact_in_the_pipeline(real_frame):
    frame = jax.tree.map(lambda a: np.asarray(a)[:8, :7] if a.ndim else a, real_frame)
    denoiser = pd.FunctionDenoiser(blur)
    exact = pd.progressive_denoise(frame, denoiser, method=pd.Exact("coloring", reach=(2, 1)))
    expected = np.asarray(frame.variance) * dense_jacobian_diagonal(blur, np.asarray(frame.color))
    np.testing.assert_allclose(
        exact.divergence, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max()
    )
    given = pd.progressive_denoise(frame, denoiser, divergence=np.asarray(exact.divergence))
    np.testing.assert_array_equal(given.divergence, exact.divergence)
    np.testing.assert_allclose(given.sure, exact.sure, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(given.image, exact.image, rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="a divergence is given and a method, Exact"):
        pd.progressive_denoise(frame, denoiser, divergence=given.sure, method=pd.Exact())
    with pytest.raises(ValueError, match="divergence has shape"):
        pd.progressive_denoise(frame, denoiser, divergence=given.sure[1:])


def test_messages():
    x = jnp.ones((4, 4, 3))
    with pytest.raises(ValueError, match="expected one of 'auto', 'basis', 'coloring', 'cone'"):
        pd.Exact("cones")
    with pytest.raises(ValueError, match="f, a function, does not show its layers"):
        pd.divergence(blur, x, x, method=pd.Exact("cone"))
    with pytest.raises(ValueError, match=r"primitive 'scan', which is not followed. Give Exact\("):
        pd.divergence(functools.partial(jax.lax.map, jnp.tanh), x, x, method=pd.Exact("coloring"))
    with pytest.raises(ValueError, match="expected a radius of at least 0"):
        pd.Exact("coloring", reach=(-1, 1))
    with pytest.raises(ValueError, match="reads nodes that come later or have several strides"):
        graph.levels((Input(), Conv((0,), "a"), MaxPool(1), Conv((1, 2), "b")))
