"""Collaborative regression written out pixel by pixel in float64, to compare the library's blocks with."""

import numpy as np


def patches(image, patch):
    """(H, W, C, n, n) around every pixel, the border's values repeated outside."""
    padded = np.pad(image, ((patch, patch), (patch, patch), (0, 0)), "edge")
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * patch + 1,) * 2, axis=(0, 1))


def distances(guide, variance, p, near):
    """Means over patch and channels of ((u − u')² − (v + min(v, v'))) / (v + v'), at least 0."""
    a, va, b, vb = guide[p], variance[p], guide[near], variance[near]
    level = 1e-8 * (a**2 + b**2) + 1e-18
    terms = ((a - b) ** 2 - (va + np.minimum(va, vb))) / (level + va + vb)
    return np.maximum(terms.mean((1, 2, 3)), 0)


def regression(image, features, guide, variance, *, radius, patch, bandwidth, ridge):
    """What `regress` gives for one bandwidth."""
    image, features, guide, variance = (
        np.asarray(a, np.float64) for a in (image, features, guide, variance)
    )
    guide, variance = patches(guide, patch), patches(variance, patch)
    height, width = image.shape[:2]
    total, weights = np.zeros_like(image), np.zeros((height, width, 1))
    for p in np.ndindex(height, width):
        rows, columns = (
            slice(max(at - radius, 0), min(at + radius + 1, size))
            for at, size in zip(p, (height, width), strict=True)
        )
        near = tuple(np.mgrid[rows, columns].reshape(2, -1))
        w = np.exp(-distances(guide, variance, p, near) / bandwidth**2)
        model = features[near] - features[p]
        # The ridge holds slopes back, not the constant, which is free once features are centred.
        mean = w @ model / w.sum()
        centred = model - mean
        values = image[near]
        average = w @ values / w.sum()
        covariance = centred.T @ (w[:, None] * centred) / w.sum() + ridge * np.eye(len(mean))
        slope = np.linalg.solve(covariance, centred.T @ (w[:, None] * values) / w.sum())
        total[near] += w[:, None] * (average + centred @ slope)
        weights[near] += w[:, None]
    return total / weights
