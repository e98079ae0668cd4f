"""The U-Net of Open Image Denoise 2.x: its layers, their sizes and their names in archives.

Two layouts of weights are known. Base and small have one convolution per encoder level, large has two; which
one it is follows from the names of the layers. Every convolution is 3×3 with zero padding and is
followed by a ReLU, the last one too; 2×2 max pooling down, nearest neighbour up, and skips from the
pooled levels and from the input.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from progden_jax.denoisers._network import Params
from progden_jax.denoisers.graph import Conv, Input, MaxPool, Node, Relu, Upsample

_BASE = (
    (("enc_conv0", "enc_conv1"), ("enc_conv2",), ("enc_conv3",), ("enc_conv4",)),
    ("enc_conv5a", "enc_conv5b"),
    (
        ("dec_conv4a", "dec_conv4b"),
        ("dec_conv3a", "dec_conv3b"),
        ("dec_conv2a", "dec_conv2b"),
        ("dec_conv1a", "dec_conv1b", "dec_conv0"),
    ),
)
_LARGE = (
    tuple((f"enc_conv{n}a", f"enc_conv{n}b") for n in (1, 2, 3, 4)),
    ("enc_conv5a", "enc_conv5b"),
    (
        *((f"dec_conv{n}a", f"dec_conv{n}b") for n in (4, 3, 2)),
        tuple("dec_conv1" + s for s in "abc"),
    ),
)


_WIDTHS = {
    "small": (_BASE, (*[32] * 7, *[64] * 5, *[32] * 3, 3)),
    "base": (
        _BASE,
        (32, 32, 48, 64, 80, 96, 96, 112, 112, 96, 96, 64, 64, 64, 32, 3),
    ),
    "large": (
        _LARGE,
        (*(64, 64, 96, 96, 128, 128, 192, 192, 256, 256, 192, 192, 128, 128, 96, 96), 64, 64, 3),
    ),
}

SIZES = tuple(_WIDTHS)
"""OIDN's three sizes: 0.3, 0.9 and 3.8 million weights."""


def shapes(size: str) -> dict[str, tuple[int, int]]:
    """Of every layer of a network of that size, in order, the kernel's edge and its output channels."""
    candidate, widths = _WIDTHS[size]
    return {name: (3, width) for name, width in zip(_layers(candidate), widths, strict=True)}


def layout(
    params: Iterable[str],
) -> tuple[tuple[tuple[str, ...], ...], tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Names of the layers per encoder level, at the bottom, and per decoder level.

    Raises
    ------
    ValueError
        If the layers are neither those of the base and small nor those of the large network.
    """
    for candidate in (_BASE, _LARGE):
        if set(_layers(candidate)) == set(params):
            return candidate
    raise ValueError(
        f"the weights hold the layers {', '.join(sorted(params))}; expected those of OIDN's U-Net "
        f"(base and small: {', '.join(_layers(_BASE))}; large: {', '.join(_layers(_LARGE))})."
    )


def _layers(candidate: Sequence) -> list[str]:
    encoder, bottom, decoder = candidate
    return [name for level in (*encoder, bottom, *decoder) for name in level]


def graph(params: Iterable[str]) -> tuple[Node, ...]:
    """The network of those layers."""
    encoder, bottom, decoder = layout(params)
    nodes: list[Node] = [Input()]

    def convolve(names: Sequence[str], *sources: int) -> int:
        for name in names:
            nodes.append(Conv(sources, name))
            nodes.append(Relu(len(nodes) - 1))
            sources = (len(nodes) - 1,)
        return sources[0]

    x, skips = 0, [0]
    for names in encoder:
        nodes.append(MaxPool(convolve(names, x)))
        x = len(nodes) - 1
        skips.append(x)
    skips.pop()
    x = convolve(bottom, x)
    for skip, names in zip(reversed(skips), decoder, strict=True):
        nodes.append(Upsample(x))
        x = convolve(names, len(nodes) - 1, skip)
    return tuple(nodes)


def from_tensors(tensors: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Parameters from the tensors of a TZA archive, in float32."""
    params: dict[str, dict[str, np.ndarray]] = {}
    for name, tensor in tensors.items():
        layer, _, kind = name.rpartition(".")
        if kind == "weight":
            params.setdefault(layer, {})["kernel"] = np.transpose(tensor, (2, 3, 1, 0)).astype(
                np.float32
            )
        elif kind == "bias":
            params.setdefault(layer, {})["bias"] = tensor.astype(np.float32)
        else:
            raise ValueError(
                f"the weights hold a tensor {name!r}; expected LAYER.weight or LAYER.bias."
            )
    for layer, parts in params.items():
        if parts.keys() != {"kernel", "bias"}:
            raise ValueError(f"the weights of layer {layer} lack its weight or its bias.")
    layout(params)
    return params


def to_tensors(params: Params, dtype: np.typing.DTypeLike = np.float16) -> dict[str, np.ndarray]:
    """The tensors of a TZA archive from parameters: the inverse of `from_tensors` but for `dtype`."""
    tensors = {}
    for name in _layers(layout(params)):
        kernel = np.asarray(params[name]["kernel"], dtype)
        tensors[f"{name}.weight"] = np.transpose(kernel, (3, 2, 0, 1))
        tensors[f"{name}.bias"] = np.asarray(params[name]["bias"], dtype)
    return tensors
