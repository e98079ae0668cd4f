"""Structured probes: sign patterns under which neighbouring pixels cancel instead of averaging out."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from progden_jax import _checks
from progden_jax._numeric import safe_sqrt
from progden_jax.divergence import _adaptive, _random
from progden_jax.divergence._base import Evaluation, Function, Origin, accumulate

MOST_PROBES = 1024
"""Number of colours of the lattice, and so of probes before the pattern repeats."""

_ROW_STEP = 539
_CHANNEL_STEPS = (0, 775, 526)

SCALES = ("radiance", "sigma", "unit")

_REACH_LIMIT = 30
"""Times the geometric mean of |f| + σ/10: what lies above and is mostly noise counts for less."""

_WORTH_A_PROBE = 0.7
"""Outliers get probes of their own where the error of the rest is expected to fall to this share or less."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Probing:
    """Hierarchical probing on a lattice: mean of (σ²/w²) · b · J b, b = w·s·h_k.

    s is one field of random signs, so the estimate is unbiased for any K. h_k are the first K Walsh
    functions of each pixel's colour, x + 539 y + (0, 775, 526)_c mod 1024. After K = 2^n of them what is
    left is the J_ij between pixels whose colours agree modulo K, and these lie far apart: the error falls
    nearly as 1/K where J is local, not as 1/√K. The sequence is nested: more probes refine what fewer found.

    The variance per pixel is (σ_i²/w_i)² Σ_{j≠i} (J_ij w_j c_ij)², c_ij the mean of h_k(i) h_k(j). Cost:
    one denoiser pass and one tangent pass per probe.

    Where few values hold most of the variance, as fireflies do, up to a quarter of the probes are unit
    vectors of these (deflation): they come out exact, and the others no longer see them; see `deflated`.

    Parameters
    ----------
    probes : number K of tangent passes, 1 to 1024, best a power of two; by default 16, or with a tolerance
        1024, of which no more are spent than needed.
    tolerance : stop, in each tile, once the standard error of the mean of SURE over the tile is at most
        this share of that mean; None spends all probes. Checked after 1, 2, 4, ... probes per replicate. A
        tile whose mean SURE is near 0 spends all. The denoiser runs on the whole frame until the last
        tile has stopped. Under ``vmap`` all probes are computed, though the result is the same.
    replicates : independent fields of signs that the probes are shared between. With one, the
        default, the error is least and its size unknown (standard error inf); with R ≥ 2 the error is
        larger (by about √R) and its size known from their spread; no probe is then spent on a single value.
        A tolerance needs at least 2, its default.
    scale : "radiance" takes w = σ (|f(x)| + σ/10): a denoiser that works on the logarithm of radiance
        responds less to a pixel the brighter it is, so dark ones would pollute bright ones. Above 30 times
        its geometric mean |f| + σ/10 is reduced, unless |f| > σ, so that no firefly drowns the rest. "sigma"
        takes w = σ, better for filters linear in radiance; "unit" takes w = 1.
    tile : edge of a tile in pixels.
    chunk : probes in flight at once; memory grows with it.

    Raises
    ------
    ValueError
        If a setting is out of range, or probes is no multiple of replicates.

    Notes
    -----
    Stathopoulos, Laeuchli, Orginos 2013; deflation after Gambhir, Stathopoulos, Orginos 2017, of single
    values instead of singular vectors. Lattice and weight were fitted on training renders with OIDN's
    network: experiments/divergence.
    """

    probes: int | None = None
    tolerance: float | None = None
    replicates: int | None = None
    scale: str = "radiance"
    tile: int = 32
    chunk: int = 1

    def __post_init__(self) -> None:
        adaptive = self.tolerance is not None
        if self.probes is None:
            object.__setattr__(self, "probes", MOST_PROBES if adaptive else 16)
        if self.replicates is None:
            object.__setattr__(self, "replicates", 2 if adaptive else 1)
        _checks.positive_int("probes", self.probes, at_most=MOST_PROBES)
        _checks.positive_int("replicates", self.replicates)
        _checks.positive_int("tile", self.tile)
        _checks.positive_int("chunk", self.chunk)
        _checks.choice("scale", self.scale, SCALES)
        probes, replicates = self._counts
        if probes % replicates:
            raise ValueError(
                f"probes is {probes}, expected a multiple of replicates, which is {replicates}: "
                f"{probes + replicates - probes % replicates} would do."
            )
        if self.tolerance is not None:
            if not 0 < self.tolerance < float("inf"):
                raise ValueError(
                    f"tolerance is {self.tolerance}, expected a number above 0, such as 0.01."
                )
            if replicates < 2:
                raise ValueError(
                    "replicates is 1, and one field of signs cannot tell its own error: "
                    "give replicates=2 or more with a tolerance."
                )

    @property
    def _counts(self) -> tuple[int, int]:
        assert self.probes is not None
        assert self.replicates is not None
        return self.probes, self.replicates

    def evaluate(
        self,
        f: Function,
        x: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        key: jax.Array,
        *,
        origin: Origin = (0, 0),
    ) -> Evaluation:
        value, tangent = jax.linearize(f, x)
        weight, gain = weight_and_gain(safe_sqrt(variance), value, self.scale)
        pixel_colors = colors(*x.shape[:2], origin=origin)
        probes, replicates = self._counts
        each = probes // replicates

        def sample(probe: Array, replicate: Array) -> Array:
            pattern = _random.signs(key, replicate, x, origin) * walsh(probe, pixel_colors).astype(
                x.dtype
            )
            return gain * pattern * tangent(weight * pattern)

        if self.tolerance is not None:
            return _adaptive.evaluate(
                sample,
                each,
                replicates,
                value=value,
                sure_without=(value - x) ** 2 - variance,
                tolerance=self.tolerance,
                tile=self.tile,
                chunk=self.chunk,
            )
        outliers, number = deflated(variance, probes)
        if replicates > 1 or not len(outliers):
            return Evaluation(value, *_replicated(sample, each, replicates, self.chunk, value))

        place = jnp.arange(x.size).reshape(x.shape)
        taken = jnp.where(jnp.arange(len(outliers)) < number, outliers, x.size)
        apart = jnp.zeros(x.size, bool).at[taken].set(True, mode="drop").reshape(x.shape)
        weight, gain = jnp.where(apart, 0, weight), jnp.where(apart, 0, gain)
        shared = probes - number

        def either(probe: Array) -> Array:
            structured = probe < shared
            pattern = _random.signs(key, 0, x, origin) * walsh(probe, pixel_colors).astype(x.dtype)
            unit = (place == outliers[jnp.clip(probe - shared, 0)]).astype(x.dtype)
            found = tangent(jnp.where(structured, weight * pattern, unit))
            share = probes / shared.astype(x.dtype)
            return found * jnp.where(structured, share * gain * pattern, probes * variance * unit)

        # Probes of one field of signs are no independent samples: their spread is not their mean's error.
        found, _ = accumulate(either, probes, self.chunk, value)
        return Evaluation(value, found, jnp.full_like(value, jnp.inf))


def _replicated(
    sample: Callable[[Array, Array], Array], each: int, replicates: int, chunk: int, like: Array
) -> tuple[Array, Array]:
    def mean(replicate: Array) -> Array:
        return accumulate(lambda probe: sample(probe, replicate), each, chunk, like)[0]

    return accumulate(mean, replicates, 1, like)


def deflated(
    variance: Float[Array, "h w 3"], probes: int
) -> tuple[Int[Array, " most"], Int[Array, ""]]:
    """Flat indices of the largest variances, a quarter as many as probes, and how many get a probe each.

    With M of them out of the way and K − M probes for the rest, the error of these falls to about
    (1 − c)/(1 − M/K) where they hold the share c of the variance: M makes that least, and is 0 where it would
    stay above 0.7. (What reaches far depends on Σ σ² alone; structured probes fall as 1/K.)
    """
    most = probes // 4
    # The barrier keeps XLA from sorting a constant variance while it compiles, which takes minutes.
    values = lax.optimization_barrier(lax.stop_gradient(variance).ravel())
    top, index = lax.top_k(values, min(most, values.size))
    total = values.sum()
    held = jnp.concatenate([jnp.zeros(1, top.dtype), jnp.cumsum(top)])
    # Below what sums in float32 can tell, fewer are as good.
    left = jnp.maximum(1 - held / jnp.where(total > 0, total, 1), 1e-5)
    error = left / (1 - jnp.arange(len(held)) / probes)
    number = jnp.argmin(error)
    return index, jnp.where(error[number] <= _WORTH_A_PROBE, number, 0)


def colors(height: int, width: int, *, origin: Origin = (0, 0)) -> Int[Array, "h w 3"]:
    """Each pixel's colour in 0..1023, by its position alone.

    Reduced modulo 2^n it is a lattice colouring with 2^n colours for each n, the channels shifted.
    """
    rows, columns = (
        jnp.arange(n) + first for n, first in zip((height, width), origin, strict=True)
    )
    rows, columns = rows[:, None, None], columns[None, :, None]
    return (columns + _ROW_STEP * rows + jnp.asarray(_CHANNEL_STEPS)) % MOST_PROBES


def walsh(probe: Array | int, color: Int[Array, "h w 3"]) -> Int[Array, "h w 3"]:
    """±1: the Walsh function of this number at each colour, in Hadamard's order.

    The first 2^n of them tell colours apart by their lowest n bits and by nothing else.
    """
    shared = jnp.asarray(probe, color.dtype) & color
    return 1 - 2 * (lax.population_count(shared) & 1)


def weight_and_gain(sigma: Array, value: Array, scale: str) -> tuple[Array, Array]:
    """w, and σ²/w; formed apart so that nothing under- or overflows between 1e-6 and 1e6."""
    if scale == "unit":
        return jnp.ones_like(sigma), sigma**2
    if scale == "sigma":
        return sigma, sigma
    seen = sigma > 0
    signal, noise = jnp.abs(value), jnp.where(seen, sigma, 1)
    reach = jnp.where(seen, signal + noise / 10, 1)
    mean = jnp.exp(jnp.where(seen, jnp.log(reach), 0).sum() / jnp.maximum(seen.sum(), 1))
    # Bright surfaces are no outliers: 128 samples show them with |f| far above σ.
    level = _REACH_LIMIT * mean * jnp.clip(signal / noise, 1, 1e3) ** 2
    reach = reach * jnp.minimum(level / reach, 1) ** 1.5
    return jnp.where(seen, sigma * reach, 0), jnp.where(seen, sigma / reach, 0)
