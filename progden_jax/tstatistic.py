"""The confidence bound on α that makes the mix converge to the truth."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jax import nn
from jax.scipy import special
from jaxtyping import Array, Bool, Float

from progden_jax import _checks, _windows
from progden_jax._numeric import safe_sqrt

_SIGMOIDS = {"normal": special.ndtr, "logistic": nn.sigmoid}


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("a", "c"),
    meta_fields=("window", "shift", "sigmoid"),
)
@dataclasses.dataclass(frozen=True)
class Bound:
    """Settings of the t-bound, by default the authors'; see `t_bound` for each.

    A pytree: one compiled program serves every `a` and `c`.
    """

    a: float = 2.0
    c: float = 4.2
    window: int = 11
    shift: bool = True
    sigmoid: str = "normal"

    def __post_init__(self) -> None:
        # Traced numbers are taken as they come.
        if isinstance(self.a, int | float) and not 0 < self.a < math.inf:
            raise ValueError(f"a is {self.a}, expected a steepness above 0, such as 2.")
        if isinstance(self.c, int | float) and not math.isfinite(self.c):
            raise ValueError(f"c is {self.c}, expected a finite number, such as 4.2.")
        _checks.odd_int("window", self.window)
        _checks.choice("sigmoid", self.sigmoid, _SIGMOIDS)

    @property
    def radius(self) -> int:
        """How many pixels away the bound on α can depend on the images."""
        return self.window // 2

    def __call__(
        self,
        alpha: Float[Array, "h w 3"],
        x: Float[Array, "h w 3"],
        y: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        *,
        mean_variance: Float[Array, ""] | None = None,
        inside: Bool[Array, "h w 1"] | None = None,
    ) -> Float[Array, "h w 3"]:
        """`t_bound` with these settings."""
        settings = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return t_bound(
            alpha, x, y, variance, **settings, mean_variance=mean_variance, inside=inside
        )


def t_bound(
    alpha: Float[Array, "h w 3"],
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    variance: Float[Array, "h w 3"],
    *,
    a: float = 2.0,
    c: float = 4.2,
    window: int = 11,
    shift: bool = True,
    sigmoid: str = "normal",
    mean_variance: Float[Array, ""] | None = None,
    inside: Bool[Array, "h w 1"] | None = None,
) -> Float[Array, "h w 3"]:
    """α lowered where the mix departs from the render by more than its noise explains.

    Parameters
    ----------
    alpha : (H, W, 3) in [0, 1], the mixing weight of `y`.
    x, y, variance : (H, W, 3) noisy and denoised image, and the variance of `x`.
    a, c : steepness and position of the sigmoid on |t|.
    window : odd width of the neighbourhood, in pixels.
    shift : False leaves out the window's pixel of highest variance, which else weighs most.
    sigmoid : "normal", the standard normal's distribution function, or "logistic".
    mean_variance : over the whole image, where x is only a tile of it; by default that of `variance`.
    inside : (H, W, 1) False where the arrays are padding around the image.

    Returns
    -------
    (H, W, 3) between 0 and `alpha`. One t per pixel is shared by the channels.

    Raises
    ------
    ValueError
        If shapes differ, the window is even, or the sigmoid is unknown.

    Notes
    -----
    Firmino et al. 2022, Eqs. 12 to 18, as in the authors' program: with d = α(y − x), κ a Gaussian of
    standard deviation s = max(100·sqrt(clip(mean σ², 0, 1)), 1e-3) over s·√(2π), and M_c the
    window's pixel of highest variance, t = |Σκd + ⅓Σ_c d_M| / (sqrt(Σκ²σ² + ⅑Σ_c σ²_M) + 1e-6). The
    paper divides nothing by 3, which is its only difference but for a mean over channels.
    """
    _checks.image("x", x)
    for name, value in (("alpha", alpha), ("y", y), ("variance", variance)):
        _checks.same_shape(name, value, "x", x)
    _checks.odd_int("window", window)
    _checks.choice("sigmoid", sigmoid, _SIGMOIDS)
    return _t_bound(alpha, x, y, variance, a, c, mean_variance, inside, window, shift, sigmoid)


@functools.partial(jax.jit, static_argnames=("window", "shift", "sigmoid"))
def _t_bound(
    alpha: Array,
    x: Array,
    y: Array,
    variance: Array,
    a: float,
    c: float,
    mean_variance: Array | None,
    inside: Array | None,
    window: int,
    shift: bool,
    sigmoid: str,
) -> Array:
    difference = alpha * (y - x)
    if mean_variance is None:
        pixels = x.shape[0] * x.shape[1] if inside is None else jnp.maximum(inside.sum(), 1)
        mean_variance = variance.sum() / (3 * pixels)
    clipped = jnp.clip(jnp.asarray(mean_variance, x.dtype), 0, 1)
    scale = jnp.maximum(100 * safe_sqrt(clipped), 1e-3)
    height = 1 / (scale * math.sqrt(2 * math.pi))

    # Zero outside for the sums, and out of reach for the maximum.
    numerator = height * _windows.gaussian_sum(difference.sum(-1), window, 0.5 / scale**2)
    noise = height**2 * _windows.gaussian_sum(variance.sum(-1), window, 1 / scale**2)
    if shift:
        candidates = variance if inside is None else jnp.where(inside, variance, -jnp.inf)
        highest, difference_there = _windows.argmax_payload(candidates, difference, window)
        if inside is not None:
            highest = jnp.where(inside, highest, 0)
        numerator = numerator + difference_there.sum(-1) / 3
        noise = noise + highest.sum(-1) / 9
    t = jnp.abs(numerator) / (safe_sqrt(noise) + 1e-6)
    return alpha * _SIGMOIDS[sigmoid](-a * (t - c))[..., None]
