"""Denoisers fitted to the one render at hand, without a reference.

Two ways: `post_correct` trains a small network behind the denoiser on two halves of the render (Back et al.
2022), and `adapt` changes the denoiser's, or with `adapt_mixer` a mixer's, own weights by Stein's risk
estimate. What comes out of either can be given to `progden_jax.progressive_denoise`.
"""

from progden_jax.adaptation._halves import Halves, WithHalves, halves, paired, split
from progden_jax.adaptation.by_halves import Corrected, post_correct
from progden_jax.adaptation.by_sure import Adaptation, Adapted, adapt, adapt_mixer
from progden_jax.adaptation.correction import SETTINGS, PostCorrected, PostCorrection

__all__ = [
    "SETTINGS",
    "Adaptation",
    "Adapted",
    "Corrected",
    "Halves",
    "PostCorrected",
    "PostCorrection",
    "WithHalves",
    "adapt",
    "adapt_mixer",
    "halves",
    "paired",
    "post_correct",
    "split",
]
