"""What a learned mixer can look like: features and network, by name."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from progden_jax import _checks
from progden_jax.mixers._base import Architecture, Params
from progden_jax.mixers.multiscale import Multiscale
from progden_jax.mixing import FEATURES, MixingNet, mixing_features


@dataclasses.dataclass(frozen=True)
class Paper:
    """`MixingNet` on `mixing_features`, as published, with the paper's ablations as settings.

    Parameters
    ----------
    width : channels of the hidden layers.
    sure : False hides SURE, and 2σ²f' with it, from the network (Table 4, "w/o SURE").
    ratio : False replaces f_act by a sigmoid (Table 4, "w/o f_act").
    space : "linear" mixes radiance; "log" mixes log(1 + radiance), expressed as a weight of linear radiance.
    """

    width: int = 48
    sure: bool = True
    ratio: bool = True
    space: str = "linear"

    def __post_init__(self) -> None:
        _checks.positive_int("width", self.width)
        _checks.choice("space", self.space, ("linear", "log"))

    @property
    def receptive_radius(self) -> int:
        """How many pixels away α can depend on the images: one 5×5 and five 3×3 convolutions."""
        return 2 + 5

    def init(self, key: jax.Array) -> Params:
        """He's random kernels and zero biases; the last layer's are such that f_act begins with a slope.

        From biases of zero x3 is negative in half of all pixels, and there f_act is a step.
        """
        form = jax.eval_shape(self._net.init, key, jnp.zeros((1, 8, 8, FEATURES)))["params"]
        params = he_normal(key, form)
        if self.ratio:
            start = jnp.repeat(jnp.asarray([0.5, 0.0, 1.0]), 3)
            params["conv_out"] = {"kernel": 0.1 * params["conv_out"]["kernel"], "bias": start}
        return params

    def apply(
        self,
        params: Params,
        x: Float[Array, "*b h w 3"],
        y: Float[Array, "*b h w 3"],
        variance: Float[Array, "*b h w 3"],
        divergence: Float[Array, "*b h w 3"],
        sure: Float[Array, "*b h w 3"],
        *,
        inside: Bool[Array, "h w 1"] | None = None,
        level: Float[Array, ""] | None = None,
    ) -> Float[Array, "*b h w 3"]:
        del divergence, level
        features = mixing_features(x, y, variance, sure)
        if not self.sure:
            shown = jnp.repeat(jnp.asarray([True, True, True, False, True, False]), 3)
            features = jnp.where(shown, features, 0)
        alpha = self._net.apply({"params": params}, features, inside=inside)
        assert isinstance(alpha, jax.Array)
        return alpha if self.space == "linear" else from_log_weight(alpha, x, y)

    @property
    def _net(self) -> MixingNet:
        return MixingNet(width=self.width, ratio=self.ratio)


def he_normal(key: jax.Array, form: Params) -> dict[str, dict[str, Array]]:
    """Layers of these shapes: kernels normal with variance 2 / fan-in, biases zero.

    All numbers come from one draw, which compiles several times faster than one per layer.
    """
    sizes = {name: math.prod(layer["kernel"].shape) for name, layer in form.items()}
    numbers = jax.random.normal(key, (sum(sizes.values()),))
    params, start = {}, 0
    for name, layer in form.items():
        shape = layer["kernel"].shape
        kernel = numbers[start : start + sizes[name]].reshape(shape)
        start += sizes[name]
        scale = math.sqrt(2 / math.prod(shape[:-1]))
        params[name] = {"kernel": scale * kernel, "bias": jnp.zeros(layer["bias"].shape)}
    return params


def from_log_weight(
    alpha: Float[Array, "*b h w 3"], x: Float[Array, "*b h w 3"], y: Float[Array, "*b h w 3"]
) -> Float[Array, "*b h w 3"]:
    """The weight that does to radiance what `alpha` does to log(1 + radiance).

    With d = log(1 + y) − log(1 + x) it is (e^(αd) − 1) / (e^d − 1), which tends to α as d does to 0.
    """
    d = jnp.log1p(jnp.maximum(y, 0)) - jnp.log1p(jnp.maximum(x, 0))
    small = jnp.abs(d) < 1e-4
    safe = jnp.where(small, 1, d)
    return jnp.where(small, alpha, jnp.expm1(alpha * safe) / jnp.expm1(safe))


ARCHITECTURES: dict[str, type] = {"paper": Paper, "multiscale": Multiscale}
"""Names in configurations and weights files."""


def build(name: str, options: Mapping[str, Any] | None = None) -> Architecture:
    """The architecture of that name with these settings.

    Raises
    ------
    ValueError
        If there is no such name, or it has no such setting.
    """
    _checks.choice("architecture", name, ARCHITECTURES)
    options = dict(options or {})
    known = {field.name: field.type for field in dataclasses.fields(ARCHITECTURES[name])}
    for option in options:
        if option not in known:
            raise ValueError(
                f"the architecture {name!r} has no setting {option!r}, expected some of "
                f"{', '.join(known) or 'none'}."
            )
    return ARCHITECTURES[name](**options)


def name_of(architecture: Architecture) -> str:
    """The name that `build` knows it by."""
    for name, kind in ARCHITECTURES.items():
        if type(architecture) is kind:
            return name
    raise ValueError(
        f"{type(architecture).__name__} has no name in progden_jax.mixers.ARCHITECTURES: add it there."
    )
