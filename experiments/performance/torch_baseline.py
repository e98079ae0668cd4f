"""Progressive denoising as a plain eager PyTorch program that follows the paper, to compare with.

What one writes from the paper's text and OIDN's documentation: NCHW float32, OIDN's U-Net as calls of
``conv2d``, K finite differences with Gaussian vectors and ε = 1e-4, the mixing network, dense 11×11
filters, and max pooling with indices for the pixel of highest variance. Weights are those of this project's
denoiser and mixer, so that its answers can be compared. Needs PyTorch, the extra "bench".
"""

import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

torch = importlib.import_module("torch")  # not installed where types are checked
F = importlib.import_module("torch.nn.functional")

Tensor = Any
EPSILON = 1e-4

# OIDN's PU transfer function.
_A, _B, _C, _D = 1412.83765, 1.64593172, 0.431384981, -0.00294139609
_E, _F, _G = 0.192653254, 0.00626026094, 0.998620152
_Y0, _Y1, _X0, _X1 = 1.57945760e-6, 0.0322087631, 0.00223151711, 0.370974749
_SCALE = 1 / (_E * math.log(65504 + _F) + _G)


def tensor(image: Any) -> Tensor:
    """(1, C, H, W) of a channels-last image."""
    return torch.from_numpy(np.array(image, np.float32)).permute(2, 0, 1)[None].contiguous()


def image(tensor: Tensor) -> np.ndarray:
    """Channels-last again."""
    return tensor[0].permute(1, 2, 0).numpy()


def layers(params: Mapping[str, Any]) -> dict[str, tuple[Tensor, Tensor]]:
    """Kernels (out, in, h, w) and biases."""
    return {
        name: (
            torch.from_numpy(np.array(layer["kernel"], np.float32))
            .permute(3, 2, 0, 1)
            .contiguous(),
            torch.from_numpy(np.array(layer["bias"], np.float32)),
        )
        for name, layer in params.items()
    }


def conv(net: dict[str, tuple[Tensor, Tensor]], name: str, x: Tensor) -> Tensor:
    kernel, bias = net[name]
    return F.conv2d(x, kernel, bias, padding=kernel.shape[-1] // 2)


class OIDN:
    """OIDN's base or small network on HDR radiance, with or without albedo and normal."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.net = layers(params)

    def bind(
        self, color: Tensor, albedo: Tensor | None, normal: Tensor | None
    ) -> Callable[[Tensor], Tensor]:
        """y = f(x), with the exposure of this colour."""
        exposure = autoexposure(color)
        auxiliary = []
        if albedo is not None:
            auxiliary.append(albedo.clamp(0, 1))
        if normal is not None:
            auxiliary.append(normal.clamp(-1, 1) * 0.5 + 0.5)

        def f(x: Tensor) -> Tensor:
            inputs = torch.cat([pu((x * exposure).clamp(min=0)) * _SCALE, *auxiliary], 1)
            return pu_inverse(self.forward(inputs) / _SCALE) / exposure

        return f

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        x = F.pad(x, (0, -width % 16, 0, -height % 16))

        def block(x: Tensor, *names: str) -> Tensor:
            for name in names:
                x = F.relu_(conv(self.net, name, x))
            return x

        def up(x: Tensor, skip: Tensor) -> Tensor:
            return torch.cat([F.interpolate(x, scale_factor=2, mode="nearest"), skip], 1)

        pool1 = F.max_pool2d(block(x, "enc_conv0", "enc_conv1"), 2)
        pool2 = F.max_pool2d(block(pool1, "enc_conv2"), 2)
        pool3 = F.max_pool2d(block(pool2, "enc_conv3"), 2)
        pool4 = F.max_pool2d(block(pool3, "enc_conv4"), 2)
        h = block(pool4, "enc_conv5a", "enc_conv5b")
        h = block(up(h, pool3), "dec_conv4a", "dec_conv4b")
        h = block(up(h, pool2), "dec_conv3a", "dec_conv3b")
        h = block(up(h, pool1), "dec_conv2a", "dec_conv2b")
        h = block(up(h, x), "dec_conv1a", "dec_conv1b", "dec_conv0")
        return h[..., :height, :width]


def autoexposure(color: Tensor) -> Tensor:
    """0.18 / 2^mean(log2 L) over bins of about 16×16 pixels."""
    weights = torch.tensor([0.212671, 0.715160, 0.072169])[:, None, None]
    luminance = (color[0].clamp(min=0) * weights).sum(0).double()
    height, width = luminance.shape
    # Sums over bins of unequal size are differences of sums from the corner.
    sums = F.pad(luminance.cumsum(0).cumsum(1), (1, 0, 1, 0))
    rows, columns = (torch.arange(-(-n // 16) + 1) * n // -(-n // 16) for n in (height, width))
    corners = sums[rows][:, columns]
    total = corners[1:, 1:] - corners[:-1, 1:] - corners[1:, :-1] + corners[:-1, :-1]
    means = total / ((rows[1:] - rows[:-1])[:, None] * (columns[1:] - columns[:-1]))
    lit = means[means > 1e-8]
    return (0.18 / torch.exp2(lit.log2().mean()) if len(lit) else torch.ones(())).float()


def pu(y: Tensor) -> Tensor:
    power = _B * y**_C + _D
    return torch.where(y < _Y0, _A * y, torch.where(y < _Y1, power, _E * (y + _F).log() + _G))


def pu_inverse(x: Tensor) -> Tensor:
    power = ((x - _D) / _B).clamp(min=0) ** (1 / _C)
    return torch.where(x < _X0, x / _A, torch.where(x < _X1, power, ((x - _G) / _E).exp() - _F))


def divergence(
    f: Callable[[Tensor], Tensor], x: Tensor, variance: Tensor, probes: int
) -> tuple[Tensor, Tensor]:
    """y = f(x), and σ²·∂f/∂x by K finite differences (Eq. 2)."""
    y, sigma = f(x), variance.sqrt()
    total = torch.zeros_like(x)
    for _ in range(probes):
        b = sigma * torch.randn_like(x)
        total += b * (f(x + EPSILON * b) - y)
    return y, total / (EPSILON * probes)


def sure(x: Tensor, y: Tensor, variance: Tensor, divergence: Tensor) -> Tensor:
    return (y - x) ** 2 + 2 * divergence - variance


def features(x: Tensor, y: Tensor, variance: Tensor, risk: Tensor) -> Tensor:
    """The 18 of section 4.3."""
    squared = (y - x) ** 2
    slope = risk + variance - squared
    seen = [x.clamp(min=0), y.clamp(min=0), *map(torch.atan, (variance, risk, squared, slope))]
    return torch.cat(seen, 1)


class MixingNet:
    """The paper's mixing network and its activation."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.net = layers(params)

    def __call__(self, features: Tensor) -> Tensor:
        h = F.relu_(conv(self.net, "conv_in", features))
        for name in ("block1", "block2"):
            inner = F.relu_(conv(self.net, f"{name}_conv1", h))
            h = F.relu_(h + conv(self.net, f"{name}_conv2", inner))
        x1, x2, x3 = conv(self.net, "conv_out", h).chunk(3, 1)
        return ((x1 - x2) / x3.clamp(min=1e-6)).clamp(0, 1)


def t_bound(alpha: Tensor, x: Tensor, y: Tensor, variance: Tensor, window: int = 11) -> Tensor:
    """α lowered by the t-statistic of 11×11 pixels, dense filters and all (section 4.4)."""
    difference = alpha * (y - x)
    scale = (100 * variance.mean().clamp(0, 1).sqrt()).clamp(min=1e-3)
    offsets = torch.arange(window) - window // 2
    squares = offsets[:, None] ** 2 + offsets**2
    kappa = torch.exp(-squares / (2 * scale**2)) / (scale * math.sqrt(2 * math.pi))
    kernel = kappa.expand(1, 3, window, window)
    d = F.conv2d(difference, kernel, padding=window // 2)
    v = F.conv2d(variance, kernel**2, padding=window // 2)
    highest, index = F.max_pool2d(variance, window, 1, window // 2, return_indices=True)
    there = difference.flatten(2).gather(2, index.flatten(2)).view_as(difference)
    d = d + there.sum(1, keepdim=True) / 3
    v = v + highest.sum(1, keepdim=True) / 9
    t = d.abs() / (v.sqrt() + 1e-6)
    return alpha * (1 - torch.special.ndtr(2.0 * (t - 4.2)))


def mix(
    net: MixingNet, x: Tensor, y: Tensor, variance: Tensor, divergence: Tensor
) -> tuple[Tensor, Tensor]:
    """The image and α, bounded."""
    alpha = net(features(x, y, variance, sure(x, y, variance, divergence)))
    alpha = t_bound(alpha, x, y, variance)
    return x + alpha * (y - x), alpha


def progressive_denoise(
    denoiser: OIDN,
    net: MixingNet,
    x: Tensor,
    variance: Tensor,
    *auxiliary: Tensor | None,
    probes: int,
) -> tuple[Tensor, Tensor]:
    """All of it: the image and α."""
    albedo, normal = auxiliary or (None, None)
    y, found = divergence(denoiser.bind(x, albedo, normal), x, variance, probes)
    return mix(net, x, y, variance, found)
