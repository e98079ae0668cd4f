"""Every experiment's command runs to its end on the bundled series."""

import csv
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import jax
import pytest
from conftest import DEMO

import progden_jax as pd
from experiments import _common, _mixes
from experiments.divergence import methods
from experiments.fig2 import run as fig2
from experiments.fig10 import run as fig10
from experiments.fig12 import run as fig12
from experiments.fig14 import run as fig14
from experiments.main_job import run as main_job
from experiments.mc_vs_exact import run as mc_vs_exact
from experiments.mc_vs_exact import train as mc_vs_exact_train
from experiments.performance import run as performance
from experiments.performance import step
from experiments.stability import run as stability
from experiments.table1 import run as table1
from experiments.table2 import run as table2
from experiments.table3 import run as table3
from experiments.table4 import run as table4
from experiments.table4 import train as table4_train
from progden_jax import denoisers, mixers

Command = Callable[..., str]
TWO = ("--spp", 8, 32)


@pytest.fixture
def command(monkeypatch, capsys) -> Command:
    """Runs a module's command with these words and gives what it printed."""

    def run(module: ModuleType, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words)])
        monkeypatch.setattr("progden_jax.enable_compilation_cache", lambda: None)
        module.main()
        return capsys.readouterr().out

    return run


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """Weights of a denoiser that compiles at once: hardly more than a mean over 3×3 pixels."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    options = {"layers": 1, "width": 4, "layer_size": 3, "kernel_size": 3}
    denoisers.save(path, denoisers.KPCN.init(jax.random.key(0), **options))
    return path


@pytest.fixture(scope="session")
def renders(tmp_path_factory) -> Path:
    """The middle 48×48 pixels of the bundled series: running takes as long as compiling on the whole."""
    folder = tmp_path_factory.mktemp("renders")
    for path in DEMO.glob("*.exr"):
        pd.write_exr(folder / path.name, _common.centre(pd.read_exr(path), 48))
    return folder


def cells(printed: str, *begin: str) -> list[list[str]]:
    """The rows of Markdown tables that begin with these cells."""
    rows = [[c.strip() for c in x.split("|")[1:-1]] for x in printed.splitlines() if "|" in x]
    return [row for row in rows if tuple(row[: len(begin)]) == begin]


def two_scenes(renders: Path, folder: Path) -> Path:
    """The series under two names, for one scene must be held out of training."""
    for path in renders.glob("*.exr"):
        for name in ("a", "b"):
            shutil.copy(path, folder / f"{name}_{path.stem.rpartition('_')[2]}.exr")
    return folder


def test_main_job(command, monkeypatch, renders, tiny):
    monkeypatch.setattr(main_job, "DENOISERS", {"one": str(tiny), "other": str(tiny)})
    printed = command(main_job, "--data", renders, "--scenes", 1)
    rows = [line.split("|")[1:-1] for line in printed.splitlines() if "| mix |" in line]
    assert [row[0].strip() for row in rows] == ["8", "32", "128"] * 2
    assert all(0 < float(cell) < 1 for row in rows for cell in row[2:])


def test_main_job_without_data(command, tmp_path):
    with pytest.raises(SystemExit, match="give --data FOLDER"):
        command(main_job, "--data", tmp_path)


def test_stability(command, monkeypatch, tmp_path):
    """One small crop: derivatives keep float32's digits on every input, differences on none."""
    options = {
        "--data": DEMO,
        "--spp": 8,
        "--size": 16,
        "--denoiser": "oidn-hdr-small",
        "--networks": "float32",
        "--epsilons": 1e-4,
        "--scales": 1e-6,
        "--output": tmp_path / "found.csv",
    }
    monkeypatch.setattr(stability, "SAMPLED", 4)
    monkeypatch.setattr(stability, "PROBES", 2)
    words = [word for option in options.items() for word in option]
    command(stability, *words, "--methods", "FiniteDifference", "MonteCarlo, gaussian")
    with (tmp_path / "found.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["study"] for row in rows} == {"inputs", "precision", "epsilon", "scale"}
    assert {row["finite"] for row in rows} == {"True"}
    for row in rows:
        error = float(row["elsewhere"])
        if row["method"] == "FiniteDifference":
            assert 1e-3 < error < (1 if row["exposure"] == "automatic" else 10)
        else:
            assert 0 < error < 1e-4
    assert (tmp_path / "found.png").stat().st_size > 10_000
    assert "| epsilon | 0.0001 |" in (tmp_path / "found.md").read_text()


def test_methods(command, monkeypatch, tiny, tmp_path):
    """On a corner of 16 pixels: probing is nearest, and a second run has nothing left to do."""
    csv_file = tmp_path / "found.csv"
    compared = [method for method in methods.methods(4) if method[1] in (0, 4)]
    monkeypatch.setattr(methods, "methods", lambda most: compared)
    words = ("--data", DEMO, "--spp", 8, "--crop", 16, "--denoisers", tiny)
    words += ("--output", csv_file, "--kept", tmp_path / "exact")
    first = command(methods, *words)
    with csv_file.open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert float(rows["exact"]["error"]) == 0
    assert 0 < float(rows["probing"]["error"]) < float(rows["differences"]["error"])
    assert float(rows["probing"]["passes"]) == 5
    assert (tmp_path / "found.png").stat().st_size > 10_000
    assert command(methods, *words) in first


def test_table3(command, renders):
    words = ("--denoisers", "oidn-hdr-small", "--mixers", "oidn-hdr")
    printed = command(table3, "--data", renders, *TWO, *words)
    rows, oracle = cells(printed, "mix by oidn-hdr"), cells(printed, "oracle")
    assert len(rows) == len(oracle) == 3
    assert all(float(row[2]) < 1 for row in rows)
    assert all(float(row[i]) < 1 for row in oracle for i in (1, 2))


def test_tables_1_and_2(command, renders, tiny):
    """A denoiser that is not there is skipped by name; one without a mixer gets the closed form."""
    words = ("--denoisers", "unet-nowhere", tiny)
    printed = command(table1, "--data", renders, *TWO, *words)
    assert "skipped unet-nowhere: neither a file nor one of oidn-hdr" in printed
    (den,) = cells(printed, f"{tiny} (ClosedForm(window=15, confidence=0.7))", "den")
    mix, closed, oracle = (cells(printed, "", m)[0] for m in ("pro-den", "closed form", "oracle"))
    assert mix == ["", "pro-den", *closed[2:]]
    assert float(oracle[2]) < float(mix[2]) < float(den[2])
    assert den[5] == "0.0%"
    assert oracle[5] == "100.0%"
    with pytest.raises(SystemExit, match="no denoiser to measure"):
        command(table2, "--data", renders, *TWO, "--denoisers", "nowhere.safetensors")


def test_table4(command, renders, tiny, tmp_path):
    """An ablation trained for one step stands beside the whole method; what is missing is named."""
    data, runs = two_scenes(renders, tmp_path), tmp_path / "runs"
    few = ("steps=1", "batch=2", "crop=16", "spp=[8]", f"denoiser={tiny}", "exposure_stops=0.0")
    words = ("--data", data, "--output", runs, "--set", *few, "--only", "paper-ratio")
    assert "paper-ratio: step 1, score" in command(table4_train, *words)
    whole = mixers.build("paper")
    mixer = mixers.NetworkMixer(jax.jit(whole.init)(jax.random.key(0)), whole)
    (runs / "paper").mkdir()
    said = {"config": '{"steps": 7}', "steps": "7", "score": "1", "commit": "0"}
    mixers.save_mixer(runs / "paper" / "weights.safetensors", mixer, **said)
    words = ("--data", renders, "--spp", 32, "--denoiser", tiny, "--runs", runs)
    printed = command(table4, *words)
    assert "no weights of paper-sure, paper-swap, multiscale" in printed
    assert cells(printed, "paper, without f_act")[0][1] == "1 of 1"
    (change,) = cells(printed, "RMSE", "paper, without f_act")
    assert float(change[2].rstrip("%")) != 0
    assert len(cells(printed, "closed form, without t-bound")) == len(_mixes.METRICS)


def test_fig2(command, tiny, tmp_path):
    """The render's error is its variance, and SURE's estimate of the denoised image's is near."""
    output = tmp_path / "found.csv"
    words = ("--denoisers", tiny, "--probes", 1, "--output", output)
    command(fig2, "--data", DEMO, "--spp", 128, *words)
    rows = {row["image"]: row for row in _common.read_csv(output)}
    assert set(rows) == {"render", "denoised", "mix", "mix, α held", "oracle"}
    for name, tolerance in (("render", 0.2), ("denoised", 0.5), ("mix", 0.5)):
        truth, estimate = (float(rows[name][column]) for column in ("mse", "estimate"))
        assert abs(estimate / truth - 1) < tolerance
    assert float(rows["mix"]["mse"]) < float(rows["denoised"]["mse"])
    assert (tmp_path / "found-tiny.png").stat().st_size > 10_000


def test_fig10(command, renders, tiny, tmp_path):
    output = tmp_path / "found.csv"
    words = ("--denoisers", tiny, "--output", output)
    printed = command(fig10, "--data", renders, *TWO, *words)
    (render,) = cells(printed, "RMSE", "render")
    assert float(render[3]) < float(render[2])
    assert len(_common.read_csv(output)) == 10
    assert output.with_suffix(".png").stat().st_size > 10_000


def test_fig12(command, renders, tiny, tmp_path, monkeypatch):
    """Every window, with and without shift, gives another image."""
    monkeypatch.setattr(fig12, "WINDOWS", (3, 11))
    bounds = [
        fig12.Bound(window=window, shift=shift) for shift in (True, False) for window in (3, 11)
    ]
    monkeypatch.setattr(fig12, "BOUNDS", bounds)
    output = tmp_path / "found.csv"
    words = ("--denoiser", tiny, "--mixer", "closed-form", "--output", output)
    printed = command(fig12, "--data", renders, "--spp", 32, *words)
    assert len(cells(printed, "11×11, no shift")) == 3
    found = {row["image"]: row["RMSE"] for row in _common.read_csv(output)}
    assert len({found[name] for name in ("not bounded", *map(fig12.name, bounds))}) == 5
    for name in ("found.png", "found-pictures.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_fig14(command, renders, tiny, tmp_path):
    output = tmp_path / "found.csv"
    words = ("--denoiser", tiny, "--output", output)
    printed = command(fig14, "--data", renders, *TWO, *words)
    assert cells(printed, "proc2004") != []
    assert 0 < float(cells(printed, "8", "mix")[0][5]) < 1
    assert {row["spp"] for row in _common.read_csv(output)} == {"8", "32"}
    for name in ("found.png", "found-sheet.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_mc_vs_exact(command, renders, tiny, tmp_path, monkeypatch):
    """On crops of 16 pixels: probes change the image a little, and a second run has nothing to do."""
    output, runs = tmp_path / "found.csv", tmp_path / "runs"
    data = two_scenes(renders, tmp_path)
    monkeypatch.setenv("PROGDEN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(mc_vs_exact_train, "METHODS", {"exact": mc_vs_exact_train.METHODS["exact"]})
    compared = {name: (mc_vs_exact.INFERENCE[name][0], 1) for name in ("exact", "1 probe")}
    monkeypatch.setattr(mc_vs_exact, "INFERENCE", compared)
    few = ("steps=1", "batch=2", "spp=[8]", f"denoiser={tiny}", "exposure_stops=0.0")
    words = ("--data", data, "--output", runs, "--crop", 16, "--seeds", 0)
    command(mc_vs_exact_train, *words, "--set", *few, "options={ width = 4, blocks = 1 }")
    words = ("--data", data, "--runs", runs, "--crop", 16, "--scenes", 1, "--spp", 8)
    words += ("--denoiser", tiny)
    printed = command(mc_vs_exact, *words, "--output", output)
    rows = _common.read_csv(output)
    assert [row["mixer"] for row in rows] == ["denoised", "oracle", "exact-seed-0", "exact-seed-0"]
    for row in rows:
        assert (float(row["image"]) > 0) == (row["method"] != "exact")
    assert cells(printed, "exact", "1 probe") != []
    assert command(mc_vs_exact, *words, "--output", output) == printed
    assert _common.read_csv(output) == rows


def test_step(command, renders, tmp_path):
    """Of a batch of two 16×16: 54→32 1×1, then four 32→32 and one 32→3 3×3; all but the first thrice."""
    net = mixers.build("multiscale")
    first, rest = 54 * 32, 9 * 32 * (4 * 32 + 3)
    found = step.operations(jax.jit(net.init)(jax.random.key(0)), 512)
    assert found == 2 * 512 * (2 * first + 3 * rest)
    words = (
        "--data",
        two_scenes(renders, tmp_path),
        "--scenes",
        2,
        "--architectures",
        "multiscale",
    )
    printed = command(step, *words, "--batch", 2, "--crop", 16, "--repeats", 1, "--channels", 8)
    (row,) = cells(printed, "multiscale")
    assert row[1] == f"{found / 1e9:.1f}"
    assert float(row[5]) > 0


def test_performance(command, tiny, tmp_path):
    """Without competitors: every part has a time, and the convolutions their operations."""
    output = tmp_path / "found.csv"
    words = ("--sizes", "64x64", "--probes", 1, "--denoiser", tiny, "--rounds", 1)
    words += ("--against", "--error-size", "none", "--no-processes", "--output", output)
    printed = command(performance, "--data", DEMO, "--spp", 32, *words)
    rows = {row["part"]: row for row in _common.read_csv(output)}
    assert list(rows) == [
        *("forward pass", "mixer features", "mixing net", "t-bound", "divergence", "whole"),
    ]
    assert all(float(row["ms"]) > 0 for row in rows.values())
    once, twice = (float(rows[part]["operations_1e9"]) for part in ("forward pass", "divergence"))
    assert twice == 2 * once
    assert cells(printed, "mixing net / operations, 64x64") != []
    assert output.with_suffix(".png").stat().st_size > 10_000
