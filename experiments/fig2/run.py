"""Error and what is estimated of it without a reference, over spp (paper, Figure 2).

python -m experiments.fig2.run

The render's error is estimated by its variance, the denoised image's by SURE, and the mix's by SURE of
the whole chain: the derivative goes through denoiser, divergence, mixer and bound. "α held" leaves the
derivative of α out, as the closed form does.
"""

import argparse
import functools
from collections import defaultdict
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

import progden_jax as pd
from experiments import _common, _mixes
from experiments._mixes import Seen
from progden_jax import mixers
from progden_jax.pipeline import DEFAULT_METHOD
from progden_jax.training.losses import mix_risk

HERE = Path(__file__).parent
HEADER = ("denoiser", "scene", "spp", "image", "mse", "estimate")
COLORS = {"render": "tab:blue", "denoised": "tab:orange", "mix": "tab:green"}
HELD = "mix, α held"


@functools.partial(jax.jit, static_argnames="probes")
def risks(
    frame: pd.Frame, seen: Seen, denoiser: pd.Denoiser, mixer: pd.Mixer, *, probes: int
) -> dict[str, Float[Array, ""]]:
    """Image -> the estimate of its mean squared error."""
    frame, _ = pd.repair(frame)
    x, y, variance, divergence, risk = seen
    f = denoiser.bind(frame)

    def whole(color: Array) -> Array:
        y, divergence, *_ = DEFAULT_METHOD.evaluate(f, color, variance, jax.random.key(0))
        risk = pd.sure(color, y, variance, divergence)
        return _mixes.mix(Seen(color, y, variance, divergence, risk), mixer)[0]

    method = pd.MonteCarlo(probes=probes)
    z, along, *_ = method.evaluate(whole, x, variance, jax.random.key(1))
    _, alpha = _mixes.mix(seen, mixer)
    return {
        "render": variance.mean(),
        "denoised": risk.mean(),
        "mix": pd.sure(x, z, variance, along).mean(),
        HELD: mix_risk(alpha, x, y, variance, divergence).mean(),
    }


def measure(
    which: str, mixer: pd.Mixer, names: list[str], arguments: argparse.Namespace
) -> list[tuple]:
    """Rows of `HEADER`; the oracle's error has no estimate."""
    denoiser, lines = pd.denoisers.load(which), []
    for scene, spp, frame, reference in _common.series(arguments.data, names, arguments.spp):
        frame = _mixes.lean(frame)
        seen = _mixes.look(frame, denoiser, jax.random.key(0))
        found = risks(frame, seen, denoiser, mixer, probes=arguments.probes)
        z, _ = _mixes.mix(seen, mixer)
        truth = reference.color
        images = {"render": seen.x, "denoised": seen.y, "mix": z, HELD: z}
        images["oracle"] = _mixes.oracle(seen, truth)
        noise = 0.0 if reference.variance is None else float(reference.variance.mean())
        for name, image in images.items():
            mse = float(((image - truth) ** 2).mean()) - noise
            lines.append((which, scene, spp, name, mse, float(found.get(name, np.nan))))
    return lines


def table(lines: list[tuple]) -> str:
    """Medians and ranges over scenes of estimate over truth, and RMSE (root of the mean over scenes)."""
    groups: dict[tuple[int, str], list[tuple[float, float]]] = defaultdict(list)
    for _, _, spp, image, mse, estimate in lines:
        groups[spp, image].append((mse, estimate))
    found = []
    for (spp, image), pairs in sorted(groups.items(), key=lambda g: g[0][0]):
        mse, estimate = np.asarray(pairs).T
        ratio = estimate / mse
        known = not np.isnan(ratio).any()
        spread = f"{np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f})"
        negative = int((estimate < 0).sum())
        found.append(
            (
                *(spp, image, float(np.sqrt(mse.mean()))),
                *((spread, f"{negative} of {len(ratio)}") if known else ("", "")),
            )
        )
    header = ("spp", "image", "RMSE", "estimated over true MSE: median (range)", "negative")
    return _common.markdown(header, found)


def plot(lines: list[tuple], path: Path) -> None:
    """Per scene RMSE over spp, and its estimate dashed where that is positive."""
    scenes = sorted({line[1] for line in lines})
    columns = min(4, len(scenes))
    count = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.4 * columns, 3.1 * count), layout="constrained")
    axes = figure.subplots(count, columns, squeeze=False, sharex=True).ravel()
    for axis, scene in zip(axes, scenes, strict=False):
        for image, color in COLORS.items():
            own = [x for x in lines if (x[1], x[3]) == (scene, image)]
            spp, mse, estimate = np.asarray([(x[2], *x[4:]) for x in own]).T
            axis.plot(spp, np.sqrt(np.maximum(mse, 0)), "o-", color=color, ms=3, label=image)
            shown = np.sqrt(np.where(estimate > 0, estimate, np.nan))
            axis.plot(spp, shown, "x--", color=color, label=f"{image}, estimate")
        axis.set(xscale="log", yscale="log", title=scene)
        spps = sorted({x[2] for x in lines})
        axis.set_xticks(spps, labels=[str(n) for n in spps])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    for axis in axes[len(scenes) :]:
        axis.set_axis_off()
    figure.supxlabel("samples per pixel")
    figure.supylabel("RMSE")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=6, fontsize=8)
    _common.save_figure(path, figure)


def main() -> None:
    parser = _mixes.parser(__doc__, HERE / "fig2.csv")
    parser.add_argument("--denoisers", nargs="*", default=("oidn-hdr", "oidn-hdr-alb-nrm"))
    parser.add_argument("--probes", type=int, default=4, help="of the mix's derivative")
    arguments = parser.parse_args()
    names = _common.begin(arguments)
    every = []
    for which in arguments.denoisers:
        mixer = mixers.default_for(pd.denoisers.load(which))
        lines = measure(which, mixer, names, arguments)
        every += lines
        _common.write_csv(arguments.output, HEADER, every)
        picture = arguments.output.with_name(f"{arguments.output.stem}-{Path(which).stem}.png")
        plot(lines, picture)
        print(f"## {which}\n\n{table(lines)}\n", flush=True)


if __name__ == "__main__":
    main()
