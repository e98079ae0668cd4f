"""What is right already is left alone, and nothing else changes."""

import numpy as np
import pytest
from conftest import counting_compilations
from test_tiling import assert_same, mirrored

import progden_jax as pd
from progden_jax import skipping


@pytest.fixture(scope="module")
def half(real_frame):
    """Right in its left part, and in one tile within the other."""
    frame = mirrored(real_frame, 150, 333)
    variance = np.array(frame.variance)
    variance[:, :170] = 0
    variance[60:110, 200:250] = 0
    return frame.replace(variance=variance)


@pytest.fixture(scope="module")
def dense(half, near_sighted):
    return pd.progressive_denoise(half, near_sighted, outputs=["image", "alpha"], skip=False)


def test_half_a_frame_equals_the_dense_answer(half, near_sighted, dense):
    found = pd.progressive_denoise(half, near_sighted, outputs=["image", "alpha"])
    assert dense.skipped.pixels == 0
    assert found.skipped.pixels == pytest.approx(150 * 333 / 2, rel=0.1)
    assert found.skipped.computed < 0.75 * dense.skipped.computed
    assert "standard error is at most 1e-06" in found.skipped.reason
    assert_same(found.image, dense.image)
    assert np.mean(np.asarray(found.alpha) == np.asarray(dense.alpha)) > 0.99
    np.testing.assert_allclose(found.mean_alpha, dense.mean_alpha, rtol=1e-4)
    assert float(np.asarray(found.alpha)[:, 200:].mean()) > 0.01
    with counting_compilations() as compiled:
        pd.progressive_denoise(half, near_sighted, outputs=["image", "alpha"])
    assert compiled == []


def test_windows_in_bounded_memory_are_skipped_too(half, near_sighted, dense):
    found = pd.progressive_denoise(half, near_sighted, outputs=["image"], max_memory=25 * 2**20)
    assert found.skipped.pixels > 150 * 333 / 4
    assert_same(found.image, dense.image)


def test_other_outputs_forbid_it(half, near_sighted):
    every = pd.progressive_denoise(half, near_sighted)
    assert every.skipped.pixels == 0
    assert not np.allclose(every.denoised[:, :100], half.color[:, :100])


class Untouchable:
    """A denoiser that must not be asked."""

    def __call__(self, frame):
        raise AssertionError

    def bind(self, frame, **_):
        raise AssertionError


def test_a_converged_frame_is_given_back(half):
    frame = half.replace(variance=np.zeros_like(half.variance))
    result = pd.progressive_denoise(
        frame, Untouchable(), mixer=pd.ClosedForm(), outputs=["image", "alpha"]
    )
    np.testing.assert_array_equal(result.image, frame.color)
    assert not np.asarray(result.alpha).any()
    assert result.skipped.computed == 0
    assert result.skipped.pixels == 150 * 333
    assert result.skipped.reason.startswith("every pixel")
    noise = 1e-3 * np.asarray(half.color)
    nearly = half.replace(variance=noise**2)
    rule = pd.Skip(tolerance=2e-3)
    result = pd.progressive_denoise(
        nearly, Untouchable(), mixer=pd.ClosedForm(), outputs=["image"], skip=rule
    )
    assert result.skipped.pixels == 150 * 333


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_pixel_is_not_right(half, bad):
    color = np.array(half.color)
    color[:] = 1
    variance = np.zeros_like(color)
    color[40, 56, 2] = bad
    tiles = skipping.noisy_tiles(color, variance, pd.Skip(tile=16))
    assert tiles.sum() == 1
    assert tiles[2, 3]
    variance[56, 56] = np.nan
    assert skipping.noisy_tiles(color, variance, pd.Skip(tile=16)).sum() == 2


@pytest.mark.parametrize("tile", [16, 23])
def test_noisy_tiles_against_a_plain_loop(tile):
    rng = np.random.default_rng(tile)
    color = rng.random((70, 95, 3), np.float32)
    variance = np.zeros_like(color)
    for row, column in rng.integers(0, (70, 95), (6, 2)):
        variance[row, column, 1] = 1e-3
    found = skipping.noisy_tiles(color, variance, pd.Skip(tile=tile))
    assert 0 < found.sum() < found.size
    for (i, j), noisy in np.ndenumerate(found):
        rows = slice(max(i * tile - 5, 0), (i + 1) * tile + 5)
        columns = slice(max(j * tile - 5, 0), (j + 1) * tile + 5)
        assert noisy == (variance[rows, columns] > 0).any()
    on_canvas = skipping.noisy_tiles(color, variance, pd.Skip(tile=tile), (144, 96))
    assert on_canvas.shape == (-(-144 // tile), -(-96 // tile))
    rows, columns = found.shape
    np.testing.assert_array_equal(on_canvas[:rows, :columns], found)
    # What is beyond the image is noisy only where its margin reaches in.
    assert not on_canvas[rows + 1 :].any()


def test_a_large_image_is_looked_at_in_parts():
    size = (700, 411)
    assert skipping._PART < size[0] * size[1] < 2 * skipping._PART
    color = np.ones((*size, 3), np.float32)
    variance = np.zeros_like(color)
    variance[24, 200] = variance[699, 408] = 1
    color[:, 56:72] = np.inf
    found = skipping.noisy_tiles(color, variance, pd.Skip())
    rows, columns = np.nonzero(found)
    beside = np.isin(columns, (3, 4))
    assert beside.sum() == 2 * found.shape[0]
    assert list(zip(rows[~beside], columns[~beside], strict=True)) == [(1, 12), (43, 25)]


def test_settings_are_checked():
    with pytest.raises(ValueError, match="relative error from 0 up"):
        pd.Skip(tolerance=-1)
    with pytest.raises(ValueError, match="at least 16"):
        pd.Skip(tile=8)
