"""`progden denoise --adapt`, `--post-correct` and `--halves`, through real files."""

import functools
import importlib
import json

import jax
import numpy as np
import pytest

import progden_jax as pd
from progden_jax import adaptation, combiner
from progden_jax.cli import main
from progden_jax.exr import read_exr, write_exr

SIZE = (20, 24)


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """Compiled programs go to a folder of this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PROGDEN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A file of weights that compile at once."""
    path = tmp_path_factory.mktemp("weights") / "net.safetensors"
    pd.denoisers.save(path, pd.denoisers.KPCN.init(jax.random.key(0), layers=2, width=8))
    return path


@pytest.fixture
def halves(tmp_path):
    """Files of two renders with variances, a.exr and b.exr, and of their mean, whole.exr."""
    rng = np.random.default_rng(0)
    truth = 1 + np.linspace(0, 1, SIZE[0] * SIZE[1] * 3).reshape(*SIZE, 3)
    a, b = (truth + 0.2 * rng.normal(size=truth.shape) for _ in range(2))
    for name, color, variance in (("a", a, 0.04), ("b", b, 0.04), ("whole", (a + b) / 2, 0.02)):
        frame = pd.Frame(color.astype("f4"), np.full(truth.shape, variance, "f4"))
        write_exr(tmp_path / f"{name}.exr", frame)
    return tmp_path


@pytest.fixture
def few_layers(monkeypatch):
    """A correction that compiles sooner than the paper's."""
    small = functools.partial(adaptation.PostCorrection, window=3, layers=2, width=4)
    monkeypatch.setattr(adaptation, "PostCorrection", small)


@pytest.fixture
def denoise(network, capsys):
    """Run the command with that network; gives the status, what --json told, and stderr."""

    def call(*words, denoiser=network):
        words = ["denoise", *words, "--denoiser", denoiser, "--mixer", "closed-form", "--json"]
        status = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return status, json.loads(out) if out else None, err

    return call


def test_adapted_by_sure(halves, network, denoise):
    """As by the library with the key of the command's seed, and told of."""
    out = halves / "out.exr"
    status, (told,), err = denoise(
        halves / "whole.exr", "-o", out, "--adapt", "--adapt-steps", 3, "--save", "denoised"
    )
    assert (status, err) == (0, "")
    frame = read_exr(halves / "whole.exr")
    found = adaptation.adapt(
        frame,
        pd.denoisers.load(network),
        adaptation=adaptation.Adaptation(steps=3),
        key=jax.random.fold_in(jax.random.key(0), 1),
    )
    expected = jax.jit(lambda d, f: d(f))(found.adapted, frame)
    written = pd.exr.read_layers(out)
    np.testing.assert_allclose(written["denoised"], expected, rtol=1e-5, atol=1e-6)
    assert told["denoiser"] == "net"
    assert told["adaptation"]["kind"] == "sure"
    assert told["adaptation"]["steps"] == found.step
    assert told["adaptation"]["risk_after"] == pytest.approx(found.after)


def test_a_sequence_is_corrected_by_its_halves(halves, few_layers, denoise, monkeypatch):
    """In order, each frame from the weights of the one before, its halves from folders of the same names."""
    names = ("one.exr", "two.exr")
    for folder, file in (("in", "whole"), ("a", "a"), ("b", "b")):
        (halves / folder).mkdir()
        for name in names:
            (halves / folder / name).write_bytes((halves / f"{file}.exr").read_bytes())
    starts = []
    genuine = adaptation.post_correct

    def correct(given, *others, start, **settings):
        starts.append(start)
        np.testing.assert_allclose(
            given.both()[0].color, read_exr(halves / "a.exr").color, atol=1e-6
        )
        np.testing.assert_array_equal(given.frame.variance, np.float32(0.02))
        return genuine(given, *others, start=start, **settings)

    monkeypatch.setattr(adaptation, "post_correct", correct)
    flags = ["--post-correct", "--sequence", "--adapt-steps", 1, "--save", "sure"]
    flags += ["--halves", halves / "a", halves / "b"]
    status, told, err = denoise(halves / "in", "-o", halves / "out", *flags)
    assert (status, err.count("SURE is too low"), len(err.splitlines())) == (0, 2, 2)
    assert [t["adaptation"]["reused"] for t in told] == [False, True]
    assert {t["adaptation"]["halves"] for t in told} == {"given"}
    assert [t["adaptation"]["steps"] for t in told] == [1, 1]
    assert starts[0] is None
    assert starts[1] is not None
    assert sorted(p.name for p in (halves / "out").iterdir()) == sorted(names)


def test_a_correction_is_fitted_by_sure(halves, few_layers, denoise, monkeypatch):
    """From the whole render; frames of a sequence go on from the weights of the one before."""
    (halves / "in").mkdir()
    for name in ("one.exr", "two.exr"):
        (halves / "in" / name).write_bytes((halves / "whole.exr").read_bytes())
    given = []

    def correct(frame, denoiser, *, correction, adaptation, start, key, progress):
        given.append((adaptation.steps, start, jax.random.key_data(key).tolist()))
        params = jax.tree.map(np.ones_like, correction.init(jax.random.key(0)))
        behind = PostCorrected(denoiser, params, {}, correction)
        return adapted(behind, 2, 0.5, 0.25, 0.125, np.arange(2), np.arange(2.0))

    PostCorrected, adapted = adaptation.PostCorrected, adaptation.Adapted
    monkeypatch.setattr(adaptation, "correct_by_sure", correct)
    words = ["--adapt", "--post-correct", "--sequence", "--adapt-steps", 3]
    status, told, err = denoise(halves / "in", "-o", halves / "out", *words)
    assert (status, err) == (0, "")
    (first, *_), (second, weights, key) = given
    assert (first, second, given[0][1]) == (3, 3, None)
    assert jax.tree.all(jax.tree.map(lambda w: (w == 1).all(), weights))
    assert key == jax.random.key_data(jax.random.fold_in(jax.random.key(0), 1)).tolist()
    assert [t["adaptation"]["kind"] for t in told] == ["sure-correct"] * 2
    assert [t["adaptation"]["reused"] for t in told] == [False, True]
    assert told[0]["adaptation"]["risk_after"] == 0.25


def test_the_input_may_be_one_of_the_halves(halves, few_layers, denoise):
    out = halves / "out.exr"
    words = ["--post-correct", "--adapt-steps", 1, "--save", "noisy,variance,sure"]
    pair = ["--halves", halves / "a.exr", halves / "b.exr"]
    status, _, err = denoise(halves / "a.exr", "-o", out, *words, *pair)
    assert (status, "SURE is too low behind a denoiser that was fitted" in err) == (0, True)
    written = pd.exr.read_layers(out)
    whole = read_exr(halves / "whole.exr")
    np.testing.assert_allclose(written["noisy"], whole.color, atol=1e-6)
    np.testing.assert_allclose(written["noisy_variance"], whole.variance, rtol=1e-6)
    bright = read_exr(halves / "whole.exr")
    write_exr(halves / "other.exr", bright.replace(color=2 * bright.color))
    status, (told,), _ = denoise(halves / "other.exr", "-o", halves / "no.exr", *words, *pair)
    assert (status, "neither their mean nor one of them" in told["error"]) == (1, True)
    assert not (halves / "no.exr").exists()


@pytest.fixture(scope="module")
def combines_two(network, tmp_path_factory):
    """A file of a combiner's weights for two sub-averages."""
    form = combiner.KernelNetwork(layers=1, layer_size=1, window=3, buffers=2, inputs=("variance",))
    weights = jax.jit(form.init)(jax.random.key(0))
    path = tmp_path_factory.mktemp("combiner") / "two.safetensors"
    combiner.save(path, combiner.DeepCombiner(weights, pd.denoisers.load(network), form))
    return path


def test_sub_averages_are_combined(halves, network, combines_two, denoise):
    """As by the library, whether the input is what they make up or one of them."""
    pair = [halves / "a.exr", halves / "b.exr"]
    made = combiner.load(combines_two, pd.denoisers.load(network))
    frame, buffered = combiner.of_buffers(made, [read_exr(path) for path in pair])
    words = ["--combiner", combines_two, "--halves", *pair, "--save", "denoised,variance"]
    for name in ("whole.exr", "a.exr"):
        out = halves / f"of_{name}"
        status, (told,), err = denoise(halves / name, "-o", out, *words)
        assert (status, err) == (0, "")
        assert told["denoiser"] == "net+combiner"
        written = pd.exr.read_layers(out)
        np.testing.assert_allclose(written["denoised"], buffered(frame), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(written["noisy_variance"], frame.variance, rtol=1e-6)


@pytest.mark.parametrize(
    ("names", "flags", "message"),
    [
        ("", "", "combines 2 sub-averages of the samples: name as many renders with --halves"),
        ("a.exr b.exr whole.exr", "", "--halves names 3 renders, expected 2"),
        ("a.exr a.exr", "", "--halves names one render twice"),
        ("a.exr b.exr", "--post-correct", "--post-correct fit to one image: leave one out"),
        ("a.exr b.exr", "--variance-from b.exr", "both name other renders"),
        ("a.exr b.exr", "--max-memory 1GiB", "need them whole"),
    ],
)
def test_what_does_not_go_with_sub_averages(
    halves, combines_two, denoise, monkeypatch, names, flags, message
):
    monkeypatch.chdir(halves)
    given = ["--halves", *names.split()] if names else []
    words = ["--combiner", combines_two, *given, *flags.split()]
    status, told, err = denoise("whole.exr", "-o", "out.exr", *words)
    assert (status, told) == (2, None)
    assert message in err
    assert not (halves / "out.exr").exists()


def test_nfor_filters_the_halves_by_each_other(halves, denoise, monkeypatch):
    nfor = pd.denoisers.NFOR(radius=1, patch=1, bandwidths=(1.0,), inputs=())
    monkeypatch.setattr(pd.denoisers, "NFOR", lambda **_: nfor)
    out, pair = halves / "out.exr", [halves / f"{name}.exr" for name in "ab"]
    words = ["--save", "denoised", "--halves", *pair]
    status, (told,), err = denoise(halves / "whole.exr", "-o", out, *words, denoiser="nfor")
    assert (status, err) == (0, "")
    assert (told["denoiser"], told["adaptation"]) == ("nfor", None)
    frame = read_exr(halves / "whole.exr")
    f = nfor.bind(frame, halves=tuple(read_exr(half).color for half in pair))
    written = pd.exr.read_layers(out)["denoised"]
    np.testing.assert_allclose(written, f(frame.color), atol=1e-5)


def test_an_interrupt_leaves_nothing(halves, denoise, monkeypatch):
    seen = []

    def follow(bars, done, total, of="the exact divergence"):
        seen.append((done, total, of))
        if done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("progden_jax.cli.denoise")._Bars, "follow", follow)
    status, _, err = denoise(
        halves / "whole.exr", "-o", halves / "out.exr", "--adapt", "--adapt-steps", 3
    )
    assert (status, "interrupted" in err) == (130, True)
    assert seen == [(1, 3, "the adaptation"), (2, 3, "the adaptation")]
    assert not (halves / "out.exr").exists()


def test_without_a_variance_there_is_nothing_to_fit_by(halves, denoise):
    plain = halves / "plain.exr"
    write_exr(plain, read_exr(halves / "whole.exr").replace(variance=None))
    for flag in ("--adapt", "--post-correct"):
        status, (told,), _ = denoise(plain, "-o", halves / "out.exr", flag)
        assert status == 1
        assert "has no variance" in told["error"]
