"""Deep Combiner: a network behind a denoiser that combines its image with the render, window by window.

Back et al. 2020. `load` puts trained weights behind a denoiser, and what it gives is a denoiser again, for
`progden_jax.progressive_denoise` and all else; `progden train combiner` makes weights.
"""

from progden_jax.combiner.buffers import BufferedCombiner, of_buffers
from progden_jax.combiner.denoiser import DeepCombiner
from progden_jax.combiner.files import Weights, load, names, read, save
from progden_jax.combiner.kernels import combine
from progden_jax.combiner.network import KernelNetwork

__all__ = [
    "BufferedCombiner",
    "DeepCombiner",
    "KernelNetwork",
    "Weights",
    "combine",
    "load",
    "names",
    "of_buffers",
    "read",
    "save",
]
