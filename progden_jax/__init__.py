"""Progressive denoising of Monte Carlo renders in JAX.

A noisy image with its variance goes in, and a mix of it with its denoised version comes out that converges to
the truth as samples grow (Firmino, Frisvad, Jensen 2022). Images are channels-last, linear radiance.

How to use it: `progden_jax.guides`. What is not imported with the package: `progden_jax.mixers`,
`progden_jax.adaptation`, `progden_jax.exr`, `progden_jax.rendering`, `progden_jax.training`,
`progden_jax.evaluation` and `progden_jax.report`.
"""

__version__ = "0.1.0"

from progden_jax import combiner, denoisers, metrics, subaverages, transfer
from progden_jax.batch import denoise_batch
from progden_jax.compilation import enable_compilation_cache
from progden_jax.denoisers import Denoiser, FunctionDenoiser
from progden_jax.divergence import (
    DivergenceEstimate,
    Exact,
    FiniteDifference,
    Method,
    MonteCarlo,
    Probing,
    TruncatedCone,
    divergence,
    divergence_and_error,
    exact_divergence,
)
from progden_jax.exr import ExrError, describe_exr, read_exr, write_exr
from progden_jax.frame import Frame, Repairs, repair
from progden_jax.mixers import NetworkMixer
from progden_jax.mixers import load as load_mixer
from progden_jax.mixing import ClosedForm, Mixer, MixingNet, closed_form_alpha, mixing_features
from progden_jax.pipeline import Denoised, Result, denoise, progressive_denoise
from progden_jax.session import Session
from progden_jax.skipping import Skip, Skipped
from progden_jax.sure import sure
from progden_jax.tstatistic import Bound, t_bound

__all__ = [
    "Bound",
    "ClosedForm",
    "Denoised",
    "Denoiser",
    "DivergenceEstimate",
    "Exact",
    "ExrError",
    "FiniteDifference",
    "Frame",
    "FunctionDenoiser",
    "Method",
    "Mixer",
    "MixingNet",
    "MonteCarlo",
    "NetworkMixer",
    "Probing",
    "Repairs",
    "Result",
    "Session",
    "Skip",
    "Skipped",
    "TruncatedCone",
    "closed_form_alpha",
    "combiner",
    "denoise",
    "denoise_batch",
    "denoisers",
    "describe_exr",
    "divergence",
    "divergence_and_error",
    "enable_compilation_cache",
    "exact_divergence",
    "load_mixer",
    "metrics",
    "mixing_features",
    "progressive_denoise",
    "read_exr",
    "repair",
    "subaverages",
    "sure",
    "t_bound",
    "transfer",
    "write_exr",
]
