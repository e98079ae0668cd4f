"""Batch normalisation of a network while it is trained; its convolutions take it up afterwards."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from progden_jax.denoisers import Bound, Network, graph
from progden_jax.denoisers.graph import BatchNorm, Conv, Moments, Node
from progden_jax.denoisers.nodes import BATCH, BATCH_EPSILON, moved
from progden_jax.frame import Frame

__all__ = ["BATCH", "BatchNormalized", "pooled"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BatchNormalized:
    """A network in training, whose layers `network.normalized` give

        scale · (v − mean) / √(variance + ε) + bias,    v = kernel * input,

    with the mean and the variance of each channel over the batch: the mapped axis `BATCH`, outside of
    which it cannot be called. Shared between devices, each normalises its part of the batch by itself.

    Attributes
    ----------
    network : the weights; biases of normalised layers are those above.
    scales : by layer, (channels,).

    References
    ----------
    Ioffe and Szegedy 2015.
    """

    network: Network
    scales: Mapping[str, Float[Array, " c"]]

    @classmethod
    def of(cls, network: Network) -> "BatchNormalized":
        """The network with scales of 1."""
        params = network.params
        return cls(network, {n: jnp.ones_like(params[n]["bias"]) for n in network.normalized})

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x) for one frame of the batch."""
        return jax.tree_util.Partial(_denoise, self, frame)

    def moments(self, frame: Frame) -> dict[str, Moments]:
        """What each layer is normalised by, for one frame of the batch."""
        return _run(self, frame, frame.color)[1]

    def folded(self, moments: Mapping[str, Moments]) -> Network:
        """The network that gives the same where these are the moments, without normalisation."""
        params = dict(self.network.params)
        for layer, scale in self.scales.items():
            gain = scale * lax.rsqrt(moments[layer].variance + BATCH_EPSILON)
            kernel, bias = (params[layer][name] for name in ("kernel", "bias"))
            params[layer] = {"kernel": kernel * gain, "bias": bias - moments[layer].mean * gain}
        network = copy.copy(self.network)
        network.params = params
        return network


def pooled(moments: Moments) -> Moments:
    """Of all batches together, from those of each, stacked and of equal size."""
    mean = moments.mean.mean(0)
    return Moments(mean, moments.variance.mean(0) + ((moments.mean - mean) ** 2).mean(0))


def _denoise(trained: BatchNormalized, frame: Frame, x: Array) -> Array:
    return _run(trained, frame, x)[0]


def _run(trained: BatchNormalized, frame: Frame, x: Array) -> tuple[Array, dict[str, Moments]]:
    bound: Any = trained.network.bind(frame)
    shown = bound.layered(x)
    nodes = _with_norms(shown.nodes, tuple(trained.scales))
    params = dict(shown.params)
    for layer, scale in trained.scales.items():
        kernel, bias = (params[layer][name] for name in ("kernel", "bias"))
        params[layer] = {"kernel": kernel, "scale": scale, "shift": bias}
    output, kept = graph.evaluate(nodes, params, shown.inputs, precision=trained.network.precision)
    moments = {n.layer: kept[i] for i, n in enumerate(nodes) if isinstance(n, BatchNorm)}
    return shown.decode(output[: x.shape[0], : x.shape[1]]), moments


def _with_norms(nodes: Sequence[Node], layers: Sequence[str]) -> tuple[Node, ...]:
    """The graph with normalisation after the convolutions of these layers."""
    made: list[Node] = []
    places: list[int] = []
    for node in nodes:
        made.append(moved(node, places))
        if isinstance(node, Conv) and node.layer in layers:
            made.append(BatchNorm(len(made) - 1, node.layer))
        places.append(len(made) - 1)
    return tuple(made)
