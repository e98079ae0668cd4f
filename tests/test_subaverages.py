"""Sub-averages: what they make up, and how a growing render is taken apart into them."""

import itertools

import numpy as np
import pytest

import progden_jax as pd
from progden_jax.exr._statistics import from_renders
from progden_jax.subaverages import averaged, cuts, nested

SIZE = (24, 20)


def samples(count, seed=0):
    """Skewed ones, as light that is found rarely."""
    return np.random.default_rng(seed).gamma(0.2, 1, (count, *SIZE, 3)).astype(np.float32)


def frame_of(values, **buffers):
    variance = values.var(0, ddof=1) / len(values) if len(values) > 1 else None
    return pd.Frame(values.mean(0), variance, spp=len(values), **buffers)


def test_the_mean_is_of_all_samples():
    """By the samples per pixel, colour and variance; the differences are told from it."""
    values = samples(40)
    parts = [frame_of(part) for part in (values[:8], values[8:16], values[16:])]
    parts = [part.replace(albedo=part.color) for part in parts]
    found = averaged([*parts[:2], parts[2].replace(normal=parts[2].color)])
    np.testing.assert_allclose(found.shares, [0.2, 0.2, 0.6])
    np.testing.assert_allclose(found.frame.color, values.mean(0), rtol=1e-5)
    np.testing.assert_allclose(found.frame.albedo, values.mean(0), rtol=1e-5)
    assert float(found.frame.spp) == 40
    assert found.frame.normal is None
    assert set(found.differences) == {"color", "albedo"}
    for part, difference in zip(parts, found.differences["color"], strict=True):
        np.testing.assert_allclose(found.frame.color + difference, part.color, rtol=1e-5, atol=1e-5)
    expected = sum((n / 40) ** 2 * p.variance for n, p in zip((8, 8, 24), parts, strict=True))
    np.testing.assert_allclose(found.frame.variance, expected, rtol=1e-5)


@pytest.mark.parametrize("counts", [(10, 10, 10), (5, 5, 20)])
def test_a_variance_from_the_sub_averages_alone(counts):
    """Unbiased for shares of any size, and the usual one for equal ones."""
    ends = np.cumsum(counts)[:-1]
    groups = np.split(np.random.default_rng(0).normal(size=(30, 64, 64, 3)).astype("f4"), ends)
    parts = [pd.Frame(part.mean(0), None, spp=len(part)) for part in groups]
    found = np.asarray(averaged(parts).frame.variance, np.float64)
    # Chi-squared with two degrees of freedom has a deviation as large as its mean.
    assert abs(found.mean() * 30 - 1) < 4 / np.sqrt(found.size)
    if len(set(counts)) == 1:
        same = averaged([part.replace(spp=None) for part in parts])
        expected = from_renders([np.asarray(part.color) for part in parts])[1]
        np.testing.assert_allclose(found, expected, rtol=1e-4)
        np.testing.assert_allclose(same.frame.variance, expected, rtol=1e-4)
        assert same.frame.spp is None


def test_one_frame_alone():
    frame = frame_of(samples(4))
    found = averaged([frame.replace(variance=None)])
    np.testing.assert_array_equal(found.frame.color, frame.color)
    assert found.frame.variance is None
    assert not np.any(found.differences["color"])


def test_a_series_is_taken_apart():
    """Into the very samples that each frame has beyond the one before, with their variances."""
    values, ends = samples(33), (2, 8, 9, 33)
    albedo = np.full((*SIZE, 3), 0.5, "f4")
    found = nested([frame_of(values[:n], albedo=n * albedo) for n in ends])
    groups = [values[a:b] for a, b in itertools.pairwise((0, *ends))]
    assert [float(part.spp) for part in found] == [2, 6, 1, 24]
    for part, group in zip(found, groups, strict=True):
        np.testing.assert_allclose(part.color, group.mean(0), rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(part.albedo, 33 * albedo)
    assert found[2].variance is None
    for n in (0, 1, 3):
        expected = groups[n].var(0, ddof=1) / len(groups[n])
        np.testing.assert_allclose(found[n].variance, expected, rtol=1e-3, atol=1e-6)
    whole = averaged(found).frame
    np.testing.assert_allclose(whole.color, values.mean(0), rtol=1e-4, atol=1e-5)


def test_renders_of_their_own_are_no_series():
    """The statistic that tells is exact for any distribution, at any ratio of samples."""
    for first, last in ((8, 16), (8, 32), (4, 32)):
        series = [frame_of(samples(last)[:n]) for n in (first, last)]
        assert len(nested(series)) == 2
        with pytest.raises(ValueError, match=f"of {last} samples .* go on from that of {first}"):
            nested([series[0], frame_of(samples(last, seed=1))])
    dark = [pd.Frame(0 * f.color, 0 * f.variance, spp=f.spp) for f in series]
    assert not np.any(nested(dark)[1].color)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: averaged([]), "there are no frames"),
        (lambda f: averaged([f, pd.Frame(f.color[:3], None)]), r"frames\[1\].color has shape"),
        (
            lambda f: averaged([f, pd.Frame(f.color[:3], None)], names=("a.exr", "b.exr")),
            "b.exr.color has shape .* but a.exr.color has",
        ),
        (lambda f: nested([f, f]), "have 4, 4 samples per pixel, expected rising"),
        (lambda f: nested([]), "have none samples"),
        (lambda f: nested([f.replace(spp=None)]), r"frames\[0\] has no samples per pixel"),
        (lambda f: nested([f, f.replace(variance=None)]), r"frames\[1\] has no variance"),
        (lambda f: cuts([2, 8], 8, 3), "fewer than 8 .* there are renders of 2, and 3 .* take 2"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(frame_of(samples(4)))


def test_cuts_are_as_equal_as_can_be():
    assert cuts([2, 8, 32, 128, 512], 128, 2) == (32,)
    assert cuts([8, 16, 32, 64, 128], 128, 2) == (64,)
    assert cuts([16, 32, 48, 64], 64, 4) == (16, 32, 48)
    assert cuts([2, 8, 32, 128, 512], 512, 3) == (32, 128)
    assert cuts([2, 8], 2, 1) == ()
