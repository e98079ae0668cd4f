"""Adaptation by SURE: a network's weights fitted to the one noisy image, by its own estimate of its error.

An estimate that is made small is no longer unbiased: weights come to follow the noise that it rests on. So
the image is cut into blocks of three kinds, drawn at random. The loss is taken in the first alone, where
to stop is chosen in the second, and the gain is told from the third; the last two with probes of their own,
the same ones at all times, so that only the weights differ.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from progden_jax import _checks
from progden_jax._program import checked_variance
from progden_jax.adaptation._mixed import Mixed, bind, exposure_of
from progden_jax.adaptation._running import OPTIMIZER, Progress, descended, generator
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import passable
from progden_jax.divergence import MonteCarlo
from progden_jax.frame import Frame, repaired
from progden_jax.mixing import Mixer
from progden_jax.sure import sure

_FIT, _CHOOSE, _TELL = range(3)
_SHARES = (0.6, 0.25, 0.15)


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """How weights are fitted.

    Parameters
    ----------
    steps : of Adam, at most.
    rate : its learning rate.
    only : names of layers or attributes to change, such as ("dec_conv1a", "dec_conv0") of a U-Net;
        none stands for all weights.
    crop : edge in pixels of the part that a step looks at, if the image is larger; memory grows with it.
    block : edge in pixels of the blocks that are kept apart.
    every : steps between looks at the blocks that choose.
    patience : looks without a new best after which it stops.
    confidence : by how many standard errors those blocks must be better off for the weights to
        be changed at all.
    probes : of the divergence, each time.
    """

    steps: int = 100
    rate: float = 1e-4
    only: tuple[str, ...] = ()
    crop: int = 256
    block: int = 16
    every: int = 10
    patience: int = 4
    confidence: float = 1.0
    probes: int = 1

    def __post_init__(self) -> None:
        for name in ("steps", "crop", "block", "every", "patience", "probes"):
            _checks.positive_int(name, getattr(self, name))
        if not 0 < self.rate < math.inf:
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
    step : after which they were found, 0: unchanged.
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


def adapt(
    frame: Frame,
    denoiser: Denoiser,
    *,
    adaptation: Adaptation | None = None,
    key: jax.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> Adapted:
    """The denoiser with weights fitted to this render by Stein's estimate of its error; no reference needed.

    What comes out is a denoiser of the same kind, to be given to `progressive_denoise` or saved. The same key
    gives the same result on the same machine. Bad pixels are repaired first.

    Parameters
    ----------
    frame : one frame with a variance.
    denoiser : a pytree with floating-point leaves, as all of `progden_jax.denoisers` are.
    adaptation : how; None stands for ``Adaptation()``.
    key : of probes, crops and blocks; None stands for ``jax.random.key(0)``.
    progress : called with (done, total) steps; if it returns False, the best weights so far are taken.

    Raises
    ------
    ValueError
        If the frame has no variance or is too small to be split, or there are no such weights.

    Notes
    -----
    Each step takes a pass, a tangent pass and the derivative of both, about six passes over the crop. SURE
    is unbiased for normal noise of known variance; where samples are few, variances of bright rare
    paths are too small, and fitting to it keeps some of the noise. Pixels are weighted by 1/(y² + 0.01 + σ²),
    so that neither bright nor noisy ones decide alone.

    To `progressive_denoise` the weights are constants, though they follow this noise, so that its SURE is
    biased low; and a mixing network was trained behind the denoiser as it was. On one scene, with the
    U-Net's last three layers adapted, the denoised image became better (relMSE 0.0062 to 0.0058 at 512 spp,
    0.0073 to 0.0071 at 128) and the mix worse (0.0023 to 0.0025, 0.0033 to 0.0037). Which of the two is
    why was not told apart.
    """
    adaptation = Adaptation() if adaptation is None else adaptation
    key = jax.random.key(0) if key is None else key
    denoiser = passable(denoiser)
    chosen = _weights(denoiser, adaptation.only)
    return _fit(frame, denoiser, chosen, adaptation, key, progress)


def _fit(
    frame: Frame,
    denoiser: Any,
    chosen: tuple[int, ...],
    adaptation: Adaptation,
    key: jax.Array,
    progress: Progress,
) -> Adapted:
    checked_variance(frame)
    frame = repaired(frame)
    step_key, look_key, host_key = jax.random.split(key, 3)
    host = generator(host_key)
    kinds = _kinds(frame.size, adaptation.block, host)
    fitted = jnp.asarray(_spread(kinds == _FIT, frame.size))[..., None]
    exposure, scale = _before(denoiser, frame)
    crop = tuple(min(adaptation.crop, n) for n in frame.size)

    def look(weights: Any) -> np.ndarray:
        """Risk of each block."""
        probed = _risks(denoiser, chosen, weights, frame, exposure, scale, look_key, method)
        return _block_means(np.asarray(probed, np.float64).mean(-1), kinds.shape)

    method = MonteCarlo(adaptation.probes)
    first = weights = best = [jax.tree.leaves(denoiser)[n] for n in chosen]
    optimizer = OPTIMIZER.init(weights)
    start = lowest = look(first)
    looks, best_step = [(0, start[kinds == _CHOOSE].mean())], 0
    for step in range(1, adaptation.steps + 1):
        corner = [int(host.integers(n - c + 1)) for n, c in zip(frame.size, crop, strict=True)]
        weights, optimizer = _step(
            denoiser,
            chosen,
            weights,
            optimizer,
            frame,
            exposure,
            jnp.where(fitted, scale, 0),
            jax.random.fold_in(step_key, step),
            np.asarray(corner),
            adaptation.rate,
            crop=crop,
            method=method,
        )
        # Steps are queued else, and progress would tell of what has not been done.
        jax.block_until_ready(weights)
        stopped = progress(step, adaptation.steps) is False
        if step % adaptation.every and step < adaptation.steps and not stopped:
            continue
        found = look(weights)
        looks.append((step, found[kinds == _CHOOSE].mean()))
        if looks[-1][1] < lowest[kinds == _CHOOSE].mean():
            best, best_step, lowest = weights, step, found
        if stopped or step - best_step >= adaptation.patience * adaptation.every:
            break
    gain, error = _mean_and_error((start - lowest)[kinds == _CHOOSE])
    if not gain > adaptation.confidence * error:
        best, best_step, lowest = first, 0, start
    steps, risks = zip(*looks, strict=True)
    told = kinds == _TELL
    return Adapted(
        _with(denoiser, chosen, best),
        best_step,
        before=float(start[told].mean()),
        after=float(lowest[told].mean()),
        error=_mean_and_error((start - lowest)[told])[1],
        steps=np.asarray(steps),
        risks=np.asarray(risks),
    )


def adapt_mixer(
    frame: Frame,
    denoiser: Denoiser,
    mixer: Mixer,
    *,
    adaptation: Adaptation | None = None,
    key: jax.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> Adapted:
    """The mixer with weights fitted to this render by SURE of the mix; the denoiser stays as it is.

    How α follows x counts in the mix's divergence, but for what reaches it through the estimated
    divergence of the denoiser. All else as for `adapt`; ``only`` picks among the mixer's layers.

    Raises
    ------
    ValueError
        If the mixer has no weights, as the closed form; see also `adapt`.
    """
    adaptation = Adaptation() if adaptation is None else adaptation
    mix_key, fit_key = jax.random.split(jax.random.key(0) if key is None else key)
    mixed = Mixed(passable(denoiser), mixer, mix_key)
    before = len(jax.tree.leaves(mixed.denoiser))
    chosen = tuple(before + number for number in _weights(mixer, adaptation.only))
    found = _fit(frame, mixed, chosen, adaptation, fit_key, progress)
    return found._replace(adapted=found.adapted.mixer)


def _weights(tree: Any, only: Sequence[str]) -> tuple[int, ...]:
    """Numbers of the leaves that are to be changed."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    real = [
        (number, {_name(part) for part in path})
        for number, (path, leaf) in enumerate(leaves)
        if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    if not real:
        raise ValueError(
            f"{tree!r} has no weights to adapt: give a pytree with floating-point leaves, such as those of "
            "progden_jax.denoisers."
        )
    known = set().union(*(names for _, names in real))
    if unknown := sorted(set(only) - known):
        raise ValueError(
            f"only names {', '.join(unknown)}, expected some of {', '.join(sorted(known))}."
        )
    return tuple(number for number, names in real if not only or names & set(only))


def _name(part: Any) -> str:
    return str(next(getattr(part, n) for n in ("name", "key", "idx") if hasattr(part, n)))


def _with(tree: Any, chosen: Sequence[int], values: Sequence[Any]) -> Any:
    leaves, form = jax.tree.flatten(tree)
    for number, value in zip(chosen, values, strict=True):
        leaves[number] = value
    return jax.tree.unflatten(form, leaves)


def _kinds(
    size: tuple[int, int], block: int, host: np.random.Generator
) -> Int[np.ndarray, "rows columns"]:
    """Of every block whether it is to fit, choose or tell; blocks shrink until there are 16 or so."""
    while block > 1 and math.prod(-(-n // block) for n in size) < 16:
        block //= 2
    shape = tuple(-(-n // block) for n in size)
    count = math.prod(shape)
    if count < len(_SHARES):
        raise ValueError(
            f"the frame has {size[0]}×{size[1]} pixels, too few to fit weights to some and judge by others."
        )
    held = [max(round(share * count), 1) for share in _SHARES[1:]]
    kinds = np.repeat([_FIT, _CHOOSE, _TELL], [count - sum(held), *held])
    return host.permutation(kinds).reshape(shape)


def _spread(blocks: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """One value per block to one per pixel."""
    (rows, columns), (height, width) = blocks.shape, size
    return blocks[np.arange(height)[:, None] * rows // height, np.arange(width) * columns // width]


def _block_means(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """One value per pixel to the mean of each block, as `_spread` lays them out."""
    numbers = _spread(np.arange(math.prod(shape)).reshape(shape), values.shape).ravel()
    total = np.bincount(numbers, values.ravel(), math.prod(shape))
    return (total / np.bincount(numbers, minlength=len(total))).reshape(shape)


def _mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Of independent values; nothing is known of the error from one."""
    error = values.std(ddof=1) / len(values) ** 0.5 if len(values) > 1 else math.inf
    return float(values.mean()), float(error)


@jax.jit
def _before(denoiser: Any, frame: Frame) -> tuple[Any, Array]:
    """What the denoiser takes from the whole image, and the weight of each pixel and channel."""
    exposure = exposure_of(denoiser, frame)
    y = bind(denoiser, frame, exposure)(frame.color)
    return exposure, 1 / (y**2 + 0.01 + cast(Array, frame.variance))


@functools.partial(jax.jit, static_argnames=("chosen", "method"))
def _risks(
    denoiser: Any,
    chosen: tuple[int, ...],
    weights: Any,
    frame: Frame,
    exposure: Any,
    scale: Array,
    key: jax.Array,
    method: MonteCarlo,
) -> Array:
    """Weighted SURE, (H, W, 3)."""
    f = bind(_with(denoiser, chosen, weights), frame, exposure)
    x, variance = frame.color, cast(Array, frame.variance)
    y, divergence, *_ = method.evaluate(f, x, variance, key)
    return scale * sure(x, y, variance, divergence)


@functools.partial(jax.jit, static_argnames=("chosen", "crop", "method"))
def _step(
    denoiser: Any,
    chosen: tuple[int, ...],
    weights: Any,
    optimizer: Any,
    frame: Frame,
    exposure: Any,
    scale: Array,
    key: jax.Array,
    corner: Array,
    rate: Array,
    *,
    crop: tuple[int, int],
    method: MonteCarlo,
) -> tuple[Any, Any]:
    def cut(array: Array) -> Array:
        if array.ndim < 3:
            return array
        return jax.lax.dynamic_slice(array, (*corner, 0), (*crop, array.shape[-1]))

    part, scale = jax.tree.map(cut, (frame, scale))

    def loss(weights: Any) -> Array:
        return _risks(denoiser, chosen, weights, part, exposure, scale, key, method).mean()

    return descended(weights, optimizer, jax.grad(loss)(weights), rate)
