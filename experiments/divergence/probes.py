"""Error of structured probes against the paper's differences at equal cost, per pixel.

    python -m experiments.divergence.probes

The error is the RMSE over pixels of the estimate of σ²·∂f/∂x relative to the RMS of its true value. The
true value is taken from Probing with many probes in two replicates and another key; the mean square of its
own standard error, which its replicates tell, is taken off.
"""

import argparse
import csv
from pathlib import Path

import jax
import numpy as np

import progden_jax as pd
from experiments import _common

HERE = Path(__file__).parent
PROBES = (4, 16, 64, 256)
TARGETS = {4: 0.38, 16: 0.20, 64: 0.12, 256: 0.06}
HEADER = ("scene", "spp", "method", "probes", "error", "truth_error")


def methods(most: int) -> dict[tuple[str, int], pd.Method]:
    """The methods compared, by name and number of probes."""
    found: dict[tuple[str, int], pd.Method] = {}
    for count in (k for k in PROBES if k <= most):
        found["differences", count] = pd.FiniteDifference(probes=count)
        found["probing", count] = pd.Probing(probes=count)
        if count <= 64:
            found["probing, sigma", count] = pd.Probing(probes=count, scale="sigma")
            found["rademacher", count] = pd.MonteCarlo(probes=count)
    return found


def measure(frame: pd.Frame, denoiser: pd.Denoiser, truth_probes: int, most: int) -> list[tuple]:
    """(method, probes, relative error, relative error of the truth) for every method."""
    f, x, variance = denoiser.bind(frame), frame.color, frame.variance
    assert variance is not None
    reference = pd.Probing(probes=truth_probes, replicates=2)
    found = pd.divergence_and_error(f, x, variance, method=reference, key=jax.random.key(1000))
    truth = np.asarray(found.divergence, np.float64)
    scale = (truth**2).mean()
    own = (np.asarray(found.standard_error, np.float64) ** 2).mean()
    rows = []
    for (name, count), method in methods(most).items():
        estimate = pd.divergence(f, x, variance, method=method, key=jax.random.key(1))
        square = ((np.asarray(estimate, np.float64) - truth) ** 2).mean() - own
        rows.append(
            (name, count, float(np.sqrt(max(square, 0) / scale)), float(np.sqrt(own / scale)))
        )
    return rows


def summary(rows: list[tuple]) -> str:
    """Medians over frames of the errors and of their ratio to the differences' error."""
    errors = {(r[0], int(r[1]), r[2], int(r[3])): float(r[4]) for r in rows}
    lines = []
    for name, count in sorted({(k[2], k[3]) for k in errors}, key=lambda k: (k[1], k[0])):
        frames = [k[:2] for k in errors if k[2:] == (name, count)]
        own = [errors[(*frame, name, count)] for frame in frames]
        ratio = [
            errors[(*frame, name, count)] / errors[(*frame, "differences", count)]
            for frame in frames
        ]
        target = TARGETS[count] if name == "probing" else ""
        lines.append(
            (
                count,
                name,
                *(float(f"{np.quantile(own, q):.3g}") for q in (0.25, 0.5, 0.75)),
                float(np.median(ratio)),
                target,
                len(frames),
            )
        )
    header = (
        "K",
        "method",
        "error, quartile",
        "median",
        "quartile",
        "ratio, median",
        "target",
        "frames",
    )
    return _common.markdown(header, lines)


def main() -> None:
    parser = _common.parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--spp", type=int, nargs="*", default=_common.SPP)
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--most", type=int, default=256, help="most probes of a method compared")
    parser.add_argument(
        "--truth", type=int, default=1024, help="probes that the true value is taken from"
    )
    parser.add_argument("--output", type=Path, default=HERE / "probes.csv")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    denoiser = pd.denoisers.load(arguments.denoiser)
    names = _common.scenes(arguments.data, arguments.scenes)
    rows: list[tuple] = []
    with arguments.output.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for spp in arguments.spp:
            for scene, _, frame, _ in _common.series(arguments.data, names, (spp,)):
                new = [
                    (scene, spp, *row)
                    for row in measure(frame, denoiser, arguments.truth, arguments.most)
                ]
                writer.writerows(new)
                file.flush()
                rows += new
                print(scene, spp, *(f"{r[2]} {r[3]}: {r[4]:.3g};" for r in new), flush=True)
    table = f"{_common.machine()}\n\n{summary(rows)}\n"
    arguments.output.with_suffix(".md").write_text(table)
    print(table)


if __name__ == "__main__":
    main()
