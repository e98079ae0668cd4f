"""Every experiment's command runs to its end on the bundled series."""

import sys

import pytest
from conftest import DEMO

from experiments.main_job import run as main_job


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
