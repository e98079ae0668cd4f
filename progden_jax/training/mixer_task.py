"""What it is to train a mixing network: its examples, loss and evaluation."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import combiner, denoisers, mixers
from progden_jax.denoisers import OIDN, Denoiser
from progden_jax.divergence import (
    Exact,
    FiniteDifference,
    Method,
    MonteCarlo,
    Probing,
    TruncatedCone,
)
from progden_jax.mixers import NetworkMixer, build, save_mixer
from progden_jax.mixers.architectures import Architecture, Params
from progden_jax.sure import sure
from progden_jax.training import augment, data, evaluation, losses
from progden_jax.training.config import CombinerConfig, MixerConfig
from progden_jax.training.estimates import EstimateCache, EstimateCaches
from progden_jax.tstatistic import t_bound

_WITHOUT_PROBES: dict[str, Method] = {
    **{f"cone-{levels}": TruncatedCone(levels) for levels in (1, 2, 3)},
    "exact": Exact(),
}

WITHOUT_PROBES = tuple(_WITHOUT_PROBES)
"""Estimators that take no probes, and no random numbers."""

METHODS: dict[str, Callable[[int], Method]] = {
    "monte-carlo": MonteCarlo,
    "monte-carlo-gaussian": lambda probes: MonteCarlo(probes, "gaussian"),
    "finite-difference": FiniteDifference,
    "probing": Probing,
    **{name: lambda _, method=method: method for name, method in _WITHOUT_PROBES.items()},
}
"""Estimators by the names that `progden denoise --method` has for them, of a number of probes."""

_ESTIMATED = ("denoised", "probe", "tangent")
"""Arrays with an axis of denoisers, as divergences have behind that of their draws."""


class MixerTask:
    """A mixing network for one denoiser, or for several; see `loop.Task`.

    Parameters
    ----------
    config : what to train on and how; `config.data` names the folders.
    denoiser : instead of loading the first one that the configuration names.
    cache_folder : of denoised images and divergences, by default `estimates.default_folder()`.
    progress : called with how many of how many renders are loaded.

    Raises
    ------
    ValueError
        If the data or the configuration will not do.
    """

    kind = "mixer"

    def __init__(
        self,
        config: MixerConfig,
        *,
        denoiser: Denoiser | None = None,
        cache_folder: str | os.PathLike[str] | None = None,
        progress: data.Progress = lambda done, total: None,
    ) -> None:
        self.config = config
        self.architecture = build(config.architecture, config.options)
        first = _loaded(config.denoiser) if denoiser is None else denoiser
        chosen = [first, *map(_loaded, config.further)]
        for each in chosen:
            check_exposure(config, each)
        self._start = _begun(config.start, self.architecture) if config.start else None
        tangents = config.loss == "sure" and config.sure_derivative == "probe"
        method = build_method(config)
        self.cache = EstimateCaches(
            [EstimateCache(each, method, cache_folder, tangents=tangents) for each in chosen]
        )
        examples, held = data.load_split(
            config, cache=self.cache, draws=config.draws, progress=progress
        )
        self.size = examples.size
        self.items, self.arrays = examples
        self.held_out = evaluation.HeldOut(*_of_each(held))

    def init(self, key: jax.Array) -> Params:
        return self.architecture.init(key) if self._start is None else self._start

    def example(
        self, arrays: Mapping[str, Array], index: Array, key: jax.Array
    ) -> dict[str, Array]:
        """One augmented example, with ``swap`` among its entries."""
        draw_key, change_key, swap_key = jax.random.split(key, 3)
        which = jax.random.randint(draw_key, (), 0, self.config.draws)
        # A number of its own beside those that one denoiser takes.
        of = jax.random.randint(jax.random.fold_in(key, 8), (), 0, 1 + len(self.config.further))
        chosen = {**dict.fromkeys(_ESTIMATED, (index, of)), "divergence": (index, which, of)}
        picked = {name: array[chosen.get(name, index)] for name, array in arrays.items()}
        change = augment.draw(change_key, self.size, self.config)
        changed = augment.apply(change, picked, crop=self.config.crop)
        changed["swap"] = jax.random.bernoulli(swap_key, self.config.swap)
        return changed

    def loss(
        self, params: Params, batch: Mapping[str, Float[Array, "b ..."]]
    ) -> tuple[Array, dict[str, Array]]:
        """The loss over a batch of examples, and curves to draw."""
        x, y, variance = batch["color"], batch["denoised"], batch["variance"]

        def mix(x: Array, y: Array, divergence: Array) -> Array:
            risk = sure_of(x, y, variance, divergence)
            swap = batch["swap"][:, None, None, None]
            found = swapped_alpha(self.architecture, params, x, y, variance, divergence, risk, swap)
            if self.config.bound:
                found = jax.vmap(_bounded)(found, x, y, variance, batch["mean_variance"])
            return found

        if self.config.loss == "sure":
            alpha, tangent = self._alpha_and_derivative(mix, batch)
            risk = losses.mix_risk(alpha, x, y, variance, batch["divergence"], tangent)
            loss = losses.relative_risk(risk, y).mean()
        else:
            alpha = mix(x, y, batch["divergence"])
            z = x + alpha * (y - x)
            if self.config.loss == "log-errors":
                loss = losses.log_errors(z, x, y, batch["reference"]).mean()
            else:
                loss = losses.SUPERVISED[self.config.loss](z, batch["reference"]).mean()
        return loss, {"alpha": alpha.mean()}

    def _alpha_and_derivative(
        self, mix: Any, batch: Mapping[str, Array]
    ) -> tuple[Array, Array | float]:
        """α, and an estimate of σ²∂α/∂x by one probe through render, denoised image and SURE.

        The denoiser's curvature is left out, so the divergence counts as constant: it is where a network of
        ReLUs has no kink. So does the variance, which normal noise makes independent of the mean.
        """
        x, y, divergence = batch["color"], batch["denoised"], batch["divergence"]
        if self.config.sure_derivative == "held":
            return mix(x, y, divergence), 0.0
        tangents = (batch["probe"], batch["tangent"], jnp.zeros_like(divergence))
        alpha, along = jax.jvp(mix, (x, y, divergence), tangents)
        return alpha, batch["probe"] * along

    def evaluate(self, params: Params) -> evaluation.Scores:
        """How the mixes compare on the held-out scenes, with the t-bound."""
        return self.held_out.scores(NetworkMixer(params, self.architecture), self.config.score)

    def export(self, path: os.PathLike[str], params: Params, metadata: Mapping[str, str]) -> None:
        """Write weights that `progden denoise --mixer` takes."""
        mixer = NetworkMixer(params, self.architecture)
        save_mixer(path, mixer, denoiser=self.config.denoiser, **metadata)


def _loaded(name: str) -> Denoiser:
    """The denoiser of that name or file, or of NAME+COMBINER with the combiner behind it."""
    before, plus, behind = name.partition("+")
    if not plus or Path(name).exists():
        return denoisers.load(name)
    return combiner.load(behind, denoisers.load(before))


def _of_each(held: data.Examples) -> data.Examples:
    """What several denoisers make of the renders as examples of their own, with one divergence each."""
    arrays = {**held.arrays, "divergence": held.arrays["divergence"][:, 0]}
    count = arrays["denoised"].shape[1]
    flat = {
        name: array.reshape(-1, *array.shape[2:])
        if name in (*_ESTIMATED, "divergence")
        else np.repeat(array, count, axis=0)
        for name, array in arrays.items()
    }
    flat["divergence"] = flat["divergence"][:, None]
    return data.Examples(tuple(item for item in held.items for _ in range(count)), flat)


def _begun(start: str, architecture: Architecture) -> Params:
    """The weights of that name, which must be of this architecture."""
    found = mixers.load(start)
    if not isinstance(found, NetworkMixer) or found.architecture != architecture:
        raise ValueError(f"start is {start!r}, {found!r}; what is trained is {architecture!r}.")
    return found.params


def swapped_alpha(
    architecture: Architecture,
    params: Params,
    x: Array,
    y: Array,
    variance: Array,
    divergence: Array,
    risk: Array,
    swap: Array,
) -> Array:
    """The weight of y; where `swap`, from the network asked for the weight of x in a mix from y on."""

    def either(a: Array, b: Array) -> tuple[Array, Array]:
        return jnp.where(swap, b, a), jnp.where(swap, a, b)

    first, second = either(x, y)
    first_risk, second_risk = either(variance, risk)
    found = architecture.apply(params, first, second, first_risk, divergence, second_risk)
    return jnp.where(swap, 1 - found, found)


def sure_of(x: Array, y: Array, variance: Array, divergence: Array) -> Array:
    """SURE of a batch of images."""
    return sure(x, y, variance, divergence)


def _bounded(alpha: Array, x: Array, y: Array, variance: Array, mean_variance: Array) -> Array:
    return t_bound(alpha, x, y, variance, mean_variance=mean_variance)


def build_method(config: MixerConfig) -> Method:
    """The estimator of the divergence that the configuration names."""
    if config.method not in METHODS:
        raise ValueError(f"method is {config.method!r}, expected one of {', '.join(METHODS)}.")
    return METHODS[config.method](config.probes)


def check_exposure(config: MixerConfig | CombinerConfig, denoiser: Any) -> None:
    """Raise ValueError if exposures are changed, and cached images of the denoiser do not follow."""
    if config.exposure_stops and not follows_exposure(denoiser):
        raise ValueError(
            f"exposure_stops is {config.exposure_stops}, but {config.denoiser} does not follow exposure "
            "(f(s·x) is not s·f(x)), so its images in the cache cannot be rescaled: set it to 0."
        )


def follows_exposure(denoiser: Any) -> bool:
    """Whether f(s·x) = s·f(x), but for the ends of half precision's range."""
    return isinstance(denoiser, OIDN) and denoiser.exposure is None
