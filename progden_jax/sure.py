"""Stein's unbiased risk estimate: the squared error of a denoised image, without a reference."""

from jaxtyping import Array, Float

from progden_jax import _checks


def sure(
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    divergence: Float[Array, "h w 3"],
) -> Float[Array, "h w 3"]:
    """(y − x)² + 2·divergence − variance, whose mean over pixels estimates the denoised image's MSE.

    Unbiased where the noise of `x` is normal, independent between pixels, and of the variance given.
    A single value is very noisy and may be negative, and so may the mean of few: clip neither.

    Parameters
    ----------
    x : (..., H, W, 3) noisy image, linear radiance.
    y : (..., H, W, 3) denoised image f(x).
    variance : (..., H, W, 3) of `x`, that is of the sample mean.
    divergence : (..., H, W, 3) estimate of σ²·∂f(x)/∂x per pixel and channel, see `divergence`.

    Raises
    ------
    ValueError
        If shapes differ or are not images.

    Notes
    -----
    Firmino et al. 2022, Eq. 1, with a diagonal covariance.
    """
    _checks.images("x", x)
    for name, value in (("y", y), ("variance", variance), ("divergence", divergence)):
        _checks.same_shape(name, value, "x", x)
    return (y - x) ** 2 + 2 * divergence - variance
