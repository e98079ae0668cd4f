"""Adaptation by SURE: weights fitted to the one noisy image by Stein's estimate of its error, no halves."""

import dataclasses

import jax

from progden_jax.adaptation import _leaves
from progden_jax.adaptation._fit import Adaptation, Adapted, fit
from progden_jax.adaptation._mixed import Mixed
from progden_jax.adaptation._running import Progress
from progden_jax.adaptation.correction import Params, PostCorrected, PostCorrection
from progden_jax.denoisers import Denoiser
from progden_jax.denoisers._base import passable
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer

_NEW_RATE = 2e-3
"""Of weights that are not trained yet."""


def adapt(
    frame: Frame,
    denoiser: Denoiser,
    *,
    adaptation: Adaptation | None = None,
    key: jax.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> Adapted:
    """The denoiser with weights fitted to this render by Stein's estimate of its error; no reference needed.

    What comes out is a denoiser of the same kind, to be given to `progressive_denoise` or saved. The same key
    gives the same result on the same machine. Bad pixels are repaired first.

    Parameters
    ----------
    frame : one frame with a variance.
    denoiser : a pytree with floating-point leaves, as all networks of `progden_jax.denoisers` are.
    adaptation : how; None stands for ``Adaptation()``.
    key : of probes, crops and blocks; None stands for ``jax.random.key(0)``.
    progress : called with (done, total) steps; if it returns False, the best weights so far are taken.

    Raises
    ------
    ValueError
        If the frame has no variance or is too small to be split, or there are no such weights.

    Notes
    -----
    Each step takes a pass, a tangent pass and the derivative of both, about six passes over the crop. SURE
    is unbiased for normal noise of known variance; where samples are few, variances of bright rare
    paths are too small, and fitting to it keeps some of the noise. Pixels are weighted by 1/(y² + 0.01 + σ²),
    so that neither bright nor noisy ones decide alone.

    Stein's estimate of the result is still too low on real renders, and the mix behind it gains little or
    nothing: see experiments/adaptation. For the mix take `post_correct`.
    """
    adaptation = Adaptation() if adaptation is None else adaptation
    key = jax.random.key(0) if key is None else key
    denoiser = passable(denoiser)
    chosen = _leaves.chosen(denoiser, adaptation.only)
    return fit(frame, denoiser, chosen, adaptation, key, progress)


def adapt_mixer(
    frame: Frame,
    denoiser: Denoiser,
    mixer: Mixer,
    *,
    adaptation: Adaptation | None = None,
    key: jax.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> Adapted:
    """The mixer with weights fitted to this render by SURE of the mix; the denoiser stays as it is.

    How α follows x counts in the mix's divergence, but for what reaches it through the estimated
    divergence of the denoiser. All else as for `adapt`; ``only`` picks among the mixer's layers.

    Raises
    ------
    ValueError
        If the mixer has no weights, as the closed form; see also `adapt`.
    """
    adaptation = Adaptation() if adaptation is None else adaptation
    mix_key, fit_key = jax.random.split(jax.random.key(0) if key is None else key)
    mixed = Mixed(passable(denoiser), mixer, mix_key)
    chosen = _leaves.chosen(mixer, adaptation.only, after=mixed.denoiser)
    found = fit(frame, mixed, chosen, adaptation, fit_key, progress)
    return found._replace(adapted=found.adapted.mixer)


def correct_by_sure(
    frame: Frame,
    denoiser: Denoiser,
    *,
    correction: PostCorrection | None = None,
    adaptation: Adaptation | None = None,
    start: Params | None = None,
    key: jax.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> Adapted:
    """The denoiser followed by the network of `post_correct`, fitted by SURE: no halves are needed.

    So the network sees all samples at once, and blocks of the image that nothing is fitted to say when to
    stop. The denoiser keeps its weights. All else as for `adapt`; ``adapted`` is a `PostCorrected`, or the
    denoiser where no gain is sure. As many steps as of `post_correct` took four times as long.

    Parameters
    ----------
    correction : the network; how it is fitted is in `adaptation`.
    start : weights to start from, such as ``adapted.params`` of the previous frame; None: those that keep
        most of the denoised image's detail.

    Raises
    ------
    ValueError
        As by `adapt`, or if the weights are not the correction's.
    """
    correction = PostCorrection() if correction is None else correction
    adaptation = Adaptation() if adaptation is None else adaptation
    if adaptation.rate is None:
        adaptation = dataclasses.replace(adaptation, rate=_NEW_RATE)
    start_key, fit_key = jax.random.split(jax.random.key(0) if key is None else key)
    params = _unchanging(correction, start_key) if start is None else correction.checked(start)
    denoiser = passable(denoiser)
    behind = PostCorrected(denoiser, params, {}, correction)
    chosen = _leaves.chosen(params, adaptation.only, after=denoiser)
    return fit(frame, behind, chosen, adaptation, fit_key, progress, over=denoiser)


_unchanging = jax.jit(PostCorrection.unchanging, static_argnums=0)
