"""The `progden` command through real files: in this process by `main`, and as a program of its own."""

import importlib
import itertools
import json
import os
import re
import resource
import subprocess
import sys
import weakref
from pathlib import Path

import jax
import numpy as np
import OpenEXR
import pytest
from code_generation import users_environment
from exr_files import planes, read_channels, stack, write

import progden_jax as pd
from progden_jax import _amx, _numeric, _windowed, demo, memory, pipeline
from progden_jax.cli import _options, _run, app, main
from progden_jax.exr import read_exr, write_exr

HEIGHT, WIDTH = 32, 48
PLAIN = ["--channels", "variance=none"]
QUICK = ["--quality", "fast", "--mixer", "closed-form"]
"""The quickest of OIDN's networks, for tests that see what it is given."""


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """Compiled programs go to a folder of this module, and JAX's settings come back."""
    names = [
        name
        for name in jax.config.values
        if "compilation_cache" in name or "persistent_cache" in name
    ]
    before = {name: jax.config.values[name] for name in names}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PROGDEN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("PROGDEN_DEBUG", raising=False)
        yield
    for name, value in before.items():
        jax.config.update(name, value)


def crop(path: Path, *, auxiliary: bool = True) -> pd.Frame:
    """A corner of a demo render with rods, a ball and checkers."""
    full = read_exr(path, auxiliary=auxiliary)
    window = np.s_[70 : 70 + HEIGHT, 40 : 40 + WIDTH]
    names = ("color", "variance", "albedo", "normal", "depth")
    buffers = {n: getattr(full, n) for n in names if getattr(full, n) is not None}
    return pd.Frame(**{n: np.asarray(b)[window] for n, b in buffers.items()}, spp=full.spp)


@pytest.fixture(scope="module")
def frames() -> dict[int, pd.Frame]:
    """Crops at 8 and 32 samples per pixel."""
    return {spp: crop(demo.renders()[spp]) for spp in (8, 32)}


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return demo.reference()[70 : 70 + HEIGHT, 40 : 40 + WIDTH]


@pytest.fixture
def noisy(tmp_path, frames) -> Path:
    path = tmp_path / "room.exr"
    write_exr(path, frames[8])
    return path


@pytest.fixture
def progden(capsys):
    """Run `main`; gives (status, stdout, stderr), and fails on a traceback."""

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return status, out, err

    return call


def report(out: str) -> list[dict]:
    """The one JSON document on stdout."""
    return json.loads(out)


def altered(path: Path, frame: pd.Frame, **buffers) -> Path:
    """A file of the frame with some buffers changed by functions of a writable array."""
    changed = {}
    for name, change in buffers.items():
        array = np.array(getattr(frame, name))
        changed[name] = array if (new := change(array)) is None else new
    write_exr(path, frame.replace(**changed))
    return path


def put(where, value):
    """A function for `altered` that writes `value` somewhere."""

    def change(array):
        array[where] = value

    return change


# One file, many, a folder.


def test_the_frame_is_gone_while_the_result_is_written(noisy, tmp_path, progden, monkeypatch):
    """In windows, as a huge one is, where three images at once could be more than `--max-memory`."""
    read = importlib.import_module("progden_jax.exr._read")
    job = importlib.import_module("progden_jax.cli._job")
    buffers, alive = [], []

    def adopted(array):
        buffers.append(weakref.ref(array.base))
        return _numeric.adopted(array)

    def writing(*arguments, **settings):
        alive.extend(buffer() is not None for buffer in buffers)
        return write_exr(*arguments, **settings)

    monkeypatch.setattr(read, "adopted", adopted)
    monkeypatch.setattr(job, "write_exr", writing)
    monkeypatch.setattr(_windowed, "fits", lambda *_: False)
    monkeypatch.setattr(memory, "resident", lambda: 0)
    more = ["--max-memory", "1GiB", *QUICK]
    assert progden("denoise", noisy, "-o", tmp_path / "out.exr", *more)[0] == 0
    assert alive == [False] * 5


def test_one_file_becomes_the_librarys_result(tmp_path, noisy, frames, progden):
    out = tmp_path / "clean.exr"
    status, stdout, stderr = progden("denoise", noisy, "-o", out)
    assert (status, stderr) == (0, "")
    assert "48×32, 8 spp, oidn-hdr-alb-nrm (colour + albedo + normal), mean α 0." in stdout
    frame = frames[8]
    expected = pd.progressive_denoise(frame, pd.denoisers.for_frame(frame), outputs=["image"])
    back = read_exr(out)
    np.testing.assert_allclose(back.color, expected.image, rtol=1e-5, atol=1e-6)
    assert int(back.spp) == 8
    assert back.variance is None


def test_many_files_and_json(tmp_path, frames, progden):
    paths = []
    for spp, frame in frames.items():
        paths.append(tmp_path / f"{spp}.exr")
        write_exr(paths[-1], frame)
    out = tmp_path / "new" / "deep"
    status, stdout, stderr = progden("denoise", *paths, "-o", out, "--json")
    assert (status, stderr) == (0, "")
    found = report(stdout)
    assert [Path(f["output"]) for f in found] == [out / "8.exr", out / "32.exr"]
    for f, spp in zip(found, frames, strict=True):
        assert f["ok"]
        assert f["mode"] == "progressive"
        assert (f["width"], f["height"], f["spp"]) == (WIDTH, HEIGHT, spp)
        assert 0 < f["mean_alpha"] <= 1
        assert f["auxiliary"] == ["albedo", "normal"]
        assert set(f["repairs"].values()) == {0}
    assert sorted(os.listdir(out)) == ["32.exr", "8.exr"]


def test_folder_keeps_its_structure_and_skips_other_files(tmp_path, frames, progden):
    source = tmp_path / "in"
    (source / "shot").mkdir(parents=True)
    write_exr(source / "a.exr", frames[8])
    write_exr(source / "shot" / "b.EXR", frames[8])
    (source / "notes.txt").write_text("no picture")
    (source / ".hidden.exr").write_text("no picture")
    # Inside the input: a second run must not take the first one's results for renders.
    out = source / "out"
    for force in ((), ("--force",)):
        status, stdout, _ = progden("denoise", source, "-o", out, *force)
        assert status == 0
        assert len(stdout.splitlines()) == 2
    assert {p.relative_to(out) for p in out.rglob("*") if p.is_file()} == {
        Path("a.exr"),
        Path("shot/b.EXR"),
    }


@pytest.mark.parametrize("slash", [True, False])
def test_one_file_into_a_folder(tmp_path, noisy, progden, slash):
    out = tmp_path / "out"
    if not slash:
        out.mkdir()
    assert progden("denoise", noisy, "-o", f"{out}{'/' * slash}")[0] == 0
    assert (out / "room.exr").is_file()


def test_flags_parse_in_any_order():
    groups = [
        ["-o", "out/"],
        ["--variance-from", "h1.exr", "h2.exr"],
        ["--save", "alpha,sure"],
        ["--json"],
    ]
    # Each group is last once, and first.
    for order in (groups, groups[::-1], groups[2:] + groups[:2], groups[1::-1] + groups[:1:-1]):
        flags = list(itertools.chain(*order))
        for command in (["a.exr", "b.exr", *flags], [*flags, "--", "a.exr", "b.exr"]):
            _, bound, _ = app.parse_args(
                ["denoise", *command], exit_on_error=False, print_error=False
            )
            assert [str(p) for p in bound.arguments["inputs"]] == ["a.exr", "b.exr"]
            assert bound.arguments["output"] == "out/"
            assert bound.arguments["read"].variance_from == (Path("h1.exr"), Path("h2.exr"))
            assert bound.arguments["save"] == "alpha,sure"
            assert bound.arguments["json"] is True


# What the flags do.


def test_save_adds_named_layers(tmp_path, noisy, frames, progden):
    out = tmp_path / "clean.exr"
    layers = ["--save", ",".join(_options.SAVE)]
    status, _, stderr = progden("denoise", noisy, "-o", out, *layers, *QUICK)
    assert (status, stderr) == (0, "")
    channels, _ = read_channels(out)
    x, y, alpha = (stack(channels, f"{n}.R/G/B") for n in ("noisy", "denoised", "alpha"))
    np.testing.assert_array_equal(x, frames[8].color)
    np.testing.assert_allclose(stack(channels, "R/G/B"), x + alpha * (y - x), rtol=1e-5, atol=1e-6)
    variance = stack(channels, "noisy_variance.R/G/B")
    np.testing.assert_array_equal(variance, frames[8].variance)
    risk = (y - x) ** 2 + 2 * stack(channels, "divergence.R/G/B") - variance
    np.testing.assert_allclose(stack(channels, "sure.R/G/B"), risk, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(stack(channels, "Albedo.R/G/B"), frames[8].albedo)
    np.testing.assert_array_equal(stack(channels, "Normal.X/Y/Z"), frames[8].normal)
    # The input's variance must not pass for the result's.
    assert read_exr(out).variance is None


@pytest.mark.parametrize(
    ("flags", "denoiser", "auxiliary"),
    [
        (["--quality", "fast"], "oidn-hdr-alb-nrm-small", ["albedo", "normal"]),
        (["--no-aux"], "oidn-hdr", []),
        (["--clean-aux"], "oidn-hdr-calb-cnrm", ["albedo", "normal"]),
        (["--prefilter"], "oidn-hdr-calb-cnrm", ["albedo", "normal"]),
        (["--denoiser", "oidn-hdr-alb"], "oidn-hdr-alb", ["albedo"]),
        (["--channels", "variance=none,normal=none"], "oidn-hdr-alb", ["albedo"]),
    ],
)
def test_choice_of_network(tmp_path, noisy, progden, flags, denoiser, auxiliary):
    out = tmp_path / "o.exr"
    # Without the variance, for that compiles faster.
    flags = flags if "--channels" in flags else [*flags, *PLAIN]
    status, stdout, _ = progden("denoise", noisy, "-o", out, "--json", *flags)
    (found,) = report(stdout)
    assert (status, found["mode"]) == (0, "plain")
    assert (found["denoiser"], found["auxiliary"]) == (denoiser, auxiliary)


def test_weights_from_a_file(tmp_path, noisy, progden):
    weights = tmp_path / "mine.tza"
    pd.denoisers.save_tza(weights, pd.denoisers.load("oidn-hdr-alb-nrm-small"))
    for flags in (["--weights", weights], ["--denoiser", "oidn-hdr-alb-nrm-small"]):
        out = tmp_path / f"{flags[0][2:]}.exr"
        assert progden("denoise", noisy, "-o", out, *flags, *PLAIN)[0] == 0
    a, b = (read_exr(tmp_path / f"{n}.exr").color for n in ("weights", "denoiser"))
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def quick(own) -> list[str]:
    """Flags of what compiles fastest, for tests of all but networks."""
    return ["--denoiser", str(own[1]), "--mixer", "closed-form"]


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> tuple[pd.denoisers.KPCN, Path]:
    """A tiny network of our own, and its weights file."""
    options = {"layers": 1, "width": 4, "name": "net"}
    net = pd.denoisers.KPCN.init(jax.random.key(0), ("variance",), **options)
    path = tmp_path_factory.mktemp("own") / "net.safetensors"
    pd.denoisers.save(path, net, dtype="float32")
    return net, path


def test_own_network_from_a_file(tmp_path, noisy, frames, progden, own):
    net, weights = own
    flags = ["--denoiser", weights, "--json"]
    status, out, _ = progden("denoise", noisy, "-o", tmp_path / "o.exr", *flags)
    assert (status, report(out)[0]["denoiser"]) == (0, "net")
    assert report(out)[0]["auxiliary"] == ["variance"]
    expected = pd.progressive_denoise(frames[8], net, outputs=["image"]).image
    np.testing.assert_allclose(read_exr(tmp_path / "o.exr").color, expected, rtol=1e-3, atol=1e-5)


def test_regression_instead_of_a_network(tmp_path, noisy, frames, truth, progden):
    flags = ["--denoiser", "nfor", "--save", "denoised", "--json"]
    status, out, _ = progden("denoise", noisy, "-o", tmp_path / "o.exr", *flags)
    (found,) = report(out)
    assert (status, found["denoiser"], found["mode"]) == (0, "nfor", "progressive")
    assert found["auxiliary"] == ["albedo", "normal", "depth"]
    denoised = stack(read_channels(tmp_path / "o.exr")[0], "denoised.R/G/B")
    rmse = pd.metrics.rmse
    assert rmse(denoised, truth) < 0.6 * rmse(frames[8].color, truth)
    status, _, err = progden("denoise", noisy, "-o", tmp_path / "p.exr", *flags, *PLAIN)
    assert status == 1
    assert "this frame has no variance: give one" in err


def test_prefilter_changes_what_the_network_sees(tmp_path, noisy, frames, progden):
    out = tmp_path / "o.exr"
    assert progden("denoise", noisy, "-o", out, "--prefilter", "--save", "albedo", *PLAIN)[0] == 0
    saved = stack(read_channels(out)[0], "Albedo.R/G/B")
    expected = pd.denoisers.prefilter(frames[8]).albedo
    np.testing.assert_allclose(saved, expected, atol=1e-6)
    assert np.abs(saved - np.asarray(frames[8].albedo)).max() > 1e-3


def test_method_probes_and_seed(tmp_path, noisy, progden, quick):
    maps = []
    for i, seed in enumerate((5, 5, 6)):
        out = tmp_path / f"{i}.exr"
        flags = ["--method", "finite-difference", "--probes", "2", "--seed", seed]
        status, stdout, _ = progden(
            *("denoise", noisy, "-o", out, "--json", "--save", "divergence"), *flags, *quick
        )
        assert status == 0
        assert report(stdout)[0]["method"].startswith("FiniteDifference(probes=2, ")
        maps.append(stack(read_channels(out)[0], "divergence.R/G/B"))
    np.testing.assert_array_equal(maps[0], maps[1])
    assert (maps[0] != maps[2]).mean() > 0.5


def test_methods_by_name():
    def build(**options):
        chosen = _options.EstimateOptions(**options)
        chosen.check()
        return chosen.build()

    assert build() == pipeline.DEFAULT_METHOD
    assert build(probes=3) == pd.MonteCarlo(probes=3)
    assert build(method="monte-carlo-gaussian") == pd.MonteCarlo(distribution="gaussian")
    for name, choice in _options.METHODS.items():
        method = build(method=name, probes=2 if choice.takes_probes else None)
        assert isinstance(method, getattr(pd, choice.type))
        assert not choice.takes_probes or method.probes == 2


def test_every_method_is_known_to_the_table():
    """A method added to the library without a name here would be out of the command's reach."""
    known = {choice.type for choice in _options.METHODS.values()}
    offered = {
        name
        for name in pd.__all__
        if isinstance(value := getattr(pd, name), type)
        and name != "Method"
        and hasattr(value, "evaluate")
    }
    assert offered == known


def test_exposure_is_passed_on(tmp_path, noisy, frames, progden):
    frame = frames[8].replace(variance=None)
    for exposure in ("0.01", "auto"):
        out = tmp_path / f"{exposure}.exr"
        assert progden("denoise", noisy, "-o", out, "--exposure", exposure, *PLAIN)[0] == 0
        given = None if exposure == "auto" else float(exposure)
        expected = pd.denoise(frame, pd.denoisers.for_frame(frame, exposure=given)).image
        np.testing.assert_allclose(read_exr(out).color, expected, rtol=1e-5, atol=1e-6)
    a, b = (np.asarray(read_exr(tmp_path / f"{e}.exr").color) for e in ("0.01", "auto"))
    assert np.abs(a - b).max() > 1e-3


def test_half_floats(tmp_path, noisy, progden):
    out = tmp_path / "o.exr"
    assert progden("denoise", noisy, "-o", out, "--half")[0] == 0
    assert read_channels(out)[0]["R"].dtype == np.float16


def test_input_attributes_are_kept(tmp_path, frames, progden):
    color = np.asarray(frames[8].color)
    channels = {c: np.ascontiguousarray(color[..., i]) for i, c in enumerate("RGB")}
    channels |= {f"Variance.{c}": np.full_like(channels[c], 1e-3) for c in "RGB"}
    channels["A"] = np.linspace(0, 1, HEIGHT * WIDTH, dtype="f4").reshape(HEIGHT, WIDTH)
    path = write(tmp_path / "a_8spp.exr", channels, pixelAspectRatio=2.0, owner="me")
    assert progden("denoise", path, "-o", tmp_path / "o.exr", *PLAIN)[0] == 0
    kept, header = read_channels(tmp_path / "o.exr")
    assert (header["pixelAspectRatio"], header["owner"]) == (2.0, "me")
    assert header["samplesPerPixel"] == 8
    np.testing.assert_array_equal(kept["A"], channels["A"])


def test_reference_prints_the_metrics(tmp_path, noisy, frames, truth, progden):
    write_exr(tmp_path / "ref.exr", truth)
    flags = ["denoise", noisy, "-o", tmp_path / "o.exr", "--reference", tmp_path / "ref.exr"]
    flags += QUICK
    status, stdout, _ = progden(*flags, "--json")
    scores = report(stdout)[0]["metrics"]
    assert status == 0
    assert list(scores) == ["noisy", "denoised", "mixed"]
    images = {"noisy": frames[8].color, "mixed": read_exr(tmp_path / "o.exr").color}
    for name, image in images.items():
        for metric in ("rmse", "smape", "flip", "relmse"):
            expected = float(getattr(pd.metrics, metric)(np.asarray(image), truth))
            assert scores[name][metric] == pytest.approx(expected, rel=1e-5)
    status, stdout, _ = progden(*flags, "--force")
    assert status == 0
    for text in ("RMSE", "SMAPE", "FLIP", f"{scores['mixed']['rmse']:.4f}"):
        assert text in stdout


def test_half_buffers_give_the_variance(tmp_path, frames, progden, quick):
    x = np.asarray(frames[8].color)
    spread = np.sqrt(np.asarray(frames[8].variance)) * np.random.default_rng(1).choice(
        [-1, 1], x.shape
    )
    buffers = {"a": x + spread, "b": x - spread}
    for name, color in (buffers | {"x": (buffers["a"] + buffers["b"]) / 2}).items():
        write_exr(tmp_path / f"{name}.exr", color.astype("f4"))
    halves = ["--variance-from", tmp_path / "a.exr", tmp_path / "b.exr"]
    out = tmp_path / "o.exr"
    status, _, stderr = progden(
        "denoise", tmp_path / "x.exr", "-o", out, "--save", "variance", *halves, *quick
    )
    assert status == 0
    assert "a variance from 2 renders is itself off" in stderr
    saved = stack(read_channels(out)[0], "noisy_variance.R/G/B")
    np.testing.assert_allclose(
        saved, ((buffers["a"] - buffers["b"]) / 2) ** 2, rtol=1e-3, atol=1e-9
    )


def test_variance_and_reference_from_folders_of_the_same_names(
    tmp_path, frames, truth, progden, quick
):
    rng = np.random.default_rng(2)
    for folder in ("one", "two", "truth"):
        (tmp_path / folder).mkdir()
        for name in ("a.exr", "b.exr"):
            noise = 0.05 * rng.normal(size=truth.shape) if folder != "truth" else 0
            write_exr(tmp_path / folder / name, (truth + noise).astype("f4"))
    flags = ["--variance-from", tmp_path / "two", "--reference", tmp_path / "truth", "--json"]
    flags += quick
    status, stdout, _ = progden("denoise", tmp_path / "one", "-o", tmp_path / "out", *flags)
    found = report(stdout)
    assert status == 0
    assert [f["mode"] for f in found] == ["progressive"] * 2
    # The mean of both seeds is what was denoised: half the variance of one.
    for f in found:
        assert f["metrics"]["noisy"]["rmse"] == pytest.approx(0.05 / 2**0.5, rel=0.1)


def test_variance_of_samples_std_and_moments_agree(tmp_path, frames, progden, quick):
    x, variance = (np.asarray(a, np.float64) for a in (frames[8].color, frames[8].variance))
    held = {
        "samples": ("Variance", variance * 8),
        "std": ("Variance", np.sqrt(variance)),
        "second-moment": ("m2_color", x**2 + variance * 7),
    }
    for meaning, (layer, values) in held.items():
        planes_of = {c: x[..., i] for i, c in enumerate("RGB")}
        planes_of |= {f"{layer}.{c}": values[..., i] for i, c in enumerate("RGB")}
        path = write(
            tmp_path / "in.exr", {n: np.ascontiguousarray(p, "f4") for n, p in planes_of.items()}
        )
        flags = ["--variance-of", meaning, "--spp", "8", "--save", "variance", "--force"]
        flags += quick
        status, _, stderr = progden("denoise", path, "-o", tmp_path / "o.exr", *flags)
        assert (status, stderr) == (0, ""), meaning
        saved = stack(read_channels(tmp_path / "o.exr")[0], "noisy_variance.R/G/B")
        np.testing.assert_allclose(saved, variance, rtol=1e-2, atol=1e-6, err_msg=meaning)


# Bad input: a clear error, or a finite result with the counts reported.


def test_a_folder_goes_on_where_it_stopped(tmp_path, frames, progden):
    """Files of two sizes from one program; outputs that are there are left as they are."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    small = jax.tree.map(lambda a: a[:20] if a.ndim else a, frames[32])
    for name, frame in (("a", frames[8]), ("b", small), ("c", frames[32])):
        write_exr(folder / f"{name}.exr", frame)
    status, stdout, _ = progden("denoise", folder, "-o", out, "--json")
    done = report(stdout)
    assert (status, [Path(f["input"]).name for f in done]) == (0, ["a.exr", "b.exr", "c.exr"])
    assert read_exr(out / "b.exr").size == (20, WIDTH)
    before = (out / "a.exr").read_bytes()
    (out / "c.exr").unlink()
    status, _, stderr = progden("denoise", folder, "-o", out)
    assert (status, "--resume to leave it" in stderr) == (1, True)
    status, stdout, _ = progden("denoise", folder, "-o", out, "--resume", "--json")
    assert (status, [Path(f["input"]).name for f in report(stdout)]) == (0, ["c.exr"])
    assert (out / "a.exr").read_bytes() == before
    status, stdout, _ = progden("denoise", folder, "-o", out, "--resume")
    assert (status, "nothing was left to do" in stdout) == (0, True)
    status, _, stderr = progden("denoise", folder, "-o", out, "--resume", "--force")
    assert (status, "give one" in stderr) == (2, True)


def test_what_is_right_is_skipped_and_told(tmp_path, frames, progden):
    variance = np.asarray(frames[8].variance)
    path, out = tmp_path / "a.exr", tmp_path / "o.exr"
    write_exr(path, frames[8].replace(variance=np.where(variance > 0, 1e-9, 0)))
    command = ["denoise", path, "-o", out, "--force"]
    status, stdout, _ = progden(*command, "--converged", "10")
    assert (status, "100% skipped as right already" in stdout) == (0, True)
    np.testing.assert_array_equal(read_exr(out).color, frames[8].color)
    status, stdout, _ = progden(*command, "--no-skip", "--json")
    (found,) = report(stdout)
    assert (found["skipped"], found["skipped_why"]) == (0, None)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--max-memory", "many"], "--max-memory: the size is 'many'"),
        (["--converged", "-1"], "--converged: tolerance is -1"),
        (["--no-skip", "--converged", "0.1"], "--no-skip forbids it"),
    ],
)
def test_bounds_that_are_wrong(tmp_path, noisy, progden, flags, message):
    status, _, stderr = progden("denoise", noisy, "-o", tmp_path / "o.exr", *flags)
    assert (status, message in stderr) == (2, True), stderr


def test_no_variance_is_denoised_plainly_and_says_so(tmp_path, frames, progden):
    write_exr(tmp_path / "a.exr", frames[8].replace(variance=None))
    out = tmp_path / "o.exr"
    status, stdout, stderr = progden(
        "denoise", tmp_path / "a.exr", "-o", out, "--save", "alpha,denoised"
    )
    assert status == 0
    assert "denoised plainly" in stdout
    assert "progressive denoising needs one" in stderr
    assert "--variance-from" in stderr
    assert "--variance-of" in stderr
    assert "not saved: alpha, for there is no variance" in stderr
    frame = frames[8].replace(variance=None)
    expected = pd.denoise(frame, pd.denoisers.for_frame(frame)).image
    np.testing.assert_allclose(read_exr(out).color, expected, rtol=1e-5, atol=1e-6)


def test_one_sample_per_pixel_is_denoised_plainly(tmp_path, frames, progden):
    path = altered(tmp_path / "a_1spp.exr", frames[8].replace(spp=1), variance=np.zeros_like)
    status, stdout, stderr = progden("denoise", path, "-o", tmp_path / "o.exr", "--json")
    (found,) = report(stdout)
    assert (status, found["mode"]) == (0, "plain")
    assert "1 sample per pixel has no spread" in stderr
    assert (
        np.abs(np.asarray(read_exr(tmp_path / "o.exr").color) - np.asarray(frames[8].color)).max()
        > 0.01
    )


def test_zero_variance_is_taken_as_converged_with_a_warning(tmp_path, frames, progden):
    path = altered(tmp_path / "a.exr", frames[8].replace(spp=None), variance=np.zeros_like)
    status, stdout, stderr = progden("denoise", path, "-o", tmp_path / "o.exr")
    assert status == 0
    assert "mean α 0.00" in stdout
    assert "--spp 1" in stderr
    np.testing.assert_array_equal(read_exr(tmp_path / "o.exr").color, frames[8].color)
    status, stdout, _ = progden("denoise", path, "-o", tmp_path / "p.exr", "--spp", 1)
    assert "denoised plainly" in stdout


BAD_VALUES = {
    "nan": ({"color": put(np.s_[3, 4, 0], np.nan)}, {"nonfinite_color": 1}),
    "inf": ({"color": put(np.s_[5:7, 4], np.inf)}, {"nonfinite_color": 2}),
    "negative": ({"color": put(np.s_[1:4, 2], -0.5)}, {"negative_color": 3}),
    "variance nan": ({"variance": put(np.s_[3, :5, 1], np.nan)}, {"nonfinite_variance": 5}),
    "variance negative": ({"variance": put(np.s_[3, :4], -1.0)}, {"negative_variance": 4}),
    "albedo nan": ({"albedo": put(np.s_[9, 9], np.nan)}, {"nonfinite_auxiliary": 1}),
    "1e6": ({"color": put(np.s_[8, 8], 1e6), "variance": put(np.s_[8, 8], 1e11)}, {}),
    "black": ({"color": np.zeros_like, "variance": np.zeros_like}, {}),
    "all nan": ({"color": put(np.s_[:], np.nan)}, {"nonfinite_color": HEIGHT * WIDTH}),
}


@pytest.mark.parametrize("name", list(BAD_VALUES))
def test_bad_values_are_counted_and_the_result_finite(tmp_path, frames, truth, progden, name):
    changes, counts = BAD_VALUES[name]
    path = altered(tmp_path / "a.exr", frames[8], **changes)
    write_exr(tmp_path / "ref.exr", truth)
    flags = ["--reference", tmp_path / "ref.exr", "--force", *QUICK]
    status, stdout, _ = progden("denoise", path, "-o", tmp_path / "o.exr", "--json", *flags)
    (found,) = report(stdout)
    assert status == 0
    assert {n: c for n, c in found["repairs"].items() if c} == counts
    assert np.isfinite(read_exr(tmp_path / "o.exr").color).all()
    assert np.isfinite([v for s in found["metrics"].values() for v in s.values()]).all()
    _, stdout, _ = progden("denoise", path, "-o", tmp_path / "o.exr", *flags)
    assert ("bad pixels" in stdout) == bool(counts)
    for count in counts.values():
        assert f"{count} with " in stdout


# On one canvas, so that one program serves both.
@pytest.mark.parametrize("size", [(1, 1), (1, 13)])
def test_tiny_images(tmp_path, progden, size, quick):
    rng = np.random.default_rng(3)
    color = rng.gamma(1, 1, (*size, 3)).astype("f4")
    write_exr(tmp_path / "a.exr", pd.Frame(color, 0.1 * color**2))
    flags = ["--save", "alpha", "--reference", tmp_path / "a.exr", *quick]
    assert progden("denoise", tmp_path / "a.exr", "-o", tmp_path / "o.exr", *flags)[0] == 0
    image = read_exr(tmp_path / "o.exr").color
    assert image.shape == color.shape
    assert np.isfinite(image).all()


def test_constant_image_stays_constant(tmp_path, progden):
    color = np.full((HEIGHT, WIDTH, 3), 0.5, "f4")
    write_exr(
        tmp_path / "a.exr", pd.Frame(color, np.full_like(color, 1e-4), albedo=color, normal=color)
    )
    command = ["denoise", tmp_path / "a.exr", "-o", tmp_path / "o.exr", "--json"]
    status, stdout, _ = progden(*command, "--mixer", "closed-form")
    # A constant albedo says nothing: the network without it is taken.
    assert (status, report(stdout)[0]["denoiser"]) == (0, "oidn-hdr")
    np.testing.assert_allclose(read_exr(tmp_path / "o.exr").color, color, rtol=0.05)


def unreadable(folder: Path, frames) -> dict[str, tuple[Path, str]]:
    """Kind of bad file -> (path, what the message has to say)."""
    whole = folder / "whole.exr"
    write_exr(whole, frames[8])
    data = whole.read_bytes()
    for name, content in {
        "truncated.exr": data[: len(data) // 2],
        "header.exr": data[:100],
        "text.exr": b"not a picture",
        "empty.exr": b"",
    }.items():
        (folder / name).write_bytes(content)
    return {
        "truncated": (folder / "truncated.exr", "cut off"),
        "header": (folder / "header.exr", "cut off"),
        "text": (folder / "text.exr", "not an OpenEXR file"),
        "empty": (folder / "empty.exr", "empty"),
        "absent": (folder / "absent.exr", "no such file"),
        "missing channels": (write(folder / "b.exr", planes("foo.R bar.G")), "foo.R"),
        "ambiguous": (write(folder / "c.exr", planes("left.R/G/B right.R/G/B")), "--channels"),
        "pbrt": (
            write(folder / "p.exr", planes("R G B dzdx dzdy Variance.R/G/B")),
            "--variance-of samples",
        ),
    }


@pytest.mark.parametrize("command", ["denoise", "info"])
def test_unreadable_files_fail_with_a_reason_and_leave_nothing(tmp_path, frames, progden, command):
    for kind, (path, reason) in unreadable(tmp_path, frames).items():
        output = ["-o", tmp_path / "o.exr"] if command == "denoise" else []
        status, stdout, stderr = progden(command, path, *output)
        if command == "info" and path.name in ("b.exr", "c.exr", "p.exr"):
            # `info` shows what is there, and what `denoise` would object to.
            assert status == 0, kind
            assert reason in stdout, kind
            continue
        assert (status, stdout) == (1, ""), kind
        assert str(path) in stderr, kind
        assert reason in stderr, kind
        assert not (tmp_path / "o.exr").exists(), kind


def test_a_failing_file_does_not_stop_the_others(tmp_path, frames, progden):
    source = tmp_path / "in"
    source.mkdir()
    write_exr(source / "a.exr", frames[8])
    (source / "b.exr").write_bytes(b"no picture")
    write_exr(source / "c.exr", frames[8])
    status, stdout, stderr = progden("denoise", source, "-o", tmp_path / "out", "--json")
    assert status == 1
    assert [f["ok"] for f in report(stdout)] == [True, False, True]
    assert "not an OpenEXR file" in report(stdout)[1]["error"]
    assert "1 of 3 files failed" in stderr
    assert sorted(os.listdir(tmp_path / "out")) == ["a.exr", "c.exr"]


FILE_FAILURES = {
    "wrong map": (["--channels", "albedo=Nowhere"], "Nowhere"),
    "wrong part": (["--part", "7"], "part"),
    "missing weights": (["--weights", "{tmp}/none.tza"], "none.tza"),
    "damaged weights": (["--weights", "{tmp}/bad.tza"], "bad.tza"),
    "damaged weights of our own": (["--denoiser", "{tmp}/bad.safetensors"], "no safetensors file"),
    "absent weights of our own": (["--denoiser", "{tmp}/none.safetensors"], "No such file"),
    "reference of another size": (["--reference", "{tmp}/small.exr"], "20×10"),
    "other render of another size": (["--variance-from", "{tmp}/small.exr"], "small.exr"),
    "same image twice": (["--variance-from", "{tmp}/room.exr"], "same image"),
    "reference that is absent": (["--reference", "{tmp}/none.exr"], "no such file"),
    "moments that are absent": (["--variance-of", "second-moment"], "m2_"),
}


@pytest.mark.parametrize("name", list(FILE_FAILURES))
def test_failures_with_files(tmp_path, noisy, progden, name):
    flags, reason = FILE_FAILURES[name]
    for weights in ("bad.tza", "bad.safetensors"):
        (tmp_path / weights).write_bytes(b"nonsense")
    write_exr(tmp_path / "small.exr", np.ones((10, 20, 3), "f4"))
    flags = [f.format(tmp=tmp_path) for f in flags]
    status, stdout, stderr = progden("denoise", noisy, "-o", tmp_path / "o.exr", *flags)
    assert (status, stdout) == (1, "")
    assert reason in stderr
    assert "unexpected" not in stderr
    assert not (tmp_path / "o.exr").exists()


def test_existing_output_is_kept_without_force(tmp_path, noisy, frames, progden):
    out = tmp_path / "out"
    out.mkdir()
    (out / "b.exr").write_bytes(b"precious")
    other = tmp_path / "b.exr"
    write_exr(other, frames[8])
    status, _, stderr = progden("denoise", noisy, other, "-o", out)
    assert status == 1
    assert "--force" in stderr
    # Nothing was done for the first one either.
    assert os.listdir(out) == ["b.exr"]
    assert (out / "b.exr").read_bytes() == b"precious"
    assert progden("denoise", noisy, other, "-o", out, "--force")[0] == 0
    assert read_exr(out / "b.exr").size == (HEIGHT, WIDTH)


def test_folders_that_cannot_be_made_or_found(tmp_path, noisy, progden):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    status, _, stderr = progden("denoise", noisy, "-o", f"{blocked}/out/")
    assert (status, "cannot be made" in stderr) == (1, True)
    status, _, stderr = progden("denoise", noisy, "-o", tmp_path / "no" / "o.exr")
    assert (status, "there is no folder" in stderr) == (1, True)
    status, _, stderr = progden("denoise", tmp_path / "out", tmp_path, "-o", tmp_path / "no.exr")
    assert status == 1
    (tmp_path / "empty").mkdir()
    status, _, stderr = progden("denoise", tmp_path / "empty", "-o", tmp_path / "out")
    assert (status, "no .exr files" in stderr) == (1, True)


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path, noisy, progden, quick):
    """A limit on file sizes stops writes half-way, as a full disk does."""
    command = ["denoise", noisy, *quick, "-o"]
    assert progden(*command, tmp_path / "o.exr")[0] == 0
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        status, stdout, stderr = progden(*command, f"{tmp_path}/out/")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (status, stdout) == (1, "")
    assert "cannot be written" in stderr
    assert os.listdir(tmp_path / "out") == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_folder(tmp_path, noisy, progden):
    out = tmp_path / "out"
    out.mkdir(mode=0o500)
    status, _, stderr = progden("denoise", noisy, "-o", out)
    assert (status, "permission denied" in stderr) == (1, True)


def test_interrupt_leaves_whole_files_only(tmp_path, frames, progden, monkeypatch):
    for name in "abc":
        write_exr(tmp_path / f"{name}.exr", frames[8])
    genuine, calls = pd.progressive_denoise, []

    def interrupted(*arguments, **settings):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return genuine(*arguments, **settings)

    monkeypatch.setattr(pd, "progressive_denoise", interrupted)
    inputs = [tmp_path / f"{name}.exr" for name in "abc"]
    status, stdout, stderr = progden("denoise", *inputs, "-o", tmp_path / "out", "--json")
    assert status == 130
    # What another thread had begun is finished; which of the threads comes second is chance.
    left = sorted(os.listdir(tmp_path / "out"))
    assert left in [
        ["a.exr"],
        ["b.exr"],
        ["a.exr", "b.exr"],
        ["a.exr", "c.exr"],
        ["b.exr", "c.exr"],
    ]
    assert f"{len(left)} of 3 files were done; the same command with --resume goes on" in stderr
    assert [Path(f["output"]).name for f in report(stdout) if f["ok"]] == left
    for name in left:
        assert np.isfinite(read_exr(tmp_path / "out" / name).color).all()


def test_an_unforeseen_error_is_one_line_with_a_hint(tmp_path, noisy, capsys, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a bug\nof two lines")

    monkeypatch.setattr(pd, "progressive_denoise", broken)
    arguments = ["denoise", str(noisy), "-o", str(tmp_path / "o.exr")]
    assert main(arguments) == 1
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "unexpected RuntimeError: a bug of two lines" in err
    assert "PROGDEN_DEBUG=1" in err
    monkeypatch.setenv("PROGDEN_DEBUG", "1")
    assert main(arguments) == 1
    assert "Traceback" in capsys.readouterr().err


def test_running_out_of_memory_is_told_plainly():
    text = "not enough memory"
    assert text in _run.explain(MemoryError())
    assert text in _run.explain(RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating"))


# Usage.

USAGE = {
    "no command": ["sing"],
    "unknown flag": ["denoise", "{in}", "-o", "{out}", "--frobnicate"],
    "no input": ["denoise", "-o", "{out}"],
    "no output": ["denoise", "{in}"],
    "not .exr": ["denoise", "{in}", "-o", "{tmp}/out.png"],
    "no ending": ["denoise", "{in}", "-o", "{tmp}/out"],
    "many into a file": ["denoise", "{in}", "{ref}", "-o", "{ref}"],
    "onto the input": ["denoise", "{in}", "-o", "{in}", "--force"],
    "onto the reference": ["denoise", "{in}", "-o", "{ref}", "--reference", "{ref}", "--force"],
    "into the input's folder": ["denoise", "{in}", "-o", "{tmp}", "--force"],
    "one name twice": ["denoise", "{in}", "{in}", "-o", "{tmp}/out"],
    "quality": ["denoise", "{in}", "-o", "{out}", "--quality", "best"],
    "method": ["denoise", "{in}", "-o", "{out}", "--method", "magic"],
    "denoiser": ["denoise", "{in}", "-o", "{out}", "--denoiser", "magic"],
    "weights": ["denoise", "{in}", "-o", "{out}", "--weights", "net.pt"],
    "save": ["denoise", "{in}", "-o", "{out}", "--save", "alpha,beta"],
    "save nothing": ["denoise", "{in}", "-o", "{out}", "--save", ","],
    "spp": ["denoise", "{in}", "-o", "{out}", "--spp", "0"],
    "spp word": ["denoise", "{in}", "-o", "{out}", "--spp", "many"],
    "probes": ["denoise", "{in}", "-o", "{out}", "--probes", "0"],
    "seed": ["denoise", "{in}", "-o", "{out}", "--seed=-1"],
    "exposure": ["denoise", "{in}", "-o", "{out}", "--exposure", "bright"],
    "exposure zero": ["denoise", "{in}", "-o", "{out}", "--exposure", "0"],
    "variance-of": ["denoise", "{in}", "-o", "{out}", "--variance-of", "median"],
    "variance-from nothing": ["denoise", "{in}", "-o", "{out}", "--variance-from"],
    "map": ["denoise", "{in}", "-o", "{out}", "--channels", "albedo"],
    "map role": ["denoise", "{in}", "-o", "{out}", "--channels", "taste=Sweet"],
    "map in info": ["info", "{in}", "--channels", "taste=Sweet"],
    "no input for info": ["info"],
}
CONTRADICTIONS = [
    "--denoiser oidn-hdr --weights net.tza",
    "--denoiser oidn-hdr --quality high",
    "--weights net.tza --quality fast",
    "--denoiser net.safetensors --exposure 2",
    "--no-aux --clean-aux",
    "--no-aux --prefilter",
    "--no-aux --denoiser oidn-hdr-alb",
    "--no-aux --denoiser oidn-hdr-calb-cnrm",
    "--no-aux --save normal",
    "--clean-aux --prefilter",
    "--prefilter --denoiser oidn-hdr-alb-nrm",
    "--variance-of std --variance-from b.exr",
    "--adapt --post-correct --halves a.exr b.exr",
    "--adapt --denoiser nfor",
    "--adapt --max-memory 1GiB",
    "--adapt --sequence",
    "--adapt --adapt-steps 0",
    "--adapt-steps 5",
    "--halves a.exr b.exr",
    "--denoiser nfor --combiner nfor --halves a.exr b.exr",
    "--post-correct --halves a.exr",
    "--post-correct --halves a.exr ./a.exr",
    "--post-correct --halves a.exr b.exr --variance-from a.exr b.exr",
]
USAGE |= {c: ["denoise", "{in}", "-o", "{out}", *c.split()] for c in CONTRADICTIONS}


@pytest.mark.parametrize("name", list(USAGE))
def test_wrong_usage(tmp_path, noisy, truth, progden, name):
    reference = tmp_path / "ref.exr"
    write_exr(reference, truth)
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    places = {"in": noisy, "out": tmp_path / "o.exr", "ref": reference, "tmp": tmp_path}
    status, stdout, stderr = progden(*(a.format_map(places) for a in USAGE[name]))
    assert (status, stdout) == (2, "")
    assert "--help`" in stderr
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_variance_files_are_refused_for_several_inputs(tmp_path, noisy, frames, progden):
    """Frames of an animation would be averaged with another view, unnoticed."""
    other = tmp_path / "b.exr"
    write_exr(other, frames[32])
    status, _, stderr = progden(
        "denoise", noisy, other, "-o", tmp_path / "out", "--variance-from", other
    )
    assert (status, "several inputs" in stderr) == (2, True)


@pytest.mark.parametrize("command", ["denoise", "info", "devices", "demo"])
def test_every_command_has_help_with_an_example(progden, command):
    status, stdout, _ = progden(command, "--help")
    assert status == 0
    assert stdout.startswith(f"Usage: progden {command}")
    assert stdout.count(f"progden {command}") > 1
    assert "--json" in stdout or command == "demo"


def test_help_lists_the_choices(progden):
    _, stdout, _ = progden("denoise", "--help")
    words = " ".join(stdout.replace("│", " ").split())
    for name in (*_options.METHODS, *_options.SAVE, "fast", "balanced", "high", "second-moment"):
        assert name in words


def test_version(progden):
    assert progden("--version") == (0, f"{pd.__version__}\n", "")


# info and devices.


def test_info_tells_roles_ranges_and_bad_values(tmp_path, frames, progden):
    path = altered(tmp_path / "a[1].exr", frames[8], color=put(np.s_[0, :3, 0], np.nan))
    status, stdout, _ = progden("info", path, "--json")
    (found,) = report(stdout)
    assert status == 0
    assert found["roles"]["albedo"]["channels"] == ["Albedo.R", "Albedo.G", "Albedo.B"]
    assert found["spp"] == 8
    red = next(c for c in found["parts"][0]["channels"] if c["name"] == "R")
    assert red["values"]["nan"] == 3
    assert red["values"]["maximum"] == pytest.approx(
        float(np.nanmax(np.asarray(frames[8].color)[..., 0][1:])), rel=1
    )
    status, stdout, _ = progden("info", path)
    assert status == 0
    for text in ("a[1].exr", "48×32", "Albedo.R", "Depth.Z", "of the mean", "8, by", "NaN"):
        assert text in stdout
    status, stdout, _ = progden("info", path, "--spp", "4", "--variance-of", "samples")
    assert "of samples, 4 spp" in stdout


def test_info_of_several_files_one_of_which_fails(tmp_path, noisy, progden):
    status, stdout, stderr = progden("info", tmp_path / "none.exr", noisy, "--json")
    found = report(stdout)
    assert status == 1
    assert "no such file" in found[0]["error"]
    assert found[1]["path"] == str(noisy)
    assert "no such file" in stderr


def test_devices(progden):
    status, stdout, _ = progden("devices", "--json")
    found = json.loads(stdout)
    assert status == 0
    assert [d["id"] for d in found["devices"]] == [str(d) for d in jax.devices()]
    assert found["versions"]["jax"] == jax.__version__
    assert found["versions"]["pyoidn"]
    assert found["cache"]["folder"] == os.environ["PROGDEN_CACHE"]
    assert found["huge_pages"] == memory.huge_pages()
    assert (found["amx"] is None) == _amx.available()
    status, stdout, _ = progden("devices")
    amx = "AMX, for convolutions" if found["amx"] is None else found["amx"]
    for text in (
        str(jax.devices()[0]),
        jax.__version__,
        found["cache"]["folder"],
        "huge pages",
        amx,
    ):
        assert text in stdout


def test_time_left_is_told_while_a_percent_takes_minutes():
    shown = importlib.import_module("progden_jax.cli.denoise")._Bars(1)
    seconds = [0.0]
    shown.bars.get_time = lambda: seconds[0]
    (files,) = shown.bars.tasks
    assert not files.visible
    for done in range(150, 160):
        shown.follow(done, 10_000)
        seconds[0] += 5
    *_, part = shown.bars.tasks
    assert part.completed == pytest.approx(1.59)
    assert part.time_remaining == pytest.approx(5 * (10_000 - 159), rel=1e-3)


# As a program of its own.


INTERRUPT_ITSELF = """
import importlib, os, signal, sys
from progden_jax.cli import main

# What runs in a shell's background inherits an ignored SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)
calls = []

def follow(bars, done, total):
    calls.append(done)
    if len(calls) == 5:
        os.kill(os.getpid(), signal.SIGINT)

importlib.import_module("progden_jax.cli.denoise")._Bars.follow = follow
sys.exit(main(sys.argv[1:]))
"""


def test_an_interrupted_exact_divergence_is_resumed(tmp_path, frames, progden, monkeypatch):
    """By the same command, to the same bits; nothing of it is left then."""
    path, out = tmp_path / "room.exr", tmp_path / "clean.exr"
    write_exr(path, jax.tree.map(lambda a: a[:6, :7] if np.ndim(a) else a, frames[8]))
    call = ["denoise", path, "-o", out, "--method", "exact", "--no-aux", *QUICK]
    call += ["--save", "divergence,sure"]
    program = [sys.executable, "-c", INTERRUPT_ITSELF, *map(str, call)]
    broken = subprocess.run(program, capture_output=True, text=True, timeout=300, check=False)
    assert broken.returncode == 130, broken.stderr
    (kept,) = (Path(os.environ["PROGDEN_CACHE"]) / "exact").iterdir()
    told = re.search(r"(\d+)% of the exact divergence are kept in", broken.stderr)
    assert told is not None
    assert f"{path}: {told[0]} {kept}" in broken.stderr
    assert not out.exists()

    starts = []
    bars = importlib.import_module("progden_jax.cli.denoise")._Bars
    monkeypatch.setattr(
        bars, "follow", lambda bars, done, total: starts.append(round(100 * done / total))
    )
    assert progden(*call)[::2] == (0, "")
    assert starts[0] == int(told[1])
    assert not kept.exists()
    resumed, _ = read_channels(out)
    assert progden(*call, "--force")[::2] == (0, "")
    again, _ = read_channels(out)
    assert resumed.keys() == again.keys() > {"divergence.R", "R"}
    for name, values in again.items():
        np.testing.assert_array_equal(resumed[name], values)


def shell(command: str, *, cwd: Path, **settings) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["bash", "-c", command], cwd=cwd, capture_output=True, text=True, timeout=120, **settings
    )


def test_the_program_denoises_and_exits_with_its_status(tmp_path, noisy, own):
    ascii_only = users_environment() | {"PYTHONIOENCODING": "ascii"}
    program = f"{sys.executable} -m progden_jax denoise room.exr --denoiser {own[1]}"
    done = shell(f"{program} -o o.exr", cwd=tmp_path, env=ascii_only)
    assert (done.returncode, done.stderr) == (0, "")
    assert "room.exr ? o.exr: 48?32" in done.stdout
    assert read_exr(tmp_path / "o.exr").size == (HEIGHT, WIDTH)


def test_a_reader_that_leaves_early_is_no_error_message(tmp_path, noisy):
    command = f"{sys.executable} -m progden_jax info {noisy.name} {noisy.name} | true"
    done = shell(command, cwd=tmp_path)
    assert done.stderr == ""


def test_help_needs_neither_jax_nor_numpy(tmp_path):
    """What the command's own modules import; the package's __init__ is stood in for."""
    code = (
        "import sys, types; package = types.ModuleType('progden_jax'); "
        f"package.__path__ = {list(pd.__path__)!r}; package.__version__ = '0'; "
        "sys.modules['progden_jax'] = package; import progden_jax.cli as cli; "
        "status = cli.main(['denoise', '--help']) or cli.main(['render', '--help']); "
        "heavy = {'jax', 'numpy', 'matplotlib', 'mitsuba'}; "
        "sys.exit(status or 7 * bool(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_tiled_input_of_an_odd_size(tmp_path, progden, quick):
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    path = write(tmp_path / "a.exr", planes("R G B Variance.R/G/B", size=(31, 47)), **tiles)
    assert progden("denoise", path, "-o", tmp_path / "o.exr", *quick)[0] == 0
    assert read_exr(tmp_path / "o.exr").size == (31, 47)
