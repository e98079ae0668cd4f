"""Collaborative regression written out pixel by pixel in float64, to compare the library's blocks with."""

import numpy as np


def distance(guide, variance, p, q, patch):
    """Mean over patch and channels of ((u − u')² − (v + min(v, v'))) / (v + v'), at least 0."""
    height, width = guide.shape[:2]
    terms = []
    for dy in range(-patch, patch + 1):
        for dx in range(-patch, patch + 1):
            (a, va), (b, vb) = (
                (
                    guide[at := (min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1))],
                    variance[at],
                )
                for y, x in (p, q)
            )
            level = 1e-8 * (a**2 + b**2) + 1e-18
            terms.append(((a - b) ** 2 - (va + np.minimum(va, vb))) / (level + va + vb))
    return max(np.mean(terms), 0.0)


def regression(image, features, guide, variance, *, radius, patch, bandwidth, ridge):
    """What `regress` gives for one bandwidth."""
    image, features, guide, variance = (
        np.asarray(a, np.float64) for a in (image, features, guide, variance)
    )
    height, width = image.shape[:2]
    total, weights = np.zeros_like(image), np.zeros((height, width, 1))
    for p in np.ndindex(height, width):
        near = [
            (y, x)
            for y in range(max(p[0] - radius, 0), min(p[0] + radius + 1, height))
            for x in range(max(p[1] - radius, 0), min(p[1] + radius + 1, width))
        ]
        w = np.exp([-distance(guide, variance, p, q, patch) / bandwidth**2 for q in near])
        model = np.array([[1.0, *(features[q] - features[p])] for q in near])
        mean = w @ model[:, 1:] / w.sum()
        # The ridge holds slopes back, not the constant, which is free once features are centred.
        centred = model[:, 1:] - mean
        values = np.array([image[q] for q in near])
        average = w @ values / w.sum()
        covariance = centred.T @ (w[:, None] * centred) / w.sum() + ridge * np.eye(len(mean))
        slope = np.linalg.solve(covariance, centred.T @ (w[:, None] * values) / w.sum())
        predicted = average + centred @ slope
        for q, weight, value in zip(near, w, predicted, strict=True):
            total[q] += weight * value
            weights[q] += weight
    return total / weights
