"""Self-supervised post-correction: a small network learns from two halves of one render to repair a
denoiser."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax.adaptation import combination
from progden_jax.adaptation._halves import Halves
from progden_jax.adaptation._running import OPTIMIZER, Progress, descended, generator
from progden_jax.adaptation.correction import Params, PostCorrected, PostCorrection
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import passable
from progden_jax.frame import Frame


class Corrected(NamedTuple):
    """What `post_correct` gives.

    Attributes
    ----------
    image : (H, W, 3) the corrected image.
    denoiser : the same as something that `progressive_denoise` takes for `frame`.
    frame : the mean of both halves.
    losses : of every step, Eq. 9 over its patches.
    rate : of learning.
    """

    image: Float[Array, "h w 3"]
    denoiser: PostCorrected
    frame: Frame
    losses: Float[np.ndarray, " steps"]
    rate: float


def post_correct(
    halves: Halves,
    denoiser: Denoiser,
    *,
    correction: PostCorrection | None = None,
    start: Params | None = None,
    key: jax.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> Corrected:
    """The denoised image, corrected by a network that was fitted to this render alone.

    The same key gives the same result.

    Parameters
    ----------
    halves : see `halves` for two renders, `split` for one.
    denoiser : of each half.
    correction : what is fitted and how; None: the paper's, `SETTINGS` has its ablation.
    start : weights to start from, such as ``corrected.denoiser.params`` of the previous frame.
    key : of the first weights and the order of patches; None stands for ``jax.random.key(0)``.
    progress : called with (done, total) steps; if it returns False, the weights stay as they are then.

    Raises
    ------
    ValueError
        If the frame lacks what the denoiser takes, or the weights are not the correction's.

    Notes
    -----
    Back et al. 2022. A step takes about 3·window² passes over 13 planes of its patches; memory does
    not grow with the window.
    """
    correction = PostCorrection() if correction is None else correction
    key = jax.random.key(0) if key is None else key
    weights_key, order_key = jax.random.split(key)
    params = _init(correction, weights_key) if start is None else correction.checked(start)
    data = _examples(passable(denoiser), halves)
    size = halves.frame.size
    corners = _corners(size, correction.patch)
    batch = min(correction.batch, len(corners))
    per_epoch = -(-len(corners) // batch)
    total = correction.count(per_epoch)
    rate = 0.01 * float(_noise(halves)) if correction.rate is None else correction.rate
    patch = (min(correction.patch, size[0]), min(correction.patch, size[1]))
    optimizer = OPTIMIZER.init(params)
    order = generator(order_key)
    losses: list[float] = []
    shuffled = corners
    for step in range(total):
        if step % per_epoch == 0:
            shuffled = np.resize(order.permutation(corners), (per_epoch * batch, 2))
        chosen = shuffled[(step % per_epoch) * batch :][:batch]
        params, optimizer, loss = _step(correction, patch, params, optimizer, data, chosen, rate)
        losses.append(float(loss))
        if progress(step + 1, total) is False:
            break
    corrected = PostCorrected(passable(denoiser), params, halves.difference, correction)
    image = _corrected(correction, params, data["guides"], halves.frame)
    return Corrected(image, corrected, halves.frame, np.asarray(losses), rate)


_init = jax.jit(PostCorrection.init, static_argnums=0)


def _corners(size: tuple[int, int], patch: int) -> np.ndarray:
    """Rows and columns where patches begin that cover the image, the last ones moved inside."""
    starts = [[min(s, max(n - patch, 0)) for s in range(0, n, patch)] for n in size]
    return np.asarray([(row, column) for row in starts[0] for column in starts[1]], np.int32)


@jax.jit
def _examples(denoiser: Denoiser, halves: Halves) -> dict[str, Array]:
    """Of each half the guides, and of the other half what Eq. 8 compares with and divides by.

    All radiance is in units of its mean, which leaves the quotient as it is.
    """
    units = combination.units_of(halves.frame)
    denoised = [(half, denoiser.bind(half)(half.color)) for half in halves.both()]
    guides = [combination.guides_of(half, z, units) for half, z in denoised]
    targets = [half.color / units.radiance for half, _ in reversed(denoised)]
    norms = [
        (z.mean(-1, keepdims=True) ** 2 + 0.01) / units.radiance**2 for _, z in reversed(denoised)
    ]
    return {n: jnp.stack(v) for n, v in (("guides", guides), ("target", targets), ("norm", norms))}


@jax.jit
def _noise(halves: Halves) -> Float[Array, ""]:
    """RMS noise of log(1 + radiance), which the network sees, by the halves' difference."""
    level = combination.units_of(halves.frame).radiance
    a, b = (jnp.log1p(jnp.maximum(half.color, 0) / level) for half in halves.both())
    return jnp.sqrt((((a - b) / 2) ** 2).mean())


def loss(
    correction: PostCorrection, params: Params, examples: Mapping[str, Float[Array, "n h w c"]]
) -> Float[Array, ""]:
    """Mean of (μ̂ − y')²/(z̄'² + 0.01), the primed ones of the other half (Back et al. 2022, Eqs. 8 and 9).

    A half's noise is independent of the other's, so that this is the relative error of μ̂ and what does not
    depend on the weights.
    """
    corrected = correction.apply(params, examples["guides"])
    return ((corrected - examples["target"]) ** 2 / examples["norm"]).mean()


@functools.partial(jax.jit, static_argnums=(0, 1))
def _step(
    correction: PostCorrection,
    patch: tuple[int, int],
    params: Params,
    optimizer: Any,
    data: Mapping[str, Array],
    corners: Array,
    rate: Array,
) -> tuple[Params, Any, Array]:
    def cut(array: Array, corner: Array) -> Array:
        start = (0, corner[0], corner[1], 0)
        return jax.lax.dynamic_slice(array, start, (2, *patch, array.shape[-1]))

    picked = {n: jax.vmap(cut, (None, 0))(array, corners) for n, array in data.items()}
    examples = {n: array.reshape(-1, *array.shape[2:]) for n, array in picked.items()}
    value, gradient = jax.value_and_grad(functools.partial(loss, correction))(params, examples)
    return *descended(params, optimizer, gradient, rate), value


@functools.partial(jax.jit, static_argnums=0)
def _corrected(correction: PostCorrection, params: Params, guides: Array, frame: Frame) -> Array:
    return combination.units_of(frame).radiance * correction.apply(params, guides).mean(0)
