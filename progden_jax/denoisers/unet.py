"""The U-Net of Open Image Denoise 2.x as a pure function of (params, inputs).

Two layouts of weights are known. Base and small have one convolution per encoder level, large has two; which
one it is follows from the names of the layers. Every convolution is 3×3 with zero padding and is
followed by a ReLU, the last one too; 2×2 max pooling down, nearest neighbour up, and skips from the
pooled levels and from the input.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from progden_jax._numeric import own_zero
from progden_jax.denoisers.graph import Conv, Input, MaxPool, Node, Relu, Upsample

Params = Mapping[str, Mapping[str, Any]]
"""Layer name -> {"kernel": (3, 3, in, out), "bias": (out,)}."""

LEVELS = 4
ALIGNMENT = 2**LEVELS
"""Inputs are padded with zeros to multiples of this many pixels."""

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


def layout(
    params: Params,
) -> tuple[tuple[tuple[str, ...], ...], tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Names of the layers per encoder level, at the bottom, and per decoder level.

    Raises
    ------
    ValueError
        If the layers are neither those of the base and small nor those of the large network.
    """
    for candidate in (_BASE, _LARGE):
        encoder, bottom, decoder = candidate
        names = {name for level in (*encoder, bottom, *decoder) for name in level}
        if names == set(params):
            return candidate
    raise ValueError(
        f"the weights hold the layers {', '.join(sorted(params))}; expected those of OIDN's U-Net "
        f"(base and small: {_names(_BASE)}; large: {_names(_LARGE)})."
    )


def _names(candidate: Sequence) -> str:
    encoder, bottom, decoder = candidate
    return ", ".join(name for level in (*encoder, bottom, *decoder) for name in level)


def apply(
    params: Params,
    inputs: Float[Array, "h w c"],
    *,
    valid: tuple[Array | int, Array | int] | None = None,
    precision: lax.PrecisionLike = lax.Precision.HIGHEST,
) -> Float[Array, "h w 3"]:
    """The network's output, (H, W, 3) and at least 0, in the transferred space of its input.

    Parameters
    ----------
    params : see `Params`.
    inputs : (H, W, C) transferred colour and auxiliary channels; H and W multiples of 16.
    valid : (height, width), multiples of 16, at most (H, W), may be traced: what lies outside counts as the
        zero padding around an image of this size, so that one compiled program serves many sizes.
    precision : of the convolutions. The default keeps float32 on GPUs, where JAX else takes TF32. "bfloat16"
        rounds their inputs and kernels to bfloat16 and sums in float32, tangents likewise.
    """
    encoder, bottom, decoder = layout(params)
    narrow = precision == "bfloat16"
    masks = [_mask(inputs.shape[0] >> n, inputs.shape[1] >> n, valid, n) for n in range(LEVELS + 1)]

    def convolve(name: str, x: Array, level: int) -> Array:
        kernel = jnp.asarray(params[name]["kernel"])
        x = lax.conv_general_dilated(
            x[None].astype(jnp.bfloat16) if narrow else x[None],
            kernel.astype(jnp.bfloat16) if narrow else kernel,
            (1, 1),
            "SAME",
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=None if narrow else precision,
            preferred_element_type=x.dtype if narrow else None,
        )[0]
        x = x + params[name]["bias"]
        positive = x > 0
        if (mask := masks[level]) is not None:
            positive &= mask
        return jnp.where(positive, x, own_zero(x))

    x, skips = inputs, [inputs]
    for level, names in enumerate(encoder):
        for name in names:
            x = convolve(name, x, level)
        x = max_pool(x)
        skips.append(x)
    skips.pop()
    for name in bottom:
        x = convolve(name, x, LEVELS)
    for level, names in zip(reversed(range(LEVELS)), decoder, strict=True):
        x = jnp.concatenate([upsample(x), skips[level]], axis=-1)
        for name in names:
            x = convolve(name, x, level)
    return x


def graph(params: Params) -> tuple[Node, ...]:
    """The network as a list of layers, for the exact divergence by cones."""
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


def max_pool(x: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    """The largest of each 2×2, whose derivative goes to the first of them in raster order on ties."""
    h, w, c = x.shape
    cells = x.reshape(h // 2, 2, w // 2, 2, c)
    candidates = [cells[:, i, :, j] for i in (0, 1) for j in (0, 1)]
    best = candidates[0]
    for candidate in candidates[1:]:
        best = jnp.where(candidate > best, candidate, best)
    return best


def upsample(x: Float[Array, "h w c"]) -> Float[Array, "2h 2w c"]:
    """Each pixel repeated over 2×2."""
    h, w, c = x.shape
    return jnp.broadcast_to(x[:, None, :, None], (h, 2, w, 2, c)).reshape(2 * h, 2 * w, c)


def _mask(
    height: int, width: int, valid: tuple[Array | int, Array | int] | None, level: int
) -> Bool[Array, "h w 1"] | None:
    if valid is None:
        return None
    rows = jnp.arange(height) < jnp.asarray(valid[0]) >> level
    columns = jnp.arange(width) < jnp.asarray(valid[1]) >> level
    return (rows[:, None] & columns[None, :])[..., None]


def receptive_radius(params: Params) -> int:
    """How many pixels away the input can be that an output pixel depends on."""
    encoder, bottom, decoder = layout(params)
    radius = 0
    for level, names in (
        *enumerate(encoder),
        (LEVELS, bottom),
        *zip(reversed(range(LEVELS)), decoder, strict=True),
    ):
        for name in names:
            radius += (np.shape(params[name]["kernel"])[0] // 2) << level
    # Each pooling step, and the blocks it fixes in place, reach one level's pixel further.
    return radius + sum(1 << level for level in range(LEVELS))


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
    encoder, bottom, decoder = layout(params)
    tensors = {}
    for level in (*encoder, bottom, *decoder):
        for name in level:
            kernel = np.asarray(params[name]["kernel"], dtype)
            tensors[f"{name}.weight"] = np.transpose(kernel, (3, 2, 0, 1))
            tensors[f"{name}.bias"] = np.asarray(params[name]["bias"], dtype)
    return tensors
