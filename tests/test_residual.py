"""The residual network: its forward pass, batch normalisation, divergences, files, and its training."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import progden_jax as pd
from progden_jax.denoisers import ResidualNet, graph, nodes
from progden_jax.divergence import _reach
from progden_jax.training import DenoiserConfig, DenoiserTask, Trainer, config
from progden_jax.training.normalization import BATCH, BatchNormalized, pooled
from progden_jax.training.step import schedule

INPUTS = ("albedo", "normal", "depth")
SIZE = (10, 11)


def network(blocks=2, width=4, inputs=INPUTS, **settings) -> ResidualNet:
    """One with random biases and slopes too, whose outputs vary."""
    settings |= {"blocks": blocks, "width": width}
    form = jax.eval_shape(lambda: ResidualNet.init(jax.random.key(0), inputs, **settings))
    rng = np.random.default_rng(0)

    def one(path, like):
        part = path[-1].key
        scale = np.prod(like.shape[:-1]) ** -0.5 if part == "kernel" else 0.2
        drawn = scale * rng.normal(size=like.shape)
        return (drawn + 0.1 if part == "slope" else drawn).astype(np.float32)

    params = jax.tree_util.tree_map_with_path(one, form.params)
    if "conv_out" in params:
        params["conv_out"]["bias"] += 0.3
    return ResidualNet(params, inputs)


@pytest.fixture(scope="module")
def frame(real_frame) -> pd.Frame:
    part = jax.tree.map(lambda a: a[50:60, 60:71], real_frame.replace(spp=None))
    albedo = np.array(part.albedo)
    albedo[0, 0] = 200
    return part.replace(albedo=albedo)


def convolved(images, kernel):
    """(N, H, W, C) in float64, zeros around."""
    height, width = images.shape[1:3]
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return sum(
        padded[:, i : i + height, j : j + width] @ kernel[i, j] for i in range(3) for j in range(3)
    )


def reference(params, images, *, scales=None):
    """The network as the paper has it, on transferred inputs (N, H, W, C); normalised where `scales` say."""
    params = jax.tree.map(lambda a: np.asarray(a, np.float64), params)

    def conv(x, layer):
        value = convolved(x, params[layer]["kernel"])
        if scales is not None and layer in scales:
            value = value - value.mean((0, 1, 2))
            value = np.asarray(scales[layer]) * value / np.sqrt(value.var((0, 1, 2)) + 1e-5)
        return value + params[layer]["bias"]

    def prelu(x, layer):
        return np.maximum(x, 0) + params[layer]["slope"] * np.minimum(x, 0)

    first = x = prelu(conv(images, "conv_in"), "prelu_in")
    for n in range(1, 1 + sum(layer.endswith("conv1") for layer in params)):
        inner = prelu(conv(x, f"block{n}_conv1"), f"block{n}_prelu")
        x = x + conv(inner, f"block{n}_conv2")
    x = first + conv(x, "conv_mid")
    difference = "conv_difference" in params
    out = conv(x, "conv_difference" if difference else "conv_out") + difference * images[..., :3]
    return np.expm1(np.clip(out, 0, 22))


def shown(frame):
    """What the network sees of a frame."""
    color, albedo, normal, depth = (
        np.asarray(a, np.float64) for a in (frame.color, frame.albedo, frame.normal, frame.depth)
    )
    return np.concatenate(
        [np.log1p(np.maximum(color, 0)), np.clip(albedo, 0, 1), normal, np.log1p(depth)], -1
    )


@pytest.mark.parametrize("difference", [False, True])
def test_forward_pass_is_the_papers(frame, difference):
    net = network(difference=difference)
    expected = reference(net.params, shown(frame)[None])[0]
    assert expected.std() > 0.1
    assert (expected == 0).any()
    np.testing.assert_allclose(net(frame), expected, rtol=2e-4, atol=1e-5)


def test_padded_as_without(frame):
    net = network()
    junk = jax.tree.map(lambda a: jnp.pad(a, ((0, 6), (0, 5), (0, 0)), constant_values=7.0), frame)
    run = jax.jit(lambda frame, valid: net.bind(frame, valid=valid)(frame.color))
    padded = run(junk, tuple(np.int32(n) for n in SIZE))
    np.testing.assert_allclose(padded[: SIZE[0], : SIZE[1]], net(frame), rtol=1e-4, atol=1e-5)
    assert not np.asarray(padded[SIZE[0] :]).any()


def test_size_and_start_of_the_papers_network():
    net = jax.eval_shape(lambda: ResidualNet.init(jax.random.key(0), INPUTS))
    assert sum(np.prod(p["kernel"].shape) for p in net.params.values() if "kernel" in p) == (
        33 * 9 * 128**2 + 9 * 10 * 128 + 9 * 128 * 3
    )
    assert len([node for node in net.nodes if isinstance(node, graph.Conv)]) == 35
    assert len(net.normalized) == 33
    small = ResidualNet.init(jax.random.key(0), INPUTS, blocks=1, width=64)
    block = small.params["block1_conv1"]["kernel"]
    np.testing.assert_allclose(block.std(), np.sqrt(2 / (9 * 64)), rtol=0.02)
    np.testing.assert_array_equal(small.params["block1_prelu"]["slope"], np.full(64, 0.25))


def test_any_inputs(frame):
    for inputs in ((), (*INPUTS, "variance")):
        net = network(1, 2, inputs)
        assert jax.eval_shape(net, frame).shape == frame.color.shape
        for role in inputs:
            with pytest.raises(ValueError, match=f"this frame has no {role}: choose a network"):
                net.bind(frame.replace(**{role: None}))
    with pytest.raises(ValueError, match="radiance with albedo and depth makes 7"):
        ResidualNet(network(1, 2, INPUTS).params, ("albedo", "depth"))
    with pytest.raises(ValueError, match="inputs is 'color', expected one of 'albedo'"):
        ResidualNet.init(jax.random.key(0), ("color",))
    with pytest.raises(ValueError, match="blocks is 0"):
        ResidualNet.init(jax.random.key(0), blocks=0)
    params = network(1, 2, ()).params
    for wrong in ({"conv_in": params["conv_in"]}, {**params, "block9_prelu": {}}):
        with pytest.raises(ValueError, match="expected those of a residual network: conv_in,"):
            ResidualNet(wrong)


def test_it_reaches_35_pixels(frame):
    """As it says, and as the derivative's program says."""
    x = jnp.zeros((72, 74, 3))
    net = network(16, 8, ())
    f = net.bind(pd.Frame(x, None))
    assert (f.receptive_radius, f.alignment) == (35, 1)
    assert _reach.radii(lambda x: f(x), x) == (35, 35)
    costs = pd.Exact().cost(f, x)
    assert costs["coloring"] == 3 * 36**2
    assert costs["cone"] < costs["coloring"] / 2
    wide = network(2, 4).bind(frame)
    assert (wide.receptive_radius, wide.alignment) == (7, 1)


def test_exact_divergence_in_float64(frame):
    """By coloring and by cone as by unit vectors, where the image is larger than the reach."""
    with jax.enable_x64(True):
        wide, net = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a), jnp.float64), (frame, network(difference=True))
        )

        @jax.jit
        def run(net, frame):
            f, one = net.bind(frame), jnp.ones_like(frame.color)
            return [
                pd.divergence(f, frame.color, one, method=pd.Exact(algorithm))
                for algorithm in ("basis", "coloring", "cone")
            ]

        basis, *others = run(net, wide)
        scale = np.abs(basis).max()
        assert scale > 1e-2
        for found in others:
            np.testing.assert_allclose(found, basis, atol=1e-11 * scale)


@pytest.fixture(scope="module")
def batch(frame):
    """Three frames, stacked."""
    many = [
        frame,
        jax.tree.map(lambda a: 0.5 * a[::-1], frame),
        jax.tree.map(lambda a: a[:, ::-1], frame),
    ]
    return jax.tree.map(lambda *a: jnp.stack(a), *many)


@pytest.fixture(scope="module")
def trained() -> BatchNormalized:
    """A network in training, with scales of all sizes."""
    start = BatchNormalized.of(network(difference=True))
    assert set(start.scales) == set(start.network.normalized)
    assert all((scale == 1).all() for scale in start.scales.values())
    rng = np.random.default_rng(4)
    scales = {n: rng.uniform(0.3, 1.5, s.shape).astype(np.float32) for n, s in start.scales.items()}
    return BatchNormalized(start.network, scales)


@jax.jit
def together(trained, frames):
    """Outputs, moments, and the gradient of the mean logarithm."""

    def mean(trained):
        def one(frame):
            return trained.bind(frame)(frame.color), trained.moments(frame)

        y, moments = jax.vmap(one, axis_name=BATCH, out_axes=(0, None))(frames)
        return jnp.log1p(y).mean(), (y, moments)

    (_, found), gradient = jax.value_and_grad(mean, has_aux=True)(trained)
    return (*found, gradient)


def test_normalised_over_the_batch(trained, batch):
    """As in float64, its derivative along a random direction too; folded, each image alone gives the same."""
    y, moments, gradient = together(trained, batch)
    inputs = np.stack([shown(jax.tree.map(lambda a, n=n: a[n], batch)) for n in range(3)])

    def dense(step=0.0):
        moved = jax.tree.map(lambda a, d: np.asarray(a, np.float64) + step * d, trained, towards)
        return reference(moved.network.params, inputs, scales=moved.scales)

    rng = np.random.default_rng(5)
    towards = jax.tree.map(lambda a: rng.normal(size=np.shape(a)), trained)
    np.testing.assert_allclose(y, dense(), rtol=1e-3, atol=1e-4)
    up, down = (np.log1p(dense(step)).mean() for step in (1e-6, -1e-6))
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: np.vdot(g, d), gradient, towards)))
    np.testing.assert_allclose(along, (up - down) / 2e-6, rtol=1e-3)
    folded = trained.folded(moments)
    assert isinstance(folded, ResidualNet)
    for n in range(3):
        alone = folded(jax.tree.map(lambda a, n=n: a[n], batch))
        np.testing.assert_allclose(alone, y[n], rtol=1e-3, atol=1e-4)
    other = together(trained, jax.tree.map(lambda a: a[::-1] * 0.9, batch))[0][2]
    assert np.abs(other / 0.9 - y[0]).max() > 1e-2


def test_moments_of_several_batches_are_those_of_all():
    values = 5 + np.random.default_rng(0).normal(size=(4, 100, 3))
    found = pooled(graph.Moments(jnp.asarray(values.mean(1)), jnp.asarray(values.var(1))))
    flat = values.reshape(-1, 3)
    np.testing.assert_allclose(found.mean, flat.mean(0), rtol=1e-6)
    np.testing.assert_allclose(found.variance, flat.var(0), rtol=1e-5)


def test_nodes_at_other_places():
    """What a moved node reads is at the new places of what it read."""
    places = [10, 11, 12, 13]
    for node in (
        graph.Conv((0, 3), "a"),
        graph.Add((1, 2)),
        graph.Filter(2, 1, 3),
        graph.LeakyRelu(3, "b"),
        graph.Pointwise(1, jnp.tanh, 3),
    ):
        found = nodes.moved(node, places)
        assert type(found) is type(node)
        assert graph.sources(found) == tuple(places[s] for s in graph.sources(node))
        assert nodes.moved(found, {p: n for n, p in enumerate(places)}) == node
    assert nodes.moved(graph.Input(), []) == graph.Input()


def test_files_round_trip(tmp_path, frame):
    net = network(1, 2)
    pd.denoisers.save(tmp_path / "r.safetensors", net, dtype="float32")
    again = pd.denoisers.load(tmp_path / "r.safetensors")
    assert isinstance(again, ResidualNet)
    assert (again.name, again.inputs) == ("r", INPUTS)
    jax.tree.map(np.testing.assert_array_equal, again.params, dict(net.params))
    assert jax.eval_shape(again, frame).shape == frame.color.shape


def test_rates_by_stages():
    paper = config.load(DenoiserConfig, "residual")
    rate = schedule(paper)
    expected = {0: 1e-2, 999: 1e-2, 1000: 1e-3, 1999: 1e-3, 2000: 1e-4, 999_999: 1e-4}
    for step, value in expected.items():
        np.testing.assert_allclose(rate(step), value, rtol=1e-6)
    for changes, message in (
        ({"rates": [1e-3, 1e-4]}, "rate_steps is .* expected rising steps, one less than the"),
        ({"rates": [1e-3, 1e-4], "rate_steps": [0]}, "expected rising steps"),
        ({"rate_steps": [10]}, "expected rising steps"),
        ({"rates": [1e-3, -1.0], "rate_steps": [10]}, "rates is .*, expected numbers above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            config.load(DenoiserConfig, "smoke", changes)


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("renders")
    for seed, scene in enumerate(("one", "two", "three")):
        rng = np.random.default_rng(seed)
        truth = rng.random((3, 3, 3)).repeat(6, 0).repeat(6, 1)
        depth = rng.uniform(1, 5, (18, 18, 1))
        for spp in (4, 16):
            variance = truth / spp
            color = truth + np.sqrt(variance) * rng.normal(size=truth.shape)
            buffers = (color, variance, truth, truth - 0.5, depth)
            frame = pd.Frame(*(a.astype(np.float32) for a in buffers))
            pd.write_exr(folder / f"{scene}_{spp:06}spp.exr", frame)
        pd.write_exr(folder / f"{scene}_004096spp.exr", truth.astype(np.float32))
    return folder


def test_training_and_going_on(renders, tmp_path):
    """Stopped and gone on with, the weights are the same bit for bit; they load as what was evaluated."""
    changes = {"data": [str(renders)], "held_out_scenes": ["two"], "batch": 2, "crop": 16}
    changes |= {"options": {"blocks": 1, "width": 4}, "steps": 4, "log_every": 1}
    changes |= {"evaluate_every": 2, "checkpoint_every": 2, "weights_dtype": "float32"}
    task = DenoiserTask(config.load(DenoiserConfig, "residual-small", changes))
    trainer = Trainer(task, devices=jax.devices()[:1])
    whole = trainer.run(tmp_path / "whole")
    half = trainer.run(tmp_path / "parts", until=2)
    parts = trainer.run(tmp_path / "parts")
    for one, other in zip(jax.tree.leaves(whole.state), jax.tree.leaves(parts.state), strict=True):
        np.testing.assert_array_equal(one, other)
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), half.state.params, whole.state.params)
    assert all(jax.tree.leaves(changed))
    loaded = pd.denoisers.load(parts.weights)
    assert isinstance(loaded, ResidualNet)
    assert loaded.inputs == INPUTS
    finished = task.finished(whole.state.best)
    jax.tree.map(np.testing.assert_array_equal, loaded.params, dict(finished.params))
    lines = (tmp_path / "whole" / "curves.jsonl").read_text().splitlines()
    scores = [json.loads(line).get("held-out/score") for line in lines]
    np.testing.assert_allclose(task.evaluate(whole.state.best).score, min(filter(None, scores)))
