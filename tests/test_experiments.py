"""Every experiment's command runs to its end on the bundled series."""

import csv
import sys

import pytest
from conftest import DEMO

from experiments.divergence import methods
from experiments.main_job import run as main_job
from experiments.stability import run as stability
from experiments.table3 import run as table3


def test_main_job(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run", "--data", str(DEMO), "--scenes", "1"])
    main_job.main()
    printed = capsys.readouterr().out
    rows = [line.split("|")[1:-1] for line in printed.splitlines() if "| mix |" in line]
    assert [row[0].strip() for row in rows] == ["8", "32", "128"] * 2
    assert all(0 < float(cell) < 1 for row in rows for cell in row[2:])


def test_main_job_without_data(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["run", "--data", str(tmp_path)])
    with pytest.raises(SystemExit, match="give --data FOLDER"):
        main_job.main()


def test_stability(monkeypatch, tmp_path):
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
    command = [str(word) for option in options.items() for word in option]
    chosen = ["--methods", "FiniteDifference", "MonteCarlo, gaussian"]
    monkeypatch.setattr(sys, "argv", ["run", *command, *chosen])
    monkeypatch.setattr(stability.pd, "enable_compilation_cache", lambda: None)
    stability.main()
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


def test_methods(monkeypatch, tmp_path, capsys):
    """On a corner of 16 pixels: probing is nearest, and a second run has nothing left to do."""
    csv_file = tmp_path / "found.csv"
    options = ["--data", str(DEMO), "--spp", "8", "--crop", "16", "--most", "1"]
    paths = ["--output", str(csv_file), "--kept", str(tmp_path / "exact")]
    command = ["methods", *options, "--denoisers", "oidn-hdr-small", *paths]
    monkeypatch.setattr(sys, "argv", command)
    monkeypatch.setattr(methods.pd, "enable_compilation_cache", lambda: None)
    methods.main()
    first = capsys.readouterr().out
    with csv_file.open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert float(rows["exact"]["error"]) == 0
    assert 0 < float(rows["probing"]["error"]) < float(rows["differences"]["error"])
    assert float(rows["probing"]["passes"]) == 2
    assert (tmp_path / "found.png").stat().st_size > 10_000
    methods.main()
    assert capsys.readouterr().out in first


def test_table3(monkeypatch, capsys):
    options = ["--data", str(DEMO), "--spp", "8", "32", "--denoisers", "oidn-hdr-small"]
    monkeypatch.setattr(sys, "argv", ["run", *options, "--mixers", "oidn-hdr"])
    monkeypatch.setattr(table3.pd, "enable_compilation_cache", lambda: None)
    table3.main()
    printed = capsys.readouterr().out
    rows = [[c.strip() for c in x.split("|")[1:-1]] for x in printed.splitlines() if "mix by" in x]
    oracle = [
        [c.strip() for c in x.split("|")[1:-1]] for x in printed.splitlines() if "oracle |" in x
    ]
    assert len(rows) == 3
    assert all(float(row[2]) < 1 for row in rows)
    assert all(float(row[i]) < 1 for row in oracle for i in (1, 2))
