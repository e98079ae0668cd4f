"""Does the mix beat render and denoiser, and does SURE tell the denoiser's error?

python -m experiments.main_job.run
"""

from collections import defaultdict

import jax
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax import metrics

DENOISERS = {"OIDN HDR": "oidn-hdr", "OIDN HDR+ALB+NRM": "oidn-hdr-alb-nrm"}
METRICS = {
    "RMSE": metrics.rmse,
    "SMAPE": metrics.smape,
    "FLIP": metrics.flip,
    "relMSE": metrics.relmse,
}
FIREFLY_SHARE = 0.04
"""A render has fireflies if 0.1 % of its values hold more than this share of its summed variance."""


def measure(images: dict[str, jax.Array], reference: jax.Array) -> dict[str, dict[str, float]]:
    return {
        name: {label: float(metric(image, reference)) for label, metric in METRICS.items()}
        for name, image in images.items()
    }


def firefly_share(variance: np.ndarray) -> float:
    """The share of the summed variance that its largest 0.1 % hold."""
    ordered = np.sort(np.asarray(variance, np.float64).ravel())[::-1]
    return float(ordered[: max(1, ordered.size // 1000)].sum() / ordered.sum())


def main() -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--probes", type=int, default=1)
    arguments = parser.parse_args()
    method = pd.MonteCarlo(probes=arguments.probes)
    names = _common.begin(arguments, f"divergence by {method}")

    for title, denoiser_name in DENOISERS.items():
        denoiser = pd.denoisers.load(denoiser_name)
        table = defaultdict(list)
        worst, risks = defaultdict(list), []
        for scene, spp, frame, reference in _common.series(arguments.data, names):
            result = pd.progressive_denoise(frame, denoiser, method=method)
            images = {"render": frame.color, "denoised": result.denoised, "mix": result.image}
            measured = measure(images, reference.color)
            for name, values in measured.items():
                table[spp, name].append([values[label] for label in METRICS])
            best = min(measured["render"]["RMSE"], measured["denoised"]["RMSE"])
            worst[spp].append((measured["mix"]["RMSE"] / best, scene))
            if spp >= 128:
                assert reference.variance is not None
                error = (result.denoised - reference.color) ** 2 - reference.variance
                per_pixel = np.asarray(result.sure).mean(-1)
                truth = float(error.mean())
                risks.append(
                    (
                        scene,
                        spp,
                        firefly_share(np.asarray(frame.variance)),
                        truth,
                        float(per_pixel.mean()) / truth,
                        float(per_pixel.std() / np.sqrt(per_pixel.size)) / truth,
                    )
                )
        print(f"## {title}, mean over scenes\n")
        rows = [
            (spp, name, *(float(v) for v in np.mean(table[spp, name], axis=0)))
            for spp in sorted({spp for spp, _ in table})
            for name in ("render", "denoised", "mix")
        ]
        print(_common.markdown(("spp", "image", *METRICS), rows))
        print("\nRMSE of the mix over the better of render and denoised, worst scene:\n")
        print(
            _common.markdown(
                ("spp", "ratio", "scene"), [(spp, *max(w)) for spp, w in worst.items()]
            )
        )
        print("\nMean SURE over true MSE (the reference's own variance taken off):\n")
        header = (
            "scene",
            "spp",
            "share of 0.1 %",
            "true MSE",
            "ratio",
            "± from pixels",
            "fireflies",
        )
        print(
            _common.markdown(
                header,
                [
                    (*row, "yes" if row[2] > FIREFLY_SHARE else "no")
                    for row in sorted(risks, key=lambda r: r[2])
                ],
            )
        )
        print()


if __name__ == "__main__":
    main()
