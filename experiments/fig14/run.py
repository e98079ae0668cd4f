"""The scene of the most extreme variance: does the mix fall behind the render? (paper, Figure 14)

python -m experiments.fig14.run

The scene is the one with the largest variance of a pixel over the squared mean radiance of its image.
"""

from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common, _mixes
from experiments._mixes import Mix
from progden_jax import mixers
from progden_jax.sheet import Row, save_sheet

HERE = Path(__file__).parent
SHEET = (32, 512)
"""Samples per pixel of the rows of the sheet, and the most there are."""

IMAGES = ("render", "denoised", "closed form", "mix", "oracle")


def extremity(frame: pd.Frame) -> float:
    """The largest variance over the squared mean, both of the mean over channels."""
    frame, _ = pd.repair(frame)
    assert frame.variance is not None
    mean = np.asarray(frame.color, np.float64).mean()
    return float(np.asarray(frame.variance, np.float64).mean(-1).max() / mean**2)


def main() -> None:
    parser = _mixes.parser(__doc__, HERE / "fig14.csv")
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--at", type=int, default=32, help="spp that the scene is chosen at")
    arguments = parser.parse_args()
    names = _common.begin(arguments, arguments.denoiser)
    found = {
        s: extremity(f) for s, _, f, _ in _common.series(arguments.data, names, [arguments.at])
    }
    ranking = sorted(found, key=lambda s: -found[s])
    header = ("scene", f"largest variance over squared mean, {arguments.at} spp")
    print(_common.markdown(header, [(s, found[s]) for s in ranking]))
    scene = ranking[0]

    denoiser = pd.denoisers.load(arguments.denoiser)
    mixer = mixers.default_for(denoiser)
    mixes = {"closed form": Mix(pd.ClosedForm()), "mix": Mix(mixer)}
    series = list(_common.series(arguments.data, [scene], arguments.spp))
    errors = _mixes.measure(denoiser, mixes, series)
    rows, shown = [], []
    for _, spp, frame, _ in series:
        seen = _mixes.look(_mixes.lean(frame), denoiser, jax.random.key(0))
        z, alpha = _mixes.mix(seen, mixer)
        if spp in SHEET or spp == series[-1][1]:
            images = (np.asarray(a) for a in (seen.x, seen.y, z, alpha))
            rows.append(Row(f"{spp} spp", *images))
        for name in IMAGES:
            share = float(alpha.mean()) if name == "mix" else ""
            shown.append((spp, name, *errors[scene, spp, name].values(), share))
    print(f"\n## {scene}\n\n{_common.markdown(('spp', 'image', *_mixes.METRICS, 'mean α'), shown)}")

    _common.write_csv(arguments.output, _mixes.HEADER, _mixes.rows(arguments.denoiser, errors))
    save_sheet(
        arguments.output.with_name(f"{arguments.output.stem}-sheet.png"),
        rows,
        np.asarray(series[0][3].color),
        title=f"{scene}, the scene of the most extreme variance; {arguments.denoiser}",
    )
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    for axis, label in zip(figure.subplots(1, 3), _mixes.METRICS, strict=True):
        _mixes.plot_over_spp(axis, errors, IMAGES, label)
    figure.axes[0].legend()
    _common.save_figure(arguments.output.with_suffix(".png"), figure)


if __name__ == "__main__":
    main()
