"""What mixing gains over OIDN, beside the closed form and what an oracle could gain (paper, Table 3).

python -m experiments.table3.run [--mixers NAME_OR_FILE ...]
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax import metrics, mixers
from progden_jax.training.evaluation import oracle_alpha

METRICS = {"RMSE": metrics.rmse, "SMAPE": metrics.smape, "FLIP": metrics.flip}
WINDOWS = (7, 15, 31)
"""Of the paper's closed form; the best of them is what a mixer must beat."""

Errors = dict[tuple[str, int, str], dict[str, float]]
"""(scene, spp, image) -> metric -> error."""


GOALS = {"RMSE": 0.95, "SMAPE": 0.85, "FLIP": 0.90}
"""Shares of the oracle's gain over the denoiser, means over scenes and 32 to 512 spp."""


@jax.jit
def images(
    frame: pd.Frame, reference: jax.Array, denoiser: pd.Denoiser, others: Mapping[str, pd.Mixer]
) -> dict[str, jax.Array]:
    """The render, the denoised image, the oracle's mix, and each mixer's with its t-bound."""
    frame, _ = pd.repair(frame)
    x, variance = frame.color, frame.variance
    assert variance is not None
    f, one = denoiser.bind(frame), pd.MonteCarlo(probes=1)
    y = f(x)
    divergence = pd.divergence(f, x, variance, method=one, key=jax.random.key(0))
    risk = pd.sure(x, y, variance, divergence)
    found = {"render": x, "denoised": y, "oracle": x + oracle_alpha(x, y, reference) * (y - x)}
    for name, mixer in others.items():
        alpha = mixer(x, y, variance, divergence, risk)
        found[name] = x + pd.t_bound(alpha, x, y, variance) * (y - x)
    return found


def measure(
    denoiser: pd.Denoiser,
    others: Mapping[str, pd.Mixer],
    series: Iterable[tuple[str, int, pd.Frame, pd.Frame]],
) -> Errors:
    """Every image's errors on every render of a series."""
    errors: Errors = {}
    for scene, spp, frame, reference in series:
        # One structure for all frames, so that one program serves them.
        frame = pd.Frame(*(getattr(frame, n) for n in ("color", "variance", "albedo", "normal")))
        for name, image in images(frame, reference.color, denoiser, dict(others)).items():
            errors[scene, spp, name] = {
                label: float(metric(image, reference.color)) for label, metric in METRICS.items()
            }
    return errors


def by_spp(errors: Errors, image: str, label: str) -> dict[int, float]:
    """The means over scenes."""
    found = defaultdict(list)
    for (_, spp, name), values in errors.items():
        if name == image:
            found[spp].append(values[label])
    return {spp: float(np.mean(values)) for spp, values in sorted(found.items())}


def summary(errors: Errors, shown: Sequence[str]) -> str:
    """Errors relative to the denoiser's per spp, shares of the oracle's gain, and the worst frames."""
    parts = []
    for label, goal in GOALS.items():
        denoised, oracle = by_spp(errors, "denoised", label), by_spp(errors, "oracle", label)
        rows = []
        for name in ("render", *shown, "oracle"):
            means = by_spp(errors, name, label)
            high = [spp for spp in means if spp >= 32]
            gain, most = (
                sum(denoised[s] for s in high) - sum(m[s] for s in high) for m in (means, oracle)
            )
            worst = worst_512 = 0.0
            for (scene, spp, image), values in errors.items():
                if image == name and spp >= 8:
                    best = min(errors[scene, spp, i][label] for i in ("render", "denoised"))
                    worst = max(worst, values[label] / best)
                if image == name and spp == 512:
                    worst_512 = max(worst_512, values[label] / errors[scene, spp, "render"][label])
            ratios = (float(f"{means[s] / denoised[s]:.4f}") for s in means)
            share = f"{gain / most:.1%}" if most else ""
            rows.append((name, *ratios, share, f"{worst:.3f}", f"{worst_512:.3f}"))
        spps = [f"{s} spp" for s in denoised]
        header = (
            f"{label} over the denoiser's",
            *spps,
            f"of the oracle's gain, ≥ 32 spp (goal {goal:.0%})",
            "worst over the better of both, ≥ 8 spp",
            "worst over the render, 512 spp",
        )
        parts.append(_common.markdown(header, rows))
    return "\n\n".join(parts)


def main() -> None:
    parser = _common.parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--denoisers", nargs="*", default=("oidn-hdr", "oidn-hdr-alb-nrm"))
    parser.add_argument("--mixers", nargs="*", help="names or files; by default what is shipped")
    parser.add_argument("--spp", type=int, nargs="*", default=_common.SPP)
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    print(_common.machine())
    names = _common.scenes(arguments.data, arguments.scenes)
    print(f"{len(names)} scenes of {arguments.data}\n")
    for which in arguments.denoisers:
        denoiser = pd.denoisers.load(which)
        chosen = arguments.mixers or ([which] if which in mixers.names() else [])
        others: dict[str, pd.Mixer] = {"closed form": pd.ClosedForm()}
        others |= {f"paper's closed form, {w}×{w}": pd.ClosedForm(w, 0.0) for w in WINDOWS}
        others |= {f"mix by {name}": pd.load_mixer(name) for name in chosen}
        series = _common.series(arguments.data, names, arguments.spp)
        errors = measure(denoiser, others, series)
        print(f"## {which}\n\n{summary(errors, list(others))}\n", flush=True)


if __name__ == "__main__":
    main()
