"""Convergence: error over spp of render, denoiser and mixes (paper, Figure 10).

python -m experiments.fig10.run
"""

import itertools
from pathlib import Path

from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common, _mixes
from experiments._mixes import Mix
from progden_jax import mixers

HERE = Path(__file__).parent
IMAGES = ("render", "denoised", "closed form", "mix", "oracle")


def slopes(errors: _mixes.Errors) -> str:
    """Errors per spp, and what is left of them each time the samples are quadrupled."""
    lines = []
    for label in _mixes.METRICS:
        for name in IMAGES:
            means = list(_mixes.by_spp(errors, name, label).values())
            ratios = " ".join(f"{b / a:.2f}" for a, b in itertools.pairwise(means))
            lines.append((label, name, *means, ratios))
    spps = (f"{s} spp" for s in _mixes.by_spp(errors, "render", "RMSE"))
    return _common.markdown(("error", "image", *spps, "over the one before"), lines)


def plot(found: dict[str, _mixes.Errors], path: Path) -> None:
    """A row per denoiser, a column per metric."""
    figure = Figure(figsize=(12, 3.7 * len(found)), layout="constrained")
    axes = figure.subplots(len(found), len(_mixes.METRICS), squeeze=False)
    for line, (which, errors) in zip(axes, found.items(), strict=True):
        for axis, label in zip(line, _mixes.METRICS, strict=True):
            _mixes.plot_over_spp(axis, errors, IMAGES, label)
            axis.set_title(which)
    axes[0, 0].legend()
    _common.save_figure(path, figure)


def main() -> None:
    parser = _mixes.parser(__doc__, HERE / "fig10.csv")
    parser.add_argument("--denoisers", nargs="*", default=("oidn-hdr", "oidn-hdr-alb-nrm"))
    arguments = parser.parse_args()
    names = _common.begin(arguments)
    found: dict[str, _mixes.Errors] = {}
    for which in arguments.denoisers:
        denoiser = pd.denoisers.load(which)
        mixes = {"closed form": Mix(pd.ClosedForm()), "mix": Mix(mixers.default_for(denoiser))}
        series = _common.series(arguments.data, names, arguments.spp)
        found[which] = _mixes.measure(denoiser, mixes, series)
        print(f"## {which}\n\n{slopes(found[which])}\n", flush=True)
    rows = [row for which, errors in found.items() for row in _mixes.rows(which, errors)]
    _common.write_csv(arguments.output, _mixes.HEADER, rows)
    plot(found, arguments.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
