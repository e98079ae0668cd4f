"""Window sizes of the t-bound, with and without the shift to the highest variance (paper, Figure 12).

python -m experiments.fig12.run
"""

from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common, _mixes
from experiments._mixes import Mix
from progden_jax import Bound, mixers
from progden_jax.sheet import display, exposure_for

HERE = Path(__file__).parent
WINDOWS = (3, 5, 7, 11, 15, 21)
UNBOUNDED = "not bounded"
SHOWN_SPP = 32
"""Of the pictures, as in the paper."""


def name(bound: Bound) -> str:
    return f"{bound.window}×{bound.window}{'' if bound.shift else ', no shift'}"


BOUNDS = [Bound(window=window, shift=shift) for shift in (True, False) for window in WINDOWS]


def plot(errors: _mixes.Errors, path: Path) -> None:
    """RMSE and SMAPE over those of the mix that is not bounded, over the window's width."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    for axis, label in zip(figure.subplots(1, 2), ("RMSE", "SMAPE"), strict=True):
        free = _mixes.by_spp(errors, UNBOUNDED, label)
        for number, spp in enumerate(free):
            for shift, style in ((True, "o-"), (False, "s--")):
                means = [
                    _mixes.by_spp(errors, name(Bound(window=w, shift=shift)), label)[spp]
                    for w in WINDOWS
                ]
                axis.plot(
                    WINDOWS,
                    np.asarray(means) / free[spp],
                    style,
                    color=f"C{number}",
                    ms=4,
                    label=f"{spp} spp{'' if shift else ', no shift'}",
                )
        axis.axhline(1, color="gray", linewidth=0.8)
        axis.set(xlabel="window, pixels", ylabel=f"{label} over that without a bound")
        axis.set_xticks(WINDOWS)
        axis.grid(alpha=0.3)
    figure.axes[1].legend(fontsize=7, ncols=2)
    _common.save_figure(path, figure)


def pictures(
    scene: str,
    frame: pd.Frame,
    reference: pd.Frame,
    denoiser: pd.Denoiser,
    mixer: pd.Mixer,
    path: Path,
) -> None:
    """The mixes of one render, a row with and one without shift; the reference and no bound beside them."""
    seen = _mixes.look(_mixes.lean(frame), denoiser, jax.random.key(0))
    truth = np.asarray(reference.color)
    exposure = exposure_for(truth)
    figure = Figure(figsize=(14, 4.6), layout="constrained")
    axes = figure.subplots(2, len(WINDOWS) + 1)
    free, _ = _mixes.mix(seen, mixer, bound=None)
    shown = [(axes[0, 0], UNBOUNDED, free), (axes[1, 0], "reference", truth)]
    for axis, bound in zip(axes[:, 1:].ravel(), BOUNDS, strict=True):
        shown.append((axis, name(bound), _mixes.mix(seen, mixer, bound=bound)[0]))
    for axis, title, image in shown:
        image = np.asarray(image)
        axis.imshow(display(image, exposure), interpolation="nearest")
        rmse = float(np.sqrt(np.mean((image - truth) ** 2)))
        axis.set_title(title if title == "reference" else f"{title}: {rmse:.4f}", fontsize=9)
        axis.set_axis_off()
    figure.suptitle(f"{scene}, {frame.spp or SHOWN_SPP} spp; RMSE")
    _common.save_figure(path, figure)


def main() -> None:
    parser = _mixes.parser(__doc__, HERE / "fig12.csv")
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--mixer", help="name or file; by default what is shipped for the denoiser")
    arguments = parser.parse_args()
    names = _common.begin(arguments, arguments.denoiser)
    denoiser = pd.denoisers.load(arguments.denoiser)
    chosen = arguments.mixer
    mixer = mixers.load(chosen) if chosen else mixers.default_for(denoiser)
    mixes = {UNBOUNDED: Mix(mixer, None)} | {name(b): Mix(mixer, b) for b in BOUNDS}
    series = _common.series(arguments.data, names, arguments.spp)
    errors = _mixes.measure(denoiser, mixes, series)
    _common.write_csv(arguments.output, _mixes.HEADER, _mixes.rows(arguments.denoiser, errors))
    plot(errors, arguments.output.with_suffix(".png"))
    print(_mixes.summary(errors, list(mixes)))

    # The scene on which the shift weighs most.
    with_, without = (name(Bound(shift=shift)) for shift in (True, False))
    spp = SHOWN_SPP if SHOWN_SPP in arguments.spp else max(arguments.spp)
    ratios = {s: errors[s, spp, without]["RMSE"] / errors[s, spp, with_]["RMSE"] for s in names}
    scene = max(names, key=lambda s: abs(np.log(ratios[s])))
    _, _, frame, reference = next(_common.series(arguments.data, [scene], [spp]))
    beside = arguments.output.with_name(f"{arguments.output.stem}-pictures.png")
    pictures(scene, frame.replace(spp=spp), reference, denoiser, mixer, beside)
    print(
        f"\npictures: {scene} at {spp} spp, RMSE without the shift over with: {ratios[scene]:.4f}"
    )


if __name__ == "__main__":
    main()
