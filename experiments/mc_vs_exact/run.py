"""Does an exact divergence change the mix, at inference or in training?

python -m experiments.mc_vs_exact.run                                  # at inference, the shipped mixer
python -m experiments.mc_vs_exact.run --runs RUNS --output trained.csv   # of what `train` made

Centre crops of every frame, the network run on the crop. Goes on with the frames that its CSV lacks.
"""

from collections import defaultdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common, _mixes, _training
from experiments.mc_vs_exact.train import CROP, DENOISER, SPP, runs
from progden_jax import mixers
from progden_jax.training.estimates import EstimateCache

HERE = Path(__file__).parent
INFERENCE: dict[str, tuple[pd.Method, int]] = {
    "exact": (pd.Exact(), 1),
    "1 probe": (pd.MonteCarlo(probes=1), 4),
    "4 probes": (pd.MonteCarlo(probes=4), 4),
}
"""Name -> method, and how many seeds of it."""

HEADER = (
    *("denoiser", "crop", "mixer", "scene", "spp", "method", "seed"),
    *(*_mixes.METRICS, "image", "alpha"),
)
ORACLE, DENOISED = "oracle", "denoised"
Row = dict[str, str]


def rms(value: jax.Array) -> float:
    return float(np.sqrt(np.square(np.asarray(value, np.float64)).mean()))


def measure(
    frame: pd.Frame,
    reference: jax.Array,
    caches: dict[str, EstimateCache],
    chosen: dict[str, pd.Mixer],
) -> list[tuple]:
    """The columns of `HEADER` from "mixer" on, less scene and spp: (mixer, method, seed, ...).

    `image` is the RMS difference from the image that the exact divergence gives, over that one's RMSE, and
    `alpha` that of α.
    """
    frame, _ = pd.repair(_mixes.lean(frame))
    assert frame.variance is not None
    x, variance = frame.color, frame.variance
    exact: dict[str, tuple[jax.Array, jax.Array]] = {}
    lines = []
    for method, (_, seeds) in INFERENCE.items():
        for seed in range(seeds):
            y, divergence = map(jnp.asarray, caches[method].get(frame, seed)[:2])
            seen = _mixes.Seen(x, y, variance, divergence, pd.sure(x, y, variance, divergence))
            if method == "exact":
                for name, image in ((DENOISED, y), (ORACLE, _mixes.oracle(seen, reference))):
                    found = _mixes.errors(image, reference)
                    lines.append((name, method, seed, *found.values(), 0.0, 0.0))
            for name, mixer in chosen.items():
                image, alpha = _mixes.mix(seen, mixer)
                right, right_alpha = exact.setdefault(name, (image, alpha))
                differences = rms(image - right) / rms(right - reference), rms(alpha - right_alpha)
                found = _mixes.errors(image, reference)
                lines.append((name, method, seed, *found.values(), *differences))
    return lines


def groups(rows: list[Row], *, by: tuple[str, ...]) -> dict[tuple[str, ...], list[Row]]:
    """The rows by these columns."""
    found: dict[tuple[str, ...], list[Row]] = defaultdict(list)
    for row in rows:
        found[tuple(row[name] for name in by)].append(row)
    return found


def training_of(mixer: str) -> str:
    """A run's name without its seed."""
    return mixer.partition("-seed-")[0]


def table(rows: list[Row]) -> str:
    """Geometric means over frames and seeds of errors over the denoiser's, and what probes change."""
    frames = groups(rows, by=("mixer", "method", "scene", "spp"))
    lines = []
    pairs = {(training_of(r["mixer"]), r["method"]): None for r in rows}
    for mixer, method in pairs:
        own = [r for r in rows if (training_of(r["mixer"]), r["method"]) == (mixer, method)]
        cells = []
        for label in _mixes.METRICS:
            ratios = []
            for row in own:
                (base,) = frames[DENOISED, "exact", row["scene"], row["spp"]]
                ratios.append(float(row[label]) / float(base[label]))
            cells.append(f"{np.exp(np.mean(np.log(ratios))):.4f}")
        changes = []
        for label in ("RMSE", "SMAPE"):
            relative = [
                abs(float(r[label]) / float(exact[label]) - 1)
                for r in own
                for exact in frames[r["mixer"], "exact", r["scene"], r["spp"]]
            ]
            changes.append(f"{np.median(relative):.3%}, {np.max(relative):.2%}")
        image, alpha = (np.median([float(r[name]) for r in own]) for name in ("image", "alpha"))
        count = len({(r["scene"], r["spp"]) for r in own})
        lines.append((mixer, method, *cells, *changes, f"{image:.1%}", f"{alpha:.3f}", count))
    header = (
        *("mixer", "divergence", *(f"{m} over the denoiser's" for m in _mixes.METRICS)),
        *("change of RMSE: median, largest", "of SMAPE", "image", "α", "frames"),
    )
    return _common.markdown(header, lines)


def main() -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--denoiser", help=f"by default oidn-hdr, of runs {DENOISER}")
    parser.add_argument("--runs", type=Path, help="folder that experiments.mc_vs_exact.train wrote")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1], help="of the runs")
    parser.add_argument("--spp", type=int, nargs="*", default=SPP)
    parser.add_argument(
        "--crop", type=int, default=CROP, help="side of the crops, a multiple of 16"
    )
    parser.add_argument("--output", type=Path, default=HERE / "inference.csv")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    which = arguments.denoiser or (DENOISER if arguments.runs else "oidn-hdr")
    denoiser = pd.denoisers.load(which)
    names = _common.scenes(arguments.data, arguments.scenes)
    chosen: dict[str, pd.Mixer] = {}
    if arguments.runs:
        chosen |= _training.trained(arguments.runs, runs(arguments.seeds))
        if not chosen:
            raise SystemExit(f"{arguments.runs} holds no run: run experiments.mc_vs_exact.train")
    else:
        chosen |= {"shipped": mixers.default_for(denoiser), "closed form": pd.ClosedForm()}
    caches = {name: EstimateCache(denoiser, method) for name, (method, _) in INFERENCE.items()}

    rows = _common.read_csv(arguments.output)
    done = groups(rows, by=("denoiser", "crop", "mixer", "scene", "spp"))
    at = (which, str(arguments.crop))
    for scene, spp, frame, reference in _common.series(arguments.data, names, arguments.spp):
        lacking = {n: m for n, m in chosen.items() if (*at, n, scene, str(spp)) not in done}
        if not lacking:
            continue
        frame, truth = (_common.centre(f, arguments.crop) for f in (frame, reference))
        for mixer, *line in measure(frame, truth.color, caches, lacking):
            if (*at, mixer, scene, str(spp)) in done:
                continue
            cells = (*at, mixer, scene, spp, *line)
            rows.append(dict(zip(HEADER, map(str, cells), strict=True)))
        _common.write_csv(arguments.output, HEADER, [tuple(row.values()) for row in rows])
    print(_common.machine())
    for (name, size), own in groups(rows, by=("denoiser", "crop")).items():
        print(f"\n## {name}, {size}×{size} pixels\n\n{table(own)}", flush=True)


if __name__ == "__main__":
    main()
