"""How far an image is from its reference: RMSE, SMAPE, relative MSE, SSIM and HDR-FLIP.

Layout everywhere: (H, W, 3) linear radiance, finite, one image at a time (map over a batch with
``jax.vmap``). The reference is the second argument; shapes must be equal, nothing is broadcast.
All but FLIP are pure JAX: they compile, map and have finite gradients, at equality too. A NaN in
an image gives a NaN.
"""

import os
from typing import Any

import dm_pix
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from progden_jax import _checks, transfer

SMAPE_EPSILON = 0.01
RELMSE_EPSILON = 0.01
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5


def rmse(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Root of the mean squared difference over pixels and channels, in radiance.

    Parameters
    ----------
    image, reference : (H, W, 3) linear radiance.

    Returns
    -------
    A scalar of the inputs' dtype, at least 0. Its gradient at equality is taken as 0.

    Raises
    ------
    ValueError
        If an argument is not one floating-point image, or the shapes differ.
    """
    image, reference = _pair(image, reference)
    mse = jnp.mean((image - reference) ** 2)
    differs = mse > 0
    return jnp.where(differs, jnp.sqrt(jnp.where(differs, mse, 1)), mse)


def smape(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Symmetric mean absolute percentage error, mean |z − μ| / (|z| + |μ| + 0.01).

    Parameters
    ----------
    image, reference : (H, W, 3) linear radiance.

    Returns
    -------
    A scalar of the inputs' dtype in [0, 1): a fraction, in spite of the name.

    Raises
    ------
    ValueError
        If an argument is not one floating-point image, or the shapes differ.
    """
    return jnp.mean(smape_of_values(*_pair(image, reference)))


def smape_of_values(
    z: Float[Array, "*shape"], mu: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """|z − μ| / (|z| + |μ| + 0.01) of every value (Firmino et al. 2022, section 5.3)."""
    return jnp.abs(z - mu) / (jnp.abs(z) + jnp.abs(mu) + SMAPE_EPSILON)


def relmse(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Mean squared error relative to the squared reference, mean (z − μ)² / (μ² + 0.01).

    Parameters
    ----------
    image, reference : (H, W, 3) linear radiance.

    Returns
    -------
    A scalar of the inputs' dtype, at least 0; one firefly can make it arbitrarily large.

    Raises
    ------
    ValueError
        If an argument is not one floating-point image, or the shapes differ.
    """
    return jnp.mean(relmse_of_values(*_pair(image, reference)))


def relmse_of_values(
    z: Float[Array, "*shape"], mu: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """(z − μ)² / (μ² + 0.01) of every value."""
    return (z - mu) ** 2 / (mu**2 + RELMSE_EPSILON)


def ssim(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Structural similarity of the tone-mapped images, averaged over pixels and channels.

    SSIM is defined on display values, so radiance goes through `tone_map` first. The window is a
    Gaussian of standard deviation 1.5 over 11×11 pixels that lie within the image; an axis shorter
    than that gets the largest odd window that fits.

    Parameters
    ----------
    image, reference : (H, W, 3) linear radiance; negative values count as 0.

    Returns
    -------
    A scalar of the inputs' dtype in [−1, 1], 1 at equality.

    Raises
    ------
    ValueError
        If an argument is not one floating-point image, or the shapes differ.

    References
    ----------
    Wang, Bovik, Sheikh, Simoncelli 2004, Image quality assessment, with K1 = 0.01 and K2 = 0.03.
    """
    image, reference = _pair(image, reference)
    window: Any = _gaussian
    return jnp.asarray(dm_pix.ssim(tone_map(image), tone_map(reference), filter_fn=window))


def tone_map(radiance: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Display values in [0, 1]: Reinhard's x / (1 + x) of the radiance, then the sRGB curve.

    Parameters
    ----------
    radiance : linear radiance of any shape; negative values count as 0.
    """
    positive = jnp.maximum(radiance, 0)
    return transfer.srgb(positive / (1 + positive))


def flip(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> float:
    """Mean HDR-FLIP error over the pixels, by NVIDIA's evaluator at its default settings.

    Parameters
    ----------
    image, reference : (H, W, 3) linear radiance in sRGB primaries, NumPy or JAX, from 1×1 pixels
        up; computed in float32. Negative values, which no display can show, count as 0.

    Returns
    -------
    A Python float in [0, 1], 0 at equality. It is not symmetric: the exposures at which the two
    are compared come from the reference. Where that is black, they are those of luminance 2⁻²³,
    the floor that FLIP itself puts under a reference's median.

    Raises
    ------
    ValueError
        If an argument is not one floating-point image of finite values, or the shapes differ.
    TypeError
        Under ``jit``, ``vmap`` or ``grad``: FLIP is compiled C++ that JAX cannot trace.

    References
    ----------
    Andersson, Nilsson, Shirley, Akenine-Möller 2021, Visualizing Errors in Rendered High Dynamic
    Range Images; 67 pixels per degree, ACES tone mapping.
    """
    return _flip(image, reference)[1]


def flip_map(
    image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """HDR-FLIP error of every pixel, whose mean is `flip`.

    Parameters
    ----------
    image, reference : as for `flip`, which also says what is raised.

    Returns
    -------
    (H, W) float32 NumPy array in [0, 1].
    """
    return _flip(image, reference)[0]


def _pair(image: Any, reference: Any) -> tuple[Array, Array]:
    _check(image, reference)
    return jnp.asarray(image), jnp.asarray(reference)


def _check(image: Any, reference: Any) -> None:
    _checks.image("image", image)
    _checks.image("reference", reference)
    _checks.same_shape("image", image, "reference", reference)


def _gaussian(images: Array) -> Array:
    """SSIM's window over the last but two and last but one axes, inside the image only.

    dm_pix's own window wraps around images that are smaller than it (its `jnp.convolve` swaps
    the two), and is a matrix product elsewhere, which a GPU may round to TF32.
    """
    for axis in (-3, -2):
        size = images.shape[axis]
        radius = min(SSIM_WINDOW, size - (size + 1) % 2) // 2
        weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / SSIM_SIGMA) ** 2)
        weights /= weights.sum()
        inside = size - 2 * radius
        images = sum(
            (
                float(weight) * lax.slice_in_dim(images, start, start + inside, axis=axis)
                for start, weight in enumerate(weights)
            ),
            start=jnp.zeros((), images.dtype),
        )
    return images


# FLIP's floor under a luminance, and the stops of exposure that bring it to 0.85 on its ACES curve.
_FLIP_FLOOR = 2.0**-23
_FLIP_DARK_EXPOSURE = 23 + 1.0832973
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def _flip(image: Any, reference: Any) -> tuple[np.ndarray, float]:
    for name, value in (("image", image), ("reference", reference)):
        if isinstance(value, Tracer):
            raise TypeError(
                f"{name} is being traced, but FLIP cannot be traced by JAX: call it outside jit, "
                "vmap and grad, on arrays that hold values."
            )
    _check(image, reference)
    test, truth = _displayable("image", image), _displayable("reference", reference)
    settings = {}
    # FLIP finds no exposure for a reference this dark, and would end the process.
    if (truth @ _LUMINANCE).max() < 1.001 * _FLIP_FLOOR:
        settings = dict.fromkeys(("startExposure", "stopExposure"), _FLIP_DARK_EXPOSURE)
    # FLIP's idle OpenMP threads would else spin, for four times its run time on two cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    import flip_evaluator

    errors, mean, _ = flip_evaluator.evaluate(
        truth, test, "HDR", applyMagma=False, parameters=settings
    )
    return np.asarray(errors)[..., 0], float(mean)


def _displayable(name: str, value: Any) -> np.ndarray:
    """`value` as FLIP needs it: contiguous float32, finite, at least 0."""
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(value, np.float32)
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(-1).sum())
        raise ValueError(
            f"{name} has NaN or infinite values in {bad} pixels, which FLIP cannot compare: "
            "repair them first, for instance with progden_jax.repair."
        )
    return np.maximum(array, 0)
