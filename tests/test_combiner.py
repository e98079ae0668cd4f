"""Deep Combiner: kernel and network written out, limits, canvases, tiles, derivatives, training, files."""

import dataclasses
import functools
import json

import dense_combiner
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn
from toy_denoisers import blur

import progden_jax as pd
from progden_jax import combiner, denoisers, tiling
from progden_jax.cli import main
from progden_jax.combiner import KernelNetwork, kernels
from progden_jax.combiner.buffers import bound_parts
from progden_jax.denoisers._base import passable
from progden_jax.denoisers._network import inside_of
from progden_jax.evaluation import measure, parts, plan, settings
from progden_jax.training import CombinerConfig, CombinerTask, Trainer, config

SMALL = KernelNetwork(layers=2, width=3, layer_size=3, window=3)
SIZE = (12, 14)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Column:
    """The mean over a pixel and those above and below it, dimmed, on canvases and tiles."""

    gain: jax.Array
    canvas = True
    receptive_radius = 1
    alignment = 1
    inputs = ("albedo",)

    def __call__(self, frame):
        return self.bind(frame)(frame.color)

    def exposure_of(self, frame, valid):
        return self.gain

    def bind(self, frame, *, valid=None, exposure=None):
        gain = self.exposure_of(frame, valid) if exposure is None else exposure
        return BoundColumn(gain, valid)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BoundColumn:
    gain: jax.Array
    valid: tuple | None
    receptive_radius = 1
    alignment = 1

    def __call__(self, x):
        inside = inside_of(x.shape[:2], self.valid)
        return self.gain * blur(x if inside is None else jnp.where(inside, x, 0))


COLUMN = Column(jnp.float32(0.7))


def frame_of(height=SIZE[0], width=SIZE[1], seed=0):
    rng = np.random.default_rng(seed)
    truth = rng.random((height, width, 3)) + 0.2
    variance = 0.1 * truth**2
    buffers = {
        "color": truth + np.sqrt(variance) * rng.normal(size=truth.shape),
        "variance": variance,
        "albedo": rng.random(truth.shape),
        "normal": rng.normal(size=truth.shape),
        "depth": 1 + rng.random((height, width, 1)),
    }
    frame = pd.Frame(**{name: b.astype(np.float32) for name, b in buffers.items()})
    return jax.tree.map(np.asarray, frame)


def weights_of(network, seed=0):
    return drawn(network.form, seed)


FRAME = frame_of()
COMBINER = combiner.DeepCombiner(weights_of(SMALL), COLUMN, SMALL)


@functools.partial(jax.jit, static_argnames="window")
def combined(noisy, denoised, weights, window):
    """Of one image, by given weights (B, window², H, W)."""

    def weigh(buffer, first, count):
        own = jax.lax.dynamic_index_in_dim(weights, buffer, keepdims=False)
        return jax.lax.dynamic_slice_in_dim(own, first, count)[:, None]

    return combiner.combine(noisy[:, None], denoised[:, None], weigh, window=window)[0]


def images_of(buffers, seed=1):
    rng = np.random.default_rng(seed)
    shape = (buffers, 5, 6)
    noisy, denoised = rng.gamma(1, 1, (2, *shape, 3)).astype(np.float32)
    return noisy, denoised, rng.gamma(1, 1, (buffers, 25, 5, 6)).astype(np.float32)


@pytest.mark.parametrize("at_once", [1, 1 << 24])
@pytest.mark.parametrize("buffers", [1, 3])
def test_kernel_is_the_dense_one(monkeypatch, buffers, at_once):
    """Equations 8 and 14, a row at a time and all at once."""
    monkeypatch.setattr(kernels, "_AT_ONCE", at_once)
    combined.clear_cache()
    given = images_of(buffers)
    expected = dense_combiner.combine(*(a.astype(np.float64) for a in given), 5)
    assert np.abs(expected - given[0].mean(0)).max() > 0.3
    np.testing.assert_allclose(combined(*given, 5), expected, rtol=1e-5, atol=1e-6)


def test_limits_of_the_kernel():
    """Equal images, one pixel, and uniform weights, which filter the residual by a box."""
    noisy, _, weights = images_of(2)
    np.testing.assert_array_equal(combined(noisy[:1], noisy[:1], weights[:1], 5), noisy[0])
    alone = combined(noisy[:1, :1, :1], 0 * noisy[:1, :1, :1], weights[:1, :, :1, :1], 5)
    np.testing.assert_allclose(alone, noisy[0, :1, :1], rtol=1e-6)
    uniform = combined(noisy[:1], noisy[1:], np.ones_like(weights[:1]), 5)
    residual = (noisy[0] - noisy[1])[:5, 1:6].mean((0, 1))
    np.testing.assert_allclose(uniform[2, 3], noisy[1, 2, 3] + residual, rtol=1e-5)


def test_weights_do_not_all_exist_at_once(monkeypatch):
    """In the derivative neither: the 225 of a pixel would be as large as 225 planes."""
    monkeypatch.setattr(kernels, "_AT_ONCE", 1)
    network = KernelNetwork(layers=2, width=4, layer_size=3, inputs=())

    def loss(params, noisy, denoised):
        return (network.apply(params, noisy, denoised, {}) ** 2).sum()

    forms = [jax.ShapeDtypeStruct((1, 1, 64, 64, 3), np.float32)] * 2
    program = jax.jit(jax.grad(loss, (0, 1))).lower(network.form, *forms).compile()
    assert program.memory_analysis().temp_size_in_bytes < 0.7 * 225 * 64 * 64 * 4


@pytest.mark.parametrize(("buffers", "robust"), [(1, False), (2, True)])
def test_network_is_the_dense_one(buffers, robust):
    network = dataclasses.replace(SMALL, buffers=buffers, robust=robust)
    params = weights_of(network)
    noisy = np.stack([frame_of(seed=n).color for n in range(buffers)])
    denoised = np.stack([np.asarray(COLUMN(FRAME.replace(color=x))) for x in noisy])
    shares = None if buffers == 1 else np.float32([0.25, 0.75])
    found = applied(network, params, noisy, denoised, shares)
    expected = dense_combiner.network(network, params, noisy, denoised, FRAME, shares)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@functools.partial(jax.jit, static_argnums=0)
def applied(network, params, noisy, denoised, shares=None):
    buffers = {role: getattr(FRAME, role)[None] for role in network.inputs}
    shares = None if shares is None else shares[:, None]
    return network.apply(params, noisy[:, None], denoised[:, None], buffers, shares=shares)[0]


def test_the_papers_network_has_its_size():
    four = KernelNetwork(buffers=4, inputs=("albedo", "normal", "depth"))
    assert four.outputs == 900
    assert list(four.form) == ["conv1", "conv2", "conv3", "conv4", "conv5", "kernel"]
    count = sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(four.form))
    # Of 43 channels that the first layer sees the paper has 31: no relative differences.
    assert round((count - 12 * 25 * 100) / 1e6, 1) == 3.3
    assert KernelNetwork().receptive_radius == 6 * 2 + 7
    assert KernelNetwork(inputs=()).receptive_radius == 12


def test_it_begins_as_a_box():
    params = jax.jit(SMALL.init)(jax.random.key(0))
    SMALL.check(params)
    flat = jax.tree.map(jnp.zeros_like, params)
    image, y = np.asarray(FRAME.color), np.asarray(COLUMN(FRAME))
    by_box, at_first = (applied(SMALL, p, image[None], y[None]) for p in (flat, params))
    expected = y[4, 5] + (image - y)[3:6, 4:7].mean((0, 1))
    np.testing.assert_allclose(by_box[4, 5], expected, rtol=1e-5)
    assert 0 < np.abs(at_first - by_box).mean() < 0.2 * np.abs(image - y).mean()


def test_it_is_a_denoiser():
    """Called, bound, mixed progressively; its name and inputs tell of the one within."""
    assert isinstance(COMBINER, pd.Denoiser)
    expected = applied(SMALL, COMBINER.params, FRAME.color[None], COLUMN(FRAME)[None])
    np.testing.assert_allclose(COMBINER(FRAME), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(COMBINER.bind(FRAME)(FRAME.color), expected, rtol=1e-5, atol=1e-6)
    assert COMBINER.inputs == ("albedo", "normal", "depth", "variance")
    assert COMBINER.name == "Column+combiner"
    form = jax.eval_shape(pd.progressive_denoise, FRAME, COMBINER)
    assert form.image.shape == FRAME.color.shape


def test_it_reaches_no_further_than_it_tells():
    """The network with what the images reach: 3 pixels; depth, a constant, is seen from 4."""
    rows = np.arange(SIZE[0])
    apart = np.abs(rows[:, None, None, None] - rows[:, None])

    def beyond(dtype):
        frame = jax.tree.map(lambda a: jnp.asarray(a[:, :1], dtype), FRAME)
        params, column = jax.tree.map(dtype, (COMBINER.params, COLUMN))
        f = combiner.DeepCombiner(params, column, SMALL).bind(frame)
        assert f.receptive_radius == COMBINER.receptive_radius == tiling.margin(COMBINER) == 4
        jacobian = np.asarray(jax.jit(jax.jacfwd(f))(frame.color))[:, 0, :, :, 0]
        assert (jacobian * (apart == 3)).any()
        return np.abs(jacobian * (apart > 3)).max() / np.abs(jacobian).max()

    # Sums of rows leave rounding in rows beside their own.
    assert beyond(jnp.float32) < 1e-6
    with jax.enable_x64(True):
        assert beyond(jnp.float64) == 0


def test_gradients_are_those_of_differences():
    with jax.enable_x64(True):
        frame = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), FRAME)
        given = jax.tree.map(jnp.float64, (COMBINER.params, COLUMN)), frame.color
        along = jax.tree.map(jnp.float64, drawn(jax.eval_shape(lambda *a: a, *given), 3))

        @jax.jit
        @jax.value_and_grad
        def value(given):
            (params, column), x = given
            f = combiner.DeepCombiner(params, column, SMALL).bind(frame)
            return (f(x) ** 2).sum()

        slopes = jax.tree.map(lambda g, d: (g * d).sum(), value(given)[1], along)
        step = 1e-6
        ends = [
            value(jax.tree.map(lambda a, d, s=s: a + s * d, given, along))[0] for s in (step, -step)
        ]
        total = sum(jax.tree.leaves(slopes))
        assert abs(total) > 0.1
        np.testing.assert_allclose(total, (ends[0] - ends[1]) / (2 * step), rtol=1e-5)


def test_nothing_breaks_where_there_is_no_noise_or_light():
    @jax.jit
    def both(frame):
        f = COMBINER.bind(frame)
        return jax.jvp(f, (frame.color,), (jnp.ones_like(frame.color),))

    zero = jnp.zeros_like(FRAME.color)
    empty = {"depth": 0 * FRAME.depth, "albedo": zero, "normal": zero}
    for color in (zero, FRAME.color, 1e6 * FRAME.color, -FRAME.color):
        for image in both(FRAME.replace(color=color, variance=zero, **empty)):
            assert np.isfinite(image).all()
    assert not np.asarray(both(FRAME.replace(color=zero, variance=zero))[0]).any()


def test_canvas_and_tiles_are_as_the_whole():
    big = frame_of(26, 28, seed=2)
    height, width = SIZE

    @jax.jit
    def padded(frame, valid):
        return COMBINER.bind(frame, valid=valid)(frame.color)

    junk = jax.tree.map(np.copy, big)
    for buffer in jax.tree.leaves(junk):
        buffer[height:], buffer[:, width:] = 1e3, -5
    found = np.asarray(padded(junk, (np.int32(height), np.int32(width))))
    part = jax.tree.map(lambda a: a[:height, :width], big)
    np.testing.assert_allclose(found[:height, :width], COMBINER(part), rtol=1e-4, atol=1e-5)
    assert not found[height:].any()
    assert COMBINER.canvas
    assert COMBINER.alignment == 1
    whole = np.asarray(padded(big, (np.int32(26), np.int32(28))))
    tile = jax.tree.map(lambda a: a[5 : 5 + height, 3 : 3 + width], big)
    there = whole[5 : 5 + height, 3 : 3 + width]
    inner = np.s_[4:-4, 4:-4]
    np.testing.assert_allclose(COMBINER(tile)[inner], there[inner], rtol=1e-4, atol=1e-5)


def test_settings_alone_pass_through_jit_by_value():
    """NFOR has no weights: as a constant told apart by identity it would be compiled again for each file."""
    assert passable(denoisers.NFOR()) == denoisers.NFOR()


def test_behind_a_function_it_neither_tiles_nor_pads():
    behind = dataclasses.replace(COMBINER, denoiser=pd.FunctionDenoiser(blur))
    assert not tiling.can_tile(behind)
    assert not behind.canvas
    assert behind.exposure_of(FRAME, None) is None
    expected = applied(SMALL, COMBINER.params, FRAME.color[None], blur(FRAME.color)[None])
    np.testing.assert_allclose(behind(FRAME), expected, rtol=1e-5, atol=1e-6)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gained:
    """A filter whose gain depends on the image that it is found for; `filtered` shares it."""

    def __call__(self, frame):
        return self.bind(frame)(frame.color)

    def bind(self, frame):
        del frame
        return BoundGained()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BoundGained:
    def __call__(self, x):
        return self.filtered(x, x[None])[0]

    def filtered(self, x, images):
        return images / (1 + x.mean())


def test_buffers_share_their_means_kernels():
    network = dataclasses.replace(SMALL, buffers=2)
    two = combiner.DeepCombiner(weights_of(network), Gained(), network)
    frame, buffered = combiner.of_buffers(two, [FRAME.replace(color=2 * FRAME.color), FRAME])
    colors = np.stack([2 * FRAME.color, FRAME.color])
    denoised = colors / (1 + colors.mean())
    expected = dense_combiner.network(network, two.params, colors, denoised, frame)
    np.testing.assert_allclose(buffered(frame), expected, rtol=1e-4, atol=1e-5)


def test_several_buffers():
    """Their mean is the frame, by their samples; each is denoised by itself; the result is a denoiser."""
    network = dataclasses.replace(SMALL, buffers=2)
    two = combiner.DeepCombiner(weights_of(network), COLUMN, network)
    parts_of = [
        FRAME.replace(color=f.color, variance=f.variance, spp=spp)
        for f, spp in ((frame_of(seed=0), 8.0), (frame_of(seed=1), 24.0))
    ]
    frame, buffered = combiner.of_buffers(two, parts_of)
    colors = np.stack([part.color for part in parts_of])
    shares = (0.25, 0.75)
    np.testing.assert_allclose(frame.color, np.average(colors, 0, shares), rtol=1e-6)
    denoised = np.stack([COLUMN(part) for part in parts_of])
    expected = dense_combiner.network(network, two.params, colors, denoised, frame, shares)
    np.testing.assert_allclose(buffered(frame), expected, rtol=1e-4, atol=1e-5)
    assert buffered.name == "Column+combiner"
    form = jax.eval_shape(pd.progressive_denoise, frame, buffered)
    assert form.image.shape == frame.color.shape
    with pytest.raises(ValueError, match="there are 3 frames, and the .* takes 2 sub-averages"):
        combiner.of_buffers(two, [*parts_of, FRAME])
    with pytest.raises(ValueError, match=r"frames\[1\].color has shape"):
        combiner.of_buffers(two, [FRAME, frame_of(4, 4)])
    with pytest.raises(ValueError, match="belong to the frame that they make up"):
        buffered(frame_of(4, 4))
    with pytest.raises(ValueError, match="takes 2 sub-averages .* and a frame is one"):
        two(FRAME)


def test_a_part_is_denoised_as_a_render_of_its_samples():
    """With its share of the variance and of the samples, which the denoiser may look at."""
    seen = []

    class Watched:
        def bind(self, frame):
            seen.append((np.asarray(frame.variance), float(frame.spp)))
            return lambda x: x

    frame = FRAME.replace(spp=32.0)
    bound_parts(Watched(), frame, np.zeros((2, *FRAME.color.shape), "f4"), np.float32([0.25, 0.75]))
    _, *parts_of = seen
    assert [spp for _, spp in parts_of] == [8, 24]
    for (variance, _), factor in zip(parts_of, (4, 4 / 3), strict=True):
        np.testing.assert_allclose(variance, factor * FRAME.variance, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layers": 0}, "layers is 0"),
        ({"width": 2.5}, "width is 2.5"),
        ({"buffers": 0}, "buffers is 0"),
        ({"layer_size": 4}, "layer_size is 4"),
        ({"window": 14}, "window is 14"),
        ({"inputs": ("color",)}, "inputs is 'color', expected one of 'albedo'"),
    ],
)
def test_wrong_settings(changes, message):
    with pytest.raises(ValueError, match=message):
        KernelNetwork(**changes)


def test_frames_and_weights_that_will_not_do():
    with pytest.raises(ValueError, match="and this frame has no normal and no depth: give"):
        COMBINER(FRAME.replace(normal=None, depth=None))
    wider = dataclasses.replace(COMBINER, network=dataclasses.replace(SMALL, width=4))
    with pytest.raises(
        ValueError, match=r"conv1 \(3, 3, 19, 3\).*, expected conv1 \(3, 3, 19, 4\)"
    ):
        wider(FRAME)
    with pytest.raises(ValueError, match="denoised has shape"):
        combiner.combine(FRAME.color[None, None], FRAME.color[None], lambda *_: 1, window=3)


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    """Three scenes at two numbers of samples, with depth, albedo and normal."""
    folder = tmp_path_factory.mktemp("renders")
    for seed, scene in enumerate(("one", "two", "three")):
        made = frame_of(16, 16, seed)
        truth = np.asarray(made.albedo).repeat(4, 0).repeat(4, 1)[:16, :16] + 0.1
        buffers = {"albedo": truth, "normal": np.asarray(made.normal)}
        rng = np.random.default_rng(seed)
        samples = truth + truth * rng.normal(size=(64, *truth.shape)).astype(np.float32)
        for spp in (4, 64):
            first = samples[:spp]
            variance = first.var(0, ddof=1) / spp
            frame = pd.Frame(first.mean(0), variance, **buffers, depth=made.depth)
            pd.write_exr(folder / f"{scene}_{spp:06}spp.exr", frame)
        pd.write_exr(folder / f"{scene}_004096spp.exr", truth)
    return folder


def chosen(renders, **changes):
    values = {"data": [str(renders)], "crop": 16, "held_out_scenes": ["two"], **changes}
    return config.load(CombinerConfig, "smoke", values)


@pytest.fixture(scope="module")
def trainer(renders, tmp_path_factory):
    """Behind a denoiser that blurs and dims."""
    how = {
        "steps": 30,
        "evaluate_every": 30,
        "checkpoint_every": 30,
        "peak_rate": 0.03,
        "loss": "log-relmse",
    }
    how = chosen(renders, options={"layers": 1, "layer_size": 3, "window": 3}, **how)
    cache = tmp_path_factory.mktemp("cache")
    return Trainer(CombinerTask(how, denoiser=COLUMN, cache_folder=cache))


@pytest.fixture(scope="module")
def trained(trainer, tmp_path_factory):
    """The task and the outcome of a few steps."""
    return trainer.task, trainer.run(tmp_path_factory.mktemp("trained") / "run")


def test_training_lowers_the_error(trained):
    task, outcome = trained
    lines = (outcome.weights.parent / "curves.jsonl").read_text().splitlines()
    curves = [json.loads(line) for line in lines]
    last = curves[-1]
    for spp in (4, 64):
        assert last[f"combined/relmse/{spp}spp"] < last[f"denoised/relmse/{spp}spp"]
    at_first = task.evaluate(task.init(jax.random.key(0))).score
    assert float(outcome.state.best_score) < min(0.7, 0.95 * at_first)
    assert all(np.isfinite(c["train/relmse-ratio"]) for c in curves if "train/loss" in c)
    assert task.cache.misses == 6
    assert "divergence" not in task.arrays


@pytest.fixture(scope="module")
def divided(renders, tmp_path_factory):
    """The task and the outcome of two steps with sub-averages of 4 and of 60 samples."""
    how = {"options": {"layers": 1, "layer_size": 1, "window": 3, "inputs": ["variance"]}}
    how |= {"steps": 2, "evaluate_every": 2, "crop": 8, "buffers": 2}
    cache = tmp_path_factory.mktemp("cache")
    task = CombinerTask(chosen(renders, **how), denoiser=COLUMN, cache_folder=cache)
    return task, Trainer(task).run(tmp_path_factory.mktemp("divided") / "run")


def test_training_on_sub_averages(divided, renders):
    """Made of what a render gained, denoised each by itself, kept in the cache, in random order."""
    task, outcome = divided
    assert combiner.read(outcome.weights).network.buffers == 2
    assert {item.spp for item in task.items} == {64}
    assert np.isfinite(float(outcome.state.best_score))
    scene = next(n for n, item in enumerate(task.items) if item.scene == "one")
    a, x = (np.asarray(pd.read_exr(renders / f"one_{n:06}spp.exr").color) for n in (4, 64))
    expected = np.stack([a, (64 * x - 4 * a) / 60])
    np.testing.assert_allclose(task.arrays["parts"][scene], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(task.arrays["shares"][scene], [1 / 16, 15 / 16])
    frame = pd.read_exr(renders / "one_000064spp.exr")
    for part, denoised in zip(expected, task.arrays["denoised_parts"][scene], strict=True):
        np.testing.assert_allclose(denoised, COLUMN(frame.replace(color=part)), rtol=1e-4)
    again = CombinerTask(task.config, denoiser=COLUMN, cache_folder=task.cache.folder)
    assert (again.cache.hits, again.cache.misses) == (6, 0)
    arrays = {name: jnp.asarray(array) for name, array in task.arrays.items()}
    keys = jax.random.split(jax.random.key(0), 8)
    found = jax.jit(jax.vmap(task.example, (None, None, 0)))(arrays, scene, keys)
    first = np.isclose(found["shares"][:, 0], 1 / 16)
    assert 0 < first.sum() < len(keys)
    # What belongs together stays together: weighted by the shares it is the render.
    whole = jnp.einsum("nb,nbhwc->nhwc", found["shares"], found["parts"])
    np.testing.assert_allclose(whole, found["color"], rtol=1e-4, atol=1e-5)
    spread = np.asarray(found["parts"] - found["reference"][:, None]).std((2, 3, 4))
    assert ((spread[:, 0] > spread[:, 1]) == first).all()


def test_weights_as_files(trained, tmp_path):
    task, outcome = trained
    weights = combiner.read(outcome.weights)
    assert weights.network == task.network
    assert weights.metadata["denoiser"] == "nfor"
    assert json.loads(weights.metadata["config"])["seed"] == 0
    jax.tree.map(np.testing.assert_array_equal, dict(weights.params), outcome.state.best)
    assert combiner.load(outcome.weights).denoiser == denoisers.NFOR()
    behind = combiner.load(outcome.weights, COLUMN)
    assert behind.denoiser is COLUMN
    path = tmp_path / "half.safetensors"
    combiner.save(path, behind, metadata={"denoiser": "column"})
    again = combiner.load(path, pd.FunctionDenoiser(blur))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6),
        dict(again.params),
        dict(behind.params),
    )
    with pytest.raises(ValueError, match="combiner is 'guess', expected one of"):
        combiner.load("guess")
    with pytest.raises(ValueError, match="cannot read the weights"):
        combiner.load(tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="holds no combiner .its metadata says 'mixer'"):
        combiner.load(denoisers.files.FOLDER / "mixer-oidn-hdr.safetensors")
    for options in ({**dataclasses.asdict(SMALL), "width": 4}, {"depth": 3}):
        text = {"kind": "combiner", "options": json.dumps(options)}
        combiner.files._safetensors.write(path, COMBINER.params, text, dtype="float32")
        with pytest.raises(ValueError, match=f"{path.name}: .*(width=4|depth)"):
            combiner.load(path)


def test_configurations(renders):
    assert config.names(CombinerConfig) == ("cpu", "paper", "smoke", "wide")
    for name in config.names(CombinerConfig):
        KernelNetwork(**config.load(CombinerConfig, name).options)
    for changes, message in (
        ({"loss": "sure"}, "loss is 'sure', expected one of"),
        ({"weights_dtype": "int8"}, "weights_dtype is 'int8'"),
        ({"options": {"depth": 2}}, "options is {'depth': 2}: .*depth"),
        ({"options": {"buffers": 2}}, "options is {'buffers': 2}: .*multiple values"),
        ({"buffers": 0}, "buffers is 0, expected a whole number of at least 1"),
        (
            {"buffers": 2, "spp": [4]},
            "000004spp.exr: of fewer than 4 samples per pixel there are renders of none",
        ),
        ({"exposure_stops": 1.0}, "nfor does not follow exposure"),
    ):
        with pytest.raises(ValueError, match=message):
            CombinerTask(chosen(renders, **changes))


@pytest.fixture
def network_file(tmp_path):
    """Weights of a small denoiser."""
    kpcn = denoisers.KPCN.init(
        jax.random.key(0), layers=1, width=4, layer_size=3, kernel_size=3, name="mine"
    )
    denoisers.save(tmp_path / "mine.safetensors", kpcn)
    return str(tmp_path / "mine.safetensors")


def test_command(trained, renders, network_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("progden_jax.enable_compilation_cache", lambda: None)
    _, outcome = trained
    render, out = str(renders / "one_000004spp.exr"), str(tmp_path / "out.exr")
    flags = ["denoise", render, "-o", out, "--denoiser", network_file, "--combiner"]
    assert main([*flags, str(outcome.weights), "--save", "denoised", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)
    assert told["denoiser"] == "mine+combiner"
    assert told["auxiliary"] == ["albedo", "normal", "depth", "variance"]
    frame = pd.read_exr(render)
    expected = combiner.load(outcome.weights, denoisers.load(network_file))
    y = np.asarray(pd.read_exr(out, channels="color=denoised").color)
    np.testing.assert_allclose(y, expected(frame), rtol=1e-4, atol=1e-5)
    x, z = np.asarray(frame.color), np.asarray(pd.read_exr(out, auxiliary=False).color)
    assert ((np.minimum(x, y) - 1e-5 <= z) & (z <= np.maximum(x, y) + 1e-5)).all()
    assert told["mixer"] == repr(pd.load_mixer("any"))
    assert 0 < told["mean_alpha"] <= 1
    for wrong, message in (
        ("guess", "--combiner: combiner is 'guess', expected one of"),
        (network_file, "holds no combiner (its metadata says 'kpcn')"),
    ):
        assert main([*flags, wrong, "--force"]) == 2
        assert message in capsys.readouterr().err
    bare = [*flags, str(outcome.weights), "--force", "--channels", "depth=none"]
    assert main(bare) == 1
    assert "and this frame has no depth: give the buffer" in capsys.readouterr().err


def test_the_command_trains(trainer, renders, tmp_path, monkeypatch, capsys):
    """What the command line gives to training, and what it prints of the outcome."""
    given = []

    def task(chosen, *, cache_folder, progress):
        given.append((chosen, cache_folder))
        return trainer.task

    monkeypatch.setattr("progden_jax.training.CombinerTask", task)
    monkeypatch.setattr("progden_jax.training.train", lambda task, *a, **k: trainer.run(*a, **k))
    monkeypatch.setattr("progden_jax.enable_compilation_cache", lambda: None)
    arguments = ["train", "combiner", "--config", "smoke", "--data", str(renders)]
    arguments += ["--set", "crop=16", "--set", "denoiser=unet-hdr"]
    run, cache = tmp_path / "run", tmp_path / "cache"
    assert main([*arguments, "-o", str(run), "--cache", str(cache)]) == 0
    expected = {"crop": 16, "denoiser": "unet-hdr", "data": [str(renders)]}
    assert given == [(config.load(CombinerConfig, "smoke", expected), cache)]
    first, last = capsys.readouterr().out.splitlines()
    assert "RELMSE combined 0." in first
    assert last == f"step 30; the best weights are of step 30: {run}/weights.safetensors"


def test_in_evaluations(trained, network_file):
    """A setting like any other, which counts by what is in the file."""
    _, outcome = trained
    values = {"denoiser": network_file, "image": "denoised", "estimator": "none"}
    plain = settings.parse(values, source="here")
    behind = settings.parse({**values, "combiner": str(outcome.weights)}, source="here")
    assert "combiner" not in plain.flat()
    assert behind.flat()["combiner"] == str(outcome.weights)
    assert behind.label().endswith("combiner=run/weights")
    assert plain.estimate() != behind.estimate()
    assert parts.content(plain) != parts.content(behind)
    found = parts.denoiser_for(FRAME, behind)
    assert isinstance(found, combiner.DeepCombiner)
    assert found.name == "mine+combiner"
    mixed = settings.parse({**values, "image": "mix", "estimator": "exact"}, source="here")
    both = dataclasses.replace(mixed, combiner=str(outcome.weights))
    assert parts.mixer_for(found, both) is pd.load_mixer("any")


def test_evaluations_divide_renders(divided, renders, network_file):
    """By the earlier renders of the series, which count for the row's key; not beside an adaptation."""
    _, outcome = divided
    values = {"denoiser": network_file, "image": "denoised", "estimator": "none"}
    values["combiner"] = str(outcome.weights)
    behind = settings.parse(values, source="here")
    data = {"data": [str(renders)], "spp": [64], "scenes": ["one"]}
    made = plan.load(None, data=data, base=values, methods=["denoised"])
    (cell,) = made.cells()
    (row,) = measure.measure(measure.Job((cell,)))
    files = [renders / f"one_{n:06}spp.exr" for n in (4, 64)]
    parts_of = pd.subaverages.nested([pd.read_exr(path) for path in files])
    two = combiner.load(outcome.weights, denoisers.load(network_file))
    frame, buffered = combiner.of_buffers(two, parts_of)
    truth = pd.read_exr(renders / "one_004096spp.exr").color
    assert row.rmse == pytest.approx(float(pd.metrics.rmse(buffered(frame), truth)), rel=1e-4)
    before, content = files[0], files[0].read_bytes()
    pd.write_exr(before, pd.read_exr(before).replace(depth=None), overwrite=True)
    assert made.cells()[0].key != cell.key
    before.write_bytes(content)
    adapted = dataclasses.replace(behind, adaptation="sure")
    with pytest.raises(ValueError, match="combines 2 sub-averages, and adaptation is 'sure'"):
        parts.sub_averages(adapted)
