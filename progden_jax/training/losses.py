"""What training makes small, per pixel and channel, and the order of the examples."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax.metrics import relmse_of_values, smape_of_values

Loss = Callable[[Array, Array], Array]


def l1(z: Float[Array, "..."], reference: Float[Array, "..."]) -> Float[Array, "..."]:
    """|z − μ|."""
    return jnp.abs(z - reference)


def logl1(z: Float[Array, "..."], reference: Float[Array, "..."]) -> Float[Array, "..."]:
    """|log(1 + z) − log(1 + μ)|, with both clamped at 0."""
    return jnp.abs(jnp.log1p(jnp.maximum(z, 0)) - jnp.log1p(jnp.maximum(reference, 0)))


def log_errors(
    z: Float[Array, "*b h w 3"],
    x: Float[Array, "*b h w 3"],
    y: Float[Array, "*b h w 3"],
    reference: Float[Array, "*b h w 3"],
) -> Float[Array, "*b"]:
    """log SMAPE + log RMSE of each image: one percent off either counts alike, whatever the image.

    A small share of the lesser error of x and y is added, so that an image that is nearly right does not
    outweigh all others.
    """

    def both(image: Array) -> tuple[Array, Array]:
        axes = (-3, -2, -1)
        return smape_of_values(image, reference).mean(axes), ((image - reference) ** 2).mean(axes)

    relative, squared = both(z)
    least_relative, least_squared = (
        jnp.minimum(a, b) for a, b in zip(both(x), both(y), strict=True)
    )
    tiny = jnp.finfo(z.dtype).tiny
    return jnp.log(relative + 0.05 * least_relative + 1e-6) + 0.5 * jnp.log(
        squared + 0.02 * least_squared + tiny
    )


LOG_RELMSE = "log-relmse"
"""The name of `log_relmse` in configurations."""


def log_relmse(
    z: Float[Array, "*b h w 3"], y: Float[Array, "*b h w 3"], reference: Float[Array, "*b h w 3"]
) -> Float[Array, "*b"]:
    """Of each image the logarithm of its relative MSE over that of y, so that noisy and clean images count
    alike; a twentieth is added, so that one that is nearly right does not outweigh all others."""
    axes = (-3, -2, -1)
    error, before = (relmse_of_values(image, reference).mean(axes) for image in (z, y))
    return jnp.log(error / jnp.maximum(before, jnp.finfo(z.dtype).tiny) + 0.05)


SUPERVISED: dict[str, Loss] = {
    "smape": smape_of_values,
    "relmse": relmse_of_values,
    "l1": l1,
    "logl1": logl1,
}
"""Losses against a reference, by their names in configurations."""


def relative_risk(
    risk: Float[Array, "*b h w 3"], denoised: Float[Array, "*b h w 3"]
) -> Float[Array, "*b h w 3"]:
    """A risk estimate over y² + 0.01, so that bright pixels do not outweigh all others.

    What divides is held constant in derivatives. It depends on the noise through y, so the weighted
    estimate is biased by as much as y varies; a denoiser's output varies little.
    """
    return risk / lax.stop_gradient(denoised**2 + 0.01)


def mix_risk(
    alpha: Float[Array, "*b h w 3"],
    x: Float[Array, "*b h w 3"],
    y: Float[Array, "*b h w 3"],
    variance: Float[Array, "*b h w 3"],
    divergence: Float[Array, "*b h w 3"],
    alpha_derivative: Float[Array, "*b h w 3"] | float = 0.0,
) -> Float[Array, "*b h w 3"]:
    """SURE of the mix z = x + α(y − x), whose mean estimates its squared error without a reference.

    From SURE(z) = (z − x)² + 2σ²∂z/∂x − σ² and ∂z/∂x = 1 + α(f' − 1) + (y − x)∂α/∂x:

        α²(y − x)² + 2α(σ²f' − σ²) + σ² + 2(y − x)·σ²∂α/∂x.

    With α held constant the last term is missing, and the minimum is the closed form (paper, Eq. 9). A
    network sees x, so its α depends on it: leaving the term out makes the risk of an α that follows the
    noise look lower than it is. `alpha_derivative` is an estimate of σ²∂α/∂x per pixel.
    """
    difference = y - x
    risk = alpha**2 * difference**2 + 2 * alpha * (divergence - variance) + variance
    return risk + 2 * difference * alpha_derivative
