"""What it is to train a denoiser: its examples, loss and evaluation."""

import functools
import os
from collections.abc import Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Float

from progden_jax import _checks, denoisers
from progden_jax.denoisers import Network, files
from progden_jax.denoisers.graph import Moments
from progden_jax.denoisers.own import LogNetwork
from progden_jax.divergence import MonteCarlo
from progden_jax.frame import Frame
from progden_jax.sure import sure
from progden_jax.training import augment, data, evaluation, losses, order
from progden_jax.training.config import DenoiserConfig
from progden_jax.training.normalization import BATCH, BatchNormalized, pooled

_BUFFERS = ("albedo", "normal", "depth")

_BATCHES = 8
"""Batches of training examples that batch normalisation's final statistics are taken over."""


class DenoiserTask:
    """A denoiser from scratch; its weights are the denoiser itself, as a pytree. See `step.Task`.

    One with batch normalisation is a `BatchNormalized` while it is trained. The statistics that stay in the
    end are no moving averages, which lag behind the weights and are not those of averaged weights, but
    computed for the very weights that are evaluated (Wu and Johnson 2021, "PreciseBN").

    The loss is of y = f(x) against the reference, or, with the loss "sure", Stein's estimate of y's error
    over y² + 0.01, which needs no reference: only renders with their variances. The divergence is then
    estimated anew in each step with random probes, and differentiated through.

    Parameters
    ----------
    config : what to train on and how; `config.data` names the folders.
    progress : called with how many of how many renders are loaded.

    Raises
    ------
    ValueError
        If the data or the configuration will not do.
    """

    kind = "denoiser"

    def __init__(
        self,
        config: DenoiserConfig,
        *,
        progress: data.Progress = lambda done, total: None,
    ) -> None:
        _checks.choice("architecture", config.architecture, files.ARCHITECTURES)
        self.config = config
        try:
            jax.eval_shape(self.init, jax.random.key(0))
        except TypeError as error:
            raise ValueError(f"options is {dict(config.options)}: {error}") from None
        auxiliary = [role for role in _BUFFERS if role in config.inputs]
        examples, held = data.load_split(config, auxiliary=auxiliary, progress=progress)
        self.size = examples.size
        self.items, self.arrays = examples
        self._held_items = held.items
        self._held = {name: jnp.asarray(array) for name, array in held.arrays.items()}

    def init(self, key: jax.Array) -> Any:
        kind: Any = files.ARCHITECTURES[self.config.architecture]
        network = kind.init(key, self.config.inputs, precision="default", **self.config.options)
        if self.config.start:
            return _begun(self.config.start, network)
        return BatchNormalized.of(network) if network.normalized else network

    def example(
        self, arrays: Mapping[str, Array], index: Array, key: jax.Array
    ) -> dict[str, Array]:
        """One augmented example, and a key for its probes."""
        change_key, probe_key = jax.random.split(key)
        change = augment.draw(change_key, self.size, self.config)
        picked = {name: array[index] for name, array in arrays.items()}
        changed = augment.apply(change, picked, crop=self.config.crop)
        return {**changed, "key": probe_key}

    def loss(
        self, params: Any, batch: Mapping[str, Float[Array, "b ..."]]
    ) -> tuple[Array, dict[str, Array]]:
        """The loss over a batch of examples."""
        return jax.vmap(self._one, (None, 0), axis_name=BATCH)(params, dict(batch)).mean(), {}

    def _one(self, denoiser: Any, example: Mapping[str, Array]) -> Array:
        f, x = denoiser.bind(_frame(example)), example["color"]
        if self.config.loss != "sure":
            return losses.SUPERVISED[self.config.loss](f(x), example["reference"]).mean()
        method, variance = MonteCarlo(self.config.probes), example["variance"]
        y, divergence, *_ = method.evaluate(f, x, variance, example["key"])
        return losses.relative_risk(sure(x, y, variance, divergence), y).mean()

    def evaluate(self, params: Any) -> evaluation.Scores:
        """RMSE and SMAPE on the held-out scenes; the score is the mean SMAPE."""
        errors = _held_errors(self._held, self.finished(params))
        found = {name: np.asarray(v) for name, v in errors.items()}
        table = evaluation.tabulate(self._held_items, found)
        return evaluation.Scores(float(found["denoised"][:, 1].mean()), table)

    def export(self, path: os.PathLike[str], params: Any, metadata: Mapping[str, str]) -> None:
        """Write weights that `denoisers.load` takes."""
        network = self.finished(params)
        files.save(path, network, dtype=self.config.weights_dtype, metadata=metadata)

    def finished(self, params: Any) -> Any:
        """The denoiser that the weights make, without batch normalisation."""
        return _folded(params, self._batches) if isinstance(params, BatchNormalized) else params

    @functools.cached_property
    def _batches(self) -> dict[str, Array]:
        """Examples as training sees them, (batches, batch, ...); the same each time."""
        config, count = self.config, len(self.items)
        chosen = np.concatenate(
            [
                order.indices(step, count=count, batch=config.batch, seed=config.seed)
                for step in range(_BATCHES)
            ]
        )
        arrays = {name: array[chosen] for name, array in self.arrays.items()}
        keys = jax.random.split(jax.random.key(config.seed), len(chosen))
        examples = jax.jit(jax.vmap(self.example, (None, 0, 0)))
        found = examples(arrays, jnp.arange(len(chosen)), keys)
        return jax.tree.map(lambda a: a.reshape(_BATCHES, config.batch, *a.shape[1:]), found)


def _begun(start: str, network: Network) -> Network:
    """The network with the weights of that name, which may take fewer inputs."""
    found = denoisers.load(start, precision=network.precision)
    if type(found) is not type(network) or network.normalized:
        wanted = f"a {type(network).__name__}"
        if network.normalized:
            wanted += ", which cannot go on from a file: its batch normalisation is folded in there"
        raise ValueError(
            f"start is {start!r}, a {type(found).__name__}; what is trained is {wanted}."
        )
    try:
        wide = cast(LogNetwork, found).with_inputs(network.inputs)
    except ValueError as error:
        raise ValueError(f"start is {start!r}: {error}") from None
    ours, theirs = _shapes(network), _shapes(wide)
    for name in [*ours, *theirs]:
        if ours.get(name) != theirs.get(name):
            raise ValueError(
                f"start is {start!r}, which has {_said(theirs.get(name))} weights {name}; this configuration "
                f"makes {_said(ours.get(name))}: give it the options that those weights were trained with."
            )
    return wide


def _shapes(network: Network) -> dict[str, tuple[int, ...]]:
    flat: dict[str, Any] = flatten_dict(network.params, sep=".")
    return {name: value.shape for name, value in flat.items()}


def _said(shape: tuple[int, ...] | None) -> str:
    return "no" if shape is None else "×".join(map(str, shape))


def _frame(example: Mapping[str, Array]) -> Frame:
    buffers = {role: example.get(role) for role in _BUFFERS}
    return Frame(example["color"], example["variance"], **buffers)


@jax.jit
def _folded(trained: BatchNormalized, batches: Mapping[str, Array]) -> Network:
    """The network with the moments of all batches folded in."""

    def moments(batch: Mapping[str, Array]) -> dict[str, Moments]:
        over = jax.vmap(lambda e: trained.moments(_frame(e)), axis_name=BATCH, out_axes=None)
        return over(dict(batch))

    found = jax.lax.map(moments, dict(batches))
    return trained.folded({layer: pooled(of_batches) for layer, of_batches in found.items()})


@jax.jit
def _held_errors(arrays: Mapping[str, Array], denoiser: Any) -> dict[str, Array]:
    def one(example: Mapping[str, Array]) -> dict[str, Array]:
        x, reference = example["color"], example["reference"]
        y = denoiser.bind(_frame(example))(x)
        return {n: evaluation.errors(i, reference) for n, i in (("render", x), ("denoised", y))}

    return jax.lax.map(one, dict(arrays))
