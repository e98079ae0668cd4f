"""`progden sweep`: configurations expanded, jobs given out, workers lost, Ray."""

import itertools
import json
import multiprocessing
import os
import signal
from collections import Counter
from pathlib import Path

import pytest
from evaluation_runs import SPP, TOY, Remembers, write_series

from progden_jax import evaluation
from progden_jax.cli import main
from progden_jax.evaluation.dispatch import ATTEMPTS, Failed, Lost, dispatch
from progden_jax.evaluation.measure import jobs
from progden_jax.evaluation.plan import Cell, Method
from progden_jax.evaluation.processes import Processes
from progden_jax.evaluation.settings import parse
from progden_jax.training.index import Item

SMOKE = Path(__file__).parents[1] / "experiments" / "sweeps" / "smoke.yaml"


@pytest.fixture(scope="module")
def renders(tmp_path_factory) -> Path:
    return write_series(tmp_path_factory.mktemp("series") / "renders", SCENES)


@pytest.fixture
def config(tmp_path, renders):
    """Writes a configuration; gives its path."""

    def write(text: str) -> Path:
        path = tmp_path / "sweep.yaml"
        path.write_text(f"data: [{renders}]\n{text}")
        return path

    return write


def labels(path: Path) -> list[str]:
    return [method.label for method in evaluation.load(path).methods]


def test_a_grid_is_every_combination_and_a_list_single_methods(config):
    path = config(
        "base: {denoiser: oidn-hdr, bound: {window: 7}}\n"
        "grid:\n  estimator: [monte-carlo, exact]\n  probes: [1, 4]\n  bound.c: [3, 4.2]\n"
        "list: [render, {image: denoised, label: plain}]\n"
    )
    # The exact divergence takes no probes, so these make no second method of it.
    assert labels(path) == [
        "render",
        "plain",
        "mix oidn-hdr bound.c=3 bound.window=7",
        "mix oidn-hdr bound.window=7",
        "mix oidn-hdr monte-carlo(4) bound.c=3 bound.window=7",
        "mix oidn-hdr monte-carlo(4) bound.window=7",
        "mix oidn-hdr exact bound.c=3 bound.window=7",
        "mix oidn-hdr exact bound.window=7",
    ]
    *_, last = evaluation.load(path).methods
    assert last.settings.limits.window == 7
    assert last.settings.flat()["bound.window"] == 7


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("grid: {probe: [1]}", "no setting 'probe'; did you mean 'probes'?"),
        ("grid: {probes: 4}", "grid: probes is 4, expected a list of values, such as [4]"),
        ("grid: {probes: [one]}", "grid: probes is 'one', expected a whole number"),
        ("grid: {probes: [0]}", "probes is 0, expected a whole number of at least 1"),
        ("grid: {estimator: [mc]}", "estimator is 'mc', expected one of 'monte-carlo'"),
        ("grid: {image: [picture]}", "image is 'picture', expected one of 'mix', 'denoised'"),
        ("grid: {bound.sigmoid: [tanh]}", "sigmoid is 'tanh', expected one of 'normal'"),
        ("base: {estimator: none}", "mixing needs SURE"),
        ("base: {risk_probes: -1}", "risk_probes is -1, expected a whole number from 0 up"),
        ("crop: -1", "crop is -1, expected a side in pixels"),
        ("base: 3", "base is 3, expected settings"),
        ("list: [mixed]", "list, entry 1 is 'mixed', expected settings or one of render"),
        ("list: [{image: render, label: 3}]", "label is 3, expected text"),
        ("list: [{label: a}, {label: a, seed: 1}]", "two methods are called 'a'"),
        ("list: []", "there is no method"),
        ("scene: [a]", "there is no field 'scene'; did you mean 'scenes'?"),
        ("grid: [", "is no YAML"),
    ],
)
def test_what_is_wrong_in_a_configuration_is_named(text, match, config, capsys):
    path = config(text)
    assert main(["sweep", str(path), "--dry-run"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert match in told
    assert str(path) in told


def test_paths_are_relative_to_the_configuration(config):
    path = config("list: [{mixer: runs/w.safetensors, denoiser: mine.py:f}, {mixer: oidn-hdr}]")
    first, second = (method.settings for method in evaluation.load(path).methods)
    assert first.mixer == str(path.parent / "runs" / "w.safetensors")
    assert first.denoiser == f"{path.parent / 'mine.py'}:f"
    assert (second.mixer, second.denoiser) == ("oidn-hdr", "auto")
    assert labels(path)[0] == f"mix {path.parent.name}/mine.py:f runs/w"


def test_the_smoke_grid_is_shown_without_computing(capsys):
    assert main(["sweep", str(SMOKE), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (len(told["methods"]), told["renders"], told["rows"]) == (14, 3, 42)
    assert main(["sweep", str(SMOKE), "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert "14 methods × 3 renders = 42 rows" in printed
    assert "denoised oidn-hdr-small" in printed


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["--workers", "0"], "--workers is 0"),
        (["--num-gpus", "1"], "--num-gpus is for Ray"),
        ([], "--output is missing"),
    ],
)
def test_wrong_usage(words, match, capsys):
    assert main(["sweep", str(SMOKE), *words]) == 2
    assert match in " ".join(capsys.readouterr().err.split())


class Scripted:
    """Workers that do nothing; those whose turn it is are lost."""

    def __init__(self, count, lost=()):
        self.count, self._lost, self._turn = count, set(lost), 0
        self.busy, self.given = {}, []

    def give(self, worker, job):
        assert worker not in self.busy
        self.busy[worker] = job
        self.given.append((worker, job))

    def wait(self):
        worker = next(iter(self.busy))
        self.busy.pop(worker)
        self._turn += 1
        return worker, Lost("of the script") if self._turn in self._lost else []

    def close(self):
        pass


def made_jobs(programs=3, renders=4):
    cells = [
        Cell(f"{n} {p}", Item(f"s{n}", 8, Path("a"), Path("b")), Method(f"m{p}", settings))
        for n in range(renders)
        for p in range(programs)
        for settings in [parse({"probes": p + 1}, source="")]
    ]
    return jobs(cells)


def test_methods_of_one_estimate_are_one_job():
    item = Item("s", 8, Path("a"), Path("b"))
    settings = ({"image": "render"}, {}, {"bound.c": 3.0}, {"image": "denoised"}, {"seed": 1})
    cells = [
        Cell(str(i), item, Method(str(i), parse(given, source="")))
        for i, given in enumerate(settings)
    ]
    assert [[c.key for c in job.cells] for job in jobs(cells)] == [["0", "1", "2", "3"], ["4"]]
    assert [[c.key for c in job.cells] for job in jobs(cells[:1])] == [["0"]]


def test_workers_stay_with_their_programs():
    """Each program has its worker as long as there are jobs of it, and every job is done once."""
    todo, crew = made_jobs(), Scripted(3)
    done = [job for job, _ in dispatch(todo, crew)]
    assert Counter(done) == Counter(todo)
    programs = {(worker, job.shown.program()) for worker, job in crew.given}
    assert len(programs) == 3
    # A fourth worker helps; a worker alone goes through the programs one after the other.
    assert len(list(dispatch(todo, Scripted(4)))) == 12
    alone = Scripted(1)
    list(dispatch(todo, alone))
    order = [job.shown.program() for _, job in alone.given]
    assert sum(a != b for a, b in itertools.pairwise(order)) == 2


def test_a_lost_job_is_done_again_but_not_for_ever():
    todo = made_jobs()
    outcomes = list(dispatch(todo, Scripted(2, lost=(1, 4, 5))))
    assert Counter(job for job, _ in outcomes) == Counter(todo)
    assert not any(isinstance(outcome, Failed) for _, outcome in outcomes)
    ((_, outcome),) = dispatch(todo[:1], Scripted(1, lost=range(ATTEMPTS + 1)))
    assert isinstance(outcome, Failed)
    assert "3 workers were lost on it, the last one because of the script" in outcome.reason


CONFIG = f"base: {{denoiser: {TOY}, estimator: none}}\nlist: [render, denoised]\n"
SCENES = 3
ROWS = 2 * SCENES * len(SPP)


def check(run: Path) -> None:
    found = Counter((r.method, r.scene, r.spp) for r in evaluation.rows(run))
    assert set(found.values()) == {1}
    assert len(found) == ROWS


def test_a_killed_process_costs_no_row(config, tmp_path):
    def kill(number):
        if number == 2:
            multiprocessing.active_children()[0].kill()

    report = Remembers(kill)
    plan = evaluation.load(config(CONFIG))
    run = tmp_path / "run"
    done = evaluation.carry_out(plan, run, report=report, workers=lambda jobs: Processes(1))
    assert done == (ROWS, 0, 0)
    check(run)
    assert multiprocessing.active_children() == []


def test_a_killed_ray_worker_costs_no_row(config, tmp_path):
    ray = pytest.importorskip("ray", reason="needs the extra `sweep`")
    from progden_jax.evaluation.cluster import Cluster

    crews = []

    def start(jobs):
        crews.append(Cluster(1, jobs=jobs))
        return crews[0]

    def kill(number):
        if number == 2:
            (actor,) = crews[0]._actors
            os.kill(ray.get(actor.__ray_call__.remote(lambda _: os.getpid())), signal.SIGKILL)

    run = tmp_path / "run"
    plan = evaluation.load(config(CONFIG))
    report = Remembers(kill)
    assert evaluation.carry_out(plan, run, report=report, workers=start) == (ROWS, 0, 0)
    check(run)
    assert not ray.is_initialized()
