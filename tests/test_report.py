"""The report's folder: what is written, once, whole or not at all; its pictures' encoding."""

import base64
import json
import re
import sqlite3
import zlib

import numpy as np
import pytest
from report_run import HEIGHT, METHODS, SCENES, SPPS, WIDTH, make_run

from progden_jax import metrics
from progden_jax.cli import main
from progden_jax.exr import write_exr
from progden_jax.report import build_report
from progden_jax.report.images import ImageFiles, encode, to_half


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run") / "ablation")


@pytest.fixture(scope="module")
def site(run, tmp_path_factory):
    """The folder of a report with everything in it."""
    output = tmp_path_factory.mktemp("report") / "site"
    build_report(run.folder, output)
    return output


def contents(site) -> dict:
    text = (site / "data.js").read_text("ascii")
    return json.loads(text.removeprefix("progden.data = ").removesuffix(";\n"))


def decoded(site, name: str) -> np.ndarray:
    """An image file's values, read back by other means than the page's."""
    call = (site / "images" / f"{name}.js").read_text("ascii")
    found = re.fullmatch(r'progden\.image\("(\w+)",(\{.*?\}),"(.*)"\);\n', call)
    assert found
    assert found[1] == name
    about = json.loads(found[2])
    planes = np.frombuffer(zlib.decompress(base64.b64decode(found[3])), np.uint8).reshape(2, -1)
    bits = np.cumsum(planes[0].astype("u8") * 256 + planes[1]).astype("u2")
    half = bits.view("f2").reshape(about["channels"], about["height"], about["width"])
    return np.moveaxis(half, 0, -1).astype("f8") * about["scale"]


def snapshot(folder) -> dict:
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def rejects(run, output, match, **settings):
    """That this raises, and leaves the folder around as it was."""
    before = snapshot(output.parent)
    with pytest.raises(ValueError, match=match):
        build_report(run, output, **settings)
    assert snapshot(output.parent) == before


def test_everything_of_the_run_is_in_it(run, site):
    data = contents(site)
    assert [s["name"] for s in data["scenes"]] == sorted(SCENES)
    assert [m["name"] for m in data["methods"]] == list(METHODS)
    assert data["title"] == "ablation"
    assert len(data["rows"]) == len(SCENES) * len(SPPS) * len(METHODS)
    for row in data["rows"]:
        scene, method = data["scenes"][row["scene"]]["name"], METHODS[row["method"]]
        errors = run.errors[scene, row["spp"], method]
        assert row["values"]["rmse"] == pytest.approx(errors["rmse"])
        assert row["values"]["dssim"] == pytest.approx(1 - errors["ssim"])
        image = run.images[scene, row["spp"], method]
        pictures = row["pictures"]
        np.testing.assert_allclose(decoded(site, pictures["image"]), image, rtol=5e-4, atol=1e-7)
        np.testing.assert_allclose(
            decoded(site, pictures["reference"]), run.references[scene], rtol=5e-4
        )
        for name, layer in run.layers[scene, row["spp"], method].items():
            np.testing.assert_allclose(decoded(site, pictures[name]), layer, rtol=5e-4, atol=1e-7)
        assert ("sure" in pictures) == (method != "denoised")
        flip = decoded(site, pictures["flip"])[..., 0]
        np.testing.assert_allclose(
            flip, metrics.flip_map(image, run.references[scene]), atol=1 / 512
        )
    # Nothing was measured of these, so they are no columns.
    assert {"seconds", "relmse"}.isdisjoint(m["name"] for m in data["metrics"])


def test_each_image_is_written_once(run, site):
    named = {name for row in contents(site)["rows"] for name in row["pictures"].values()}
    assert {p.stem for p in (site / "images").iterdir()} == named
    # Of each row image, FLIP, and for two methods α and SURE; of each scene one reference.
    assert len(named) == len(run.images) * 2 + len(run.images) * 2 // 3 * 2 + len(SCENES)


def test_same_content_shares_a_file(tmp_path):
    files = ImageFiles(tmp_path)
    image = np.linspace(0, 3, 60).reshape(4, 5, 3)
    names = {files.add(image), files.add(image.copy()), files.add(2 * image), files.add(image[:3])}
    # Twice the image differs in its scale alone.
    assert len(names) == len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("factor", [1.0, 1e-9, 1e9, 1e30])
def test_values_come_back_in_half_precision(factor):
    rng = np.random.default_rng(0)
    image = (rng.normal(size=(5, 7, 3)) * 10.0 ** rng.integers(-4, 3, (5, 7, 3)) * factor).astype(
        "f4"
    )
    half, scale = to_half(image)
    assert np.log2(scale) % 1 == 0
    # What is 2⁻²⁹ of the largest and less has fewer digits.
    least = 2**-39 * np.abs(image).max()
    np.testing.assert_allclose(half.astype("f8") * scale, image, rtol=2**-11, atol=least)


def test_values_that_are_none_stay(tmp_path):
    image = np.array([[[np.nan, np.inf, -np.inf], [0, -0.0, 1e-45]]], "f4")
    half, scale = to_half(image)
    np.testing.assert_array_equal(half[0, 0], image[0, 0])
    assert np.isfinite(scale)
    files = ImageFiles(tmp_path / "images")
    np.testing.assert_array_equal(decoded(tmp_path, files.add(image))[0, 0], image[0, 0])
    assert to_half(np.zeros((1, 1, 3), "f4"))[1] == 1


def test_encoding_is_smaller_than_halves_of_a_smooth_image():
    y, x = np.mgrid[:64, :64]
    smooth = np.stack([np.hypot(x, y)] * 3, -1) / 64
    half, _ = to_half(smooth)
    assert len(encode(half)) < half.nbytes / 3


def test_exposure_brings_the_reference_to_where_it_is_visible(run, site):
    for scene in contents(site)["scenes"]:
        bright = np.percentile(run.references[scene["name"]].mean(-1), 90)
        assert 2 ** scene["exposure"] * bright == pytest.approx(0.7, rel=1e-5)


def test_without_images(run, tmp_path):
    built = build_report(run.folder, tmp_path / "site", images=False, title="a", scenes=[SCENES[0]])
    data = contents(tmp_path / "site")
    assert built.images == 0
    assert not any((tmp_path / "site" / "images").iterdir())
    assert all(row["pictures"] == {} for row in data["rows"])
    assert [s["name"] for s in data["scenes"]] == [SCENES[0]]
    assert data["title"] == "a"


def test_pictures_that_cannot_be_used_are_left_out_with_a_warning(tmp_path):
    run = make_run(tmp_path / "run")
    scene = SCENES[0]
    run.files[scene, 2, "render"].unlink()
    run.files[scene, 2, "denoised"].write_bytes(b"no image")
    write_exr(run.files[scene, 8, "denoised"], np.ones((3, 3, 3), "f4"), overwrite=True)
    bad = np.full((HEIGHT, WIDTH, 3), np.nan, "f4")
    write_exr(run.files[scene, 8, "render"], bad, overwrite=True)
    built = build_report(run.folder, tmp_path / "site", scenes=[scene])
    found = {
        (row["spp"], METHODS[row["method"]]): set(row["pictures"])
        for row in contents(tmp_path / "site")["rows"]
    }
    assert found[2, "render"] == found[2, "denoised"] == found[8, "denoised"] == {"reference"}
    assert found[8, "render"] == {"reference", "image"}
    assert found[2, METHODS[2]] == {"reference", "image", "flip", "alpha", "sure"}
    text = "\n".join(built.warnings)
    for path in (run.files[scene, 2, "render"], run.files[scene, 2, "denoised"]):
        assert path.name in text
    assert f"3×3 pixels but its reference {tmp_path}" in text
    assert "no FLIP map" in text
    assert len(built.warnings) == 4


def test_a_render_that_was_not_copied_is_taken_from_where_it_is(tmp_path):
    run = make_run(tmp_path / "run")
    render = run.files[SCENES[0], 2, "render"]
    with sqlite3.connect(run.folder / "results.sqlite") as database:
        database.execute(
            "UPDATE results SET render = ?, image = NULL WHERE method = 'render'", [str(render)]
        )
    database.close()
    build_report(run.folder, tmp_path / "site", scenes=[SCENES[0]])
    name = contents(tmp_path / "site")["rows"][0]["pictures"]["image"]
    expected = run.images[SCENES[0], 2, "render"]
    np.testing.assert_allclose(decoded(tmp_path / "site", name), expected, rtol=5e-4, atol=1e-7)


def test_failure_leaves_the_old_report(run, tmp_path, monkeypatch):
    output = tmp_path / "site"
    build_report(run.folder, output, images=False, title="old")
    before = snapshot(tmp_path)

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(metrics, "flip_map", fail)
    with pytest.raises(KeyboardInterrupt):
        build_report(run.folder, output, force=True)
    assert snapshot(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["site"]
    build_report(run.folder, output, force=True, images=False, title="new")
    assert contents(output)["title"] == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["site"]


def test_places_that_are_taken(run, tmp_path):
    output = tmp_path / "site"
    build_report(run.folder, output, images=False)
    rejects(run.folder, output, "--force")
    (output / "mine.txt").write_text("not the report's")
    rejects(run.folder, output, "holds other things", force=True)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "index.html").write_text("somebody's own")
    rejects(run.folder, tmp_path / "photos", "holds other things", force=True)
    (tmp_path / "file").write_text("")
    rejects(run.folder, tmp_path / "file", "is a file", force=True)
    rejects(run.folder, tmp_path / "none" / "site", "there is no folder")
    (tmp_path / "empty").mkdir()
    assert build_report(run.folder, tmp_path / "empty", images=False).page.is_file()


def test_runs_that_cannot_be_shown(run, tmp_path):
    output = tmp_path / "site"
    rejects(tmp_path / "none", output, "results.sqlite")
    rejects(make_run(tmp_path / "empty", rows=False).folder, output, "no results yet")
    rejects(run.folder, output, "no scene cellar; it has .*attic", scenes=["cellar"])
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "results.sqlite").write_bytes(b"SQLite format 3\0 and then nothing")
    rejects(tmp_path / "damaged", output, "results.sqlite cannot be")


def test_command(run, tmp_path, capsys):
    output = tmp_path / "site"
    arguments = ["report", str(run.folder), "-o", str(output), "--images", "none"]
    assert main(arguments) == 0
    out, err = capsys.readouterr()
    assert (str(output / "index.html") in out, "18 results" in out, err) == (True, True, "")
    assert main(arguments) == 1
    assert "--force" in capsys.readouterr().err
    assert main([*arguments, "--force", "--scenes", SCENES[0], "--title", "T"]) == 0
    assert "6 results" in capsys.readouterr().out
    assert main(["report", str(run.folder)]) == 2
    assert main([*arguments, "--images", "some"]) == 2


def test_command_tells_what_is_missing(tmp_path, capsys):
    run = make_run(tmp_path / "run")
    for path in run.files.values():
        path.unlink()
    assert main(["report", str(run.folder), "-o", str(tmp_path / "site")]) == 0
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 11
    assert "and 8 more" in err[-1]
