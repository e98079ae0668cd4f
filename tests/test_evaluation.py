"""`progden evaluate`: rows against the pipeline, what is computed again, the database, exports."""

import csv
import json
import math
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import jax
import numpy as np
import pytest
from code_generation import users_environment
from conftest import counting_compilations
from evaluation_runs import REFERENCE, TOY, Remembers, write_series

import progden_jax as pd
from progden_jax import adaptation, evaluation, metrics
from progden_jax.cli import main
from progden_jax.evaluation import exports, statistics
from progden_jax.evaluation.database import Database, Row
from progden_jax.evaluation.parts import load_denoiser
from progden_jax.evaluation.plan import PRESETS

METHODS = [name for name in PRESETS if name != "paper"]


@pytest.fixture(scope="module")
def renders(tmp_path_factory) -> Path:
    return write_series(tmp_path_factory.mktemp("series") / "renders")


def plan_of(renders, methods=(), **base):
    base = {"denoiser": TOY, **base}
    return evaluation.load(None, data={"data": [str(renders)]}, base=base, methods=methods)


@pytest.fixture(scope="module")
def run(renders, tmp_path_factory) -> tuple[Path, list[str]]:
    """A run of `METHODS` with images, and the names of the programs compiled for it."""
    folder = tmp_path_factory.mktemp("evaluated") / "run"
    with counting_compilations() as compiled:
        report = Remembers()
        plan = plan_of(renders, METHODS)
        done = evaluation.carry_out(plan, folder, report=report, keep_images=True)
    assert done == (len(METHODS) * 4, 0, 0)
    assert report.failures == []
    return folder, compiled


def row_of(rows, method, scene="scene1", spp=4) -> Row:
    (found,) = (r for r in rows if (r.method, r.scene, r.spp) == (method, scene, spp))
    return found


def test_rows_are_of_what_the_pipeline_gives(run, renders):
    folder, _ = run
    rows = evaluation.rows(folder)
    frame = pd.read_exr(renders / "scene1_000004spp.exr")
    reference = pd.read_exr(renders / f"scene1_{REFERENCE:06}spp.exr")
    result = pd.progressive_denoise(frame, load_denoiser(TOY, "highest"))
    label = f"{TOY.split('/')[-2]}/{TOY.split('/')[-1]}"
    ssim = jax.jit(metrics.ssim)
    images = {
        "render": frame.color,
        f"denoised {label}": result.denoised,
        f"mix {label}": result.image,
    }
    for method, image in images.items():
        row = row_of(rows, method)
        z, mu = (np.asarray(i, np.float64) for i in (image, reference.color))
        expected = {
            "rmse": np.sqrt(np.mean((z - mu) ** 2)),
            "smape": np.mean(np.abs(z - mu) / (np.abs(z) + np.abs(mu) + 0.01)),
            "relmse": np.mean((z - mu) ** 2 / (mu**2 + 0.01)),
            "ssim": ssim(image, reference.color),
            "flip": metrics.flip(image, reference.color),
        }
        for name, value in expected.items():
            assert getattr(row, name) == pytest.approx(float(value), rel=1e-4), (method, name)
        error = np.mean((np.asarray(image, np.float64) - reference.color) ** 2)
        assert row.mse == pytest.approx(float(error - np.mean(reference.variance)), rel=1e-4)
        kept = pd.read_exr(folder / row.image)
        np.testing.assert_allclose(kept.color, image, rtol=1e-5)
    row = row_of(rows, f"mix {label}")
    assert row.sure == pytest.approx(float(np.mean(result.sure)), rel=1e-3)
    assert row.denoised_mse == row_of(rows, f"denoised {label}").mse
    assert row_of(rows, "render").sure is None
    assert row.settings["estimator"] == "monte-carlo"
    assert row.settings["bound.c"] == 4.2
    assert "bound.c" not in row_of(rows, f"mix {label} unbounded").settings
    info = {c.split(".")[0] for c in channels(folder / row.image)}
    assert info == {"R", "G", "B", "alpha", "sure", "denoised"}
    assert any(r.seconds is not None for r in rows)
    oracle, mixed = (row_of(rows, f"{m} {label}").rmse for m in ("oracle", "mix"))
    assert oracle < mixed


def test_a_denoiser_is_adapted_to_each_render(renders, tmp_path):
    """By its own settings, which are part of the row; what cannot be adapted fails alone."""
    small = {"window": 3, "layers": 2, "width": 4, "patch": 8, "steps": 2}
    base = {f"correction.{name}": value for name, value in small.items()}
    plan = plan_of(renders, ["denoised", "mix"], adaptation="post-correct", seed=3, **base)
    assert evaluation.carry_out(plan, tmp_path, report=Remembers()) == (8, 0, 0)
    assert evaluation.carry_out(plan, tmp_path, report=Remembers()) == (0, 8, 0)
    frame = pd.read_exr(renders / "scene1_000004spp.exr")
    split_key, fit_key = jax.random.split(jax.random.fold_in(jax.random.key(3), 1))
    found = adaptation.post_correct(
        adaptation.split(frame, split_key),
        load_denoiser(TOY, "highest"),
        correction=adaptation.PostCorrection(**small),
        key=fit_key,
    )
    reference = pd.read_exr(renders / f"scene1_{REFERENCE:06}spp.exr")
    method, _ = plan.methods[0]
    row = row_of(evaluation.rows(tmp_path), method)
    assert row.rmse == pytest.approx(float(metrics.rmse(found.image, reference.color)), rel=1e-4)
    assert row.settings["adaptation"] == "post-correct"
    assert row.settings["correction.steps"] == 2
    assert row.settings["seed"] == 3
    report = Remembers()
    plan = plan_of(renders, ["denoised"], adaptation="sure")
    assert evaluation.carry_out(plan, tmp_path / "sure", report=report).failed == 4
    assert "has no weights to adapt" in report.failures[0]


def channels(path):
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return list(file.channels())


def test_there_are_no_more_programs_than_methods(run, renders, tmp_path):
    """The key of the probes aside, and none is compiled twice."""
    _, compiled = run
    own = {"progressive", "plain", "_oracle", "_scores"}
    programs = [name for name in compiled if name.removeprefix("jit(").removesuffix(")") in own]
    assert 0 < len(programs) <= len(METHODS), compiled
    with counting_compilations() as again:
        evaluation.carry_out(plan_of(renders, METHODS), tmp_path / "run", report=Remembers())
    assert again == []


def test_a_render_that_fails_keeps_no_other(renders, tmp_path, capsys):
    own = tmp_path / "renders"
    shutil.copytree(renders, own)
    broken = own / "scene0_000016spp.exr"
    broken.write_bytes(broken.read_bytes()[:300])
    words = ["-o", str(tmp_path / "run"), "--methods", "render", "--json"]
    assert main(["evaluate", str(own), *words]) == 1
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (told["computed"], told["failed"]) == (3, 1)
    assert f"progden: {broken}" in err
    shutil.copy(renders / broken.name, broken)
    assert main(["evaluate", str(own), *words]) == 0
    assert json.loads(capsys.readouterr().out)["computed"] == 1


def test_the_reference_may_lack_a_variance_but_not_differ_in_size(renders, tmp_path):
    own = tmp_path / "renders"
    shutil.copytree(renders, own)
    reference = own / f"scene0_{REFERENCE:06}spp.exr"
    color = pd.read_exr(reference).color
    pd.write_exr(reference, color, overwrite=True)
    pd.write_exr(own / f"scene1_{REFERENCE:06}spp.exr", color[:8], overwrite=True)
    report = Remembers()
    plan = plan_of(own, ["render"])
    assert evaluation.carry_out(plan, tmp_path / "run", report=report) == (2, 0, 2)
    assert "16×16 pixels but its reference" in report.failures[0]
    for row in evaluation.rows(tmp_path / "run"):
        assert row.mse == pytest.approx(row.rmse**2, rel=1e-4)


def test_a_run_has_one_writer_and_no_foreign_files(tmp_path):
    run = tmp_path / "run"
    with Database(run), pytest.raises(ValueError, match="being written by another process"):
        Database(run)
    (run / "images").mkdir()
    (run / "images" / "0123.exr").write_bytes(b"left by a kill")
    with Database(run) as database:
        assert database.known() == set()
    assert list((run / "images").iterdir()) == []
    other = tmp_path / "other"
    with pytest.raises(ValueError, match="holds no results.sqlite"):
        evaluation.rows(other)
    other.mkdir()
    (other / "results.sqlite").write_text("no database, but long enough to be looked at" * 50)
    with pytest.raises(ValueError, match="cannot be used as a database"):
        evaluation.rows(other)
    with closing(sqlite3.connect(run / "results.sqlite")) as connection:
        connection.execute("PRAGMA user_version = 9")
    with pytest.raises(ValueError, match="user_version is 9, expected 1"):
        Database(run)


def test_a_label_means_one_thing_in_a_run(renders, tmp_path):
    config = tmp_path / "own.toml"
    for scale, match in (("monte-carlo", None), ("probing", "'mine' with another estimator")):
        config.write_text(
            f'data = ["{renders}"]\nspp = [4]\n'
            f'list = [{{label = "mine", image = "denoised", denoiser = "{TOY}", estimator = "{scale}"}}]\n'
        )
        plan = evaluation.load(config)
        if match is None:
            evaluation.carry_out(plan, tmp_path / "run", report=Remembers())
        else:
            with pytest.raises(ValueError, match=match):
                evaluation.carry_out(plan, tmp_path / "run", report=Remembers())


def test_intervals():
    """Against tables of Student's distribution: 4 values, 3.182 standard errors."""
    values = [1.0, 2.0, 4.0, 9.0]
    found = statistics.interval(values)
    assert found.mean == 4
    assert found.half == pytest.approx(3.1824463 * np.std(values, ddof=1) / 2, rel=1e-6)
    assert math.isnan(statistics.interval([3.0]).half)


def made(method, scene, spp=8, **values):
    empty = dict.fromkeys(Row._fields)
    numbers = dict.fromkeys(("rmse", "smape", "relmse", "flip", "ssim", "mse"), 1.0)
    given = {"key": f"{method}{scene}{spp}", "settings": {"image": "mix"}, "created": "now"}
    given |= {"method": method, "scene": scene, "spp": spp}
    return Row(**{**empty, **numbers, **given, **values})


def test_means_ratios_and_the_bias_of_sure():
    errors = {"a": (1.0, 10.0), "b_1": (0.5, 5.0)}
    rows = [
        made(m, s, rmse=v, sure=v + 0.1, denoised_mse=v)
        for m, vs in errors.items()
        for s, v in zip("xy", vs, strict=True)
    ]
    table = statistics.means(rows, "rmse")
    assert table["a"][8].mean == 5.5
    assert statistics.best(table, "rmse", ["a", "b_1"]) == {8: "b_1"}
    assert statistics.best(table, "ssim", ["a", "b_1"]) == {8: "a"}
    ratio = statistics.relative_to(rows, "a", "rmse")["b_1"][8]
    assert ratio == pytest.approx((0.5, 0, 2), abs=1e-12)
    with pytest.raises(ValueError, match="baseline is 'c', expected one of the methods: a, b_1"):
        statistics.relative_to(rows, "c", "rmse")
    bias = statistics.sure_bias(rows)["a"][8]
    assert bias.mean == pytest.approx(0.1 / 5.5)


def test_exports(tmp_path):
    rows = [
        made("a", "x", rmse=1.0, settings={"image": "oracle"}),
        made("b_1", "x", rmse=2.0, settings={"image": "mix", "bound.c": 3.0}),
        made("b_1", "y", rmse=4.0, settings={"image": "mix", "bound.c": 3.0}),
    ]
    for name in ("found.csv", "found.md", "found.tex"):
        exports.export(tmp_path / name, rows)
    with (tmp_path / "found.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [r["settings.bound.c"] for r in read] == ["", "3.0", "3.0"]
    assert [float(r["rmse"]) for r in read] == [1, 2, 4]
    text = (tmp_path / "found.md").read_text()
    assert "| b_1 | **3.00 ± 12.71** |" in text
    assert "| a | 1.00 |" in text
    text = (tmp_path / "found.tex").read_text()
    assert r"b\_1 & \boldmath$3.00 \pm 12.71$ \\" in text
    assert text.count(r"\toprule") == text.count(r"\bottomrule") == text.count(r"\end{table}") == 6
    with pytest.raises(ValueError, match="must end in .csv, .parquet, .md, .tex"):
        exports.export(tmp_path / "found.xls", rows)


def test_parquet(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `evaluate`")
    rows = [made("a", "x", rmse=0.25), made("b", "x", settings={"image": "mix", "bound": False})]
    exports.export(tmp_path / "found.parquet", rows)
    assert parquet.read_table(tmp_path / "found.parquet").to_pylist() == exports.records(rows)


def test_the_command_shows_and_exports_what_is_there(run, tmp_path, capsys):
    folder, _ = run
    out = tmp_path / "table.md"
    assert main(["evaluate", "-o", str(folder), "--export", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "RMSE" in printed
    assert "means over 2 scenes" in printed
    assert out.read_text().count("## ") == 7
    assert main(["evaluate", "-o", str(folder), "--json", "--baseline", "render"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["means"]["rmse"]["render"]["4"] == {"mean": 1.0, "half": 0.0, "scenes": 2}


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ([], "--output"),
        (["-o", "run", "--spp", "4"], "DATA is missing"),
        (
            ["DATA", "-o", "run", "--methods", "mixed"],
            "is 'mixed', expected settings or one of render",
        ),
        (
            ["DATA", "-o", "run", "--set", "bound.d=3"],
            "no setting 'bound.d'; did you mean 'bound.c'?",
        ),
        (["DATA", "-o", "run", "--set", "bound.c=x"], "bound: c is 'x', expected a number"),
        (["DATA", "-o", "run", "--export", "a.xls"], "must end in .csv"),
        (["DATA", "-o", "run", "--confidence", "95"], "expected a share below 1"),
        (["DATA", "-o", "run", "--config", "none.yaml"], "there is no such file"),
    ],
)
def test_wrong_usage(words, match, renders, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [str(renders) if word == "DATA" else word for word in words]
    assert main(["evaluate", *words]) == 2
    assert match in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


def test_killed_at_any_moment_it_keeps_what_it_had(renders, tmp_path):
    """A process that is killed while it writes leaves a sound file, and the next goes on from there."""
    folder = tmp_path / "run"
    words = [
        "evaluate",
        str(renders),
        "-o",
        str(folder),
        "--set",
        f"denoiser={TOY}",
        "--keep-images",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "progden_jax", *words, "--methods", "render", "denoised"],
        env=users_environment() | {"PROGDEN_CACHE": str(tmp_path / "cache")},
        stdout=subprocess.DEVNULL,
    )
    try:
        while process.poll() is None and not (folder / "images").exists():
            time.sleep(0.005)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    before = evaluation.rows(folder)
    assert all((folder / row.image).is_file() for row in before)
    report = Remembers()
    plan = plan_of(renders, ["render", "denoised"], estimator="none")
    evaluation.carry_out(plan, folder, report=report, keep_images=True)
    assert report.numbers == (8 - len(before), len(before))
    after = evaluation.rows(folder)
    assert len({(r.method, r.scene, r.spp) for r in after}) == len(after) == 8
    assert {row.key for row in before} <= {row.key for row in after}
    assert len(list((folder / "images").iterdir())) == 8


def test_only_what_changed_is_computed_again(renders, tmp_path):
    folder, own = tmp_path / "run", tmp_path / "renders"
    shutil.copytree(renders, own)
    source = tmp_path / "mine.py"
    source.write_text("def f(x):\n    return 0.5 * x\n")

    def carry_out(**others):
        report = Remembers()
        plan = plan_of(own, ["render", "denoised"], denoiser=f"{source}:f", estimator="none")
        evaluation.carry_out(plan, folder, report=report, **others)
        return report.numbers

    assert carry_out() == (8, 0)
    assert carry_out() == (0, 8)
    before = evaluation.rows(folder)
    os.utime(own / "scene0_000004spp.exr")
    assert carry_out() == (0, 8)
    frame = pd.read_exr(own / "scene0_000004spp.exr")
    frame = frame.replace(color=frame.color * np.float32(1.5))
    pd.write_exr(own / "scene0_000004spp.exr", frame, overwrite=True)
    assert carry_out() == (2, 6)
    after = evaluation.rows(folder)
    assert len(after) == 8
    changed = [r.key for r in before if r.key not in {s.key for s in after}]
    assert len(changed) == 2
    source.write_text("def f(x):\n    return 0.25 * x\n")
    clear_parts()
    assert carry_out() == (4, 4)
    assert carry_out(keep_images=True) == (8, 0)
    assert carry_out(keep_images=True) == (0, 8)
    assert len(list((folder / "images").iterdir())) == 8


def clear_parts():
    from progden_jax.evaluation import parts

    load_denoiser.cache_clear()
    parts._denoiser_content.cache_clear()
