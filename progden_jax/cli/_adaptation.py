"""Denoisers fitted to the file at hand: the flags, and what they do."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from progden_jax.cli._options import CostOptions, NetworkOptions, ReadOptions
from progden_jax.cli._paths import Item
from progden_jax.cli._run import Failure, UsageError

if TYPE_CHECKING:
    import jax

    from progden_jax.adaptation import Halves
    from progden_jax.adaptation.correction import Params
    from progden_jax.cli._job import Outcome, Progress
    from progden_jax.denoisers import Denoiser
    from progden_jax.exr import Settings
    from progden_jax.frame import Frame

NFOR = "nfor"

FITTED_SURE = (
    "SURE is too low behind a denoiser that was fitted to the same noise: by up to 96 % at 128 samples per "
    "pixel, where it was measured"
)


@Parameter(name="*", group="Adaptation to the render")
@dataclass(frozen=True)
class AdaptOptions:
    """Whether the denoiser learns from the render first, without a reference; it takes minutes."""

    adapt: Annotated[
        bool,
        Parameter(
            help="Fit the network's weights to the render, by Stein's estimate of its error."
        ),
    ] = False
    post_correct: Annotated[
        bool,
        Parameter(
            help="Repair the denoised image by a small network that learns from two halves of the render "
            "(Back et al. 2022); with --adapt from the whole, by Stein's estimate. SURE is too low behind "
            "either."
        ),
    ] = False
    halves: Annotated[
        tuple[Path, ...] | None,
        Parameter(
            consume_multiple=True,
            help="Two independent renders of half the samples, for --post-correct and --denoiser nfor. IN is "
            "their mean, or one of them: then their mean is denoised. For several inputs, folders that hold "
            "files of the same names [default: IN, split by its variance].",
        ),
    ] = None
    adapt_steps: Annotated[
        int | None,
        Parameter(
            help="Steps of fitting [default: 100 at most; 20 epochs of --post-correct alone, at least 80]."
        ),
    ] = None
    sequence: Annotated[
        bool,
        Parameter(
            help="The inputs are frames of an animation, in this order: --post-correct goes on from the "
            "weights of the frame before."
        ),
    ] = False

    @property
    def fits(self) -> bool:
        """Whether anything is fitted."""
        return self.adapt or self.post_correct

    def check(self, read: ReadOptions, network: NetworkOptions, cost: CostOptions) -> None:
        """Raise UsageError for what is wrong whatever the files hold."""
        if self.adapt and not self.post_correct and network.denoiser == NFOR:
            raise UsageError(
                "--adapt fits a network's weights, and --denoiser nfor has none: add --post-correct."
            )
        if self.adapt_steps is not None and not self.fits:
            raise UsageError("--adapt-steps is for --adapt or --post-correct: give one of them.")
        if self.adapt_steps is not None and self.adapt_steps < 1:
            raise UsageError(f"--adapt-steps is {self.adapt_steps}, expected at least 1.")
        if self.sequence and not self.post_correct:
            raise UsageError("--sequence is for --post-correct, which hands its weights on.")
        if self.halves is not None:
            self._check_halves(read, network)
        if cost.max_memory is not None and (self.fits or self.halves):
            raise UsageError(
                "--max-memory cuts images into parts, and --adapt, --post-correct and --halves need them "
                "whole: leave it out."
            )

    def _check_halves(self, read: ReadOptions, network: NetworkOptions) -> None:
        if len(self.halves or ()) != 2:
            raise UsageError(
                f"--halves names {len(self.halves or ())} renders, expected two, after IN and before other "
                "flags."
            )
        if self.adapt:
            raise UsageError(
                "--adapt fits to the whole render, --halves are for --post-correct alone: leave one out."
            )
        if not self.post_correct and network.denoiser != NFOR:
            raise UsageError(
                "--halves are for --post-correct and --denoiser nfor; for the variance alone give "
                "--variance-from."
            )
        if network.combiner and not self.post_correct:
            raise UsageError(
                "--halves go to --denoiser nfor itself, and --combiner puts another behind it: leave one out."
            )
        if read.variance_from:
            raise UsageError(
                "--halves and --variance-from both name other renders, and both give a variance: give one."
            )


class Handed:
    """What one frame of a sequence leaves to the next: the correction's weights."""

    def __init__(self) -> None:
        self.params: Params | None = None

    def take(self, denoiser: "Denoiser", options: AdaptOptions) -> None:
        """What is to be handed on: in a sequence, and where there is a correction."""
        from progden_jax.adaptation import PostCorrected

        self.params = None
        if options.sequence and isinstance(denoiser, PostCorrected):
            self.params = denoiser.params


def read_halves(item: Item, frame: "Frame", read: "Settings", outcome: "Outcome") -> "Halves":
    """The two renders of which the item's frame is the mean, or of which it is one; bad pixels stay.

    Raises
    ------
    Failure
        If it is neither.
    ValueError
        If a file cannot be read, or sizes or samples per pixel differ.
    """
    import numpy as np

    from progden_jax import adaptation
    from progden_jax.exr import read_exr
    from progden_jax.exr._statistics import are_halves

    is_half = any(item.input.samefile(other) for other in item.halves if other.exists())
    spp = read.get("spp")
    if spp is not None and not is_half:
        spp /= 2
    a, b = (read_exr(other, **{**read, "spp": spp}) for other in item.halves)
    found = adaptation.halves(a, b)
    if (a.variance is None or b.variance is None) and (is_half or frame.variance is None):
        outcome.variance = "two halves"
        outcome.warnings.append(
            "a variance from 2 renders is itself off by about 141 % at every pixel"
        )
    if is_half:
        outcome.spp = None if found.frame.spp is None else float(found.frame.spp)
        return found._replace(frame=found.frame.replace(color=(a.color + b.color) / 2))
    colors = [np.asarray(half.color) for half in (frame, a, b)]
    if frame.size != a.size or not are_halves(colors[0], colors[1:]):
        raise Failure(
            f"{item.input}: --halves {' '.join(map(str, item.halves))}: the input is neither their mean nor "
            "one of them; give two renders of half its samples each."
        )
    variance = found.frame.variance if frame.variance is None else frame.variance
    kept = {name: d for name, d in found.difference.items() if getattr(frame, name) is not None}
    return adaptation.Halves(frame.replace(variance=variance), kept)


def adapted(
    frame: "Frame",
    denoiser: "Denoiser",
    halves: "Halves | None",
    options: AdaptOptions,
    key: "jax.Array",
    handed: Handed,
    outcome: "Outcome",
    progress: "Progress",
) -> "Denoiser":
    """The denoiser as the flags have it, fitted to the frame; what was done is told in `outcome`."""
    import jax

    from progden_jax import adaptation
    from progden_jax.frame import repaired

    start = time.perf_counter()
    steps = options.adapt_steps
    if options.adapt:
        how: dict[str, Any] = {
            "adaptation": None if steps is None else adaptation.Adaptation(steps=steps),
            "key": key,
            "progress": lambda done, total: progress(done, total, of="the adaptation"),
        }
        if options.post_correct:
            found = adaptation.correct_by_sure(
                frame, denoiser, correction=adaptation.PostCorrection(), start=handed.params, **how
            )
        else:
            found = adaptation.adapt(frame, denoiser, **how)
        outcome.adaptation = {
            "kind": "sure-correct" if options.post_correct else "sure",
            "steps": found.step,
            "risk_before": found.before,
            "risk_after": found.after,
            "risk_error": found.error,
        }
        denoiser = found.adapted
        if options.post_correct:
            outcome.adaptation["reused"] = handed.params is not None
            handed.take(denoiser, options)
    elif options.post_correct:
        split_key, fit_key = jax.random.split(key)
        if halves is None:
            both = adaptation.split(frame, split_key)
        else:
            # A buffer that was prefiltered has no noise left to differ by.
            same = (n for n in halves.difference if getattr(frame, n) is getattr(halves.frame, n))
            both = adaptation.Halves(repaired(frame), {n: halves.difference[n] for n in same})
        corrected = adaptation.post_correct(
            both,
            denoiser,
            correction=adaptation.PostCorrection(steps=steps),
            start=handed.params,
            key=fit_key,
            progress=lambda done, total: progress(done, total, of="the post-correction"),
        )
        outcome.adaptation = {
            "kind": "post-correct",
            "steps": len(corrected.losses),
            "halves": "split by the variance" if halves is None else "given",
            "reused": handed.params is not None,
        }
        denoiser = corrected.denoiser
        handed.take(denoiser, options)
    elif halves is not None:
        return adaptation.WithHalves(denoiser, halves.difference["color"])
    else:
        return denoiser
    outcome.adaptation["seconds"] = round(time.perf_counter() - start, 3)
    return denoiser


def described(found: dict[str, Any]) -> str:
    """What was done, for people."""
    done = "adapted" if found["kind"] == "sure" else "post-corrected"
    if found["kind"] != "post-correct" and found["risk_after"] == found["risk_before"]:
        return f"not {done}, as no gain was sure"
    return f"{done} in {found['steps']} steps"
