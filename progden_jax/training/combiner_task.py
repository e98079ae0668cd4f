"""What it is to train a deep combiner: its examples, loss and evaluation."""

import functools
import os
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import combiner, denoisers, metrics
from progden_jax.combiner import files
from progden_jax.combiner.network import Params
from progden_jax.denoisers import Denoiser
from progden_jax.training import augment, data, evaluation, losses
from progden_jax.training.config import CombinerConfig
from progden_jax.training.estimates import EstimateCache
from progden_jax.training.mixer_task import check_exposure

_METRICS = ("rmse", "smape", "relmse")

_OF_PARTS = ("shares", "parts", "denoised_parts")


class CombinerTask:
    """A combiner for one denoiser; see `step.Task`.

    Of several buffers, the sub-averages of a render are what it and earlier renders of its nested series
    hold beyond one another, chosen as equal in samples as can be and taken in random order.

    Parameters
    ----------
    config : what to train on and how; `config.data` names the folders.
    denoiser : instead of loading the one that the configuration names.
    cache_folder : of denoised images, by default `estimates.default_folder()`.
    progress : called with how many of how many renders are loaded.

    Raises
    ------
    ValueError
        If the data or the configuration will not do.
    """

    kind = "combiner"

    def __init__(
        self,
        config: CombinerConfig,
        *,
        denoiser: Denoiser | None = None,
        cache_folder: str | os.PathLike[str] | None = None,
        progress: data.Progress = lambda done, total: None,
    ) -> None:
        self.config = config
        try:
            self.network = combiner.KernelNetwork(buffers=config.buffers, **config.options)
        except TypeError as error:
            raise ValueError(f"options is {dict(config.options)}: {error}") from None
        self.denoiser = denoisers.load(config.denoiser) if denoiser is None else denoiser
        check_exposure(config, self.denoiser)
        self._start = _begun(config.start, self.network) if config.start else None
        self.cache = EstimateCache(self.denoiser, None, cache_folder)
        auxiliary = [role for role in self.network.inputs if role != "variance"]
        examples, held = data.load_split(
            config,
            cache=self.cache,
            auxiliary=auxiliary,
            parts=config.buffers,
            progress=progress,
        )
        self.size = examples.size
        self.items, self.arrays = examples
        self._held_items = held.items
        self._held = {name: jnp.asarray(array) for name, array in held.arrays.items()}

    def init(self, key: jax.Array) -> Params:
        return self.network.init(key) if self._start is None else self._start

    def example(
        self, arrays: Mapping[str, Array], index: Array, key: jax.Array
    ) -> dict[str, Array]:
        """One augmented example."""
        change = augment.draw(key, self.size, self.config)
        changed = functools.partial(augment.apply, change, crop=self.config.crop)
        picked = {name: array[index] for name, array in arrays.items()}
        if self.network.buffers == 1:
            return changed(picked)
        # A number of its own beside those that `draw` takes.
        order = jax.random.permutation(jax.random.fold_in(key, 8), self.network.buffers)
        shares, color, denoised = (picked.pop(name)[order] for name in _OF_PARTS)
        parts = jax.vmap(changed)({"color": color, "denoised": denoised})
        found = shares, parts["color"], parts["denoised"]
        return {**changed(picked), **dict(zip(_OF_PARTS, found, strict=True))}

    def loss(
        self, params: Params, batch: Mapping[str, Float[Array, "b ..."]]
    ) -> tuple[Array, dict[str, Array]]:
        """The loss over a batch of examples, and how its relMSE compares to the denoised images'."""
        y, reference = batch["denoised"], batch["reference"]
        z = _combined(self.network, params, batch)
        if self.config.loss == losses.LOG_RELMSE:
            loss = losses.log_relmse(z, y, reference).mean()
        else:
            loss = losses.SUPERVISED[self.config.loss](z, reference).mean()
        after, before = (metrics.relmse_of_values(i, reference).mean() for i in (z, y))
        return loss, {"relmse-ratio": after / before}

    def evaluate(self, params: Params) -> evaluation.Scores:
        """Errors on the held-out scenes; the score is the mean ratio of relMSE to the denoised images'."""
        found = _held_errors(self.network, params, self._held)
        errors = {name: np.asarray(values) for name, values in found.items()}
        table = evaluation.tabulate(self._held_items, errors, _METRICS)
        column = _METRICS.index("relmse")
        after, before = (errors[name][:, column] for name in ("combined", "denoised"))
        score = (after / np.maximum(before, np.finfo(np.float32).tiny)).mean()
        return evaluation.Scores(float(score), table)

    def export(
        self, path: str | os.PathLike[str], params: Params, metadata: Mapping[str, str]
    ) -> None:
        """Write weights that `progden denoise --combiner` takes."""
        made = combiner.DeepCombiner(params, self.denoiser, self.network)
        said = {"denoiser": self.config.denoiser, **metadata}
        combiner.save(path, made, dtype=self.config.weights_dtype, metadata=said)


def _begun(start: str, network: combiner.KernelNetwork) -> Params:
    """The weights of that name, which must be of this network."""
    found = files.read(start)
    if found.network != network:
        raise ValueError(f"start is {start!r}, {found.network}; what is trained is {network}.")
    return found.params


def _combined(network: combiner.KernelNetwork, params: Params, batch: Mapping[str, Array]) -> Array:
    buffers = {role: batch[role] for role in network.inputs}
    if network.buffers == 1:
        return network.apply(params, batch["color"][None], batch["denoised"][None], buffers)
    shares, noisy, denoised = (jnp.moveaxis(batch[name], 1, 0) for name in _OF_PARTS)
    return network.apply(params, noisy, denoised, buffers, shares=shares)


@functools.partial(jax.jit, static_argnums=0)
def _held_errors(
    network: combiner.KernelNetwork, params: Params, arrays: Mapping[str, Array]
) -> dict[str, Array]:
    def errors(image: Array, reference: Array) -> Array:
        return jnp.stack([getattr(metrics, name)(image, reference) for name in _METRICS])

    def one(example: Mapping[str, Array]) -> dict[str, Array]:
        z = _combined(network, params, {n: array[None] for n, array in example.items()})[0]
        images = {"render": example["color"], "denoised": example["denoised"], "combined": z}
        return {name: errors(image, example["reference"]) for name, image in images.items()}

    return jax.lax.map(one, dict(arrays))
