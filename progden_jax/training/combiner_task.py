"""What it is to train a deep combiner: its examples, loss and evaluation."""

import functools
import os
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import combiner, denoisers, metrics
from progden_jax.combiner.network import Params
from progden_jax.denoisers import Denoiser
from progden_jax.training import augment, data, evaluation, losses
from progden_jax.training.config import CombinerConfig
from progden_jax.training.estimates import EstimateCache
from progden_jax.training.mixer_task import check_exposure

_METRICS = ("rmse", "smape", "relmse")


class CombinerTask:
    """A combiner for one denoiser, of one buffer; see `step.Task`.

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
            self.network = combiner.KernelNetwork(**config.options)
        except TypeError as error:
            raise ValueError(f"options is {dict(config.options)}: {error}") from None
        if self.network.buffers != 1:
            raise ValueError(
                f"options has buffers = {self.network.buffers}, and the data are single renders without "
                "sub-averages: leave it at 1."
            )
        self.denoiser = denoisers.load(config.denoiser) if denoiser is None else denoiser
        check_exposure(config, self.denoiser)
        self.cache = EstimateCache(self.denoiser, None, cache_folder)
        auxiliary = [role for role in self.network.inputs if role != "variance"]
        examples, held = data.load_split(
            config, cache=self.cache, auxiliary=auxiliary, progress=progress
        )
        self.size = examples.size
        self.items, self.arrays = examples
        self._held_items = held.items
        self._held = {name: jnp.asarray(array) for name, array in held.arrays.items()}

    def init(self, key: jax.Array) -> Params:
        return self.network.init(key)

    def example(
        self, arrays: Mapping[str, Array], index: Array, key: jax.Array
    ) -> dict[str, Array]:
        """One augmented example."""
        change = augment.draw(key, self.size, self.config)
        picked = {name: array[index] for name, array in arrays.items()}
        return augment.apply(change, picked, crop=self.config.crop)

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


def _combined(network: combiner.KernelNetwork, params: Params, batch: Mapping[str, Array]) -> Array:
    buffers = {role: batch[role] for role in network.inputs}
    return network.apply(params, batch["color"][None], batch["denoised"][None], buffers)


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
