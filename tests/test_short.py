"""Convolutions of short windows in few products, against plain sums in float64."""

import itertools

import numpy as np
import pytest

from progden_jax.divergence import _short

SOURCES, TARGETS, TAPS = (1, 2, 3, 5, 9, 20), (1, 2, 3, 4, 6, 7, 13, 33), (1, 3, 5, 9)


def along(axis, phase, weights, x):
    at_points = axis.points[axis.kind[phase]] @ weights
    found = []
    for tile in range(axis.tiles):
        pixels = axis.start[phase] + tile * axis.stride + np.arange(axis.spread.shape[2])
        found.append(axis.combine[phase] @ (at_points * (axis.spread[phase] @ at(x, pixels))))
    return np.concatenate(found)[: axis.target]


def at(x, positions):
    inside = (positions >= 0) & (positions < len(x))
    return np.where(inside, x[np.clip(positions, 0, len(x) - 1)], 0)


@pytest.mark.parametrize("taps", TAPS)
def test_windows_at_any_offset(taps):
    rng = np.random.default_rng(taps)
    shift = np.array([-(taps // 2), 0, 2, -taps - 3])
    for source, target in itertools.product(SOURCES, TARGETS):
        axis = _short.convolution(source, target, shift, taps)
        x, weights = rng.normal(size=source), rng.normal(size=taps)
        for phase, offset in enumerate(shift):
            positions = np.arange(target)[:, None] + np.arange(taps) + offset
            expected = at(x, positions) @ weights
            np.testing.assert_allclose(along(axis, phase, weights, x), expected, atol=1e-12)


@pytest.mark.parametrize("taps", TAPS[:3])
def test_windows_of_repeated_pixels(taps):
    rng = np.random.default_rng(taps)
    first, parent = np.arange(-3, 5), np.array([-2, -1, 0, 1, -3, 0, 1, 2])
    for source, target in itertools.product(SOURCES, TARGETS):
        axis = _short.upsampled_convolution(source, target, first, parent, taps)
        x, weights = rng.normal(size=source), rng.normal(size=taps)
        for phase in range(len(first)):
            fine = first[phase] + np.arange(target)[:, None] + np.arange(taps) - taps // 2
            expected = at(x, fine // 2 - parent[phase]) @ weights
            np.testing.assert_allclose(along(axis, phase, weights, x), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("source", "target", "points", "plain"),
    [(5, 5, 7, 13), (7, 5, 7, 15), (3, 5, 5, 9), (3, 7, 5, 9), (6, 4, 6, 12), (33, 33, 49, 97)],
)
def test_fewer_points_than_pixels_times_taps(source, target, points, plain):
    shift = np.array([(source - target) // 2 - 1])
    axis = _short.convolution(source, target, shift, 3)
    reads = np.arange(target)[:, None] + np.arange(3) + shift
    assert np.count_nonzero((reads >= 0) & (reads < source)) == plain
    assert axis.tiles * axis.spread.shape[1] == points
    transforms = axis.multiply_adds(100, 100) - 100**2 * points**2
    assert 0 < transforms < 0.35 * 100**2 * points**2


def test_float32_rounds_by_a_millionth():
    rng = np.random.default_rng(0)
    worst = 0.0
    for target in range(2, 6):
        axis = _short.convolution(target + 2, target, np.array([0]), 3)
        x, weights = rng.normal(size=(target + 2, 2000)), rng.normal(size=3)
        reads = np.arange(target)[:, None] + np.arange(3)
        expected = np.einsum("ot...,t->o...", x[reads], weights)
        at_points = np.asarray(axis.points[0] @ weights, np.float32)[:, None]
        spread, combine = (
            np.asarray(axis.spread[0], np.float32),
            np.asarray(axis.combine[0], np.float32),
        )
        error = combine @ (at_points * (spread @ np.asarray(x, np.float32))) - expected
        worst = max(worst, float(np.sqrt((error**2).mean() / (expected**2).mean())))
    assert worst < 2e-6
