"""`progden render`: samples, moments, scenes and files, mostly by Mitsuba's scalar variant on tiny images."""

import sys
import typing
from pathlib import Path

import numpy as np
import pytest
from exr_files import SHARED, needs_shared, read_channels

import progden_jax as pd
from progden_jax.cli import main
from progden_jax.exr import read_exr

mi = pytest.importorskip("mitsuba", reason="needs Mitsuba: pip install 'progden_jax[render]'")

from progden_jax import rendering  # noqa: E402
from progden_jax.cli.render import SceneOptions  # noqa: E402
from progden_jax.rendering import _mitsuba, files, moments  # noqa: E402
from progden_jax.rendering.loading import loaded  # noqa: E402
from progden_jax.rendering.sampling import Samples  # noqa: E402
from progden_jax.rendering.series import grow  # noqa: E402

SIZE = (6, 8)
CHANNELS = {
    **dict.fromkeys(["R", "G", "B", "Variance.R", "Variance.G", "Variance.B"], "float32"),
    **dict.fromkeys(["Albedo.R", "Albedo.G", "Albedo.B"], "float16"),
    **dict.fromkeys(["Normal.X", "Normal.Y", "Normal.Z"], "float16"),
    "Depth.Z": "float32",
}
"""As the data's README has them."""

XML = """<scene version="3.0.0">
    <default name="fov" value="40"/>
    <integrator type="direct"/>
    <sensor type="thinlens">
        <float name="fov" value="$fov"/>
        <float name="aperture_radius" value="0.05"/>
        <float name="focus_distance" value="4"/>
        <transform name="to_world"><lookat origin="0,1,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="6"/>
            <rfilter type="gaussian"><float name="stddev" value="1"/></rfilter>
        </film>
        <sampler type="stratified"/>
    </sensor>
    <shape type="sphere"/>
    <shape type="rectangle">
        <transform name="to_world">
            <rotate x="1" angle="-90"/><scale value="5"/><translate y="-1"/>
        </transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.2,0.5,0.8"/></bsdf>
    </shape>
    <emitter type="constant"/>
</scene>
"""


@pytest.fixture(autouse=True)
def scalar():
    rendering.use_variant("scalar_rgb").set_log_level(mi.LogLevel.Error)


def simple(**film) -> dict:
    """A ball on a floor under a small lamp, before a lamp that fills some pixels: those have no noise."""
    t = mi.ScalarTransform4f
    floor = t().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "to_world": t().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "height": SIZE[0], "width": SIZE[1], **film},
        },
        "ball": {"type": "sphere", "bsdf": {"type": "roughconductor"}},
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": {"type": "diffuse"}},
        "lamp": {
            "type": "sphere",
            "center": [2, 3, 1],
            "radius": 0.3,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [20, 15, 9]}},
        },
        "screen": {
            "type": "rectangle",
            "to_world": t().translate([-6, 0, -8]).scale(5),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}},
        },
    }


def all_samples(samples: Samples, count: int) -> np.ndarray:
    return np.concatenate([wave.radiance for wave in samples.waves(0, count)])


def test_frames_are_the_moments_of_single_samples():
    samples = all_samples(Samples(loaded(simple())), 12).astype(np.float64)
    assert samples.shape == (12, *SIZE, 3)
    frames = list(rendering.series(simple(), [2, 5, 12]))
    assert [int(frame.spp) for frame in frames] == [2, 5, 12]
    for n, frame in zip((2, 5, 12), frames, strict=True):
        np.testing.assert_allclose(frame.color, samples[:n].mean(0), rtol=1e-6)
        variance = samples[:n].var(0, ddof=1) / n
        np.testing.assert_allclose(frame.variance, variance, rtol=1e-5, atol=1e-12)
        still = np.asarray(frame.variance) == 0
        assert still[0, 0].all(), "a pixel that sees nothing but a lamp has no variance at all"


def test_means_and_variances_are_right():
    """Against Mitsuba's own render with another sampler, and over independent series."""
    scene = loaded(simple(rfilter={"type": "box"}))
    truth = np.array(mi.render(scene, spp=4096))
    (frame,) = rendering.series(scene, [1024], seed=3)
    error = np.abs(np.asarray(frame.color) - truth)
    sigma = np.sqrt(np.asarray(frame.variance) * (1 + 1024 / 4096))
    assert (error <= 5 * sigma + 1e-5).all()

    # 150 series of 4 samples: their means vary as they say, on average over the pixels.
    runs = [next(rendering.series(scene, [4], seed=seed)) for seed in range(150)]
    colors = np.array([run.color for run in runs], np.float64)
    said = np.array([run.variance for run in runs], np.float64).mean((0, 2, 1))
    varied = colors.var(0, ddof=1).mean((0, 1))
    np.testing.assert_allclose(said, varied, rtol=0.15)
    np.testing.assert_allclose(colors.mean(0).mean((0, 1)), truth.mean((0, 1)), rtol=0.05)


def test_samples_are_independent_of_each_other_and_of_their_neighbours():
    """Whatever the scene's filter is. With Mitsuba's own seeds 0, 1, 2, ... some pixels' means vary twice
    as much as they should."""
    scene = loaded(simple(rfilter={"type": "gaussian", "stddev": 1.0}))
    noise = all_samples(Samples(scene, auxiliary=False), 8192).astype(np.float64)
    noise -= noise.mean(0)
    noise /= np.maximum(noise.std(0), 1e-9)
    neighbours = (noise[:, :, 1:] * noise[:, :, :-1]).mean(0)
    assert np.abs(neighbours).max() < 5 / np.sqrt(8192)
    blocks = noise.reshape(128, 64, *SIZE, 3).mean(1)
    ratio = 64 * blocks.var(0, ddof=1)[noise.any(0)]
    assert ratio.max() < 1 + 4.5 * np.sqrt(2 / 127)
    np.testing.assert_allclose(ratio.mean(), 1, atol=0.1)


def test_the_reference_has_other_random_numbers():
    scene = loaded(simple())
    ours, theirs = (
        all_samples(Samples(scene, seed=1, reference=r), 8)[:, 3:5].reshape(-1, 3)
        for r in (False, True)
    )
    lit = {tuple(row) for row in ours if row.any()}
    assert lit
    assert not lit & {tuple(row) for row in theirs}


def test_moments_merge_in_any_parts_and_discard_what_is_not_finite():
    rng = np.random.default_rng(5)
    samples = (1e4 + rng.normal(size=(40, 2, 3, 3))).astype(np.float32)
    samples[:, 0, 0] = np.float32(0.1)
    found = moments.none(2, 3)
    for start, stop in ((0, 1), (1, 2), (2, 17), (17, 40)):
        found = moments.add(found, samples[start:stop])
    exact = samples.astype(np.float64)
    np.testing.assert_allclose(found.mean, exact.mean(0), rtol=1e-14)
    np.testing.assert_allclose(found.variance, exact.var(0, ddof=1) / 40, rtol=1e-9)
    assert (found.variance[0, 0] == 0).all()

    samples[3, 1, 1, 2], samples[4, 1, 1, 0] = np.nan, np.inf
    broken = moments.add(moments.none(2, 3), samples)
    assert broken.discarded == 2
    exact[3:5, 1, 1] = 0
    np.testing.assert_allclose(broken.mean, exact.mean(0), rtol=1e-14)


def test_what_goes_with_the_colour():
    (frame,) = rendering.series(simple(), [16])
    albedo, normal, depth = (np.asarray(a) for a in (frame.albedo, frame.normal, frame.depth))
    np.testing.assert_allclose(albedo[-1], 0.5, atol=1e-6)  # the floor's, diffuse by default
    np.testing.assert_allclose(normal[-1], np.tile([0, 1, 0], (8, 1)), atol=1e-5)
    assert (albedo >= 0).all()
    assert (albedo <= 1).all()
    centre = depth[2:4, 3:5]
    assert ((centre > 4) & (centre < 5)).all()  # the ball's front, 5.1 − 1 from the camera


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_a_camera_in_a_medium(variant):
    """A lamp that fills the view, two metres off, through fog that absorbs half a nat per metre."""
    if variant.startswith("llvm") and _mitsuba._llvm_problem():
        pytest.skip("needs a libLLVM that works")
    mi = rendering.use_variant(variant)
    fog = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.5}
    scene = {
        "type": "scene",
        "integrator": {"type": "volpath"},
        "fog": fog,
        "sensor": {
            "type": "perspective",
            "fov": 2.0,
            "inside": {"type": "ref", "id": "fog"},
            "film": {"type": "hdrfilm", "height": 2, "width": 2},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).rotate([0, 1, 0], 180),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
        },
    }
    (frame,) = rendering.series(scene, [1024])
    mean, sd = np.mean(frame.color), np.sqrt(np.mean(frame.variance) / 4)
    assert 0 < sd < 0.05
    assert abs(mean - 3 * np.exp(-1)) < 4 * sd


@pytest.mark.parametrize("kind", list(rendering.KINDS))
def test_a_seed_gives_the_same_scene_and_image(kind):
    def picture(seed):
        (frame,) = rendering.series(rendering.scene(seed, kind, size=(12, 16)), [4])
        return np.asarray(frame.color)

    first = picture(7)
    assert first.shape == (12, 16, 3)
    assert 0.01 < np.median(first) < 3
    if kind == "studio":
        np.testing.assert_array_equal(first, picture(7))
        assert not np.array_equal(first, picture(8))


@pytest.mark.parametrize("kind", list(rendering.KINDS))
def test_shapes_are_loaded_by_mitsuba_from_files_that_go_with_the_scene(kind):
    """Those that Python has seen cost its lock in every sample of albedo, normal and depth."""
    scene = rendering.scene(3, kind)
    assert all(isinstance(value, dict | str) for value in scene.values())
    files = [Path(shape["filename"]) for shape in scene.values() if "filename" in shape]
    assert files
    assert all(file.exists() for file in files)
    del scene
    assert not any(file.exists() for file in files)


@pytest.mark.skipif(bool(_mitsuba._llvm_problem()), reason="needs a libLLVM that works")
def test_wavefronts_agree_with_the_scalar_variant():
    scene = {k: v for k, v in simple().items() if k != "ball"}
    (plain,) = rendering.series(scene, [256])
    rendering.use_variant("llvm_ad_rgb").set_log_level(mi.LogLevel.Error)
    samples = Samples(loaded(scene))
    *_, found = grow(samples, moments.none(*SIZE), [256])
    error = np.abs(found.mean - np.asarray(plain.color))
    assert (error <= 5.5 * np.sqrt(found.variance + np.asarray(plain.variance)) + 1e-5).all()
    np.testing.assert_allclose(
        found.variance.mean((0, 1)), np.mean(plain.variance, (0, 1)), rtol=0.3
    )
    depth = found.auxiliary[..., 6:]
    np.testing.assert_allclose(depth, plain.depth, atol=2)  # at the edges 0 and 13 m mix
    np.testing.assert_allclose(depth.mean(), np.mean(plain.depth), rtol=0.02)
    # Cut short a wave holds the same samples, so that series of other lengths have the same files.
    np.testing.assert_array_equal(all_samples(samples, 7), all_samples(samples, 16)[:7])


# Files.


@pytest.fixture
def progden(capsys):
    """Run `main`; gives (status, stdout, stderr)."""

    def call(*arguments: object) -> tuple[int, str, str]:
        status = main([str(a) for a in arguments])
        streams = capsys.readouterr()
        assert "Traceback" not in streams.err
        return status, streams.out, streams.err

    return call


@pytest.fixture
def xml(tmp_path) -> Path:
    path = tmp_path / "ball.xml"
    path.write_text(XML)
    return path


@pytest.fixture
def command(xml, tmp_path):
    counts = ["--spp", "2,8", "--reference-spp", 16, "--variant", "scalar_rgb"]
    return ["render", xml, "-o", tmp_path / "out", *counts]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_files_are_as_the_datas_readme_says(command, progden, tmp_path):
    assert progden(*command, "--preview")[::2] == (0, "")
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == {
        "ball_000002spp.exr",
        "ball_000008spp.exr",
        "ball_000016spp.exr",
        "ball.png",
    }
    for spp, names in ((8, CHANNELS), (16, [n for n in CHANNELS if n[0] in "RGBV"])):
        channels, _ = read_channels(out / f"ball_{spp:06d}spp.exr")
        assert {n: str(p.dtype) for n, p in channels.items()} == {n: CHANNELS[n] for n in names}
    frame = read_exr(out / "ball_000008spp.exr")
    assert (frame.size, int(frame.spp)) == ((6, 8), 8)
    two = read_exr(out / "ball_000002spp.exr").color
    rest = (8 * np.asarray(frame.color) - 2 * np.asarray(two)) / 6
    assert (rest > -1e-6).all()
    assert pd.describe_exr(out / "ball_000008spp.exr").variance.endswith("of the mean")


@needs_shared
def test_channels_are_those_of_the_shared_data():
    for spp, names in ((8, set(CHANNELS)), (4096, {n for n in CHANNELS if n[0] in "RGBV"})):
        channels, _ = read_channels(next(SHARED.glob(f"*_{spp:06d}spp.exr")))
        assert {n: str(p.dtype) for n, p in channels.items()} == {n: CHANNELS[n] for n in names}


def test_an_interrupted_render_goes_on_to_the_same_bytes(command, progden, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert progden(*command)[0] == 0
    whole = contents(out)
    render, taken, stops = files.render, [], []

    def killed(job, folder, *, progress, **settings):
        def count(paths):
            progress(paths)
            taken.append(paths)
            if len(taken) in stops:
                raise KeyboardInterrupt

        return render(job, folder, progress=count, **settings)

    monkeypatch.setattr(files, "render", killed)
    for path in out.iterdir():
        path.unlink()
    # In the series' third wave; after it began again; in the reference.
    for stop in (4, 1, 9):
        taken.clear()
        stops[:] = [stop]
        status, _, stderr = progden(*command)
        assert status == 130
        assert (
            stderr == "progden: stopped in ball; the same command goes on\nprogden: interrupted\n"
        )
    assert (out / "ball_000008spp.exr").exists()
    assert (out / ".ball_reference.partial").exists()
    stops.clear()
    taken.clear()
    made = (out / "ball_000008spp.exr").stat().st_mtime_ns
    assert progden(*command)[::2] == (0, "")
    assert contents(out) == whole
    assert (out / "ball_000008spp.exr").stat().st_mtime_ns == made
    assert taken[0] > 0, "it began at the checkpoint"


def test_a_killed_render_goes_on_at_its_last_checkpoint(xml, tmp_path, monkeypatch):
    """SIGKILL leaves no time to save: what counts is the checkpoint of a while ago."""
    monkeypatch.setattr(files, "SAVE_SECONDS", 0.0)
    monkeypatch.setattr(files, "SAVE_RATIO", 0.0)
    sampling = files.Sampling((2, 24), 0)
    job = files.of_xml(xml, {}, 0, 0, sampling)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    whole.mkdir()
    cut.mkdir()
    files.render(job, whole)
    saved = files._save

    class Killed(BaseException):
        pass

    def last(partial, made_of, state):
        if state.spp == 16:
            monkeypatch.setattr(files, "_save", lambda *_: None)
            raise Killed
        saved(partial, made_of, state)

    monkeypatch.setattr(files, "_save", last)
    with pytest.raises(Killed):
        files.render(job, cut)
    monkeypatch.setattr(files, "_save", saved)
    assert [p.name for p in sorted(cut.iterdir())] == [".ball_series.partial", "ball_000002spp.exr"]
    taken: list[int] = []
    files.render(job, cut, progress=taken.append)
    assert taken[0] == 8
    assert contents(cut) == contents(whole)


def test_existing_files_are_kept_or_refused_or_replaced(command, progden, tmp_path):
    out = tmp_path / "out"
    progden(*command)
    before = contents(out)
    times = {p: p.stat().st_mtime_ns for p in out.iterdir()}
    assert "nothing was left to do" in progden(*command)[1]
    assert {p: p.stat().st_mtime_ns for p in out.iterdir()} == times
    (out / "ball_000002spp.exr").unlink()
    assert progden(*command)[0] == 0
    assert contents(out) == before

    status, _, stderr = progden(*command, "-D", "fov=30")
    assert status == 1
    assert "--force to replace it" in stderr
    assert contents(out) == before
    assert progden(*command, "-D", "fov=30", "--force")[0] == 0
    assert contents(out).keys() == before.keys()
    assert all(contents(out)[name] != data for name, data in before.items())


def test_xml_scenes_with_a_size_a_depth_and_parameters(xml, progden, tmp_path):
    def run(*more):
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        call = ["render", xml, "-o", out, "--spp", 4, "--reference-spp", 0]
        assert progden(*call, "--variant", "scalar_rgb", *more)[0] == 0
        return read_exr(out / "ball_000004spp.exr")

    assert run("--size", "10x4").size == (4, 10)
    own, deep = run(), run("--max-depth", 9)
    assert own.size == (6, 8)
    assert not np.array_equal(own.color, deep.color)
    assert float(deep.color.mean()) > float(own.color.mean())  # more than direct light
    assert float(run("-D", "fov=120").depth.mean()) != float(own.depth.mean())


def test_procedural_series_by_the_command(progden, tmp_path):
    call = ["render", "-o", tmp_path, "--kind", "studio", "--seed", 3, "--scenes", 2, "--size", 8]
    counts = ["--spp", "2,4", "--reference-spp", 0, "--variant", "scalar_rgb"]
    status, stdout, stderr = progden(*call, *counts)
    assert (status, stderr) == (0, "")
    assert {p.name for p in tmp_path.iterdir()} == {
        f"studio{seed:04d}_{spp:06d}spp.exr" for seed in (3, 4) for spp in (2, 4)
    }
    assert "studio0003: 2 files" in stdout
    header = read_channels(tmp_path / "studio0003_000004spp.exr")[1]
    assert "studio scene 3, depth 9; 8×8, seed 3; scalar_rgb" in header[files.ATTRIBUTE]


# What goes wrong.

WRONG_USAGE = {
    "spp that does not increase": (["--spp", "8,8"], "expected increasing numbers from 2 up"),
    "one sample": (["--spp", "1,2"], "one sample has no variance"),
    "spp that are no numbers": (["--spp", "2;8"], "expected numbers with commas"),
    "reference in the series": (["--reference-spp", "8"], "is among --spp 2,8"),
    "reference of one": (["--reference-spp", "1"], "expected 0 or 2 and more"),
    "size": (["--size", "12x"], "expected WIDTHxHEIGHT"),
    "seed": (["--seed", "-1"], "--seed is -1, expected a whole number from 0 up"),
    "kind": (["--kind", "cellar"], "cellar"),
    "variant": (["--variant", "scalar_spectral"], "expected one of scalar_rgb"),
    "parameters without a scene": (["-D", "a=1"], "name one"),
}


@pytest.mark.parametrize("case", WRONG_USAGE)
def test_wrong_usage_is_told(case, progden, tmp_path):
    arguments, message = WRONG_USAGE[case]
    given = {"--spp": "2,8", "--variant": "scalar_rgb", "--reference-spp": "16"}
    given |= dict([arguments])
    flags = [text for pair in given.items() for text in pair]
    status, _, stderr = progden("render", "-o", tmp_path / "out", *flags)
    assert status == 2
    assert message in " ".join(stderr.split())
    assert not (tmp_path / "out").exists()


def test_scenes_that_cannot_be_rendered_are_told(command, xml, progden, tmp_path):
    def failure(text: str, *more: object) -> str:
        xml.write_text(text)
        status, _, stderr = progden(*command, *more)
        assert status == 1
        assert stderr.startswith("progden: ball")
        assert not list((tmp_path / "out").glob("*"))
        return stderr

    assert "Mitsuba cannot load it" in failure("<scene")
    assert "expected a scene" in failure('<shape version="3.0.0" type="sphere"/>')
    assert "no_such_thing" in failure(XML.replace('"sphere"', '"no_such_thing"'))
    assert "sensor is 3, but the scene has 1" in failure(XML, "--sensor", 3)
    assert "--max-depth" in failure(XML.replace('"direct"', '"ptracer"'))
    assert "fovv" in failure(XML, "-D", "fovv=3")
    xml.unlink()
    assert "No such file" in progden(*command)[2]


def test_folders_that_cannot_be_written_are_told(command, progden, tmp_path):
    (tmp_path / "out").write_text("in the way")
    status, _, stderr = progden(*command)
    assert status == 1
    assert "out cannot be made" in stderr


def test_without_mitsuba_the_remedy_is_named(command, progden, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    status, _, stderr = progden(*command)
    assert status == 1
    assert "pip install 'progden_jax[render]'" in stderr


def test_an_llvm_that_crashes_is_not_used(monkeypatch, caplog):
    import drjit

    monkeypatch.setattr(drjit, "has_backend", lambda backend: True)
    monkeypatch.setattr(drjit.detail, "llvm_version", lambda: (15, 0, 7))
    monkeypatch.setattr(mi, "variant", lambda: None)
    chosen = []
    monkeypatch.setattr(mi, "set_variant", chosen.append)
    _mitsuba.load()
    assert chosen == ["scalar_rgb"]
    assert "libLLVM 15.0.7 crashes" in caplog.text
    with pytest.raises(ValueError, match="libLLVM 15.0.7 crashes.*libllvm19"):
        _mitsuba.load("llvm_ad_rgb")


def test_bad_arguments_of_the_functions():
    with pytest.raises(ValueError, match="kind is 'cellar', expected one of 'room', 'outdoor'"):
        rendering.scene(1, "cellar")
    with pytest.raises(ValueError, match="seed is -1, expected a whole number"):
        rendering.scene(-1)
    with pytest.raises(ValueError, match="spp is 8, 2, expected increasing"):
        next(rendering.series(simple(), [8, 2]))
    with pytest.raises(ValueError, match="scene is a Shape, expected a scene"):
        next(rendering.series({"type": "sphere"}, [2]))
    with pytest.raises(ValueError, match="Mitsuba cannot load the scene: .*nothing"):
        next(rendering.series({"type": "scene", "a": {"type": "nothing"}}, [2]))


def test_the_command_names_the_kinds_there_are():
    hints = typing.get_type_hints(SceneOptions, include_extras=False)
    literal, _ = typing.get_args(hints["kind"])
    assert typing.get_args(literal) == tuple(rendering.KINDS)
