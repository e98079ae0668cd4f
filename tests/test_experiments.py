"""Every sweep is a plan, every plot can be made of its results, and every other command runs to its end."""

import csv
import itertools
import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DEMO

import progden_jax as pd
from experiments import _common, _plots, _training
from experiments.adaptation import equal_time, processor
from experiments.adaptation import renders as normal_renders
from experiments.divergence import methods
from experiments.fig2 import plot as fig2
from experiments.fig10 import plot as fig10
from experiments.fig12 import plot as fig12
from experiments.fig14 import plot as fig14
from experiments.main_job import plot as main_job
from experiments.mc_vs_exact import plot as mc_vs_exact
from experiments.mc_vs_exact import train as mc_vs_exact_train
from experiments.performance import convolutions, step
from experiments.performance import denoisers as denoiser_times
from experiments.performance import run as performance
from experiments.related_work import limit as related_work_limit
from experiments.related_work import plot as related_work
from experiments.stability import rounding
from experiments.stability import run as stability
from experiments.table1 import plot as table1
from experiments.table2 import plot as table2
from experiments.table3 import plot as table3
from experiments.table4 import plot as table4
from experiments.table4 import train as table4_train
from progden_jax import _amx, denoisers, evaluation, mixers
from progden_jax.evaluation.database import Database
from progden_jax.evaluation.settings import DEFAULT
from progden_jax.frame import centre
from progden_jax.training.evaluation import Scores

EXPERIMENTS = Path(_common.__file__).parent
CONFIGS = sorted(EXPERIMENTS.glob("*/*.yaml"))
SCENES = ("quiet", "wild")

Command = Callable[..., str]


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
        pd.write_exr(folder / path.name, centre(pd.read_exr(path), 48))
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


@pytest.fixture(scope="session")
def noisy(tmp_path_factory) -> Path:
    """Renders of 16×16 pixels whose variance has one outlier, which is larger in the second scene."""
    folder, rng = tmp_path_factory.mktemp("noisy"), np.random.default_rng(0)
    for number, scene in enumerate(SCENES):
        for spp in (*_common.SPP, _common.REFERENCE_SPP):
            color, variance = rng.random((2, 16, 16, 3), np.float32)
            variance[3, 5] = 100 * (number + 1)
            pd.write_exr(folder / f"{scene}_{spp:06}spp.exr", pd.Frame(color, variance / spp))
    return folder


def results(config: Path, renders: Path, run: Path) -> Path:
    """A run as if the configuration had been carried out, with made-up results.

    Errors fall as 1/√spp; the render's is 2, the denoiser's 1, the oracle's 0.5, the first mix's 0.6 and 0.01
    more for each further one. SURE is 1.5 of its truth, the risk 1.1.
    """
    plan = evaluation.load(config, data={"data": [str(renders)], "scenes": []})
    usual = {"render": 2.0, "denoised": 1.0, "oracle": 0.5}
    mixes = [label for label, settings in plan.methods if settings.image == "mix"]
    rows = []
    with Database(run) as database:
        for number, (item, (label, settings)) in enumerate(
            itertools.product(plan.items, plan.methods)
        ):
            error = usual.get(settings.image) or 0.6 + 0.01 * mixes.index(label)
            error /= math.sqrt(item.spp)
            image = None
            if item.spp in plan.data.keep_images:
                image, flat = f"images/{number}.exr", np.full((16, 16, 3), error, np.float32)
                (run / "images").mkdir(exist_ok=True)
                pd.write_exr(run / image, flat, layers={"alpha": flat / 2, "denoised": flat})
            row = evaluation.Row(
                **dict.fromkeys(("rmse", "smape", "relmse", "flip", "ssim", "alpha"), error),
                mse=error**2,
                risk=None if settings.image == "oracle" else 1.1 * error**2,
                denoised_mse=1.0,
                sure=1.5,
                sure_error=0.25,
                seconds=None,
                scene=item.scene,
                spp=item.spp,
                method=label,
                image=image,
                render=str(item.path),
                reference=str(item.reference),
                created="now",
                settings=settings.flat(),
                crop=plan.data.crop or None,
                key=f"{config} {number}",
            )
            rows.append(row)
        database.add(rows)
    return run


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_every_sweep_is_a_plan(path):
    """Of denoisers and mixers that there are, or that the experiment's own training writes."""
    plan = evaluation.load(path)
    assert {Path(data).resolve() for data in plan.data.data} <= {_common.VALID, DEMO}
    trained = {
        EXPERIMENTS.parent / "runs" / name / run / "weights.safetensors"
        for name, runs in (
            ("table4", table4_train.RUNS),
            ("mc_vs_exact", mc_vs_exact_train.runs([0, 1])),
        )
        for run in runs
    }
    for _, settings in plan.methods:
        assert settings.image == "render" or settings.denoiser in denoisers.names()
        assert settings.mixer in (DEFAULT, *mixers.names()) or Path(settings.mixer) in trained
    named = {Path(settings.mixer) for _, settings in plan.methods if "/" in settings.mixer}
    if path.stem == "trained":
        assert named == {file for file in trained if path.parent.name in file.parts}


def test_the_oidn_tables(command, noisy, tmp_path):
    """The first mix has 0.8 of the oracle's gain, each further one 0.02 of it less."""
    words = (results(EXPERIMENTS / "table3" / "sweep.yaml", noisy, tmp_path), "--output", tmp_path)
    printed = command(table3, *words)
    ours, closed = (cells(printed, name) for name in ("mix", "closed form"))
    # Per denoiser and metric; the second one's mix comes second.
    assert [row[6] for row in ours] == ["80.0%"] * 3 + ["78.0%"] * 3
    assert [row[6] for row in closed] == ["76.0%"] * 3 + ["74.0%"] * 3
    assert cells(printed, "paper's closed form, 31×31")[0][1:6] == ["0.66"] * 5
    assert [row[7:] for row in cells(printed, "oracle")] == [["0.500", "0.250"]] * 6


def test_tables_of_own_denoisers(command, noisy, tmp_path):
    """Over 32 to 512 spp: means, and the shares of the oracle's gain."""
    for name, plot, denoisers_there in (("table1", table1, 4), ("table2", table2, 1)):
        run = results(EXPERIMENTS / name / "sweep.yaml", noisy, tmp_path / name)
        printed = command(plot, run, "--output", tmp_path)
        rows = [row for row in cells(printed, "") if len(row) == 8]
        found = {row[1]: row for row in reversed(rows)}  # the first network's
        mean = np.mean([spp**-0.5 for spp in (32, 128, 512)])
        assert float(found["pro-den"][2]) == pytest.approx(0.6 * mean, rel=1e-3)
        assert found["pro-den"][5] == "80.0%"
        assert found["mc-render"][5] == "-200.0%"
        assert len(cells(printed, "mix closed-form")) == 3 * denoisers_there


def test_table4(command, noisy, tmp_path):
    """What is trained joins what needs no training, and each ablation is held against its whole method."""
    run = results(EXPERIMENTS / "table4" / "sweep.yaml", noisy, tmp_path / "run")
    printed = command(table4, run, "--output", tmp_path)
    (change,) = cells(printed, "RMSE", "closed form, without t-bound")
    assert change[2:] == ["+1.67%"] * 5
    assert "best step" not in printed
    net = mixers.build("paper", {"ratio": False})
    mixer = mixers.NetworkMixer(jax.jit(net.init)(jax.random.key(0)), net)
    config = tmp_path / "a" / "b" / "trained.yaml"
    weights = tmp_path / "runs" / "table4" / "paper-ratio" / "weights.safetensors"
    for path in (config, weights):
        path.parent.mkdir(parents=True)
    shutil.copy(EXPERIMENTS / "table4" / "trained.yaml", config)
    said = {"config": '{"steps": 7}', "steps": "5", "score": "0.5", "commit": "0"}
    mixers.save_mixer(weights, mixer, **said)
    printed = command(table4, results(config, noisy, run), "--output", tmp_path)
    without = "paper's network, without f_act"
    assert cells(printed, without)[0] == [without, "5 of 7", "0.5", "0"]
    assert cells(printed, "FLIP", without)[0][2:] == ["+5.00%"] * 5


def test_training_of_table4(command, noisy, monkeypatch, tmp_path):
    """Each run begins from its budget, and tells how it goes on."""
    found = {}

    def train(task, folder, report):
        found[folder.name] = task
        report.started(2, 6)
        report.evaluated(4, Scores(0.5, {}), best=True)

    monkeypatch.setattr(_training, "MixerTask", lambda config: config)
    monkeypatch.setattr(_training, "train", train)
    printed = command(table4_train, "--data", noisy, "--output", tmp_path, "--set", "seed=3")
    assert list(found) == list(table4_train.RUNS)
    assert "paper-swap: step 2 of 6\npaper-swap: step 4, score 0.5000 (best)" in printed
    swap, whole = found["paper-swap"], found["multiscale"]
    assert (swap.steps, swap.swap, swap.architecture, swap.seed) == (600, 0, "paper", 3)
    assert (whole.steps, whole.evaluate_every, whole.architecture) == (300, 100, "multiscale")


def test_main_job(command, noisy, tmp_path):
    run = results(EXPERIMENTS / "main_job" / "sweep.yaml", noisy, tmp_path)
    printed = command(main_job, run, "--output", tmp_path)
    assert cells(printed, "8", "mix")[0][2:] == ["0.2121"] * 4
    assert cells(printed, "8", "0.6") != []
    quiet, wild, *_ = (cells(printed, scene, "512")[0] for scene in SCENES)
    assert quiet[4:] == wild[4:] == ["1.5", "0.25", "yes"]
    # Of 768 values in [0, 1] three are 100 instead, or 200, and one is 0.1 %.
    assert 0.1 < float(quiet[2]) < float(wild[2]) < 0.3
    calm = main_job.Risk("calm", 512, share=0.01, mse=3.0, sure=3.3, error=0.0)
    one, both = cells(main_job.together([calm, calm._replace(share=0.5, mse=1.0, sure=2.7)]), "512")
    assert (one[1:], both[1:]) == (["without fireflies", "1", "1.1"], ["all", "2", "1.5"])


def test_renders_of_normal_noise(command, noisy, tmp_path):
    """Around the reference, by the variance averaged over 5×5 pixels."""
    words = ("--data", noisy, "--scenes", "1", "--crop", "16", "--spp", "8")
    command(normal_renders, tmp_path / "out", *words)
    given, frame = (
        pd.read_exr(f / f"{SCENES[0]}_000008spp.exr") for f in (noisy, tmp_path / "out")
    )
    truth, reference = (
        pd.read_exr(f / f"{SCENES[0]}_004096spp.exr") for f in (noisy, tmp_path / "out")
    )
    np.testing.assert_array_equal(reference.color, truth.color)
    assert not np.any(reference.variance)
    around = np.asarray(given.variance)[4:9, 6:11].mean((0, 1))
    np.testing.assert_allclose(frame.variance[6, 8], around, rtol=1e-5)
    spread = (np.asarray(frame.color) - truth.color) / np.sqrt(frame.variance)
    assert 0.9 < spread.std() < 1.1


def test_equal_time(command, noisy, tmp_path):
    """Denoised images are alike; each mix is 0.01 of the render's error worse than the one before."""
    run = results(EXPERIMENTS / "adaptation" / "equal_time.yaml", noisy, tmp_path)
    printed = command(equal_time, run, "--output", tmp_path)
    relmse, ratio = cells(printed, "SURE")
    assert relmse[1:] == ["0.3536", "0.1768", "0.08839", "0.04419"]
    assert ratio[1:] == ["1"] * 4 + ["0 of 8"]
    without, _, corrected = (
        cells(printed, name)[1]
        for name in ("unet-hdr, mixed", "SURE, mixed", "post-correction, mixed")
    )
    assert without[1:] == [f"{0.6 / 0.61:.4g}"] * 4 + ["8 of 8"]
    assert corrected[-1] == "0 of 8"
    assert len(_common.read_csv(tmp_path / "equal_time.csv")) == len(evaluation.rows(run))


def test_processor_time_of_fits(command, noisy, tiny, tmp_path):
    """Per step and for all; methods that share a fit are one line, those that fit nothing none."""
    config = tmp_path / "fits.yaml"
    config.write_text(
        f"""crop: 16
base: {{denoiser: {tiny}, image: denoised, correction.window: 3, correction.layers: 2, correction.steps: 5}}
list:
  - {{label: plain}}
  - {{label: by halves, adaptation: post-correct}}
  - {{label: the same mixed, adaptation: post-correct, image: mix}}
  - {{label: by SURE, adaptation: sure, adaptation.steps: 7, adaptation.block: 4}}
"""
    )
    printed = command(processor, config, "--data", noisy, "--scenes", "1", "--steps", "2")
    rows = {row[0]: row[1:] for row in cells(printed)[2:]}
    assert {label: row[1] for label, row in rows.items()} in (
        {"by halves": "5", "by SURE": "7"},
        {"the same mixed": "5", "by SURE": "7"},
    )
    for each, steps, total in rows.values():
        assert float(total) == pytest.approx(float(each) * float(steps), rel=1e-2)
        assert float(each) > 0


@pytest.mark.parametrize("name", ["sweep", "fitted"])
def test_related_work(command, noisy, tmp_path, name):
    """Each mix has its share of what is mixed, everywhere."""
    config = EXPERIMENTS / "related_work" / f"{name}.yaml"
    run = results(config, noisy, tmp_path)
    methods = (m.settings for m in evaluation.load(config).methods)
    mixes = [related_work.name(s.flat()) for s in methods if s.image == "mix"]
    printed = command(related_work, run, "--output", tmp_path)
    (relmse, rmse, *_) = cells(printed, "unet-hdr")
    assert relmse[1:] == rmse[1:] == ["0.3536", "0.1768", "0.08839", "0.04419", ""]
    label = "unet-hdr, combined, mixed"
    share = f"{0.6 + 0.01 * mixes.index(label):.3f}"
    assert [row[5] for row in cells(printed, label)[:4]] == [share] * 4
    assert bool(cells(printed, "unet-hdr, post-corrected, mixed")) == (name == "fitted")
    stem = {"sweep": "related_work"}.get(name, name)
    assert (tmp_path / f"{stem}.png").stat().st_size > 10_000
    methods = {row["method"] for row in _common.read_csv(tmp_path / f"{stem}.csv")}
    assert {"render", "nfor", "nfor, combined, mixed"} <= methods


def test_limit_of_related_work(command, noisy, tmp_path):
    """Of a denoiser that halves the colour the risk is (x/2)², of the render its variance."""
    (tmp_path / "half.py").write_text("def half(x):\n    return x / 2\n")
    methods = [{"image": "render"}, {"denoiser": "half.py:half", "image": "denoised"}]
    (tmp_path / "two.yaml").write_text(json.dumps({"list": methods}))
    words = ("--sweep", tmp_path / "two.yaml", "--data", noisy)
    printed = command(related_work_limit, *words)
    expected = {"render": [], "half": []}
    for spp in (512, 4096):
        frames = [pd.read_exr(noisy / f"{scene}_{spp:06}spp.exr") for scene in SCENES]
        squares = {"render": [f.variance for f in frames], "half": [f.color**2 / 4 for f in frames]}
        for method, images in squares.items():
            expected[method].append(np.mean([np.sqrt(np.mean(i)) for i in images]))
    (render,) = cells(printed, "render")
    (half,) = cells(printed, f"{tmp_path / 'half.py'}:half")
    np.testing.assert_allclose([float(c) for c in render[2:4]], expected["render"], rtol=1e-3)
    np.testing.assert_allclose([float(c) for c in half[2:4]], expected["half"], rtol=1e-3)
    assert (render[4], half[4]) == ("0", str(len(SCENES)))
    assert float(half[1]) > 0


def test_fig2(command, noisy, tmp_path):
    run = results(EXPERIMENTS / "fig2" / "sweep.yaml", noisy, tmp_path)
    printed = command(fig2, run, "--output", tmp_path)
    for image in ("render", "denoised", "mix", "mix, α held"):
        assert [row[3] for row in cells(printed, "128", image)] == ["1.10 (1.10 to 1.10)"] * 2
    assert cells(printed, "128", "oracle")[0][3:] == ["", ""]
    assert len(_common.read_csv(tmp_path / "fig2.csv")) == 2 * 5 * 5 * len(SCENES)
    for denoiser in ("oidn-hdr", "oidn-hdr-alb-nrm"):
        assert (tmp_path / f"fig2-{denoiser}.png").stat().st_size > 10_000


def test_fig10(command, noisy, tmp_path):
    run = results(EXPERIMENTS / "fig10" / "sweep.yaml", noisy, tmp_path)
    printed = command(fig10, run, "--output", tmp_path)
    assert cells(printed, "RMSE", "render")[0][2:] == [
        *("1.414", "0.7071", "0.3536", "0.1768", "0.08839"),
        "0.50 0.50 0.50 0.50",
    ]
    rows = _common.read_csv(tmp_path / "fig10.csv")
    assert {row["method"] for row in rows} == set(_plots.IMAGES)
    assert len(rows) == 2 * 5 * 5 * len(SCENES)
    assert (tmp_path / "fig10.png").stat().st_size > 10_000


def test_fig12(command, noisy, tmp_path):
    """The last bound of a configuration is the worst in these results."""
    run = results(EXPERIMENTS / "fig12" / "sweep.yaml", noisy, tmp_path)
    printed = command(fig12, run, "--output", tmp_path)
    assert cells(printed, "not bounded")[0][6] == "80.0%"
    assert cells(printed, "21×21, no shift")[0][6] == "56.0%"
    assert "pictures: wild at 32 spp, RMSE without the shift over with: 1.0938" in printed
    for name in ("fig12.png", "fig12-pictures.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_fig14(command, noisy, tmp_path):
    run = results(EXPERIMENTS / "fig14" / "sweep.yaml", noisy, tmp_path)
    printed = command(fig14, run, "--output", tmp_path)
    (wild,), (quiet,) = (cells(printed, scene) for scene in reversed(SCENES))
    assert float(wild[1]) > 1.5 * float(quiet[1])
    assert "## wild" in printed
    assert float(cells(printed, "8", "mix")[0][5]) == pytest.approx(0.61 / 8**0.5, rel=1e-3)
    rows = _common.read_csv(tmp_path / "fig14.csv")
    assert {row["scene"] for row in rows} == {"wild"}
    for name in ("fig14.png", "fig14-sheet.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_mc_vs_exact(command, noisy, tmp_path):
    """The k-th mix is 0.01 k from the first in the image, half that in α; the first two are exact."""
    run = results(EXPERIMENTS / "mc_vs_exact" / "sweep.yaml", noisy, tmp_path / "run")
    printed = command(mc_vs_exact, run, "--output", tmp_path)
    (exact,), (once,) = (cells(printed, "shipped", m) for m in ("exact", "1 probe"))
    assert exact[2:] == ["0.6000"] * 3 + ["0.000%, 0.00%"] * 2 + ["0.0%", "0.000", "4"]
    assert once[5] == "5.833%, 8.33%"
    assert once[7] == "5.8%"
    rows = _common.read_csv(tmp_path / "inference.csv")
    assert len(rows) == (2 + 2 + 2 * 8) * 2 * len(SCENES)
    fourth = next(
        r for r in rows if (r["mixer"], r["method"], r["seed"]) == ("shipped", "4 probes", "3")
    )
    assert float(fourth["alpha"]) == pytest.approx(0.5 * float(fourth["image"]) * 0.6 / 8**0.5)


def test_training_of_mc_vs_exact(command, noisy, monkeypatch, tmp_path):
    """Its configurations are whole, and made for crops of the renders."""
    found = {}
    monkeypatch.setattr(_training, "train_all", lambda runs, output: found.update(runs))
    words = ("--data", noisy, "--output", tmp_path, "--crop", 16, "--seeds", 0)
    command(mc_vs_exact_train, *words)
    assert list(found) == list(mc_vs_exact_train.runs([0]))
    exact = found["exact-seed-0"]
    assert (exact.method, exact.crop, exact.data) == ("exact", 16, (str(tmp_path / "crops-16"),))
    (first, *_) = sorted((tmp_path / "crops-16").iterdir())
    assert pd.read_exr(first).size == (16, 16)


def test_a_run_that_lacks_what_a_plot_shows_is_told(command, noisy, tmp_path):
    with pytest.raises(SystemExit, match="nowhere holds no results.sqlite"):
        command(table3, tmp_path / "nowhere")
    run = results(EXPERIMENTS / "table2" / "sweep.yaml", noisy, tmp_path / "run")
    with pytest.raises(SystemExit, match="no images were kept: .* --keep-images"):
        command(fig14, run, "--output", tmp_path)
    with pytest.raises(SystemExit, match="no results of 'not bounded', which this shows"):
        command(fig12, run, "--output", tmp_path)
    run = results(EXPERIMENTS / "fig10" / "sweep.yaml", noisy, tmp_path / "two")
    with pytest.raises(SystemExit, match="one denoiser, and the run has oidn-hdr, oidn-hdr-alb"):
        command(fig14, run, "--output", tmp_path)


def test_tf32_is_emulated(near_sighted, real_frame):
    """In values and tangents: three digits of their convolutions, not all and not none."""
    frame = jax.tree.map(lambda a: jnp.asarray(a[40:48, 30:38]) if a.ndim else a, real_frame)
    f, x = near_sighted.bind(frame), jnp.asarray(frame.color)

    def both(f):
        return jax.jit(lambda x: jax.jvp(f, (x,), (x,)))(x)

    for exact, rounded in zip(both(f), both(rounding.tf32(f)), strict=True):
        error = np.sqrt(((exact - rounded) ** 2).mean() / (exact**2).mean())
        assert 1e-6 < error < 1e-2


def test_stability(command, monkeypatch, tiny, tmp_path):
    """One small crop: derivatives keep float32's digits on every input, differences on none."""
    options = {
        "--data": DEMO,
        "--spp": 8,
        "--size": 16,
        "--denoiser": tiny,
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


def test_step(command, renders, tmp_path):
    """Of a batch of two 16×16: 54→32 1×1, then four 32→32 and one 32→3 3×3; all but the first thrice."""
    net = mixers.build("multiscale")
    first, rest = 54 * 32, 9 * 32 * (4 * 32 + 3)
    found = step.operations(jax.eval_shape(net.init, jax.random.key(0)), 512)
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


def test_times_of_denoisers(command, tiny):
    words = ("--data", DEMO, "--spp", 32, "--size", "20x18")
    printed = command(denoiser_times, *words, "--denoiser", tiny)
    first, again = cells(printed, str(tiny))
    assert (first[1], again[1]) == ("first", "again")
    assert float(first[2]) >= float(again[2]) >= 0


def test_convolutions(command):
    """Every way to the convolution gives the same, Winograd's too, in bfloat16 to its digits."""
    words = ("--shapes", "8x8x8", "--repeats", 1, "--net", "24x16")
    printed = command(convolutions, *words)
    off = {row[1]: row[5] for row in cells(printed, "8x8x8")}
    if _amx.available():
        assert float(off["AMX, 3 bfloat16 a value"]) < 1e-6
    assert float(off["Winograd"]) < 1e-5
    assert 1e-4 < float(off["direct, bfloat16"]) < 1e-2
    assert off["product alone"] == ""
    by = {row[1]: [float(n) for n in row[2:]] for row in cells(printed, "24x16")}
    names = {"AMX, rows summed", "AMX, row by row"} if _amx.available() else {"XLA"}
    assert set(by) == names
    for ms, speed, ratio in by.values():
        products = 18 * 25 * 48 + 4 * 9 * 48**2 + 9 * 48 * 9
        assert ratio == pytest.approx(1e6 * ms * speed / (2 * products * 24 * 16), rel=0.1)


def test_performance(command, monkeypatch, tiny, tmp_path):
    """Without competitors: every part has a time, and the convolutions their operations."""
    monkeypatch.setattr(
        performance, "convolution", lambda *_, **how: step.convolution(1, 32, 8, **how)
    )
    output = tmp_path / "found.csv"
    words = ("--sizes", "32x32", "--probes", 1, "--denoiser", tiny, "--rounds", 1)
    words += ("--against", "--error-size", "none", "--no-processes", "--output", output)
    printed = command(performance, "--data", DEMO, "--spp", 32, *words)
    rows = {row["part"]: row for row in _common.read_csv(output)}
    assert list(rows) == [
        *("forward pass", "mixer features", "mixing net", "t-bound"),
        *("mixer features, shipped mixer", "features and net, shipped mixer"),
        *("divergence", "whole", "whole, shipped mixer"),
    ]
    assert all(float(row["ms"]) > 0 for row in rows.values())
    once, twice = (float(rows[part]["operations_1e9"]) for part in ("forward pass", "divergence"))
    assert twice == 2 * once
    assert cells(printed, "mixing net / operations, 32x32") != []
    assert output.with_suffix(".png").stat().st_size > 10_000
