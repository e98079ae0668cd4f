"""Self-supervised post-correction: a small network learns from two halves of one render to repair a
denoiser."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._convolution import same_convolution
from progden_jax.adaptation import combination
from progden_jax.adaptation._halves import Halves, separate
from progden_jax.adaptation._running import OPTIMIZER, Progress, descended, generator
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound, passable
from progden_jax.frame import Frame

Params = Mapping[str, Mapping[str, Array]]
"""Layer -> kernel and bias."""

_SCALES, _BANDWIDTHS = 9, len(combination.GUIDES)
_MAX_RATE = 0.01


@dataclasses.dataclass(frozen=True)
class PostCorrection:
    """What is fitted, and how; the defaults are the paper's (section 4.2).

    Parameters
    ----------
    refined : combine by Eq. 10, with scales for denoised colour, albedo and normal; else by Eq. 3.
    bilateral : weights by Eq. 11 from five bandwidths; else one output of the network per weight.
    window : odd width in pixels.
    layers, width : 3×3 convolutions, the last one included, and the channels between them.
    epochs : passes over the image's patches.
    patch, batch : width of the patches in pixels, at most the image's, and how many make a step.
    min_steps : more epochs are made until there are so many steps: 20 of a 1024×1024 image have 80, while a
        small image would learn next to nothing from its 20.
    rate : learning rate of Adam; None: 0.01 times the render's RMS noise by its halves, at most 0.01.
    """

    refined: bool = True
    bilateral: bool = True
    window: int = 19
    layers: int = 9
    width: int = 16
    epochs: int = 20
    patch: int = 128
    batch: int = 16
    min_steps: int = 80
    rate: float | None = None

    def __post_init__(self) -> None:
        _checks.odd_int("window", self.window)
        for name in ("layers", "width", "epochs", "patch", "batch", "min_steps"):
            _checks.positive_int(name, getattr(self, name))
        if self.rate is not None and not 0 < self.rate < math.inf:
            raise ValueError(f"rate is {self.rate}, expected a number above 0, such as 1e-3.")

    @property
    def outputs(self) -> int:
        """Channels of the last layer: 15 by the paper's defaults."""
        weights = _BANDWIDTHS + 1 if self.bilateral else self.window**2
        return weights + (_SCALES if self.refined else 0)

    def init(self, key: jax.Array) -> dict[str, dict[str, Array]]:
        """Weights to start from: Glorot and Bengio's uniform, zero biases."""
        widths = [combination.CHANNELS, *[self.width] * (self.layers - 1), self.outputs]
        pairs = list(itertools.pairwise(widths))
        # One draw for all layers compiles in a fraction of the time of one per shape.
        ends = np.cumsum([9 * before * after for before, after in pairs])
        parts = jnp.split(jax.random.uniform(key, (ends[-1],), minval=-1), ends[:-1])
        params = {}
        for n, (part, (before, after)) in enumerate(zip(parts, pairs, strict=True), start=1):
            kernel = math.sqrt(6 / (9 * (before + after))) * part.reshape(3, 3, before, after)
            params[f"conv{n}"] = {"kernel": kernel, "bias": jnp.zeros(after, part.dtype)}
        return params

    def apply(self, params: Params, guides: Float[Array, "h w 13"]) -> Float[Array, "h w 3"]:
        """The corrected image of a noisy and a denoised one, see `combination.guides_of`."""
        last = params[f"conv{self.layers}"]
        radiance = jnp.log1p(jnp.maximum(guides[..., :6], 0))
        h = jnp.concatenate([radiance, guides[..., 6:]], axis=-1)
        for n in range(1, self.layers):
            h = jax.nn.relu(_layer(params[f"conv{n}"], h))
        kernel, bias = last["kernel"], last["bias"]
        scales = None
        if self.refined:
            head = {"kernel": kernel[..., :_SCALES], "bias": bias[:_SCALES]}
            scales = jnp.tanh(_layer(head, h))
            kernel, bias = kernel[..., _SCALES:], bias[_SCALES:]
        if self.bilateral:
            positive = jax.nn.softplus(_layer({"kernel": kernel, "bias": bias}, h))
            weigh = combination.bilateral(
                positive[..., :-1], positive[..., -1:], window=self.window
            )
        else:
            weigh = combination.predicted(h, kernel, bias)
        return combination.combine(guides, weigh, scales=scales, window=self.window)


def _layer(layer: Mapping[str, Array], h: Array) -> Array:
    return same_convolution(h[None], layer["kernel"], "highest")[0] + layer["bias"]


SETTINGS = {
    "A": PostCorrection(refined=False, bilateral=False),
    "B": PostCorrection(refined=False),
    "C": PostCorrection(bilateral=False),
    "D": PostCorrection(),
}
"""The paper's Table 1; D is its method."""


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("denoiser", "params", "difference"),
    meta_fields=("correction",),
)
@dataclasses.dataclass(frozen=True)
class PostCorrected:
    """A denoiser followed by the correction that was fitted to one frame; `post_correct` makes it.

    y = f(x) = ½ (g(x + d) + g(x − d)), where g is denoiser and correction of one half, and d, half of the
    halves' difference, is a constant. Normal noise in x is independent of d, so that σ²·∂f/∂x at fixed d is
    what SURE needs, and progressive mixing works as with any denoiser. What is left out is that the
    correction's weights were fitted to the same noise.

    Parameters
    ----------
    denoiser : of each half.
    params : the correction's weights.
    difference : (a − b)/2 by buffer, see `Halves`.
    correction : the settings that the weights belong to.
    """

    denoiser: Denoiser
    params: Params
    difference: dict[str, Array]
    correction: PostCorrection

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The corrected image, (H, W, 3) linear radiance."""
        return self.bind(frame)(frame.color)

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x); `frame` must be of the size of the one that it was fitted to."""
        bound = [(half, self.denoiser.bind(half)) for half in separate(frame, self.difference)]
        shift = self.difference["color"]

        def f(x: Array) -> Array:
            parts = []
            for (half, inner), color in zip(bound, (x + shift, x - shift), strict=True):
                guides = combination.guides_of(half.replace(color=color), inner(color))
                parts.append(self.correction.apply(self.params, guides))
            return (parts[0] + parts[1]) / 2

        return f


class Corrected(NamedTuple):
    """What `post_correct` gives.

    Attributes
    ----------
    image : (H, W, 3) the corrected image.
    denoiser : the same as something that `progressive_denoise` takes for `frame`.
    frame : the mean of both halves.
    losses : of every step, Eq. 9 over its patches.
    """

    image: Float[Array, "h w 3"]
    denoiser: PostCorrected
    frame: Frame
    losses: Float[np.ndarray, " steps"]


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
    params = _init(correction, weights_key) if start is None else _checked(correction, start)
    data = _examples(passable(denoiser), halves)
    size = halves.frame.size
    corners = _corners(size, correction.patch)
    batch = min(correction.batch, len(corners))
    per_epoch = -(-len(corners) // batch)
    total = max(correction.epochs * per_epoch, correction.min_steps)
    rate = correction.rate
    if rate is None:
        rate = min(0.01 * float(jnp.sqrt(jnp.mean(halves.difference["color"] ** 2))), _MAX_RATE)
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
    image = _corrected(correction, params, data["guides"])
    return Corrected(image, corrected, halves.frame, np.asarray(losses))


_init = jax.jit(PostCorrection.init, static_argnums=0)


def _checked(correction: PostCorrection, params: Params) -> Params:
    expected = jax.eval_shape(correction.init, jax.random.key(0))
    if jax.tree.map(jnp.shape, params) != jax.tree.map(jnp.shape, expected):
        raise ValueError(
            "start holds weights of other shapes than the correction's: give those of a correction with the "
            "same window, layers, width and setting."
        )
    return params


def _corners(size: tuple[int, int], patch: int) -> np.ndarray:
    """Rows and columns where patches begin that cover the image, the last ones moved inside."""
    starts = [[min(s, max(n - patch, 0)) for s in range(0, n, patch)] for n in size]
    return np.asarray([(row, column) for row in starts[0] for column in starts[1]], np.int32)


@jax.jit
def _examples(denoiser: Denoiser, halves: Halves) -> dict[str, Array]:
    """Of each half the guides, and of the other half what Eq. 8 compares with and divides by."""
    denoised = [(half, denoiser.bind(half)(half.color)) for half in halves.both()]
    guides = [combination.guides_of(half, z) for half, z in denoised]
    targets = [half.color for half, _ in reversed(denoised)]
    norms = [z.mean(-1, keepdims=True) ** 2 + 0.01 for _, z in reversed(denoised)]
    return {n: jnp.stack(v) for n, v in (("guides", guides), ("target", targets), ("norm", norms))}


def loss(
    correction: PostCorrection, params: Params, examples: Mapping[str, Float[Array, "n h w c"]]
) -> Float[Array, ""]:
    """Mean of (μ̂ − y')²/(z̄'² + 0.01), the primed ones of the other half (Back et al. 2022, Eqs. 8 and 9).

    A half's noise is independent of the other's, so that this is the relative error of μ̂ and what does not
    depend on the weights.
    """
    corrected = jax.vmap(functools.partial(correction.apply, params))(examples["guides"])
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
def _corrected(correction: PostCorrection, params: Params, guides: Array) -> Array:
    return jax.vmap(functools.partial(correction.apply, params))(guides).mean(0)
