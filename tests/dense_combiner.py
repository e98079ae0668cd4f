"""The combination kernel and its network written out pixel by pixel, float64."""

import numpy as np


def combine(noisy, denoised, weights, window, reliability=None, trust=None, shares=None):
    """Eq. 14 of (B, H, W, 3) sub-averages; weights (B, window², H, W), offsets in raster order.

    With them, the reliability (B, H, W) of each value, the weight (H, W) of the mean denoised one, and the
    shares (B,) of the samples, by which the sub-averages count.
    """
    buffers, height, width, _ = noisy.shape
    counts = np.ones(buffers) if shares is None else np.asarray(shares) * buffers
    radius = window // 2
    result = np.zeros(noisy.shape[1:])
    for c in np.ndindex(height, width):
        total, norm = np.zeros(3), 0.0
        for b in range(buffers):
            for offset, (i, j) in enumerate(np.ndindex(window, window)):
                there = (c[0] + i - radius, c[1] + j - radius)
                if not (0 <= there[0] < height and 0 <= there[1] < width):
                    continue
                weight = counts[b] * weights[b, offset, *c]
                if reliability is not None:
                    weight *= reliability[b, *there]
                norm += weight
                if there == c:
                    total += weight * noisy[b, *c]
                else:
                    total += weight * (noisy[b, *there] + denoised[b, *c] - denoised[b, *there])
        if trust is not None:
            total += trust[c] * np.average(denoised[:, *c], axis=0, weights=counts)
            norm += trust[c]
        result[c] = total / norm
    return result


def convolution(x, layer):
    """With zero padding, (H, W, C)."""
    kernel, bias = (np.asarray(layer[name], np.float64) for name in ("kernel", "bias"))
    size = len(kernel)
    padded = np.pad(x, ((size // 2,) * 2, (size // 2,) * 2, (0, 0)))
    height, width = x.shape[:2]
    return bias + sum(
        padded[i : i + height, j : j + width] @ kernel[i, j] for i, j in np.ndindex(size, size)
    )


def relative_depth(depth, window):
    """Its logarithm minus the mean of that over the window inside the image."""
    log, result = np.log(depth), np.zeros(depth.shape)
    radius = window // 2
    for r, c in np.ndindex(depth.shape[:2]):
        around = log[max(r - radius, 0) : r + radius + 1, max(c - radius, 0) : c + radius + 1]
        result[r, c] = log[r, c] - around.mean()
    return result


def network(settings, params, noisy, denoised, frame, shares=None):
    """The combined image of (B, H, W, 3) sub-averages."""
    noisy, denoised = noisy.astype(np.float64), denoised.astype(np.float64)
    level = np.maximum(denoised, 0)
    mean = np.average(level, axis=0, weights=shares)
    buffers = {
        "albedo": lambda: frame.albedo,
        "normal": lambda: frame.normal,
        "depth": lambda: relative_depth(np.asarray(frame.depth, np.float64), settings.window),
        "variance": lambda: np.log1p(np.sqrt(frame.variance) / (mean + 0.01)),
    }
    seen = [
        *np.log1p(np.maximum(noisy, 0)),
        *np.log1p(level),
        *np.arcsinh((noisy - denoised) / (level + 0.01)),
        *(buffers[role]() for role in settings.inputs),
    ]
    h = np.concatenate(seen, axis=-1, dtype=np.float64)
    for n in range(1, settings.layers):
        h = np.maximum(convolution(h, params[f"conv{n}"]), 0)
    logits = convolution(h, params["kernel"]).transpose(2, 0, 1)
    count = settings.buffers * settings.window**2
    shape = (settings.buffers, settings.window**2, *logits.shape[1:])
    further = (np.exp(logits[count:-1]), np.exp(logits[-1])) if settings.robust else ()
    weights = np.exp(logits[:count]).reshape(shape)
    return combine(noisy, denoised, weights, settings.window, *further, shares=shares)
