"""Random probes: the paper's finite differences, and directional derivatives."""

import dataclasses

import jax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._numeric import safe_sqrt
from progden_jax.divergence import _random
from progden_jax.divergence._base import Evaluation, Function, Origin, accumulate


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class FiniteDifference:
    """The paper's estimator: (1/(εK)) Σ b (f(x + εb) − f(x)), b ~ N(0, σ²) (Eq. 2).

    Biased by curvature where ε is large; where ε·b/x is small, float32 rounds much of εb away, which adds
    noise and, once nearly all of it is gone, loses the estimate. Cost: probes + 1 denoiser passes. Its
    variance per pixel and probe is σ_i² Σ_j J_ij² σ_j² + σ_i⁴ J_ii² where f is nearly linear.

    Parameters
    ----------
    probes : number K of random vectors.
    epsilon : step, in units of each pixel's standard deviation.
    chunk : probes in flight at once; memory grows with it.
    """

    probes: int = 4
    epsilon: float = 1e-4
    chunk: int = 1

    def __post_init__(self) -> None:
        _checks.positive_int("probes", self.probes)
        _checks.positive_int("chunk", self.chunk)
        if not 0 < self.epsilon < float("inf"):
            raise ValueError(f"epsilon is {self.epsilon}, expected a number above 0, such as 1e-4.")

    def evaluate(
        self,
        f: Function,
        x: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        key: jax.Array,
        *,
        origin: Origin = (0, 0),
    ) -> Evaluation:
        value = f(x)
        sigma = safe_sqrt(variance)

        def sample(probe: Array) -> Array:
            b = sigma * _random.normal(key, probe, x, origin)
            return b * (f(x + self.epsilon * b) - value) / self.epsilon

        return Evaluation(value, *accumulate(sample, self.probes, self.chunk, value))


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class MonteCarlo:
    """Hutchinson's estimator with exact directional derivatives: mean of b · J b, b = σ·s.

    Unbiased at any scale: there is no step to choose. Cost: one denoiser pass and one tangent pass
    per probe (f is linearised once). Its variance per pixel and probe is σ_i² Σ_{j≠i} J_ij² σ_j² with
    Rademacher signs; Gaussian s add 2 σ_i⁴ J_ii².

    Parameters
    ----------
    probes : number of random vectors.
    distribution : of s, "rademacher" (±1) or "gaussian".
    chunk : probes in flight at once; memory grows with it.
    """

    probes: int = 4
    distribution: str = "rademacher"
    chunk: int = 1

    def __post_init__(self) -> None:
        _checks.positive_int("probes", self.probes)
        _checks.positive_int("chunk", self.chunk)
        _checks.choice("distribution", self.distribution, ("rademacher", "gaussian"))

    def evaluate(
        self,
        f: Function,
        x: Float[Array, "h w 3"],
        variance: Float[Array, "h w 3"],
        key: jax.Array,
        *,
        origin: Origin = (0, 0),
    ) -> Evaluation:
        draw = _random.signs if self.distribution == "rademacher" else _random.normal
        value, tangent = jax.linearize(f, x)
        sigma = safe_sqrt(variance)

        def sample(probe: Array) -> Array:
            b = sigma * draw(key, probe, x, origin)
            return b * tangent(b)

        return Evaluation(value, *accumulate(sample, self.probes, self.chunk, value))
