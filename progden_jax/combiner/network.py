"""The network that predicts the weights of the combination kernel."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from progden_jax import _checks
from progden_jax._convolution import same_convolution
from progden_jax._neighbourhood import some_outputs
from progden_jax._numeric import safe_sqrt
from progden_jax._windows import box_sum
from progden_jax.combiner.kernels import combine, counts_of
from progden_jax.denoisers._network import lit
from progden_jax.denoisers.nfor import log_depth
from progden_jax.mixers.architectures import he_normal

Params = Mapping[str, Mapping[str, Array]]
"""Layer -> kernel (k, k, in, out) and bias."""

BUFFERS = {"albedo": 3, "normal": 3, "depth": 1, "variance": 3}
"""What the network can take besides the images, and their channels."""

_LAST = "kernel"
_EPSILON = 0.01
_MOST = 15.0
"""Bound on logits: products of two e^±15, summed, squared and divided, are well within float32."""


@dataclasses.dataclass(frozen=True)
class KernelNetwork:
    """A kernel-predicting network; the defaults are the paper's.

    Parameters
    ----------
    layers, width, layer_size : convolutions, the one that predicts weights included, the channels between
        them and the edge of their kernels in pixels, odd.
    window : odd width in pixels of the combination kernel.
    buffers : sub-averages of the samples that are combined; the paper's extension has 4.
    robust : what the paper has not: every pixel has a reliability too, and the denoised pixel a weight as an
        estimate of itself, see `combine`. Else a firefly has to be known by its place in the window of each
        pixel around, and noise is added where the denoised image was right.
    inputs : buffers that the network sees besides the images, some of `BUFFERS` in this order.

    Raises
    ------
    ValueError
        If a setting is out of its range.

    Notes
    -----
    Back et al. 2020, section 4.2, does not say whether its six layers include the one that predicts; with it
    they have the 3.3 million weights of its Fig. 12 for four buffers.
    """

    layers: int = 6
    width: int = 100
    layer_size: int = 5
    window: int = 15
    buffers: int = 1
    robust: bool = False
    inputs: tuple[str, ...] = tuple(BUFFERS)

    def __post_init__(self) -> None:
        for name in ("layers", "width", "buffers"):
            _checks.positive_int(name, getattr(self, name))
        for name in ("layer_size", "window"):
            _checks.odd_int(name, getattr(self, name))
        for role in self.inputs:
            _checks.choice("inputs", role, BUFFERS)
        object.__setattr__(self, "inputs", tuple(n for n in BUFFERS if n in self.inputs))

    @property
    def channels(self) -> int:
        """Of what the first layer sees."""
        return 9 * self.buffers + sum(BUFFERS[role] for role in self.inputs)

    @property
    def outputs(self) -> int:
        """Per pixel: weights of the window of every buffer, then reliabilities and the denoised pixel's."""
        return self.buffers * self.window**2 + (self.buffers + 1 if self.robust else 0)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away the result can depend on the images and the buffers."""
        seen = self.window // 2 if "depth" in self.inputs else 0
        return max(self.layers * (self.layer_size // 2) + seen, self.window // 2)

    @property
    def form(self) -> dict[str, dict[str, jax.ShapeDtypeStruct]]:
        """Shapes of the weights."""
        found, taken, size = {}, self.channels, self.layer_size
        for n in range(1, self.layers + 1):
            name, given = (_LAST, self.outputs) if n == self.layers else (f"conv{n}", self.width)
            found[name] = {
                "kernel": jax.ShapeDtypeStruct((size, size, taken, given), jnp.float32),
                "bias": jax.ShapeDtypeStruct((given,), jnp.float32),
            }
            taken = given
        return found

    def check(self, params: Params) -> None:
        """Raise ValueError unless the weights are of `form`."""
        found = jax.tree.map(jnp.shape, dict(params))
        if found != (expected := jax.tree.map(jnp.shape, self.form)):
            raise ValueError(
                f"the weights are not those of {self}: layers and shapes of kernels are "
                f"{_kernels(found)}, expected {_kernels(expected)}."
            )

    def init(self, key: jax.Array) -> dict[str, dict[str, Array]]:
        """Weights to start from: He's, with which the kernel is nearly uniform.

        Where it may trust the denoised pixel, that has the other half of the weight.
        """
        params = he_normal(key, self.form)
        params[_LAST]["kernel"] = 0.1 * params[_LAST]["kernel"]
        if self.robust:
            half = math.log(self.buffers * self.window**2)
            params[_LAST]["bias"] = params[_LAST]["bias"].at[-1].set(half)
        return params

    def apply(
        self,
        params: Params,
        noisy: Float[Array, "b n h w 3"],
        denoised: Float[Array, "b n h w 3"],
        buffers: Mapping[str, Float[Array, "n h w c"]],
        *,
        inside: Bool[Array, "h w 1"] | None = None,
        shares: Float[Array, "b n"] | None = None,
    ) -> Float[Array, "n h w 3"]:
        """The combination of n images' sub-averages and their denoised versions.

        Parameters
        ----------
        noisy, denoised : see `combine`, as many sub-averages as `buffers`.
        buffers : those in `inputs`, by name; the variance is that of the samples' mean.
        inside : False where the images are padding.
        shares : of the samples that the sub-averages have, see `combine`.
        """
        h = self._seen(noisy, denoised, buffers, inside, shares)
        for n in range(1, self.layers):
            layer = params[f"conv{n}"]
            h = jax.nn.relu(same_convolution(h, layer["kernel"]) + layer["bias"])
            h = h if inside is None else jnp.where(inside, h, 0)
        kernel, bias = params[_LAST]["kernel"], params[_LAST]["bias"]

        def weigh(buffer: Array, first: Array, count: int) -> Array:
            return positive(buffer * self.window**2 + first, count)

        def positive(first: Array | int, count: int) -> Array:
            logits = some_outputs(h, kernel, bias, first, count)
            # A softmax over the window, in one pass: bounded, its largest logit need not be known.
            return jnp.exp(jnp.clip(logits, -_MOST, _MOST))

        further: dict[str, Any] = {}
        if self.robust:
            *reliability, trust = positive(self.buffers * self.window**2, self.buffers + 1)
            further = {"reliability": jnp.stack(reliability)[..., None], "trust": trust[..., None]}
        further |= {"inside": inside, "shares": shares}
        return combine(noisy, denoised, weigh, window=self.window, **further)

    def _seen(
        self,
        noisy: Float[Array, "b n h w 3"],
        denoised: Float[Array, "b n h w 3"],
        buffers: Mapping[str, Float[Array, "n h w c"]],
        inside: Bool[Array, "h w 1"] | None,
        shares: Float[Array, "b n"] | None,
    ) -> Float[Array, "n h w c"]:
        """What the first layer sees: log(1 + y), log(1 + z) and y − z relative to z, compressed, of every
        sub-average, then the buffers; depth and noise are relative too, as relMSE is."""
        level = lit(denoised)
        whole = (counts_of(shares) * level).mean(0)
        relative = (noisy - denoised) / (level + _EPSILON)
        parts = [*jnp.log1p(lit(noisy)), *jnp.log1p(level), *jnp.arcsinh(relative)]
        for role in self.inputs:
            buffer = jnp.nan_to_num(buffers[role])
            if role == "depth":
                buffer = _beside_neighbours(log_depth(buffer), self.window, inside)
            elif role == "variance":
                buffer = jnp.log1p(safe_sqrt(buffer) / (whole + _EPSILON))
            parts.append(buffer)
        seen = jnp.concatenate(parts, axis=-1)
        return seen if inside is None else jnp.where(inside, seen, 0)


def _beside_neighbours(
    values: Float[Array, "n h w 1"], window: int, inside: Bool[Array, "h w 1"] | None
) -> Float[Array, "n h w 1"]:
    """Values minus their means over a window: of logarithms, what does not depend on the unit."""
    counted = jnp.ones(values.shape[1:], values.dtype)
    if inside is not None:
        counted = jnp.where(inside, counted, 0)
    total = jax.vmap(lambda v: box_sum(v * counted, window))(values)
    return values - total / jnp.maximum(box_sum(counted, window), 1)


def _kernels(shapes: Mapping[str, Mapping[str, tuple[int, ...]]]) -> str:
    return ", ".join(f"{layer} {layers.get('kernel')}" for layer, layers in shapes.items())
