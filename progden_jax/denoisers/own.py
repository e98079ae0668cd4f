"""The project's own denoisers, trained from scratch: a U-Net and a kernel-predicting network.

(A third is in `progden_jax.denoisers.residual`.)

Both see log(1 + v) / log(65505) of radiance and albedo, normals moved to [0, 1] and the arctangent of
the variance, and no exposure is sought (Firmino et al. 2022, section 5.1, has none). The variance
is a constant in derivatives with respect to the colour, as albedo and normal are: SURE's divergence is that
of y = f(x) at fixed σ².
"""

import functools
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from progden_jax import _checks, transfer
from progden_jax.denoisers import graph, unet
from progden_jax.denoisers._network import (
    Network,
    Params,
    channels_of,
    he_params,
    lit,
    normal_to_unit,
)
from progden_jax.denoisers.graph import Conv, Filter, Input, Node, Pointwise, Relu

INPUT_SETS: dict[str, tuple[str, ...]] = {
    "hdr": (),
    "hdr-var": ("variance",),
    "hdr-alb-nrm": ("albedo", "normal"),
    "hdr-alb-nrm-var": ("albedo", "normal", "variance"),
}
"""The paper's input sets (Table 1): what each takes besides the colour."""

LOG_GAIN = math.log(65505) / math.log(2)
"""Brings the transferred radiance 1, which is 1/16, to 1."""


class LogNetwork(Network):
    """A network between log(1 + ·) transfers.

    Attributes
    ----------
    buffers : what it may take besides the colour.
    gains : what brings an input's channels to the size of about 1 that He's weights expect, where it isn't 1.
    """

    buffers: ClassVar[tuple[str, ...]] = ("albedo", "normal", "variance")
    gains: ClassVar[Mapping[str, float]] = {"color": LOG_GAIN, "albedo": LOG_GAIN}

    def __init__(
        self,
        params: Params,
        inputs: tuple[str, ...] = (),
        *,
        name: str | None = None,
        precision: str = "highest",
    ) -> None:
        for role in inputs:
            _checks.choice("inputs", role, self.buffers)
        name = type(self).__name__.lower() if name is None else name
        super().__init__(params, tuple(inputs), name=name, precision=precision)

    def encode(self, x: Array, exposure: None) -> Array:
        del exposure
        return transfer.log1p_normalized(lit(x))

    def transferred(self, role: str, buffer: Array) -> Array:
        if role == "normal":
            return normal_to_unit(buffer)
        return (transfer.arctan if role == "variance" else transfer.log1p_normalized)(lit(buffer))

    def with_inputs(self, inputs: tuple[str, ...]) -> Self:
        """The network that takes these buffers too, with weights of zero: it gives the same images.

        Training goes on from there: zero weights of a first layer do learn.

        Raises
        ------
        ValueError
            If a buffer is none that the network knows, or one that it takes already is missing.
        """
        for role in inputs:
            _checks.choice("inputs", role, self.buffers)
        if missing := [role for role in self.inputs if role not in inputs]:
            raise ValueError(
                f"{self.name} takes {' and '.join(missing)}, and inputs is {inputs}: add what it takes."
            )
        taken = _channels_by_role(self.inputs)
        rows = [
            taken[role] if role in taken else np.full(channels_of(role), -1)
            for role in ("color", *inputs)
        ]
        widths = graph.channels(self.nodes, self.params)
        params = dict(self.params)
        for node in self.nodes:
            if isinstance(node, Conv) and 0 in node.sources:
                kernel = params[node.layer]["kernel"]
                ends = np.cumsum([widths[source] for source in node.sources])[:-1]
                parts = jnp.split(kernel, ends, axis=2)
                parts = [
                    _picked(part, np.concatenate(rows)) if source == 0 else part
                    for source, part in zip(node.sources, parts, strict=True)
                ]
                wide = jnp.concatenate(parts, axis=2)
                params[node.layer] = {**params[node.layer], "kernel": wide}
        return type(self)(params, inputs, name=self.name, precision=self.precision)

    @classmethod
    def he_params(
        cls,
        key: jax.Array,
        inputs: tuple[str, ...],
        nodes: tuple[Node, ...],
        shapes: Mapping[str, tuple[int, int]],
    ) -> dict[str, Any]:
        """He's weights for these inputs, see the function `he_params`."""
        roles = ("color", *inputs)
        gains = [cls.gains.get(role, 1.0) for role in roles for _ in range(channels_of(role))]
        return he_params(key, nodes, shapes, gains)


def _channels_by_role(inputs: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Which of the network's input channels each buffer is."""
    roles = ("color", *inputs)
    ends = np.cumsum([channels_of(role) for role in roles])
    return {r: np.arange(end - channels_of(r), end) for r, end in zip(roles, ends, strict=True)}


def _picked(kernel: Array, rows: np.ndarray) -> Array:
    """The kernel's input channels by number, zeros where that is -1."""
    return jnp.where((rows >= 0)[:, None], kernel[:, :, rows], 0)


def quietened(params: dict[str, Any], layer: str, bias: float) -> dict[str, Any]:
    """A tenth of that layer's kernel, and its bias: the network starts near a constant output."""
    last = params[layer]
    changed = {"kernel": 0.1 * last["kernel"], "bias": jnp.full_like(last["bias"], bias)}
    return params | {layer: changed}


@jax.tree_util.register_pytree_with_keys_class
class UNet(LogNetwork):
    """OIDN's U-Net with weights of its own, from and to log(1 + radiance): a pytree of its weights.

    Parameters
    ----------
    params : layers as of OIDN's networks, see `unet.shapes`.
    inputs : buffers taken besides the colour, in this order: some of "albedo", "normal" and "variance".
    name : for messages; by default the architecture's.
    precision : of the convolutions; "highest" keeps float32 on GPUs, "tensorfloat32" is about 1e-3 off.

    References
    ----------
    Firmino et al. 2022, section 5.1.
    """

    @classmethod
    def init(
        cls,
        key: jax.Array,
        inputs: tuple[str, ...] = (),
        *,
        size: str = "base",
        name: str | None = None,
        precision: str = "highest",
    ) -> Self:
        """A network to train: He's random weights, zero biases.

        The first layer allows for logarithms that are a sixteenth at radiance 1. The last has a tenth of
        its weights and a bias that stands for radiance 0.74, because a ReLU follows: a
        channel that began negative everywhere would never learn.

        Parameters
        ----------
        key : of the random numbers.
        inputs : see `UNet`; `INPUT_SETS` has the paper's.
        size : "small", "base" or "large": 0.3, 0.9 or 3.8 million weights.
        """
        _checks.choice("size", size, unet.SIZES)
        shapes = unet.shapes(size)
        params = cls.he_params(key, inputs, unet.graph(shapes), shapes)
        params = quietened(params, list(shapes)[-1], 0.05)
        return cls(params, inputs, name=name, precision=precision)

    @property
    def nodes(self) -> tuple[Node, ...]:
        return unet.graph(self.params)

    def decode(self, y: Array, exposure: None) -> Array:
        del exposure
        return transfer.log1p_normalized_inverse(y)


@jax.tree_util.register_pytree_with_keys_class
class KPCN(LogNetwork):
    """A network that predicts for every pixel the kernel which filters the radiance around it.

    Convolutions with ReLUs end in one logit per tap; y_p = Σ_q w_pq x_q with w their softmax, over the
    pixels inside the image, x the linear radiance at least 0, the three channels alike. So y is between the
    least and the most of its neighbourhood.

    Parameters
    ----------
    params : layers "conv1", "conv2", ... and "kernel", whose output channels are an odd number squared.
    inputs, name, precision : see `UNet`.

    References
    ----------
    Firmino et al. 2022, section 6 (5×5 kernels); Bako et al. 2017. How the kernels are applied is not said
    there; on linear radiance, a mean stays a mean.
    """

    @classmethod
    def init(
        cls,
        key: jax.Array,
        inputs: tuple[str, ...] = (),
        *,
        layers: int = 6,
        width: int = 80,
        layer_size: int = 5,
        kernel_size: int = 5,
        name: str | None = None,
        precision: str = "highest",
    ) -> Self:
        """A network to train: He's random weights, zero biases, kernels near a box at first.

        Parameters
        ----------
        key : of the random numbers.
        inputs : see `UNet`; `INPUT_SETS` has the paper's.
        layers, width, layer_size : convolutions before the one that predicts kernels, their channels
            and the edge of their kernels in pixels, odd.
        kernel_size : edge in pixels of the predicted kernels, odd.
        """
        _checks.positive_int("layers", layers)
        _checks.positive_int("width", width)
        _checks.odd_int("layer_size", layer_size)
        _checks.odd_int("kernel_size", kernel_size)
        shapes = {f"conv{n}": (layer_size, width) for n in range(1, layers + 1)}
        shapes["kernel"] = (layer_size, kernel_size**2)
        nodes = _kpcn_graph(layers, kernel_size)
        params = quietened(cls.he_params(key, inputs, nodes, shapes), "kernel", 0.0)
        return cls(params, inputs, name=name, precision=precision)

    @property
    def nodes(self) -> tuple[Node, ...]:
        return _kpcn_graph(*_kpcn_sizes(self.params))

    def decode(self, y: Array, exposure: None) -> Array:
        del exposure
        return y


@functools.cache
def _kpcn_graph(layers: int, size: int) -> tuple[Node, ...]:
    nodes: list[Node] = [Input()]
    for number in range(1, layers + 1):
        nodes += [Conv((len(nodes) - 1,), f"conv{number}"), Relu(len(nodes))]
    nodes.append(Conv((len(nodes) - 1,), "kernel"))
    nodes.append(Pointwise(0, transfer.log1p_normalized_inverse, channels=3))
    nodes.append(Filter(image=len(nodes) - 1, logits=len(nodes) - 2, size=size))
    return tuple(nodes)


def _kpcn_sizes(params: Params) -> tuple[int, int]:
    """Hidden layers, and the edge of the predicted kernels."""
    expected = {"kernel", *(f"conv{n}" for n in range(1, len(params)))}
    if len(params) < 2 or set(params) != expected:
        raise ValueError(
            f"the weights hold the layers {', '.join(sorted(params))}; expected those of a KPCN: "
            "conv1, conv2, ... and kernel."
        )
    taps = params["kernel"]["kernel"].shape[3]
    if math.isqrt(taps) ** 2 != taps or taps % 2 == 0:
        raise ValueError(
            f"the layer kernel predicts {taps} logits per pixel; expected an odd number squared, such as 25."
        )
    return len(params) - 1, math.isqrt(taps)
