"""A denoiser followed by a small network that repairs it (Back et al. 2022); `post_correct` fits that."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._convolution import same_convolution
from progden_jax.adaptation import combination
from progden_jax.adaptation._halves import Around, separate
from progden_jax.adaptation._mixed import bind, exposure_of
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import Bound
from progden_jax.frame import Frame

Params = Mapping[str, Mapping[str, Array]]
"""Layer -> kernel and bias."""

_SCALES, _BANDWIDTHS = 9, len(combination.GUIDES)
_MIN_STEPS = 80
"""20 epochs of a 1024×1024 image have as many; a small image would learn next to nothing from its 20."""


@dataclasses.dataclass(frozen=True)
class PostCorrection:
    """What is fitted, and how; the defaults are the paper's (section 4.2), but for `rate`.

    Radiance is in units of the render's mean, see `combination.Units`: the paper's bandwidths and rates
    suit renders of about that brightness, and in dark ones its network learns nothing.

    Parameters
    ----------
    refined : combine by Eq. 10, with scales for denoised colour, albedo and normal; else by Eq. 3.
    bilateral : weights by Eq. 11 from five bandwidths; else one output of the network per weight.
    window : odd width in pixels.
    layers, width : 3×3 convolutions, the last one included, and the channels between them.
    epochs : passes over the image's patches.
    patch, batch : width of the patches in pixels, at most the image's, and how many make a step.
    steps : instead of epochs; None: those that the epochs have, but at least 80.
    rate : learning rate of Adam; None: 0.01 times the RMS noise of log(1 + radiance), by the halves. By the
        paper it is that of radiance, which fireflies and bright renders raise until the network dies.
    """

    refined: bool = True
    bilateral: bool = True
    window: int = 19
    layers: int = 9
    width: int = 16
    epochs: int = 20
    patch: int = 128
    batch: int = 16
    steps: int | None = None
    rate: float | None = None

    def __post_init__(self) -> None:
        _checks.odd_int("window", self.window)
        for name in ("layers", "width", "epochs", "patch", "batch"):
            _checks.positive_int(name, getattr(self, name))
        if self.steps is not None:
            _checks.positive_int("steps", self.steps)
        if self.rate is not None and not 0 < self.rate < math.inf:
            raise ValueError(f"rate is {self.rate}, expected a number above 0, such as 1e-3.")

    @property
    def outputs(self) -> int:
        """Channels of the last layer: 15 by the paper's defaults."""
        weights = _BANDWIDTHS + 1 if self.bilateral else self.window**2
        return weights + (_SCALES if self.refined else 0)

    def count(self, per_epoch: int) -> int:
        """Steps to make, where an epoch has so many."""
        return max(self.epochs * per_epoch, _MIN_STEPS) if self.steps is None else self.steps

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

    def checked(self, params: Params) -> Params:
        """The weights, if they are this correction's.

        Raises
        ------
        ValueError
            If their shapes are others.
        """
        expected = jax.eval_shape(self.init, jax.random.key(0))
        if jax.tree.map(jnp.shape, params) != jax.tree.map(jnp.shape, expected):
            raise ValueError(
                "start holds weights of other shapes than the correction's: give those of a correction with "
                "the same window, layers, width and setting."
            )
        return params

    def unchanging(self, key: jax.Array) -> dict[str, dict[str, Array]]:
        """Weights to start from that keep most of the denoised image's detail."""
        params = self.init(key)
        if self.refined:
            last = params[f"conv{self.layers}"]
            last["bias"] = last["bias"].at[:3].set(2)
        return params

    def apply(self, params: Params, guides: Float[Array, "n h w 13"]) -> Float[Array, "n h w 3"]:
        """The corrected images of noisy and denoised ones, see `combination.guides_of`, in their units."""
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
            h = jax.nn.softplus(_layer({"kernel": kernel, "bias": bias}, h))

        def combined(guides: Array, h: Array, scales: Array | None) -> Array:
            if self.bilateral:
                weigh = combination.bilateral(h[..., :-1], h[..., -1:], window=self.window)
            else:
                weigh = combination.predicted(h, kernel, bias)
            return combination.combine(guides, weigh, scales=scales, window=self.window)

        return jax.vmap(combined)(guides, h, scales)


def _layer(layer: Mapping[str, Array], h: Array) -> Array:
    return same_convolution(h, layer["kernel"], "highest") + layer["bias"]


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
class PostCorrected(Around):
    """A denoiser followed by the correction that was fitted to one frame.

    After `post_correct` y = f(x) = ½ (g(x + d) + g(x − d)), where g is denoiser and correction of one half,
    and d, half of the halves' difference, is a constant. Normal noise in x is independent of d, so that
    σ²·∂f/∂x at fixed d is what SURE needs, and progressive mixing works as with any denoiser. What is left
    out is that the correction's weights were fitted to the same noise. After `correct_by_sure` there are no
    halves, and f is g.

    Parameters
    ----------
    denoiser : of each half, or of the frame.
    params : the correction's weights.
    difference : (a − b)/2 by buffer, see `Halves`; empty if there are no halves.
    correction : the settings that the weights belong to.
    """

    denoiser: Denoiser
    params: Params
    difference: dict[str, Array]
    correction: PostCorrection

    def exposure_of(self, frame: Frame, valid: None) -> tuple[Any, combination.Units]:
        """What depends on the whole image: the denoiser's exposure, if it has one, and the units."""
        del valid
        return exposure_of(self.denoiser, frame), combination.units_of(frame)

    def bind(self, frame: Frame, *, exposure: tuple[Any, combination.Units] | None = None) -> Bound:
        """f with y = f(x); with halves `frame` must be of the size of the one that it was fitted to."""
        inner, units = (None, combination.units_of(frame)) if exposure is None else exposure
        parts = separate(frame, self.difference) if self.difference else (frame,)
        bound = [(part, bind(self.denoiser, part, inner)) for part in parts]

        def f(x: Array) -> Array:
            shift = self.difference.get("color")
            colors = (x,) if shift is None else (x + shift, x - shift)
            guides = [
                combination.guides_of(part.replace(color=color), denoise(color), units)
                for (part, denoise), color in zip(bound, colors, strict=True)
            ]
            return units.radiance * self.correction.apply(self.params, jnp.stack(guides)).mean(0)

        return f
