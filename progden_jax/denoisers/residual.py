"""A deep residual network that maps noisy pixels to clean ones directly."""

import functools
from collections.abc import Mapping
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array

from progden_jax import _checks
from progden_jax.denoisers._network import Params, lit
from progden_jax.denoisers.graph import Add, Conv, Input, LeakyRelu, Node, Pointwise
from progden_jax.denoisers.own import LogNetwork, quietened

_SLOPE = 0.25
"""Of the PReLUs at first (He et al. 2015)."""

_HIGHEST = 22.0
"""Logarithm that the output is cut off at, of radiance 4e9: its exponential stays finite."""


@jax.tree_util.register_pytree_with_keys_class
class ResidualNet(LogNetwork):
    """Residual blocks between two convolutions, and a skip around them all: a pytree of its weights.

    A block adds to its input what two 3×3 convolutions with a PReLU between make of it. It sees and gives
    log(1 + radiance), sees log(1 + depth), and albedo and normal as they are, within their ranges. In
    training, batch normalisation follows the convolutions in blocks and the one after them
    (`progden_jax.training.normalization`); here it is part of their weights.

    With n blocks it reaches 2n + 3 pixels, and its exact divergence takes some 3(2n + 4)² passes by coloring
    and a third of that by cone.

    Parameters
    ----------
    params : layers "conv_in", "prelu_in", for each block "block1_conv1", "block1_prelu", "block1_conv2", ...,
        then "conv_mid" and "conv_out", or "conv_difference" where the colour is added to what it gives.
    inputs : buffers taken besides the colour, in this order: some of "albedo", "normal", "depth" and
        "variance". The paper's are all but the last.
    name : for messages; by default the architecture's.
    precision : of the convolutions; "highest" keeps float32 on GPUs, "tensorfloat32" is about 1e-3 off.

    References
    ----------
    Wong and Wong 2019, "Deep residual learning for denoising Monte Carlo renderings".

    Notes
    -----
    The paper takes x and y of normals in view space. A frame does not say where the camera looks, so all
    three components are taken in whatever space they come, as a rule the world's. In that and in the unit of
    depth, renders must be as those trained on; training can vary the unit (``depth_stops``). PReLUs have a
    slope per channel, so that images may have any size: the paper's 13.8 million weights come out with one
    per channel and pixel of its 64×64 patches. The first and the last layer have biases here.
    """

    buffers: ClassVar[tuple[str, ...]] = ("albedo", "normal", "depth", "variance")
    gains: ClassVar[Mapping[str, float]] = {}

    @classmethod
    def init(
        cls,
        key: jax.Array,
        inputs: tuple[str, ...] = (),
        *,
        blocks: int = 16,
        width: int = 128,
        difference: bool = False,
        name: str | None = None,
        precision: str = "highest",
    ) -> Self:
        """A network to train: He's random weights, zero biases, PReLUs of slope 0.25.

        The last layer has a tenth of its weights and, unless it gives differences, a bias that stands for
        radiance 0.65, because what is below 0 is cut off: a channel that began there everywhere would
        never learn.

        Parameters
        ----------
        key : of the random numbers.
        inputs : see `ResidualNet`.
        blocks, width : number of residual blocks, and their channels: 16 and 128 make 4.9 million weights.
        difference : the logarithm of the noisy colour is added in the end. Not in the paper; a short training
            would be spent on learning to pass the colour on.
        """
        _checks.positive_int("blocks", blocks)
        _checks.positive_int("width", width)
        nodes, last = _graph(blocks, difference), _LAST[difference]
        shapes = {node.layer: (3, width) for node in nodes if isinstance(node, Conv)}
        shapes[last] = (3, 3)
        params = cls.he_params(key, inputs, nodes, shapes)
        params = quietened(params, last, 0.0 if difference else 0.5)
        slope = jnp.full(width, _SLOPE, params["conv_in"]["bias"].dtype)
        slopes = {node.layer: {"slope": slope} for node in nodes if isinstance(node, LeakyRelu)}
        return cls(params | slopes, inputs, name=name, precision=precision)

    @property
    def nodes(self) -> tuple[Node, ...]:
        return _graph(*_form(self.params))

    @property
    def normalized(self) -> tuple[str, ...]:
        layers = (node.layer for node in self.nodes if isinstance(node, Conv))
        return tuple(layer for layer in layers if layer not in ("conv_in", *_LAST.values()))

    def encode(self, x: Array, exposure: None) -> Array:
        del exposure
        return jnp.log1p(lit(x))

    def transferred(self, role: str, buffer: Array) -> Array:
        match role:
            case "albedo":
                return jnp.clip(buffer, 0, 1)
            case "normal":
                return jnp.clip(buffer, -1, 1)
            case "depth":
                return jnp.log1p(lit(buffer))
            case _:
                return super().transferred(role, buffer)

    def decode(self, y: Array, exposure: None) -> Array:
        del exposure
        return jnp.expm1(jnp.clip(y, 0, _HIGHEST))


_LAST = {False: "conv_out", True: "conv_difference"}


@functools.cache
def _graph(blocks: int, difference: bool) -> tuple[Node, ...]:
    nodes: list[Node] = [Input(), Conv((0,), "conv_in"), LeakyRelu(1, "prelu_in")]
    first = last = 2
    for number in range(1, blocks + 1):
        nodes += [
            Conv((last,), f"block{number}_conv1"),
            LeakyRelu(last + 1, f"block{number}_prelu"),
            Conv((last + 2,), f"block{number}_conv2"),
            Add((last, last + 3)),
        ]
        last += 4
    nodes += [
        Conv((last,), "conv_mid"),
        Add((first, last + 1)),
        Conv((last + 2,), _LAST[difference]),
    ]
    if difference:
        nodes += [Pointwise(0, _unchanged, channels=3), Add((last + 3, last + 4))]
    return tuple(nodes)


def _unchanged(x: Array) -> Array:
    return x


def _form(params: Params) -> tuple[int, bool]:
    """Number of blocks, and whether the last layer gives differences."""
    blocks, difference = sum(n.endswith("_prelu") for n in params), _LAST[True] in params
    nodes = _graph(blocks, difference)
    expected = {layer for node in nodes if (layer := getattr(node, "layer", None))}
    if not blocks or set(params) != expected:
        raise ValueError(
            f"the weights hold the layers {', '.join(sorted(params))}; expected those of a residual "
            "network: conv_in, prelu_in, block1_conv1, block1_prelu, block1_conv2, ..., conv_mid, conv_out "
            "or conv_difference."
        )
    return blocks, difference
