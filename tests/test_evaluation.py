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
import report_run
import toy_denoisers
from conftest import counting_compilations
from evaluation_runs import REFERENCE, TOY, Remembers, write_series

import progden_jax as pd
from progden_jax import adaptation, evaluation, metrics
from progden_jax.cli import main
from progden_jax.denoisers import FunctionDenoiser
from progden_jax.evaluation import exports, statistics
from progden_jax.evaluation.database import Database, Row
from progden_jax.evaluation.parts import adapted, load_denoiser
from progden_jax.evaluation.plan import PRESETS
from progden_jax.evaluation.risk import risk_of_held, risk_of_mix
from progden_jax.evaluation.settings import parse
from progden_jax.exr import read_layers
from progden_jax.frame import centre
from progden_jax.memory import Peak
from progden_jax.report.build import build_report
from progden_jax.training.losses import mix_risk

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
    frame_risk = np.mean(np.asarray(frame.variance), dtype=np.float64)
    assert row_of(rows, "render").risk == pytest.approx(float(frame_risk), rel=1e-5)
    row = row_of(rows, f"denoised {label}")
    assert row.risk == row.sure
    pixels = np.asarray(result.sure).mean(-1)
    assert row.sure_error == pytest.approx(float(pixels.std() / 16), rel=1e-3)
    row = row_of(rows, f"mix {label}")
    held = mix_risk(*(np.asarray(a) for a in known_of(result, frame)))
    assert row.risk == pytest.approx(float(np.mean(held)), rel=1e-3)
    assert row.alpha == pytest.approx(float(result.mean_alpha), rel=1e-4)
    assert row_of(rows, "render").alpha is None
    assert row.sure == pytest.approx(float(np.mean(result.sure)), rel=1e-3)
    assert row.denoised_mse == row_of(rows, f"denoised {label}").mse
    assert row_of(rows, "render").sure is None
    assert row.settings["estimator"] == "monte-carlo"
    assert row.settings["bound.c"] == 4.2
    assert "bound.c" not in row_of(rows, f"mix {label} unbounded").settings
    info = {c.split(".")[0] for c in channels(folder / row.image)}
    assert info == {"R", "G", "B", "alpha", "sure", "denoised"}
    assert any(r.seconds is not None for r in rows)
    assert all((r.seconds is None) == (r.memory is None) for r in rows)
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


def test_settings_of_a_correction_by_sure(monkeypatch, images):
    """Of the network and of its fit, both."""
    told = {"adaptation.steps": 7, "correction.window": 3}
    settings = parse({"image": "denoised", "adaptation": "sure-correct", **told}, source="")
    assert settings.flat().items() >= told.items()
    given = {}

    def correct(frame, denoiser, **how):
        given.update(how)
        return adaptation.Adapted("fitted", 1, 0.0, 0.0, 0.0, np.zeros(1, int), np.zeros(1))

    monkeypatch.setattr(adaptation, "correct_by_sure", correct)
    frame = pd.Frame(images.x, images.variance)
    assert adapted(frame, FunctionDenoiser(jax.numpy.tanh), settings) == "fitted"
    assert given["adaptation"] == adaptation.Adaptation(steps=7)
    assert given["correction"] == adaptation.PostCorrection(window=3)


def known_of(result, frame):
    """What the risk of the mix takes."""
    return result.alpha, frame.color, result.denoised, frame.variance, result.divergence


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
    with pytest.raises(ValueError, match="user_version is 9, expected 2"):
        Database(run)


def test_results_of_the_first_version_are_read_and_added_to(tmp_path):
    with closing(sqlite3.connect(tmp_path / "results.sqlite")) as connection:
        connection.executescript(report_run.SCHEMA)
        connection.execute(
            "INSERT INTO results(key, scene, spp, method, settings, rmse, created)"
            " VALUES('old', 'a', 4, 'mix', '{}', 0.5, 'then')"
        )
        connection.commit()
    (before,) = evaluation.rows(tmp_path)
    assert (before.rmse, before.risk, before.crop) == (0.5, None, None)
    with Database(tmp_path) as database:
        assert database.known() == {"old"}
        database.add([made("mix", "b", risk=2.0, crop=8)])
    after = evaluation.rows(tmp_path)
    assert after[0] == before
    assert (after[1].risk, after[1].crop, after[1].memory) == (2.0, 8, None)
    Database(tmp_path).close()


def test_crops_kept_images_and_the_risk_of_the_whole_chain(renders, tmp_path):
    """Of a denoiser that halves the colour, whose divergence one probe has exactly."""
    config = tmp_path / "own.yaml"
    config.write_text(
        f"data: [{renders}]\nscenes: [scene1]\ncrop: 8\nkeep_images: [4]\n"
        f"base: {{denoiser: '{TOY.replace('blur', 'dim')}', bound: false, mixer: closed-form}}\n"
        "list: [render, {image: mix, label: held}, {image: mix, label: whole, risk_probes: 1}]\n"
    )
    report = Remembers()
    assert evaluation.carry_out(evaluation.load(config), tmp_path / "run", report=report) == (
        6,
        0,
        0,
    )
    rows = evaluation.rows(tmp_path / "run")
    assert [(r.spp, r.image is not None) for r in rows] == [(4, True)] * 3 + [(16, False)] * 3
    assert {row.crop for row in rows} == {8}
    frame, truth = (
        centre(pd.read_exr(renders / f"scene1_{spp:06}spp.exr"), 8) for spp in (4, REFERENCE)
    )
    render, held, whole = rows[:3]
    assert render.rmse == pytest.approx(float(metrics.rmse(frame.color, truth.color)), rel=1e-4)
    kept = read_layers(tmp_path / "run" / whole.image)
    assert kept[""].shape == (8, 8, 3)
    assert (held.rmse, held.alpha, held.sure) == (whole.rmse, whole.alpha, whole.sure)
    # α follows the noise, so that held constant it looks better than it is.
    assert held.risk < whole.risk
    built = build_report(tmp_path / "run", tmp_path / "site")
    assert built.warnings == ()
    again = evaluation.carry_out(evaluation.load(config), tmp_path / "run", report=report)
    assert again == (0, 6, 0)
    report = Remembers()
    config.write_text(config.read_text().replace("crop: 8", "crop: 32"))
    assert (
        evaluation.carry_out(evaluation.load(config), tmp_path / "two", report=report).failed == 6
    )
    assert "the crop is 32 pixels wide, the frame 16×16" in report.failures[0]


@jax.tree_util.register_static
class Quarter:
    """A mixer whose α is a quarter of the render."""

    receptive_radius = 0

    def __call__(self, x, *_, **__):
        return x / 4


def test_risk_of_a_mix_against_its_formula():
    """z = x − x²/8 has the derivative 1 − x/4; with α held constant it is taken as 1 − x/8."""
    rng = np.random.default_rng(2)
    x, variance = rng.random((2, 8, 8, 3), np.float32)
    frame, denoiser = pd.Frame(x, variance), FunctionDenoiser(toy_denoisers.dim)
    settings = {"method": pd.MonteCarlo(probes=1), "probes": 1, "seed": 3}
    found = risk_of_mix(frame, denoiser, Quarter(), None, **settings)
    change = (x**2 / 8) ** 2 - variance
    assert found == pytest.approx(float(np.mean(change + 2 * variance * (1 - x / 4))), rel=1e-5)
    held = float(risk_of_held(x / 4, x, x / 2, variance, variance / 2))
    assert held == pytest.approx(float(np.mean(change + 2 * variance * (1 - x / 8))), rel=1e-5)


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


def test_the_worst_render_and_shares_of_a_gain():
    errors = {"a": (2.0, 4.0), "b": (3.0, 1.0), "mix": (1.0, 3.0), "best": (0.5, 0.5)}
    rows = [
        made(m, s, spp, rmse=v * spp)
        for m, vs in errors.items()
        for s, v in zip("xy", vs, strict=True)
        for spp in (1, 2)
    ]
    worst = statistics.worst(rows, "rmse", ["a", "b"])
    assert worst["mix"] == (3.0, "y", 2)
    assert worst["a"].ratio == 4.0
    assert worst["best"] == (0.5, "y", 2)
    rows += [made("late", "z", rmse=1.0), made("a", "z", rmse=0.0), made("b", "z", rmse=1.0)]
    assert "late" not in statistics.worst(rows, "rmse", ["a", "b"])
    table = statistics.means(rows, "rmse")
    shares = statistics.shares(table, "a", "best", [1, 2])
    assert shares == pytest.approx({"a": 0, "b": 0.4, "mix": 0.4, "best": 1})
    assert statistics.shares(table, "a", "a", [1]) == {}
    with pytest.raises(ValueError, match="'late' has no results at 1, 2 spp"):
        statistics.shares(table, "a", "late", [1, 2])


def test_typical_costs():
    measured = {"w": (None, None), "x": (1.0, 7), "y": (9.0, 5), "z": (2.0, None)}
    rows = [made("a", s, seconds=t, memory=m) for s, (t, m) in measured.items()]
    rows += [made("b", "w"), made("c", "x", seconds=3.0)]
    assert statistics.costs(rows) == {"a": (2.0, 7), "c": (3.0, None)}


def test_rows_split_by_a_setting():
    """Labels that people gave stay, and what has no such setting is in every group."""
    chosen = [
        parse(v, source="") for v in ({"image": "render"}, {"denoiser": "a"}, {"denoiser": "b"})
    ]
    rows = [made(s.label(), "x", settings={**s.flat(), "mixer.trained.probes": 4}) for s in chosen]
    rows.append(rows[1]._replace(method="my own"))
    groups = statistics.split(rows, "denoiser")
    assert {value: [r.method for r in own] for value, own in groups.items()} == {
        "a": ["render", "mix", "my own"],
        "b": ["render", "mix"],
    }


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
        env=os.environ | {"PROGDEN_CACHE": str(tmp_path / "cache")},
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


def test_peak_memory(monkeypatch):
    """Of this process, where the kernel tells; of a device only if it has not held as much before."""
    taken = Peak()
    (np.ones(2**23) * 2).sum()
    told = taken.read()
    # 2**26 bytes; half of it is allowed for, as other threads may free some meanwhile.
    assert told is None or 2**25 <= told < 2**28

    class Device:
        told = ({"bytes_in_use": 10, "peak_bytes_in_use": 50},) * 2 + (
            {"bytes_in_use": 10, "peak_bytes_in_use": 70},
        )

        def __init__(self):
            self._left = list(self.told)

        def memory_stats(self):
            return self._left.pop(0)

    device = Device()
    monkeypatch.setattr(jax, "devices", lambda: [device])
    taken = Peak()
    assert taken.read() is None
    assert taken.read() == 60
