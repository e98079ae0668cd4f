"""A small network that corrects the closed form from what windows of several sizes say."""

import dataclasses
import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from progden_jax import _checks, _windows
from progden_jax._convolution import RectifiedConv, convolve
from progden_jax.mixers._base import Params
from progden_jax.mixing import level_of

WINDOWS = (3, 7, 15, 31)
"""Widths in pixels of the windows that statistics are averaged over."""

CHANNELS = 54
"""Of `features`."""

GROUPS = ("scales", "divergence", "relative")
"""Of features that an ablation can leave out, see `Multiscale`."""


@dataclasses.dataclass(frozen=True)
class Multiscale:
    """α = sigmoid(logit(closed form over 15×15) + network(`features`)).

    The features are ratios, so that exposure does not matter, and carry what the paper's network would have
    to learn to average: with a third of its weights an hour of training is enough. Starting
    from the closed form it does not collapse to α = 1, so it needs no swaps.

    Parameters
    ----------
    width : channels of the hidden layers.
    blocks : residual blocks of two 3×3 convolutions.
    without : groups of features that are hidden from the network, for ablations: "scales", the statistics of
        windows other than 15×15; "divergence", every f'; "relative", what is relative to the surroundings.
    start : "closed-form", or "none" for α = sigmoid(network) (an ablation).
    """

    width: int = 32
    blocks: int = 2
    without: tuple[str, ...] = ()
    start: str = "closed-form"

    def __post_init__(self) -> None:
        _checks.positive_int("width", self.width)
        _checks.positive_int("blocks", self.blocks)
        # Configurations and weights files have lists.
        object.__setattr__(self, "without", tuple(self.without))
        for group in self.without:
            _checks.choice("without", group, GROUPS)
        _checks.choice("start", self.start, ("closed-form", "none"))

    @property
    def receptive_radius(self) -> int:
        """How many pixels away α can depend on the images: the brightness is averaged twice."""
        return 15 // 2 + WINDOWS[-1] // 2 + 2 * self.blocks + 1

    def init(self, key: jax.Array) -> Params:
        """Weights that give the closed form: the last layer is zero."""
        return self._net.init(key, jnp.zeros((1, 8, 8, CHANNELS)), None)["params"]

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
        """α in [0, 1]; as if the image ended where `inside` is False. 0 where a window has no variance."""
        del sure

        def prepared(*images: Array) -> tuple[Array, Array, Array]:
            return features(*images, inside=inside, level=level, without=self.without)

        for _ in range(x.ndim - 3):
            prepared = jax.vmap(prepared)
        stacked, closed, noisy = prepared(x, y, variance, divergence)
        correction = self._net.apply({"params": params}, stacked, inside)
        assert isinstance(correction, jax.Array)
        if self.start == "none":
            alpha = nn.sigmoid(correction)
        else:
            kept = jnp.clip(closed, 0.01, 0.99)
            alpha = nn.sigmoid(jnp.log(kept / (1 - kept)) + correction)
        return jnp.where(noisy, alpha, 0)

    @property
    def _net(self) -> "_Net":
        return _Net(self.width, self.blocks)


class _Net(nn.Module):
    width: int
    blocks: int

    @nn.compact
    def __call__(self, stacked: Array, inside: Array | None) -> Array:
        def start(scale: float) -> nn.initializers.Initializer:
            return nn.initializers.variance_scaling(scale, "fan_in", "truncated_normal")

        def masked(h: Array) -> Array:
            return h if inside is None else jnp.where(inside, h, 0)

        def conv(channels: int, size: int, init: Any, name: str) -> nn.Conv:
            taps = (size, size)
            settings: dict[str, Any] = {"kernel_init": init, "conv_general_dilated": convolve}
            return nn.Conv(channels, taps, **settings, name=name)

        h = masked(nn.relu(conv(self.width, 1, start(1.0), "conv_in")(masked(stacked))))
        for block in range(1, self.blocks + 1):
            first = RectifiedConv(self.width, 3, start(1.0), name=f"block{block}_conv1")
            second = RectifiedConv(self.width, 3, start(0.1), name=f"block{block}_conv2")
            h = second(first(h, inside), inside, plus=h)
        return conv(3, 3, nn.initializers.zeros_init(), "conv_out")(h)


def features(
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    divergence: Float[Array, "h w 3"],
    *,
    inside: Bool[Array, "h w 1"] | None = None,
    level: Float[Array, ""] | None = None,
    without: tuple[str, ...] = (),
) -> tuple[Float[Array, "h w f"], Float[Array, "h w 3"], Bool[Array, "h w 3"]]:
    """What the network sees, the closed form over 15×15 windows, and where such a window has variance.

    All are ratios of means over windows, RGB each: of every window the closed-form α and log (y − x)²/σ²;
    of two f'; then per pixel log (y − x)²/σ², f' and α, the noise relative to the local brightness,
    variance and brightness relative to their surroundings, and x − y in units of its local size and of
    the noise.

    Parameters
    ----------
    x, y, variance, divergence : (H, W, 3), see `progden_jax.sure`.
    inside : (H, W, 1) False where they are padding around the image, which is a rectangle.
    level : mean radiance of the whole image, where these are a tile of it; by default that of `x`.
    without : `GROUPS` of features to give as zeros.
    """
    there = jnp.ones((*x.shape[:-1], 1), bool) if inside is None else inside

    @functools.cache  # tracing takes time, too
    def pixels(window: int, channels: int) -> Array:
        rows, columns = (there.any(axis, keepdims=True).astype(x.dtype) for axis in (1, 0))
        counts = (jnp.maximum(_windows.box_sum(n, window), 1) for n in (rows, columns))
        # As a product, not of one image for all channels: XLA turns a division by what is broadcast into a
        # product, and products and the sums before them it repeats in every use.
        rows, columns = (jnp.broadcast_to(n, (*x.shape[:-1], channels)) for n in counts)
        return rows * columns

    def mean(value: Array, window: int) -> Array:
        value = value if inside is None else jnp.where(inside, value, 0)
        return _windows.box_sum(value, window) / pixels(window, value.shape[-1])

    # In units of the image's mean no square here leaves float32's range, nor its derivatives.
    if level is None:
        level = level_of(x, inside)
    # A power of two rounds nothing, so that an image's tiles see its very features.
    unit = jnp.ldexp(jnp.ones_like(level), -jnp.frexp(level)[1])
    x, y, variance, divergence = unit * x, unit * y, unit**2 * variance, unit**2 * divergence

    brightness = mean(jnp.maximum(y, 0).mean(-1, keepdims=True), 15)
    brightness = brightness + 0.01 * mean(brightness, 31) + 1e-6
    # Below a thousandth of the brightness differences do not show; this keeps ratios of nothing quiet.
    least = 1e-6 * brightness**2
    squared, useful = (y - x) ** 2, variance - divergence
    away = {1: squared, **{w: mean(squared, w) for w in WINDOWS}}
    noise = {1: variance, **{w: mean(variance, w) for w in WINDOWS}}

    found: list[Array] = []

    def show(feature: Array, *groups: str) -> None:
        found.append(jnp.zeros_like(feature) if set(groups) & set(without) else feature)

    closed = x
    for w in WINDOWS:
        scales = () if w == 15 else ("scales",)
        changed = mean(divergence, w)
        alpha = jnp.clip((noise[w] - changed) / (away[w] + least), 0, 1)
        closed = alpha if w == 15 else closed
        show(alpha, *scales)
        show(0.3 * jnp.log((away[w] + least) / (noise[w] + least)), *scales)
        if w in (3, 15):
            slope = jnp.clip(changed / (noise[w] + least), -1, 2)
            show(slope, "divergence", *scales)
    show(0.2 * jnp.log((squared + least) / (variance + least)))
    show(jnp.clip(divergence / (variance + least), -1, 2), "divergence")
    show(jnp.clip(useful / (squared + least), -1, 2))
    show(0.2 * jnp.log((noise[15] + least) / brightness**2), "relative")
    show(0.2 * jnp.log((variance + least) / (noise[15] + least)), "relative")
    show(0.5 * jnp.log(jnp.maximum(y, 0) / brightness + 0.01), "relative")
    show(0.5 * jnp.clip((x - y) / jnp.sqrt(away[7] + least), -3, 3), "relative")
    show(0.5 * jnp.clip((x - y) / jnp.sqrt(noise[7] + least), -3, 3), "relative")
    return jnp.concatenate(found, -1), closed, noise[15] > 0
