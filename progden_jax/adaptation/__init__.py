"""Denoisers fitted to the one render at hand, without a reference.

`post_correct` trains a small network behind the denoiser on two halves of the render (Back et al. 2022).
By Stein's risk estimate, without halves, `correct_by_sure` trains the same network, and `adapt` changes the
denoiser's, or with `adapt_mixer` a mixer's, own weights. What comes out can be given to
`progden_jax.progressive_denoise`.
"""

from progden_jax.adaptation._fit import Adaptation, Adapted
from progden_jax.adaptation._halves import Halves, WithHalves, halves, paired, split
from progden_jax.adaptation.by_halves import Corrected, post_correct
from progden_jax.adaptation.by_sure import adapt, adapt_mixer, correct_by_sure
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
    "correct_by_sure",
    "halves",
    "paired",
    "post_correct",
    "split",
]
