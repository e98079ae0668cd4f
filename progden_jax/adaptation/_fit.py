"""Weights fitted to one noisy image by Stein's estimate of the error.

An estimate that is made small is no longer unbiased: weights come to follow the noise that it rests on. So
the image is cut into blocks of three kinds, drawn at random. The loss is taken in the first alone, where
to stop is chosen in the second, and the gain is told from the third; the last two with probes of their own,
the same ones at all times, so that only the weights differ.
"""

import dataclasses
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from progden_jax import _checks
from progden_jax._program import checked_variance
from progden_jax.adaptation import _blocks, _leaves
from progden_jax.adaptation._descent import Task, Weights, descent, risks, task_of
from progden_jax.adaptation._running import Progress, generator
from progden_jax.frame import Frame, repaired

_RATE = 1e-4
"""Of weights that were trained."""


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """How weights are fitted.

    Parameters
    ----------
    steps : of Adam, at most.
    rate : its learning rate; None: 1e-4, and 2e-3 for `correct_by_sure`, which starts from nothing.
    only : names of layers or attributes to change, such as ("dec_conv1a", "dec_conv0") of a U-Net;
        none stands for all weights.
    crop : edge in pixels of the part that a step looks at, if the image is larger; memory grows with it.
    block : edge in pixels of the blocks that are kept apart.
    every : steps between looks at the blocks that choose.
    patience : looks without a new best after which it stops.
    confidence : by how many standard errors those blocks must be better off for the weights to
        be changed at all.
    probes : of the divergence, each time.
    covariance : whether the estimate counts the noise that a pixel's channels share. Else weights learn to
        take each channel's noise from the others, unseen.
    """

    steps: int = 100
    rate: float | None = None
    only: tuple[str, ...] = ()
    crop: int = 256
    block: int = 16
    every: int = 10
    patience: int = 4
    confidence: float = 1.0
    probes: int = 1
    covariance: bool = True

    def __post_init__(self) -> None:
        for name in ("steps", "crop", "block", "every", "patience", "probes"):
            _checks.positive_int(name, getattr(self, name))
        if self.rate is not None and not 0 < self.rate < math.inf:
            raise ValueError(f"rate is {self.rate}, expected a number above 0, such as 1e-4.")
        if not 0 <= self.confidence < math.inf:
            raise ValueError(
                f"confidence is {self.confidence}, expected a number of standard errors from 0 up."
            )


class Adapted(NamedTuple):
    """What `adapt` gives; risks are means of SURE / (y² + 0.01 + σ²), y the denoised image before.

    Attributes
    ----------
    adapted : the denoiser, or the mixer, with the weights that were best; those before where none was surely
        better.
    step : after which they were found, 0: those to start from, or unchanged.
    before, after : risk where nothing was fitted or chosen; a single value is noisy.
    error : standard error of `before` minus `after`, over blocks.
    steps : at which the blocks that choose were looked at,
    risks : and the risk there, with the advantage of the chosen one.
    """

    adapted: Any
    step: int
    before: float
    after: float
    error: float
    steps: Int[np.ndarray, " n"]
    risks: Float[np.ndarray, " n"]


def fit(
    frame: Frame,
    denoiser: Any,
    chosen: _leaves.Numbers,
    adaptation: Adaptation,
    key: jax.Array,
    progress: Progress,
    over: Any = None,
) -> Adapted:
    """The denoiser with its chosen weights fitted, or as it was where no gain is sure.

    `over` is what there was in its place, if the weights are new: then the gain is over that, and that stays.
    """
    checked_variance(frame)
    frame = repaired(frame)
    step_key, look_key, host_key = jax.random.split(key, 3)
    host = generator(host_key)
    kinds = _blocks.kinds(frame.size, adaptation.block, host)
    fitting, choosing, telling = (kinds == kind for kind in _blocks.KINDS)
    task = before = task_of(denoiser, frame, chosen, adaptation.probes)
    if over is not None:
        before = task_of(over, frame, (), adaptation.probes)
        task = dataclasses.replace(task, scale=before.scale)
    if not adaptation.covariance:
        shared = jnp.zeros_like(task.shared)
        task, before = (dataclasses.replace(t, shared=shared) for t in (task, before))

    def look(task: Task, step: int, weights: Weights) -> _Seen:
        probed = np.asarray(risks(task, weights, look_key), np.float64)
        return _Seen(step, weights, _blocks.means(probed.mean(-1), kinds.shape))

    best = look(task, 0, task.first)
    start = best if over is None else look(before, 0, before.first)
    looks = [(0, best.risks[choosing].mean())]
    part = task.only_in(_blocks.spread(fitting, frame.size))
    rate = _RATE if adaptation.rate is None else adaptation.rate
    steps = descent(part, adaptation.crop, rate, step_key, host)
    for step, weights in enumerate(itertools.islice(steps, adaptation.steps), 1):
        stopped = progress(step, adaptation.steps) is False
        if step % adaptation.every and step < adaptation.steps and not stopped:
            continue
        seen = look(task, step, weights)
        looks.append((step, seen.risks[choosing].mean()))
        if looks[-1][1] < best.risks[choosing].mean():
            best = seen
        if stopped or step - best.step >= adaptation.patience * adaptation.every:
            break
    gain, error = _blocks.mean_and_error((start.risks - best.risks)[choosing])
    if not gain > adaptation.confidence * error:
        task, best = before, start
    numbers, values = zip(*looks, strict=True)
    return Adapted(
        task.with_weights(best.weights),
        best.step,
        before=float(start.risks[telling].mean()),
        after=float(best.risks[telling].mean()),
        error=_blocks.mean_and_error((start.risks - best.risks)[telling])[1],
        steps=np.asarray(numbers),
        risks=np.asarray(values),
    )


class _Seen(NamedTuple):
    """The weights after a step, and the risk of every block with them."""

    step: int
    weights: Weights
    risks: np.ndarray
