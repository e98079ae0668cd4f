"""The combination kernel: noisy and denoised pixels of a window make one estimate of its centre.

Where y is the render and z its denoised version, y_i + (z_c − z_i) is another estimate of the centre c for
every pixel i around it. Their weighted mean is z_c plus the weighted mean of the residuals y − z (Back et al.
2020, Eqs. 4, 8 and 15): so the kernel is a filter of residuals, of which all that must be kept are sums.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from progden_jax import _checks
from progden_jax._neighbourhood import weighted_sums

Weigh = Callable[[Array, Array, int], Float[Array, "k n h w"]]
"""From the numbers of a buffer and an offset, in raster order, and k to the weights > 0 of k offsets on."""

_AT_ONCE = 1 << 24
"""Weights that exist at a time, if that is more than a row of the window per pixel: few large convolutions
are faster than many small ones."""


def combine(
    noisy: Float[Array, "b n h w 3"],
    denoised: Float[Array, "b n h w 3"],
    weigh: Weigh,
    *,
    window: int,
    reliability: Float[Array, "b n h w 1"] | None = None,
    trust: Float[Array, "n h w 1"] | None = None,
    shares: Float[Array, "b n"] | None = None,
    inside: Bool[Array, "h w 1"] | None = None,
) -> Float[Array, "n h w 3"]:
    """β = Σ_b Σ_i w_ib (y_ib + z_cb − z_ib) / Σ_b Σ_i w_ib over the window inside the image.

    With equal images it is their mean, whatever the weights.

    Parameters
    ----------
    noisy, denoised : B sub-averages y_b of the samples, independent from pixel to pixel, and their
        correlated versions z_b, of n images; B = 1 is the kernel of one buffer.
    weigh : gives the weights of some rows of one buffer's window; the centre's is among them.
    window : odd width in pixels.
    reliability : of every y_ib, > 0, by which its weight is multiplied in all windows; None: 1.
    trust : weight ≥ 0 of the mean of z_c itself, as one more estimate of its pixel; None: 0.
    shares : of the samples, by which each sub-average counts: its weights are those of every one of them;
        None: equal.
    inside : False where the images are padding.

    Raises
    ------
    ValueError
        If the shapes differ, or the window is no odd number.

    Notes
    -----
    Back et al. 2020, "Deep Combiner for Independent and Correlated Pixel Estimates", Eq. 14, and Eqs. 4 and
    8 with one buffer; reliability, trust and shares are not in it. With a buffer for each sample, equal
    weights within a sub-average make Eq. 14 this kernel of sub-averages weighted by their samples. Of
    B·window² weights per pixel `window` exist at a time where images are large.
    """
    _checks.images("noisy", noisy)
    _checks.same_shape("denoised", denoised, "noisy", noisy)
    _checks.odd_int("window", window)
    residual = noisy - denoised
    counted = jnp.ones_like(residual[..., :1])
    both = jnp.concatenate([residual, counted], axis=-1)
    counts = counts_of(shares)
    both = both * counts
    if reliability is not None:
        both = both * reliability
    if inside is not None:
        both = jnp.where(inside, both, 0)

    fitting = _AT_ONCE // (window * counted[0].size)
    rows = max((n for n in range(1, window + 1) if window % n == 0 and n <= fitting), default=1)

    def sums_of(buffer: Array, planes: Float[Array, "4 n h w"]) -> Float[Array, "4 n h w"]:
        count = rows * window
        return weighted_sums(
            planes, lambda first: weigh(buffer, first, count), window=window, at_once=count
        )

    planes = jnp.moveaxis(both, -1, 1)
    sums = jax.lax.map(lambda pair: sums_of(*pair), (jnp.arange(len(noisy)), planes))
    weights = sums[:, 3, ..., None]
    filtered = jnp.moveaxis(sums[:, :3], 1, -1)
    # Around the mean, for buffers that are equal must come out exactly as they are.
    middle = (counts * denoised).mean(0)
    shifted = weights * (denoised - middle) + filtered
    total = weights.sum(0) if trust is None else weights.sum(0) + trust
    total = jnp.maximum(total, jnp.finfo(weights.dtype).tiny)
    return middle + shifted.sum(0) / total


def counts_of(shares: Float[Array, "b n"] | None) -> Any:
    """The shares over their mean, to be multiplied with sub-averages; 1 where they are equal."""
    return 1 if shares is None else (shares / shares.mean(0))[..., None, None, None]
