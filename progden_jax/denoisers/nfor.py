"""NFOR: nonlinearly weighted first-order regression, the classical denoiser that needs no training.

Non-local-means weights choose which neighbours belong together, and a linear model of albedo, normal and
depth says how they differ. How strictly the weights choose is decided per pixel by the estimated error.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._windows import box_sum
from progden_jax.denoisers._base import Bound, Bounded, call
from progden_jax.denoisers._network import PRECISIONS, Valid, inside_of
from progden_jax.denoisers._patches import BLOCK, Windows
from progden_jax.denoisers._regression import regress
from progden_jax.frame import Frame

NAME = "nfor"

FEATURES = ("albedo", "normal", "depth")
"""Auxiliary buffers that radiance is modelled by, where a frame has them."""

_RISK_RADIUS = 7
"""Pixels over which estimated errors are averaged: those of single pixels are mostly noise."""

_CHOICE_RADIUS = 2
"""Pixels over which the choice of a bandwidth is smoothed, so that no seams show."""


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=(),
    meta_fields=("radius", "patch", "bandwidths", "ridge", "inputs", "name", "precision"),
)
@dataclasses.dataclass(frozen=True)
class NFOR:
    """Nonlinearly weighted first-order regression: a denoiser without weights to learn.

    Parameters
    ----------
    radius : of the windows that neighbours are taken from, in pixels.
    patch : radius of the patches that are compared, in pixels.
    bandwidths : k of the weights exp(−d/k²) to choose from, per pixel; one leaves no choice.
    ridge : λ of the regression: features (albedo, normal, logarithm of depth) that spread less than √λ in a
        window hardly count.
    inputs : auxiliary buffers used where a frame has them, of `FEATURES`.
    name : for messages.
    precision : of the matrix products; "highest" keeps float32 on GPUs.

    Raises
    ------
    ValueError
        If a setting is out of its range.

    References
    ----------
    Bitterli et al. 2016, "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo Renderings".
    There the difference of two half buffers tells the error that decides; here Stein's estimate, with the
    exact divergence for weights that count as constants, for which one buffer will do. There a second pass
    follows; here there is one.
    """

    radius: int = 9
    patch: int = 3
    bandwidths: tuple[float, ...] = (0.5, 1.0, 2.0)
    ridge: float = 1e-3
    inputs: tuple[str, ...] = FEATURES
    name: str = NAME
    precision: str = "highest"

    canvas = True
    alignment = BLOCK

    def __post_init__(self) -> None:
        _checks.positive_int("radius", self.radius)
        _checks.positive_int("patch", self.patch)
        _checks.choice("precision", self.precision, PRECISIONS)
        for role in self.inputs:
            _checks.choice("inputs", role, FEATURES)
        if not self.bandwidths or not all(k > 0 for k in self.bandwidths):
            raise ValueError(
                f"bandwidths is {self.bandwidths}, expected some numbers above 0, such as (0.5, 1.0, 2.0)."
            )
        if not self.ridge > 0:
            raise ValueError(f"ridge is {self.ridge}, expected a number above 0, such as 1e-3.")

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance, at least 0.

        Raises
        ------
        ValueError
            If the frame is no single image, or has no variance.
        """
        return call(self, frame)

    def bind(
        self,
        frame: Frame,
        *,
        valid: Valid = None,
        exposure: None = None,
        halves: tuple[Float[Array, "h w 3"], Float[Array, "h w 3"]] | None = None,
    ) -> Bound:
        """f with y = f(x) for the frame's variance and features, constants; a pytree.

        Parameters
        ----------
        frame : one frame with a variance.
        valid : the true (height, width), may be traced, of a frame padded beyond it.
        exposure : nothing, as radiance is taken as it is.
        halves : two independent renders of half the samples, whose mean is the colour. Then each is filtered
            with weights from the other, and the results are averaged: noise cannot choose its own weights.
            Their difference counts as a constant.

        Raises
        ------
        ValueError
            If the frame is no single image, has no variance, or the halves have other sizes.
        """
        del exposure
        _checks.image("frame.color", frame.color)
        if frame.variance is None:
            raise ValueError(
                f"{self.name} compares patches in units of their noise, and this frame has no variance: "
                "give one, make one from half-buffers or several seeds (read_exr's variance_from), or "
                "choose a network, such as 'oidn-hdr'."
            )
        difference = None
        if halves is not None:
            for name, half in zip(("halves[0]", "halves[1]"), halves, strict=True):
                _checks.same_shape(name, half, "frame.color", frame.color)
            difference = (halves[0] - halves[1]) / 2
        found = [
            _FEATURE[role](jnp.nan_to_num(buffer))
            for role in self.inputs
            if (buffer := getattr(frame, role)) is not None
        ]
        none = jnp.zeros((*frame.size, 0), frame.color.dtype)
        features = jnp.concatenate((none, *found), -1)
        return BoundNFOR(self, features, frame.variance, difference, valid)

    def exposure_of(self, frame: Frame, valid: Valid) -> None:
        """Nothing: a pixel depends on its neighbourhood alone."""
        del frame, valid

    @property
    def windows(self) -> Windows:
        """What each pixel is compared to."""
        return Windows(self.radius, self.patch)

    @property
    def receptive_radius(self) -> int:
        """How many pixels away an output pixel can depend on the input."""
        chosen = 0 if len(self.bandwidths) == 1 else _RISK_RADIUS + _CHOICE_RADIUS
        return self.windows.reach + chosen


def log_depth(depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Ratios of distances matter, whatever the scene's unit; 0 is a ray that hits nothing, and stays 0."""
    return jnp.where(depth > 0, jnp.log(jnp.where(depth > 0, depth, 1)), 0)


_FEATURE = {"albedo": lambda albedo: albedo, "normal": lambda normal: normal, "depth": log_depth}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BoundNFOR(Bounded):
    """y = f(x) for one frame: what `NFOR.bind` gives.

    The choice of bandwidths counts as constant in derivatives.
    """

    denoiser: NFOR
    features: Array
    variance: Array
    difference: Array | None
    valid: Valid

    def __call__(self, x: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """The denoised image, (H, W, 3) linear radiance, at least 0."""
        _checks.image("x", x)
        _checks.same_shape("x", x, "the frame's variance", self.variance)
        return _run(self, x)

    def filtered(
        self, x: Float[Array, "h w 3"], images: Float[Array, "b h w 3"]
    ) -> Float[Array, "b h w 3"]:
        """Other images, filtered as x is: by the same kernels and bandwidths; at least 0."""
        _checks.image("x", x)
        _checks.images("images", images)
        _checks.same_shape("images[0]", images[0], "x", x)
        return _run(self, x, images)


@jax.jit
def _run(f: BoundNFOR, x: Array, others: Array | None = None) -> Array:
    inside = inside_of(x.shape[:2], f.valid)
    if inside is None:
        inside = jnp.ones((*x.shape[:2], 1), bool)

    def shown(image: Array) -> Array:
        return image if f.valid is None else _repeated(image, f.valid)

    color, variance, features = (shown(a) for a in (x, f.variance, f.features))
    images = guides = color[None]
    if f.difference is not None:
        half = shown(f.difference)
        images, guides = (jnp.stack((color + s * half, color - s * half)) for s in (1, -1))
        variance = 2 * variance
    if others is not None:
        beside = jnp.concatenate([shown(image) for image in others], -1)
        beside = jnp.broadcast_to(beside, (len(images), *beside.shape))
        images = jnp.concatenate([images, beside], -1)
    settings = f.denoiser
    found = lax.map(
        lambda pair: regress(
            pair[0],
            features,
            pair[1],
            variance,
            inside[..., 0],
            windows=settings.windows,
            bandwidths=settings.bandwidths,
            ridge=settings.ridge,
            precision=settings.precision,
        ),
        (images, guides),
    )
    candidates, leverage = (a.mean(0) for a in found)
    if len(settings.bandwidths) > 1:
        risks = (candidates[..., :3] - x) ** 2 + 2 * f.variance * leverage[..., None]
        share = lax.stop_gradient(_least_risk(jnp.where(inside, risks, 0), inside))
        mixed = (share * candidates).sum(0)
    else:
        mixed = candidates[0]
    result = jnp.where(inside & (mixed > 0), mixed, 0)
    if others is None:
        return result
    return jnp.stack(jnp.split(result[..., 3:], len(others), -1))


def _least_risk(risks: Float[Array, "k h w 3"], inside: Array) -> Float[Array, "k h w 1"]:
    """Shares of the bandwidths whose error, averaged over a window and the channels, is least."""
    near = jax.vmap(lambda risk: box_sum(risk, 2 * _RISK_RADIUS + 1).sum(-1, keepdims=True))(risks)
    best = jnp.argmin(near, 0)
    chosen = (jnp.arange(len(risks))[:, None, None, None] == best) & inside
    window = 2 * _CHOICE_RADIUS + 1
    votes = jax.vmap(lambda c: box_sum(c, window))(chosen.astype(risks.dtype))
    return votes / jnp.maximum(votes.sum(0), 1)


def _repeated(image: Float[Array, "h w c"], valid: Any) -> Float[Array, "h w c"]:
    """The padding around an image of that true size filled with its border."""
    for axis, size in enumerate(valid):
        index = jnp.minimum(jnp.arange(image.shape[axis]), size - 1)
        image = jnp.take(image, index, axis=axis)
    return image
