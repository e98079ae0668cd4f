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

    from progden_jax.adaptation.correction import Params
    from progden_jax.cli._job import Outcome, Progress
    from progden_jax.denoisers import Denoiser
    from progden_jax.exr import Settings
    from progden_jax.frame import Frame
    from progden_jax.subaverages import SubAverages

NFOR = "nfor"

FITTED_SURE = (
    "SURE is too low behind a denoiser that was fitted to the same noise: it tells where the image is poor, "
    "not how good it is"
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
            help="Two independent renders of half the samples, for --post-correct and --denoiser nfor; for a "
            "--combiner of sub-averages as many as it takes. IN is their mean, or one of them: then their "
            "mean is denoised. For several inputs, folders that hold files of the same names [default: IN, "
            "split by its variance].",
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
        self._check_halves(read, network)
        if cost.max_memory is not None and (self.fits or self.halves):
            raise UsageError(
                "--max-memory cuts images into parts, and --adapt, --post-correct and --halves need them "
                "whole: leave it out."
            )

    def _check_halves(self, read: ReadOptions, network: NetworkOptions) -> None:
        named = self.halves or ()
        count, expected = len(named), max(network.sub_averages, 2)
        if network.sub_averages > 1:
            if self.fits:
                raise UsageError(
                    f"--combiner {network.combiner} combines sub-averages, and --adapt and --post-correct "
                    "fit to one image: leave one out."
                )
            if self.halves is None:
                raise UsageError(
                    f"--combiner {network.combiner} combines {expected} sub-averages of the samples: name as "
                    "many renders with --halves."
                )
        if self.halves is None:
            return
        if count != expected:
            raise UsageError(
                f"--halves names {count} renders, expected {expected}, after IN and before other flags."
            )
        if len({path.resolve() for path in named}) < count:
            raise UsageError("--halves names one render twice, expected independent ones.")
        if network.sub_averages == 1:
            self._check_takers(network)
        if read.variance_from:
            raise UsageError(
                "--halves and --variance-from both name other renders, and both give a variance: give one."
            )

    def _check_takers(self, network: NetworkOptions) -> None:
        if self.adapt:
            raise UsageError(
                "--adapt fits to the whole render, --halves are for --post-correct alone: leave one out."
            )
        if not self.post_correct and network.denoiser != NFOR:
            raise UsageError(
                "--halves are for --post-correct, --denoiser nfor and combiners of sub-averages; for the "
                "variance alone give --variance-from."
            )
        if network.combiner and not self.post_correct:
            raise UsageError(
                "--halves go to --denoiser nfor itself, and --combiner puts another behind it: leave one out."
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


def read_parts(item: Item, frame: "Frame", read: "Settings", outcome: "Outcome") -> "SubAverages":
    """The renders of which the item's frame is the mean, or of which it is one; bad pixels stay.

    Raises
    ------
    Failure
        If it is neither.
    ValueError
        If a file cannot be read, or sizes differ.
    """
    import numpy as np

    from progden_jax.exr import read_exr
    from progden_jax.exr._statistics import are_halves, uncertainty
    from progden_jax.subaverages import averaged

    count = len(item.halves)
    is_part = any(item.input.samefile(other) for other in item.halves if other.exists())
    spp = read.get("spp")
    if spp is not None and not is_part:
        spp /= count
    parts = [read_exr(other, **{**read, "spp": spp}) for other in item.halves]
    found = averaged(parts, names=[str(other) for other in item.halves])
    colors, shares = [np.asarray(part.color) for part in parts], np.asarray(found.shares)
    if any(part.variance is None for part in parts) and (is_part or frame.variance is None):
        outcome.variance = f"{count} sub-averages"
        outcome.warnings += uncertainty(count)
    if is_part:
        outcome.spp = None if found.frame.spp is None else float(found.frame.spp)
        mean = np.tensordot(shares, np.stack(colors), 1)
        return found._replace(frame=found.frame.replace(color=mean))
    if frame.size != found.frame.size or not are_halves(np.asarray(frame.color), colors, shares):
        raise Failure(
            f"{item.input}: --halves {' '.join(map(str, item.halves))}: the input is neither their mean nor "
            f"one of them; give {count} renders that share its samples."
        )
    variance = found.frame.variance if frame.variance is None else frame.variance
    kept = {name: d for name, d in found.differences.items() if getattr(frame, name) is not None}
    return found._replace(frame=frame.replace(variance=variance), differences=kept)


def adapted(
    frame: "Frame",
    denoiser: "Denoiser",
    parts: "SubAverages | None",
    options: AdaptOptions,
    key: "jax.Array",
    handed: Handed,
    outcome: "Outcome",
    progress: "Progress",
) -> "Denoiser":
    """The denoiser as the flags have it, fitted to the frame; what was done is told in `outcome`."""
    import jax

    from progden_jax import adaptation
    from progden_jax.combiner import BufferedCombiner, DeepCombiner
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
        if parts is None:
            both = adaptation.split(frame, split_key)
        else:
            both = adaptation.paired(parts)
            # A buffer that was prefiltered has no noise left to differ by.
            same = (n for n in both.difference if getattr(frame, n) is getattr(parts.frame, n))
            both = adaptation.Halves(repaired(frame), {n: both.difference[n] for n in same})
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
            "halves": "split by the variance" if parts is None else "given",
            "reused": handed.params is not None,
        }
        denoiser = corrected.denoiser
        handed.take(denoiser, options)
    elif parts is None:
        return denoiser
    elif isinstance(denoiser, DeepCombiner):
        return BufferedCombiner.of(denoiser, parts)
    else:
        return adaptation.WithHalves(denoiser, adaptation.paired(parts).difference["color"])
    outcome.adaptation["seconds"] = round(time.perf_counter() - start, 3)
    return denoiser


def described(found: dict[str, Any]) -> str:
    """What was done, for people."""
    done = "adapted" if found["kind"] == "sure" else "post-corrected"
    if found["kind"] != "post-correct" and found["risk_after"] == found["risk_before"]:
        return f"not {done}, as no gain was sure"
    return f"{done} in {found['steps']} steps"
