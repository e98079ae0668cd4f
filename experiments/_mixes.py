"""What the experiments on mixing share: the images, their errors, and shares of what an oracle could gain."""

import argparse
import functools
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

import progden_jax as pd
from experiments import _common
from progden_jax import metrics
from progden_jax.pipeline import DEFAULT_METHOD
from progden_jax.training.evaluation import oracle_alpha

METRICS = {"RMSE": metrics.rmse, "SMAPE": metrics.smape, "FLIP": metrics.flip}

GOALS = {"RMSE": 0.95, "SMAPE": 0.85, "FLIP": 0.90}
"""Shares of the oracle's gain over the denoiser, means over scenes and 32 to 512 spp."""

LEAST_SPP = 32
"""From here up the paper's averages begin."""

Errors = dict[tuple[str, int, str], dict[str, float]]
"""(scene, spp, image) -> metric -> error."""

HEADER = ("denoiser", "scene", "spp", "image", *METRICS)


class Seen(NamedTuple):
    """What a mixer is told of a frame: render, denoised image, variance, divergence and SURE, (H, W, 3)."""

    x: Float[Array, "h w 3"]
    y: Float[Array, "h w 3"]
    variance: Float[Array, "h w 3"]
    divergence: Float[Array, "h w 3"]
    sure: Float[Array, "h w 3"]


BOUND = pd.Bound()
"""The authors'."""


class Mix(NamedTuple):
    """A mixer, and the bound on its α; None: not bounded."""

    mixer: pd.Mixer
    bound: pd.Bound | None = BOUND


def parser(description: str | None, output: Path | None = None) -> argparse.ArgumentParser:
    """That of `_common` with --spp, and --output where the errors go to a file."""
    made = _common.parser(description)
    made.add_argument("--spp", type=int, nargs="*", default=_common.SPP)
    if output:
        made.add_argument("--output", type=Path, default=output, help="pictures go beside it")
    return made


def lean(frame: pd.Frame) -> pd.Frame:
    """The buffers that a denoiser takes and no more, so that one program serves all frames."""
    return pd.Frame(*(getattr(frame, n) for n in ("color", "variance", "albedo", "normal")))


@functools.partial(jax.jit, static_argnames="method")
def look(
    frame: pd.Frame,
    denoiser: pd.Denoiser,
    key: jax.Array,
    *,
    method: pd.Method = DEFAULT_METHOD,
) -> Seen:
    """The frame with its bad pixels repaired, denoised, and the estimates."""
    frame, _ = pd.repair(frame)
    assert frame.variance is not None
    f = denoiser.bind(frame)
    y, divergence, *_ = method.evaluate(f, frame.color, frame.variance, key)
    risk = pd.sure(frame.color, y, frame.variance, divergence)
    return Seen(frame.color, y, frame.variance, divergence, risk)


@jax.jit
def mix(
    seen: Seen, mixer: pd.Mixer, *, bound: pd.Bound | None = BOUND
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w 3"]]:
    """The mixed image and its α. Compiled once per structure of the mixer, whatever its weights."""
    x, y, variance, *_ = seen
    alpha = mixer(*seen)
    if bound is not None:
        alpha = bound(alpha, x, y, variance)
    return x + alpha * (y - x), alpha


@jax.jit
def oracle(seen: Seen, reference: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
    """The mix of least squared error against the reference, α constant over windows of 7×7."""
    return seen.x + oracle_alpha(seen.x, seen.y, reference) * (seen.y - seen.x)


def measure(
    denoiser: pd.Denoiser,
    mixes: Mapping[str, Mix],
    series: Iterable[tuple[str, int, pd.Frame, pd.Frame]],
) -> Errors:
    """The errors of render, denoised image, oracle and every mix on every render of a series."""
    found: Errors = {}
    for scene, spp, frame, reference in series:
        seen = look(lean(frame), denoiser, jax.random.key(0))
        images = {"render": seen.x, "denoised": seen.y, "oracle": oracle(seen, reference.color)}
        for name, (mixer, bound) in mixes.items():
            images[name], _ = mix(seen, mixer, bound=bound)
        for name, image in images.items():
            found[scene, spp, name] = errors(image, reference.color)
    return found


def errors(image: Array, reference: Array) -> dict[str, float]:
    """By metric."""
    return {label: float(metric(image, reference)) for label, metric in METRICS.items()}


def rows(denoiser: str, errors: Errors) -> list[tuple]:
    """For a CSV of `HEADER`."""
    return [(denoiser, *image, *values.values()) for image, values in errors.items()]


def by_spp(errors: Errors, image: str, label: str) -> dict[int, float]:
    """The means over scenes."""
    found = defaultdict(list)
    for (_, spp, name), values in errors.items():
        if name == image:
            found[spp].append(values[label])
    return {spp: float(np.mean(values)) for spp, values in sorted(found.items())}


def mean(errors: Errors, image: str, label: str) -> float:
    """Over scenes and the spp from `LEAST_SPP` up (of all, where there are none)."""
    means = by_spp(errors, image, label)
    return float(np.mean([m for s, m in means.items() if s >= min(LEAST_SPP, max(means))]))


def share(errors: Errors, image: str, label: str) -> str:
    """Of the oracle's gain over the denoiser."""
    denoised, found, most = (mean(errors, i, label) for i in ("denoised", image, "oracle"))
    return f"{(denoised - found) / (denoised - most):.1%}" if denoised != most else ""


def summary(errors: Errors, shown: Sequence[str]) -> str:
    """Errors relative to the denoiser's per spp, shares of the oracle's gain, and the worst frames."""
    parts = []
    for label, goal in GOALS.items():
        denoised = by_spp(errors, "denoised", label)
        lines = []
        for name in ("render", *shown, "oracle"):
            means = by_spp(errors, name, label)
            worst = worst_512 = 0.0
            for (scene, spp, image), values in errors.items():
                if image == name and spp >= 8:
                    best = min(errors[scene, spp, i][label] for i in ("render", "denoised"))
                    worst = max(worst, values[label] / best)
                if image == name and spp == 512:
                    worst_512 = max(worst_512, values[label] / errors[scene, spp, "render"][label])
            ratios = (float(f"{means[s] / denoised[s]:.4f}") for s in means)
            found = share(errors, name, label)
            lines.append((name, *ratios, found, f"{worst:.3f}", f"{worst_512:.3f}"))
        header = (
            f"{label} over the denoiser's",
            *(f"{s} spp" for s in denoised),
            f"of the oracle's gain, ≥ {LEAST_SPP} spp (goal {goal:.0%})",
            "worst over the better of both, ≥ 8 spp",
            "worst over the render, 512 spp",
        )
        parts.append(_common.markdown(header, lines))
    return "\n\n".join(parts)


COLORS = {
    "render": "tab:blue",
    "denoised": "tab:orange",
    "closed form": "tab:purple",
    "mix": "tab:green",
    "oracle": "gray",
}


def plot_over_spp(axis: Axes, errors: Errors, images: Sequence[str], label: str) -> None:
    """Means over scenes, log-log."""
    spps: list[int] = []
    for name in images:
        means = by_spp(errors, name, label)
        spps = list(means)
        style = ":" if name == "oracle" else "o-"
        axis.plot(spps, list(means.values()), style, color=COLORS[name], ms=4, label=name)
    axis.set(xscale="log", yscale="log", xlabel="samples per pixel", ylabel=label)
    axis.set_xticks(spps, labels=[str(s) for s in spps])
    axis.minorticks_off()
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.grid(alpha=0.3)
