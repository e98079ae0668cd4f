"""How much of the denoised image to mix in: α from a network or in closed form."""

import dataclasses
import functools
from typing import Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from progden_jax import _checks, _windows
from progden_jax._convolution import RectifiedConv, convolve
from progden_jax._numeric import safe_sqrt

FEATURES = 18


def mixing_features(
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    sure: Float[Array, "h w 3"],
) -> Float[Array, "h w 18"]:
    """What the mixing network sees of each pixel.

    Returns
    -------
    (..., H, W, 18), RGB each: x and y clamped below at 0; arctan of σ², of SURE, of (y − x)², and of
    SURE + σ² − (y − x)², which is 2σ²f'. Swapping x with y and σ² with SURE swaps the first four
    and leaves the rest.

    Raises
    ------
    ValueError
        If shapes differ or are not images.

    Notes
    -----
    Firmino et al. 2022, section 4.3.
    """
    _checks.images("x", x)
    for name, value in (("y", y), ("variance", variance), ("sure", sure)):
        _checks.same_shape(name, value, "x", x)
    squared = (y - x) ** 2
    return jnp.concatenate(
        [
            jnp.maximum(x, 0),
            jnp.maximum(y, 0),
            jnp.arctan(variance),
            jnp.arctan(sure),
            jnp.arctan(squared),
            jnp.arctan(sure + variance - squared),
        ],
        axis=-1,
    )


def f_act(
    x1: Float[Array, "..."], x2: Float[Array, "..."], x3: Float[Array, "..."]
) -> Float[Array, "..."]:
    """α = clip((x1 − x2) / max(x3, 1e-6), 0, 1), the form of the closed solution (paper, Eq. 19)."""
    return jnp.clip((x1 - x2) / jnp.maximum(x3, 1e-6), 0, 1)


class MixingNet(nn.Module):
    """The paper's mixing network (section 4.3): features (..., H, W, 18) to α (..., H, W, 3) in [0, 1].

    conv 5×5 to 48 channels, two residual blocks of two 3×3, conv 3×3 to 9, then `f_act` on three
    groups of three; zero padding throughout; about 108 thousand weights. Without `ratio` (the paper's
    ablation) conv_out has 3 channels, and α is their logistic sigmoid.
    """

    width: int = 48
    ratio: bool = True

    def setup(self) -> None:
        self.conv_in = RectifiedConv(self.width, 5)
        self.block1_conv1 = RectifiedConv(self.width, 3)
        self.block1_conv2 = RectifiedConv(self.width, 3)
        self.block2_conv1 = RectifiedConv(self.width, 3)
        self.block2_conv2 = RectifiedConv(self.width, 3)
        self.conv_out = self._conv(9 if self.ratio else 3, 3)

    def _conv(self, channels: int, size: int) -> nn.Conv:
        return nn.Conv(channels, (size, size), padding="SAME", conv_general_dilated=convolve)

    def __call__(
        self, features: Float[Array, "*b h w 18"], *, inside: Bool[Array, "h w 1"] | None = None
    ) -> Float[Array, "*b h w 3"]:
        """α; `inside` is False where the features are padding around the image."""
        _checks.images("features", features, channels=FEATURES)

        def masked(h: Array) -> Array:
            return h if inside is None else jnp.where(inside, h, 0)

        h = self.conv_in(masked(features), inside)
        for first, second in (
            (self.block1_conv1, self.block1_conv2),
            (self.block2_conv1, self.block2_conv2),
        ):
            h = second(first(h, inside), inside, plus=h)
        out = self.conv_out(h)
        return f_act(*jnp.split(out, 3, axis=-1)) if self.ratio else nn.sigmoid(out)


def closed_form_alpha(
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    divergence: Float[Array, "h w 3"],
    *,
    window: int = 15,
    confidence: float = 0.0,
    inside: Bool[Array, "h w 1"] | None = None,
) -> Float[Array, "h w 3"]:
    """α = σ²(1 − f') / (y − x)², both averaged over a window per channel, clipped to [0, 1].

    The mix of least expected squared error where α is constant over the window. A ratio of noisy averages:
    small windows are far too noisy, and where samples are few their variances are too small, so that
    it keeps too much of the render. `confidence` answers the latter: 1 − α is the share of (y − x)² that
    noise does not explain, E = Σ (y − x)² − σ²(1 − f'), and only what exceeds so many standard errors of E
    counts as bias of the denoiser. Those errors come from the spread in the window, at most 2σ|y − x| a
    pixel, which vanishes with the noise: as samples grow both forms agree.

    Parameters
    ----------
    x, y, variance, divergence : (H, W, 3), see `sure`. Padding around the image must have zero variance
        and y = x.
    window : odd width in pixels.
    inside : (H, W, 1) False where the arrays are padding around the image.
    confidence : standard errors of evidence to ask for before the render is mixed in; 0 is the paper's form.

    Returns
    -------
    (H, W, 3) in [0, 1]; 0 where the window has no variance or y equals x throughout it.

    Notes
    -----
    Firmino et al. 2022, Eq. 9; the confidence is this project's, see experiments/main_job.
    """
    _checks.image("x", x)
    for name, value in (("y", y), ("variance", variance), ("divergence", divergence)):
        _checks.same_shape(name, value, "x", x)
    _checks.odd_int("window", window)
    return _closed_form_alpha(x, y, variance, divergence, inside, window, confidence)


@functools.partial(jax.jit, static_argnames=("window", "confidence"))
def _closed_form_alpha(
    x: Array,
    y: Array,
    variance: Array,
    divergence: Array,
    inside: Array | None,
    window: int,
    confidence: float,
) -> Array:
    squared = (y - x) ** 2
    excess = squared - (variance - divergence)
    total, noise = _windows.box_sum(squared, window), _windows.box_sum(variance, window)
    bias = _windows.box_sum(excess, window)
    if confidence:
        counted = jnp.ones_like(x[..., :1]) if inside is None else inside.astype(x.dtype)
        pixels = jnp.maximum(_windows.box_sum(counted, window), 1)
        largest = jnp.maximum(variance, noise / pixels)
        spread = _windows.box_sum(jnp.minimum(excess**2, 4 * squared * largest), window)
        bias = bias - confidence * safe_sqrt(spread)
    usable = (total > 0) & (noise > 0)
    # Selecting before dividing keeps a tiny denominator from overflowing, in the gradient too. (Written as
    # clip(bias, 0, total) / total, LLVM with AVX-512 compiles a wrong derivative; a test pins this one.)
    mixed = usable & (bias > 0) & (bias < total)
    share = jnp.where(mixed, bias, 0) / jnp.where(mixed, total, 1)
    return jnp.where(usable & (bias < total), 1 - share, 0)


def level_of(
    x: Float[Array, "h w 3"], inside: Bool[Array, "h w 1"] | None = None
) -> Float[Array, ""]:
    """Mean over pixels and channels of the radiance above 0, a constant in derivatives; see `Mixer`."""
    counted = jnp.ones_like(x[..., :1]) if inside is None else inside.astype(x.dtype)
    radiance = lax.stop_gradient(jnp.maximum(x, 0)) * counted
    return radiance.sum() / (3 * counted.sum())


class Mixer(Protocol):
    """Anything that gives α from what is known of an image; a pytree, so that it passes through jit."""

    def __call__(
        self,
        x: Float[Array, "h w 3"],
        y: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        divergence: Float[Array, "h w 3"],
        sure: Float[Array, "h w 3"],
        *,
        inside: Bool[Array, "h w 1"] | None = None,
        level: Float[Array, ""] | None = None,
    ) -> Float[Array, "h w 3"]:
        """α in [0, 1], (H, W, 3).

        `inside` is False where the arrays are padding around the image. `level` is the mean radiance of the
        whole image where they are a tile of it, which only mixers with a `receptive_radius` are called on.
        """
        ...


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ClosedForm:
    """The mixer that needs no weights: `closed_form_alpha` over a window of this width."""

    window: int = 15
    confidence: float = 0.7

    def __post_init__(self) -> None:
        _checks.odd_int("window", self.window)
        if not 0 <= self.confidence < float("inf"):
            raise ValueError(
                f"confidence is {self.confidence}, expected a number of standard errors from 0 up."
            )

    @property
    def receptive_radius(self) -> int:
        """How many pixels away α can depend on the images."""
        return self.window // 2

    def __call__(
        self,
        x: Float[Array, "h w 3"],
        y: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        divergence: Float[Array, "h w 3"],
        sure: Float[Array, "h w 3"],
        *,
        inside: Bool[Array, "h w 1"] | None = None,
        level: Float[Array, ""] | None = None,
    ) -> Float[Array, "h w 3"]:
        del sure, level
        return closed_form_alpha(
            x,
            y,
            variance,
            divergence,
            window=self.window,
            confidence=self.confidence,
            inside=inside,
        )
