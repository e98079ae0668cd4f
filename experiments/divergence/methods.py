"""Monte Carlo or exact? Every estimator of the divergence against the exact one, and what its error does.

    python -m experiments.divergence.methods

Per frame and method: the RMSE over pixels of σ²·∂f/∂x relative to the exact one's RMS, the error of the
image's mean, time and denoiser passes; then how far the SURE map, the closed-form α and the final image are
from those of the exact divergence, beside how far the latter are from the truth. Goes on with the frames that
its CSV lacks.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.divergence import _figures
from progden_jax import _windows
from progden_jax.compilation import cache_folder
from progden_jax.divergence import Evaluation, evaluate
from progden_jax.divergence.running import ExactRun
from progden_jax.training.evaluation import oracle_alpha

HERE = Path(__file__).parent
WINDOW = 15
"""Of the closed form, in pixels; SURE maps are compared after averaging over it, too."""

NAMES = ("exact", "differences", "rademacher", "probing", "truncated")
TRUNCATED = {
    4: pd.TruncatedCone(levels=1, whole=0),
    16: pd.TruncatedCone(levels=1, whole=1 / 16),
    64: pd.TruncatedCone(levels=3, whole=1 / 20),
}
"""By the number of probes that takes as many operations or more, with OIDN's base network; the exact
divergence itself takes fewer than 256."""

HEADER = (
    *("denoiser", "scene", "spp", "method", "probes", "passes", "seconds"),
    *("error", "mean_error", "sure", "sure_exact", "sure_window", "sure_window_exact"),
    *("alpha", "alpha_exact", "rmse_ratio", "smape_ratio", "image"),
)


def methods(most: int) -> list[tuple[str, int, pd.Method]]:
    """(name, probes, method) of all that are compared, the exact one first."""
    found: list[tuple[str, int, pd.Method]] = [("exact", 0, pd.Exact("cone"))]
    for count in (1, 2, 4, 16, 64, 256):
        if count <= most:
            found.append(("differences", count, pd.FiniteDifference(probes=count)))
            found.append(("rademacher", count, pd.MonteCarlo(probes=count)))
            found.append(("probing", count, pd.Probing(probes=count)))
    found += [("truncated", count, method) for count, method in TRUNCATED.items() if count <= most]
    return found


def passes(name: str, count: int, f: Any, x: jax.Array) -> float:
    """Denoiser passes: the forward one, and one per probe; of cones what their plan counts."""
    if name == "truncated":
        return 1 + TRUNCATED[count].cost(f, x)
    return 1 + (pd.Exact().cost(f, x)["cone"] if name == "exact" else count)


@jax.jit
def consequences(frame: pd.Frame, reference: jax.Array, y: jax.Array, divergence: jax.Array) -> Any:
    """The SURE map, the same averaged, the closed form's α and the bounded mix."""
    x, variance = frame.color, frame.variance
    assert variance is not None
    risk = pd.sure(x, y, variance, divergence)
    alpha = pd.ClosedForm(window=WINDOW)(x, y, variance, divergence, risk)
    image = x + pd.t_bound(alpha, x, y, variance) * (y - x)
    ones = _windows.box_sum(jnp.ones_like(x[..., :1]), WINDOW)
    return {
        "sure": risk,
        "sure_window": _windows.box_sum(risk, WINDOW) / ones,
        "alpha": alpha,
        "image": image,
        "truth": (y - reference) ** 2,
        "truth_window": _windows.box_sum((y - reference) ** 2, WINDOW) / ones,
        "oracle": oracle_alpha(x, y, reference, window=WINDOW),
        "rmse": pd.metrics.rmse(image, reference),
        "smape": pd.metrics.smape(image, reference),
    }


class Frame(NamedTuple):
    """One frame as every method gets it, and where it came from."""

    label: tuple[str, str, int]
    frame: pd.Frame
    reference: jax.Array
    f: Any


def exact(case: Frame, folder: Path) -> tuple[Evaluation, float]:
    """The exact divergence and its seconds, nan where a checkpoint in `folder` had some of it."""
    frame = case.frame
    assert frame.variance is not None
    run = ExactRun(case.f, frame.color, frame.variance, method=pd.Exact("cone"))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{run.key}.npz"
    start = float("nan") if path.exists() else time.perf_counter()
    found = jax.block_until_ready(run.finish(checkpoint=path))
    return found, time.perf_counter() - start


def measure(
    case: Frame, wanted: set[tuple[str, int]], most: int, folder: Path, warm: set
) -> Iterator[tuple]:
    """The columns from "method" on, for the methods wanted; `warm` has those that are compiled."""
    frame, f = case.frame, case.f
    x, variance = frame.color, frame.variance
    assert variance is not None
    key = jax.random.key(1)
    found, seconds = exact(case, folder)
    truth = np.asarray(found.divergence, np.float64)
    right = consequences(frame, case.reference, found.value, found.divergence)
    for name, count, method in methods(most):
        if (name, count) not in wanted:
            continue
        if name != "exact":
            if (name, count, case.label[0]) not in warm:
                jax.block_until_ready(evaluate(f, x, variance, method=method, key=key))
                warm.add((name, count, case.label[0]))
            start = time.perf_counter()
            found = jax.block_until_ready(evaluate(f, x, variance, method=method, key=key))
            seconds = time.perf_counter() - start
        estimate = np.asarray(found.divergence, np.float64)
        seen = consequences(frame, case.reference, found.value, found.divergence)
        yield (
            *(name, count, passes(name, count, f, x), seconds),
            _common.rms(estimate - truth) / _common.rms(truth),
            abs(estimate.mean() - truth.mean()) / abs(truth.mean()),
            _common.rms(seen["sure"] - right["sure"]),
            _common.rms(right["sure"] - right["truth"]),
            _common.rms(seen["sure_window"] - right["sure_window"]),
            _common.rms(right["sure_window"] - right["truth_window"]),
            _common.rms(seen["alpha"] - right["alpha"]),
            _common.rms(right["alpha"] - right["oracle"]),
            float(seen["rmse"] / right["rmse"]),
            float(seen["smape"] / right["smape"]),
            _common.rms(seen["image"] - right["image"]) / float(right["rmse"]),
        )


def main() -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--spp", type=int, nargs="*", default=(8, 128))
    parser.add_argument("--denoisers", nargs="*", default=("oidn-hdr", "oidn-hdr-alb-nrm"))
    parser.add_argument("--most", type=int, default=256, help="most probes of a method compared")
    parser.add_argument("--crop", type=int, default=128, help="side of the frames' corner taken")
    parser.add_argument("--methods", nargs="*", choices=NAMES, default=NAMES)
    parser.add_argument("--again", nargs="*", choices=NAMES, default=(), help="forget their rows")
    parser.add_argument("--output", type=Path, default=HERE / "methods.csv")
    parser.add_argument("--kept", type=Path, default=cache_folder() / "exact")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    names = _common.scenes(arguments.data, arguments.scenes)
    kept = _common.read_csv(arguments.output)
    rows = [row for row in kept if row["method"] not in arguments.again]
    done = {tuple(map(str, (row[name] for name in HEADER[:5]))) for row in rows}
    every = [(m, k) for m, k, _ in methods(arguments.most) if m in arguments.methods]
    warm: set = set()
    for which in arguments.denoisers:
        denoiser = pd.denoisers.load(which)
        for scene, spp, frame, reference in _common.series(arguments.data, names, arguments.spp):
            wanted = {(m, k) for m, k in every if (which, scene, str(spp), m, str(k)) not in done}
            if not wanted:
                continue
            n = arguments.crop
            frame, truth = jax.tree.map(
                lambda a, n=n: a[:n, :n] if a.ndim else a, (frame, reference.color)
            )
            frame, _ = pd.repair(frame)
            case = Frame((which, scene, spp), frame, truth, denoiser.bind(frame))
            for row in measure(case, wanted, arguments.most, arguments.kept, warm):
                cells = (*case.label, *row)
                rows.append(dict(zip(HEADER, map(str, cells), strict=True)))
                _common.write_csv(arguments.output, HEADER, [tuple(r.values()) for r in rows])
            print(which, scene, spp, flush=True)
    table = f"{_common.machine()}\n\n{_figures.table(rows)}\n"
    _common.write_text(arguments.output.with_suffix(".md"), table)
    _figures.pareto(rows, arguments.output.with_suffix(".png"))
    print(table)


if __name__ == "__main__":
    main()
