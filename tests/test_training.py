"""Training: configurations, data, cache, augmentation, the loop and its resumption."""

import dataclasses
import functools
import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import counting_compilations

import progden_jax as pd
from progden_jax import combiner, denoisers, mixers
from progden_jax.cli import main
from progden_jax.denoisers import KPCN, UNet
from progden_jax.training import (
    DenoiserConfig,
    DenoiserTask,
    MixerConfig,
    MixerTask,
    Trainer,
    config,
    losses,
    mixer_task,
    order,
    train,
)
from progden_jax.training import augment as augmenting
from progden_jax.training.estimates import EstimateCache
from progden_jax.training.index import index, split
from progden_jax.training.mixer_task import swapped_alpha

SIZE = 24


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Blur:
    """A denoiser that halves the distance to the mean of the four neighbours, times a gain."""

    gain: float = 1.0

    def __call__(self, frame: pd.Frame) -> jax.Array:
        return self.bind(frame)(frame.color)

    def bind(self, frame: pd.Frame) -> jax.tree_util.Partial:
        del frame
        return jax.tree_util.Partial(_blurred, self.gain)


def _blurred(gain, x):
    around = sum(jnp.roll(x, s, a) for s in (1, -1) for a in (0, 1)) / 4
    return gain * (x + around) / 2


def _write_series(folder: Path, scene: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.random((4, 4, 3)).repeat(SIZE // 4, 0).repeat(SIZE // 4, 1)
    for spp in (4, 64):
        variance = truth / spp
        color = truth + np.sqrt(variance) * rng.normal(size=truth.shape)
        frame = pd.Frame(color.astype(np.float32), variance.astype(np.float32))
        pd.write_exr(folder / f"{scene}_{spp:06}spp.exr", frame)
    pd.write_exr(folder / f"{scene}_004096spp.exr", truth.astype(np.float32))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("renders")
    for seed, scene in enumerate(("one", "two", "three")):
        _write_series(made, scene, seed)
    return made


def _config(folder: Path, **changes) -> MixerConfig:
    values = {"data": [str(folder)], "crop": 16, "held_out_scenes": ["two"], **changes}
    return config.load(MixerConfig, "smoke", values)


@pytest.fixture(scope="module")
def trainer(folder, tmp_path_factory) -> Trainer:
    cache = tmp_path_factory.mktemp("cache")
    chosen = _config(folder, options={"width": 4})
    return Trainer(MixerTask(chosen, denoiser=Blur(), cache_folder=cache))


@pytest.fixture(scope="module")
def whole(trainer, tmp_path_factory):
    """The outcome of an uninterrupted run, its folder, and what was compiled during steps 4 to 6."""
    where = tmp_path_factory.mktemp("whole")

    class Report:
        compiled = None

        def started(self, step, steps):
            assert (step, steps) == (0, 6)

        def stepped(self, step, values):
            assert (values is None) == (step % trainer.task.config.log_every != 0)
            if step == 3:
                self.listening = counting_compilations()
                self.names = self.listening.__enter__()
            if step == 5:
                self.compiled = list(self.names)
                self.listening.__exit__(None, None, None)

        def evaluated(self, step, scores, *, best):
            assert step in (3, 6)

    report = Report()
    return trainer.run(where, report=report), where, report


def test_a_run_changes_the_weights_and_compiles_once(trainer, whole):
    outcome, where, report = whole
    start = trainer.task.init(jax.random.key(trainer.task.config.seed))
    assert int(outcome.state.step) == 6
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), start, outcome.state.params)
    assert all(jax.tree.leaves(changed))
    assert not {"step", "train_step"} & set(report.compiled)
    lines = [json.loads(line) for line in (where / "curves.jsonl").read_text().splitlines()]
    losses_seen = [line["train/loss"] for line in lines if "train/loss" in line]
    assert len(losses_seen) == 6
    assert all(0 < value < 1 for value in losses_seen)
    assert list((where / "tensorboard").iterdir())


def test_resumption_is_exact(trainer, whole, tmp_path):
    """Three steps, a kill after a fourth that no checkpoint knows, then the rest: bit for bit the same."""

    class Killed(Exception):
        pass

    class Killer:
        def started(self, step, steps): ...

        def stepped(self, step, values):
            if step == 4:
                raise Killed

        def evaluated(self, step, scores, *, best): ...

    with pytest.raises(Killed):
        trainer.run(tmp_path, report=Killer())
    resumed = trainer.run(tmp_path)
    outcome, where, _ = whole
    for one, other in zip(
        jax.tree.leaves(outcome.state), jax.tree.leaves(resumed.state), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    curves = [
        [
            {k: v for k, v in json.loads(line).items() if "seconds" not in k}
            for line in (f / "curves.jsonl").read_text().splitlines()
        ]
        for f in (where, tmp_path)
    ]
    assert curves[0] == curves[1]
    ours, theirs = (mixers.load(f / "weights.safetensors") for f in (where, tmp_path))
    jax.tree.map(np.testing.assert_array_equal, ours.params, theirs.params)


def test_a_folder_belongs_to_one_run(whole, folder, tmp_path):
    _, where, _ = whole
    other = MixerTask(
        _config(folder, options={"width": 4}, peak_rate=0.1), denoiser=Blur(), cache_folder=tmp_path
    )
    with pytest.raises(ValueError, match=r"other settings \(peak_rate is 0\.1 and was 0\.001\)"):
        train(other, where)


def test_a_run_of_an_earlier_version_goes_on(whole, trainer, tmp_path):
    """Fields that its version did not know are as if they had their defaults."""
    _, where, _ = whole
    there = shutil.copytree(where, tmp_path / "run")
    written = json.loads((there / "run.json").read_text())
    written["config"].pop("start")
    (there / "run.json").write_text(json.dumps(written))
    assert int(trainer.run(there).state.step) == 6


def test_weights_are_the_best_and_say_where_they_come_from(trainer, whole):
    outcome, _, _ = whole
    mixer = mixers.load(outcome.weights)
    jax.tree.map(np.testing.assert_array_equal, mixer.params, outcome.state.best)
    assert mixer.metadata["denoiser"] == "oidn-hdr"
    assert mixer.metadata["architecture"] == "paper"
    assert int(mixer.metadata["steps"]) == int(outcome.state.best_step)
    assert json.loads(mixer.metadata["config"])["steps"] == 6
    assert mixer.metadata["commit"]
    scores = trainer.task.evaluate(outcome.state.best)
    np.testing.assert_allclose(scores.score, outcome.state.best_score, rtol=1e-6)
    assert set(scores.table) == {"render", "denoised", "closed-form", "oracle", "mix"}
    assert set(scores.table["oracle"]["rmse"]) == {4, 64}
    for spp in (4, 64):
        least = min(scores.table[name]["rmse"][spp] for name in ("render", "denoised"))
        assert scores.table["oracle"]["rmse"][spp] <= 1.001 * least
    assert f"mix/rmse/{4}spp" in scores.flat()


def test_an_exhausted_patience_stops(trainer, whole, tmp_path, monkeypatch):
    task = trainer.task
    scores = task.evaluate(whole[0].state.best)
    monkeypatch.setattr(task, "evaluate", lambda params: scores)
    often = dataclasses.replace(task.config, patience=1, evaluate_every=1)
    monkeypatch.setattr(task, "config", often)
    outcome = trainer.run(tmp_path)
    assert outcome.stopped_early
    assert (int(outcome.state.step), int(outcome.state.best_step)) == (2, 1)


def test_order_visits_every_example_once_an_epoch():
    seen = [order.indices(step, count=10, batch=4, seed=3) for step in range(5)]
    first, second = np.concatenate(seen)[:10], np.concatenate(seen)[10:]
    assert sorted(first) == sorted(second) == list(range(10))
    assert list(first) != list(second)
    np.testing.assert_array_equal(order.indices(3, count=10, batch=4, seed=3), seen[3])


def test_augmentation_is_consistent():
    """SURE of the changed example is the changed SURE; all eight symmetries occur; normals keep values."""
    rng = np.random.default_rng(0)
    names = ("color", "denoised", "variance", "divergence", "reference", "albedo", "normal")
    example = {n: rng.random((6, 6, 3), np.float32) for n in names}
    example["depth"] = rng.random((6, 6, 1), np.float32)
    example["mean_variance"] = np.float32(0.5)
    sure = pd.sure(*(example[n] for n in ("color", "denoised", "variance", "divergence")))
    keys = jax.random.split(jax.random.key(0), 200)
    chosen = MixerConfig(steps=1, crop=4, exposure_stops=2.0, depth_stops=1.0)

    @jax.jit
    @jax.vmap
    def changed(key):
        change = augmenting.draw(key, (6, 6), chosen)
        # SURE is of squared radiance, as the variance is.
        moved = augmenting.apply(change, {"variance": sure}, crop=4)["variance"]
        return change, augmenting.apply(change, example, crop=4), moved

    change, many, moved = jax.tree.map(np.asarray, changed(keys))
    again = pd.sure(*(many[n] for n in ("color", "denoised", "variance", "divergence")))
    np.testing.assert_allclose(again, moved, rtol=1e-4, atol=1e-5)
    scale = np.exp2(change.stops)
    assert scale.min() < 0.3
    assert scale.max() > 3
    np.testing.assert_allclose(many["mean_variance"], 0.5 * scale**2, rtol=1e-5)
    assert many["albedo"].max() <= 1
    unit = np.exp2(change.depth_stops)
    assert unit.min() < 0.55
    assert unit.max() > 1.8
    assert abs(np.corrcoef(change.depth_stops, change.stops)[0, 1]) < 0.3
    symmetries = {(bool(a), bool(b), bool(c)) for a, b, c in zip(*change[2:5], strict=True)}
    assert len(symmetries) == 8
    assert set(change.order) == set(range(6))
    # By hand: the crop, transposed, mirrored, reordered and scaled.
    for i in (0, 1, 2, 3):
        c = jax.tree.map(lambda a, i=i: a[i], change)
        expected = example["color"][c.row : c.row + 4, c.column : c.column + 4]
        normal = example["normal"][c.row : c.row + 4, c.column : c.column + 4]
        depth = example["depth"][c.row : c.row + 4, c.column : c.column + 4]
        if c.transpose:
            expected, normal, depth = (a.swapaxes(0, 1) for a in (expected, normal, depth))
        rows, columns = (
            slice(None, None, 1 - 2 * c.flip_rows),
            slice(None, None, 1 - 2 * c.flip_columns),
        )
        colors = list(augmenting.ORDERS[c.order])
        np.testing.assert_allclose(
            many["color"][i], expected[rows, columns][..., colors] * scale[i], rtol=1e-6
        )
        np.testing.assert_array_equal(many["normal"][i], normal[rows, columns])
        np.testing.assert_allclose(many["depth"][i], depth[rows, columns] * unit[i], rtol=1e-6)


def test_turns_without_flips_are_rotations():
    keys = jax.random.split(jax.random.key(1), 64)
    chosen = MixerConfig(steps=1, crop=4, flips=False, permute_colors=False)
    change = jax.jit(jax.vmap(lambda k: augmenting.draw(k, (4, 4), chosen)))(keys)
    mirrored = change.transpose ^ change.flip_rows ^ change.flip_columns
    assert not mirrored.any()
    assert change.transpose.any()
    assert not change.order.any()


def test_swap_symmetry(images):
    """Asked the other way round, α is 1 − β; and the closed form's α and β add up to 1."""
    x, y, variance, divergence = (
        jnp.asarray(a) for a in (images.x, images.y, images.variance, images.divergence)
    )
    risk = pd.sure(x, y, variance, divergence)
    paper = mixers.build("paper", {"width": 8})

    @jax.jit
    def both(params):
        swapped = swapped_alpha(paper, params, x, y, variance, divergence, risk, jnp.asarray(True))
        straight = swapped_alpha(
            paper, params, y, x, risk, divergence, variance, jnp.asarray(False)
        )
        return swapped, straight

    swapped, straight = both(jax.jit(paper.init)(jax.random.key(0)))
    np.testing.assert_allclose(swapped, 1 - straight, atol=1e-6)
    closed = jax.jit(functools.partial(pd.closed_form_alpha, window=9))
    alpha, beta = closed(x, y, variance, divergence), closed(y, x, risk, divergence)
    inner = (alpha > 0) & (alpha < 1)
    assert inner.mean() > 0.2
    np.testing.assert_allclose((alpha + beta)[inner], 1, atol=1e-4)


@pytest.fixture(scope="module")
def render(folder) -> pd.Frame:
    """One of the renders, as training sees it."""
    return pd.read_exr(folder / "one_000004spp.exr").replace(spp=None)


def test_cache_of_estimates(render, tmp_path):
    method = pd.MonteCarlo(1)
    cache = EstimateCache(Blur(), method, tmp_path)
    first = cache.get(render)
    again = EstimateCache(Blur(), method, tmp_path)
    np.testing.assert_array_equal(again.get(render).divergence, first.divergence)
    assert (cache.misses, again.hits, again.misses) == (1, 1, 0)
    np.testing.assert_allclose(first.denoised, Blur()(render), rtol=1e-5, atol=1e-6)
    # Everything that the result depends on is in the key.
    keys = {
        cache.key(render, 0),
        cache.key(render, 1),
        cache.key(render.replace(variance=2 * render.variance), 0),
        cache.key(render.replace(albedo=render.color), 0),
        cache.key(render.replace(normal=render.color), 0),
        EstimateCache(Blur(0.5), method, tmp_path).key(render, 0),
        EstimateCache(Blur(), pd.MonteCarlo(2), tmp_path).key(render, 0),
        EstimateCache(Blur(), method, tmp_path, tangents=True).key(render, 0),
    }
    assert len(keys) == 8
    # Damaged entries are made again: cut short, of one bit changed, and empty.
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    for damaged in (data[:-100], data[:-1] + bytes([data[-1] ^ 1]), b""):
        path.write_bytes(damaged)
        mended = EstimateCache(Blur(), method, tmp_path)
        np.testing.assert_array_equal(mended.get(render).divergence, first.divergence)
        assert mended.misses == 1
        assert path.read_bytes() == data


def test_a_python_function_is_not_cached(tmp_path):
    """Its name in a pytree is its address, which another may have in the next process."""
    assert EstimateCache(Blur(), pd.MonteCarlo(1), tmp_path).stores
    unnamed = pd.FunctionDenoiser(lambda x: x / 2)
    assert not EstimateCache(unnamed, pd.MonteCarlo(1), tmp_path).stores


@dataclasses.dataclass(frozen=True)
class Tilt:
    """An architecture of one weight."""

    def init(self, key):
        del key
        return {"slope": jnp.asarray(0.3)}

    def apply(self, params, x, y, variance, divergence, sure, *, inside=None):
        return jax.nn.sigmoid(params["slope"] * (sure - variance + x))


def test_training_by_sure_alone(folder, render, tmp_path, monkeypatch):
    """The derivative of α along the cached probe is what finite differences through the denoiser give."""
    monkeypatch.setitem(mixers.ARCHITECTURES, "tilt", Tilt)
    changes = {"architecture": "tilt", "options": {}, "draws": 2, "swap": 0.0}
    changes |= {"loss": "sure", "sure_derivative": "probe", "exposure_stops": 0.0}
    task = MixerTask(_config(folder, **changes), denoiser=Blur(), cache_folder=tmp_path)
    assert task.arrays["divergence"].shape == (4, 2, 1, SIZE, SIZE, 3)
    arrays = {n: a[:1] for n, a in task.arrays.items()}
    arrays |= {n: arrays[n][:, 0] for n in ("denoised", "probe", "tangent")}
    arrays["divergence"] = arrays["divergence"][:, 0, 0]
    np.testing.assert_allclose(np.abs(arrays["probe"][0]), np.sqrt(render.variance), rtol=1e-5)
    params = task.init(None)

    @jax.jit
    def alpha(step):
        x = render.color + step * arrays["probe"][0]
        y, variance, divergence = _blurred(1.0, x), render.variance, arrays["divergence"][0]
        risk = pd.sure(x, y, variance, divergence)
        return Tilt().apply(params, x, y, variance, divergence, risk)

    along = np.asarray(alpha(0.02) - alpha(-0.02)) / 0.04
    x, y = render.color, _blurred(1.0, render.color)
    risk = losses.mix_risk(
        alpha(0.0),
        x,
        y,
        render.variance,
        arrays["divergence"][0],
        along * arrays["probe"][0],
    )
    expected = (risk / (y**2 + 0.01)).mean()
    batch = {**arrays, "swap": jnp.zeros(1, bool)}
    loss, found = jax.jit(jax.value_and_grad(lambda p: task.loss(p, batch)[0]))(params)
    np.testing.assert_allclose(loss, expected, rtol=1e-3)
    assert np.isfinite(found["slope"])


def test_a_mixer_for_several_denoisers(folder, tmp_path):
    """Each render's image is by any of them, with its own divergence; held out are those of all."""
    changes = {"further": ["unet-hdr"], "flips": False, "turns": False, "permute_colors": False}
    task = MixerTask(_config(folder, **changes, crop=SIZE), denoiser=Blur(), cache_folder=tmp_path)
    alone = [
        MixerTask(_config(folder), denoiser=denoiser, cache_folder=tmp_path)
        for denoiser in (Blur(), denoisers.load("unet-hdr"))
    ]
    assert (task.cache.misses, [each.cache.misses for each in alone]) == (12, [0, 0])
    keys = jax.random.split(jax.random.key(0), 16)
    arrays = jax.tree.map(jnp.asarray, task.arrays)
    examples = jax.vmap(lambda key: task.example(arrays, 1, key))(keys)
    seen = set()
    for image, divergence in zip(examples["denoised"], examples["divergence"], strict=True):
        by = [bool((image == each.arrays["denoised"][1, 0]).all()) for each in alone]
        expected = alone[by.index(True)].arrays["divergence"][1, 0, 0]
        np.testing.assert_array_equal(divergence, expected)
        seen.add(by.index(True))
    assert seen == {0, 1}

    closed = pd.ClosedForm()
    scores = [each.held_out.scores(closed) for each in (task, *alone)]
    np.testing.assert_allclose(scores[0].score, (scores[1].score + scores[2].score) / 2, rtol=1e-5)
    smape = [found.table["denoised"]["smape"][4] for found in scores]
    assert smape[0] == pytest.approx((smape[1] + smape[2]) / 2)


def test_a_combiner_behind_a_denoiser_by_name():
    found = mixer_task._loaded("unet-hdr+nfor")
    assert isinstance(found, combiner.DeepCombiner)
    assert found.network == combiner.read("nfor").network
    assert found.denoiser.name == "unet-hdr"
    with pytest.raises(ValueError, match="denoiser is 'nothing'"):
        mixer_task._loaded("nothing+nfor")


def test_risk_of_the_mix_is_unbiased():
    """Many noisy draws, a linear denoiser, and α that depends on x: only the full derivative will do."""
    rng = np.random.default_rng(0)
    truth, sigma, shrink = 0.5, 0.3, 0.4
    x = truth + sigma * rng.normal(size=(200_000, 1, 1, 3))
    y, variance = shrink * x + 0.4, np.full_like(x, sigma**2)
    for alpha, slope in ((np.full_like(x, 0.6), 0.0), (1 / (1 + x**2), -2 * x / (1 + x**2) ** 2)):
        z = x + alpha * (y - x)
        error = (z - truth) ** 2
        for derivative, unbiased in ((sigma**2 * slope, True), (0.0, np.all(slope == 0))):
            risk = losses.mix_risk(alpha, x, y, variance, shrink * variance, derivative)
            off = np.asarray(risk - error, np.float64)
            standard_error = off.std() / np.sqrt(off.size)
            assert (abs(off.mean()) < 4 * standard_error) == unbiased


def log_errors(z, truth, x, y):
    """Of each image log SMAPE + log RMSE, with shares of the better of render and denoised."""
    relative, squared = (
        [f(image).mean((1, 2, 3)) for image in (z, x, y)]
        for f in (
            lambda i: abs(i - truth) / (abs(i) + abs(truth) + 0.01),
            lambda i: (i - truth) ** 2,
        )
    )
    relative = relative[0] + 0.05 * np.minimum(*relative[1:])
    return np.log(relative) + 0.5 * np.log(squared[0] + 0.02 * np.minimum(*squared[1:]))


@pytest.mark.parametrize(
    ("loss", "bound"),
    [
        ("smape", False),
        ("smape", True),
        ("relmse", False),
        ("l1", False),
        ("logl1", False),
        ("log-errors", False),
    ],
)
def test_losses_and_the_bound(trainer, monkeypatch, loss, bound):
    """Each loss is the mean over the batch of what its formula says of the mix."""
    task = trainer.task
    changes = {"loss": loss, "bound": bound}
    monkeypatch.setattr(task, "config", dataclasses.replace(task.config, **changes))
    monkeypatch.setattr(task, "architecture", Tilt())
    batch = {name: jnp.asarray(a[:2]) for name, a in task.arrays.items()}
    batch["divergence"], batch["swap"] = batch["divergence"][:, 0, 0], jnp.asarray([False, True])
    batch["denoised"] = batch["denoised"][:, 0]
    x, y, v, d = (batch[n] for n in ("color", "denoised", "variance", "divergence"))
    params = Tilt().init(None)

    @jax.jit
    def mixed():
        risk = pd.sure(x, y, v, d)
        straight, swapped = (
            Tilt().apply(params, *a) for a in ((x, y, v, d, risk), (y, x, risk, d, v))
        )
        alpha = jnp.stack([straight[0], 1 - swapped[1]])
        return x + (jax.vmap(pd.t_bound)(alpha, x, y, v) if bound else alpha) * (y - x)

    z, truth = (np.asarray(a, np.float64) for a in (mixed(), batch["reference"]))
    formula = {
        "smape": abs(z - truth) / (abs(z) + abs(truth) + 0.01),
        "relmse": (z - truth) ** 2 / (truth**2 + 0.01),
        "l1": abs(z - truth),
        "logl1": abs(np.log1p(np.maximum(z, 0)) - np.log1p(np.maximum(truth, 0))),
        "log-errors": log_errors(z, truth, np.asarray(x), np.asarray(y)),
    }[loss]
    found = jax.jit(lambda p: task.loss(p, batch)[0])(params)
    np.testing.assert_allclose(found, formula.mean(), rtol=1e-4)


def test_log_weights():
    x, y = (np.random.default_rng(s).gamma(1, 2, (4, 5, 3)).astype(np.float32) for s in (0, 1))
    y[0] = x[0]
    alpha = np.full_like(x, 0.3)
    found = mixers.architectures.from_log_weight(alpha, x, y)
    z = np.expm1(0.7 * np.log1p(x) + 0.3 * np.log1p(y))
    np.testing.assert_allclose(x + found * (y - x), z, rtol=1e-4)
    np.testing.assert_allclose(found[0], 0.3)


def test_index_and_split(folder, tmp_path):
    items = index([folder])
    assert [(i.scene, i.spp) for i in items] == [
        (scene, spp) for scene in ("one", "three", "two") for spp in (4, 64)
    ]
    assert {i.reference.name for i in items} == {
        f"{s}_004096spp.exr" for s in ("one", "two", "three")
    }
    assert {i.spp for i in index([folder], reference_spp=64)} == {4, 4096}
    assert {i.spp for i in index([folder], spp=[64])} == {64}
    nested = tmp_path / "a" / "b"
    nested.mkdir(parents=True)
    for spp in (2, 16):
        (nested / f"one_{spp:06}spp.exr").touch()
    more = index([folder, tmp_path])
    assert [i.scene for i in more if i.spp == 2] == ["a/b/one"]
    with pytest.raises(ValueError, match="are both one at 000004 spp"):
        index([folder, _copy(folder, tmp_path / "copy")])
    with pytest.raises(ValueError, match="no render at 3 spp named NAME_SSSSSSspp.exr"):
        index([folder], spp=[3])
    with pytest.raises(ValueError, match="is no folder"):
        index([tmp_path / "nowhere"])
    with pytest.raises(ValueError, match="name at least one folder"):
        index([])

    training, held = split(items, share=0.0001)
    assert {i.scene for i in held}
    assert {i.scene for i in held}.isdisjoint(i.scene for i in training)
    for share in (0.3, 0.7):
        ours, theirs = (split(a, share=share)[1] for a in (items, more))
        if len({i.scene for i in ours}) > 1:
            assert {i.scene for i in ours} <= {i.scene for i in theirs}
    assert {i.scene for i in split(items, share=0.5, scenes=["two"])[1]} == {"two"}
    with pytest.raises(ValueError, match="names four, not among"):
        split(items, share=0.5, scenes=["four"])
    with pytest.raises(ValueError, match="names every scene"):
        split(items, share=0.5, scenes=["one", "two", "three"])
    with pytest.raises(ValueError, match="at least two are needed"):
        split(items[:2], share=0.5)


def _copy(folder: Path, to: Path) -> Path:
    to.mkdir()
    (to / "one_000004spp.exr").touch()
    return to


def test_data_that_will_not_do(folder, tmp_path):
    with pytest.raises(ValueError, match="kept for reports, which must not be trained on"):
        MixerTask(_config(tmp_path / "valid"), denoiser=Blur())
    with pytest.raises(ValueError, match="crop is 64, but the images are 24×24"):
        MixerTask(_config(folder, crop=64), denoiser=Blur(), cache_folder=tmp_path)
    with pytest.raises(ValueError, match="oidn-hdr does not follow exposure"):
        MixerTask(_config(folder, exposure_stops=1), denoiser=Blur())
    with pytest.raises(ValueError, match="method is 'guess', expected one of monte-carlo"):
        MixerTask(_config(folder, method="guess"), denoiser=Blur())
    plain = np.ones((8, 8, 3), np.float32)
    for scene in "ab":
        for spp in (1, 2):
            pd.write_exr(tmp_path / f"{scene}_{spp}spp.exr", plain)
    with pytest.raises(ValueError, match="b_1spp.exr has no variance"):
        MixerTask(_config(tmp_path, held_out_scenes=["a"]), denoiser=Blur(), cache_folder=tmp_path)


def test_configurations(tmp_path):
    assert config.names(MixerConfig) == ("any", "cpu", "gpu", "multiscale", "paper", "smoke")
    loaded = {name: config.load(MixerConfig, name) for name in config.names(MixerConfig)}
    paper = loaded["paper"]
    assert (paper.steps, paper.batch, paper.peak_rate, paper.loss) == (2_300_000, 12, 2e-5, "smape")
    assert (paper.crop, paper.swap, paper.architecture) == (128, 0.5, "paper")
    mine = tmp_path / "mine.toml"
    mine.write_text('base = "smoke"\nsteps = 9\nspp = [8, 32]\noptions = { width = 4 }\n')
    found = config.load(MixerConfig, mine, {"peak_rate": 1})
    assert (found.steps, found.batch, found.spp, found.peak_rate) == (9, 2, (8, 32), 1.0)
    assert dict(found.options) == {"width": 4}
    assert isinstance(found.peak_rate, float)
    other = tmp_path / "other.yaml"
    other.write_text("base: mine.toml\nloss: relmse\n")
    assert config.load(MixerConfig, other).steps == 9
    assert config.parse_change("peak_rate=1e-3", MixerConfig) == ("peak_rate", 1e-3)
    assert config.parse_change("denoiser=oidn-hdr", MixerConfig) == ("denoiser", "oidn-hdr")
    assert config.parse_change("spp = [2, 8]", MixerConfig) == ("spp", [2, 8])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepz = 3", r"there is no field 'stepz'; did you mean 'steps'\?"),
        ("qqqqq = 3", "there is no field 'qqqqq'; known are steps"),
        ("batch = 3", "the field 'steps' is lacking"),
        ("steps = 'many'", "steps is 'many', expected a whole number"),
        ("steps = true", "steps is True, expected a whole number"),
        ("steps = 0", "steps is 0, expected a whole number of at least 1"),
        ("steps = 1\nspp = 8", "spp is 8, expected a list of a whole number"),
        ("steps = 1\nspp = [1.5]", "an element of spp is 1.5"),
        ("steps = 1\npeak_rate = -1.0", "peak_rate is -1.0, expected a number above 0"),
        ("steps = 1\nloss = 'l2'", "loss is 'l2', expected one of 'smape'"),
        ("steps = 1\nvariance_of = 'sd'", "variance_of is 'sd', expected one of 'mean'"),
        ("steps = 1\nema = 1.5", "ema is 1.5, expected a decay below 1"),
        ("steps = 1\nflips = 1", "flips is 1, expected true or false"),
        ("steps = 1\noptions = 3", "options is 3, expected a table of settings"),
        ("steps == 1", "is no TOML"),
        ("base = 'bad.toml'", "begin from each other"),
        ("base = 'nowhere.toml'", "nowhere.toml: there is no such file"),
        (
            "base = 'big'",
            "config is 'big', expected one of any, cpu, gpu, multiscale, paper, smoke, or a file",
        ),
    ],
)
def test_configurations_that_will_not_do(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text(text)
    with pytest.raises(ValueError, match=message):
        config.load(MixerConfig, "bad.toml")


def test_command(trainer, folder, tmp_path, monkeypatch, capsys):
    """What the command line gives to training, and what it prints of the outcome."""
    given = []

    def task(chosen, *, cache_folder, progress):
        given.append((chosen, cache_folder))
        return trainer.task

    monkeypatch.setattr("progden_jax.training.MixerTask", task)
    monkeypatch.setattr("progden_jax.training.train", lambda task, *a, **k: trainer.run(*a, **k))
    monkeypatch.setattr("progden_jax.enable_compilation_cache", lambda: None)
    run, cache = str(tmp_path / "run"), tmp_path / "cache"
    arguments = ["train", "mixer", "-o", run, "--config", "smoke", "--data", str(folder)]
    full = [*arguments, "--cache", str(cache), "--set", "crop=8", "--set", "loss=relmse"]
    assert main([*full, "--until", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["step"] == 1
    expected = config.load(
        MixerConfig, "smoke", {"crop": 8, "loss": "relmse", "data": [str(folder)]}
    )
    assert given == [(expected, cache)]
    assert main(full) == 0
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first.startswith("step 3: score ")
    assert "RMSE render 0." in first or "RMSE closed-form 0." in first
    assert last.startswith("step 6; the best weights are of step ")
    for wrong, message in (
        ([*arguments, "--set", "crop"], "'crop' is no field=value"),
        ([*arguments[:5], "big"], "config is 'big', expected one of any"),
        (arguments[:6], "name folders of renders with --data"),
        ([*arguments, "--until", "0"], "--until is 0"),
    ):
        assert main(wrong) == 2
        assert message in capsys.readouterr().err


def test_training_a_denoiser(folder, tmp_path):
    """A small KPCN learns from renders without references, and its weights load as a denoiser."""
    changes = {"data": [str(folder)], "crop": 16, "held_out_scenes": ["two"], "loss": "sure"}
    changes |= {"steps": 20, "evaluate_every": 20, "peak_rate": 0.01, "inputs": ["variance"]}
    changes["weights_dtype"] = "float16"
    chosen = config.load(DenoiserConfig, "smoke", changes)
    outcome = train(DenoiserTask(chosen), tmp_path)
    loaded = pd.denoisers.load(outcome.weights)
    assert loaded.inputs == ("variance",)
    halves = jax.tree.map(lambda a: np.asarray(a, np.float16), outcome.state.best.params)
    jax.tree.map(np.testing.assert_array_equal, loaded.params, halves)
    lines = [json.loads(line) for line in (tmp_path / "curves.jsonl").read_text().splitlines()]
    last = lines[-2]
    assert lines[-1]["denoised/rmse/4spp"] < lines[-1]["render/rmse/4spp"]
    assert np.isfinite(last["train/loss"])


def _example(seed=0):
    rng = np.random.default_rng(seed)
    color, albedo, variance = rng.random((3, 16, 16, 3), np.float32)
    return pd.Frame(color, 0.1 * variance, albedo=albedo, normal=2 * albedo - 1)


def test_further_inputs():
    """A network that is given more buffers gives the same images, and learns to use them."""
    frame, inputs = _example(), ("normal", "albedo", "variance")
    # The U-Net's inputs go to its last level, too.
    for kind, options in ((UNet, {"size": "small"}), (KPCN, {"layers": 1, "width": 4})):
        narrow = kind.init(jax.random.key(0), ("albedo",), **options)
        wide = narrow.with_inputs(inputs)
        np.testing.assert_allclose(wide(frame), narrow(frame), rtol=1e-5, atol=1e-5)
    found = jax.jit(jax.grad(lambda network: jnp.square(network(frame)).mean()))(wide)
    by_channel = np.abs(found.params["conv1"]["kernel"]).max((0, 1, 3))
    assert by_channel.shape == (12,)
    assert (by_channel > 0).all()
    with pytest.raises(ValueError, match="takes albedo, and inputs is .'variance',."):
        narrow.with_inputs(("variance",))


def test_weights_to_start_from(folder, tmp_path):
    """Training goes on from a file's weights, of a denoiser with fewer inputs too."""
    changes = {"data": [str(folder)], "crop": 16, "start": str(tmp_path / "net.safetensors")}
    options = dict(config.load(DenoiserConfig, "smoke").options)
    given = KPCN.init(jax.random.key(3), (), **options)
    pd.denoisers.save(changes["start"], given, dtype="float32")
    chosen = config.load(DenoiserConfig, "smoke", {**changes, "inputs": ["variance"]})
    begun = DenoiserTask(chosen).init(jax.random.key(0))
    assert begun.inputs == ("variance",)
    frame = _example()
    np.testing.assert_allclose(begun(frame), given(frame), rtol=1e-5, atol=1e-7)
    for more, message in (
        (
            {"options": {**options, "width": 9}},
            "has 4 weights conv1.bias; this configuration makes 9",
        ),
        (
            {"architecture": "unet", "options": {"size": "small"}},
            "a KPCN; what is trained is a UNet",
        ),
        ({"start": "oidn"}, "is 'oidn', expected one of oidn-hdr"),
    ):
        with pytest.raises(ValueError, match=message):
            DenoiserTask(config.load(DenoiserConfig, "smoke", {**changes, **more}))


def test_a_mixer_to_start_from(folder, trainer, tmp_path):
    architecture = trainer.task.architecture
    params = architecture.init(jax.random.key(5))
    path = tmp_path / "mixer.safetensors"
    mixers.save_mixer(path, mixers.NetworkMixer(params, architecture))
    make = functools.partial(MixerTask, denoiser=Blur(), cache_folder=tmp_path)
    task = make(_config(folder, options={"width": 4}, start=str(path)))
    jax.tree.map(np.testing.assert_array_equal, task.init(jax.random.key(0)), params)
    for start, options in ((str(path), {"width": 6}), ("closed-form", {"width": 4})):
        with pytest.raises(ValueError, match="start is .*; what is trained is "):
            make(_config(folder, options=options, start=start))


def test_denoiser_configurations(folder):
    named = {"cpu", "gpu", "kpcn", "paper", "residual", "residual-small", "small", "smoke", "wider"}
    assert set(config.names(DenoiserConfig)) == named
    for name in config.names(DenoiserConfig):
        config.load(DenoiserConfig, name)
    for changes, message in (
        ({"architecture": "vit"}, "architecture is 'vit', expected one of 'unet', 'kpcn'"),
        ({"options": {"depth": 2}}, "options is {'depth': 2}: .*depth"),
        ({"inputs": ["albedo"]}, "has no albedo, which this network takes"),
        (
            {"inputs": ["depth"]},
            "inputs is 'depth', expected one of 'albedo', 'normal', 'variance'",
        ),
        ({"weights_dtype": "bfloat16"}, "weights_dtype is 'bfloat16', expected one of 'float32'"),
    ):
        values = {"data": [str(folder)], "crop": 16, **changes}
        with pytest.raises(ValueError, match=message):
            DenoiserTask(config.load(DenoiserConfig, "smoke", values))
    with pytest.raises(ValueError, match="inputs is 'position', expected one of 'albedo'"):
        config.load(DenoiserConfig, "smoke", {"inputs": ["position"]})


def test_a_batch_that_devices_cannot_share(trainer):
    with pytest.raises(ValueError, match="batch is 2, which 3 devices cannot share"):
        Trainer(trainer.task, devices=[None] * 3)
