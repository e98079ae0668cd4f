"""Frame as a pytree, its checks, and the repair of bad values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import progden_jax as pd


@pytest.fixture
def color():
    return np.random.default_rng(0).random((9, 8, 3)).astype(np.float32)


def test_is_a_pytree(color):
    frame = pd.Frame(color, color, depth=color[..., :1], spp=8)
    doubled = jax.tree.map(lambda a: 2 * a, frame)
    assert isinstance(doubled, pd.Frame)
    assert doubled.albedo is None
    np.testing.assert_array_equal(doubled.color, 2 * color)
    batch = jax.tree.map(lambda *a: jnp.stack(a), frame, doubled)
    assert batch.color.shape == (2, 9, 8, 3)
    np.testing.assert_array_equal(batch.spp, [8, 16])
    assert jax.vmap(lambda f: f.depth.sum())(batch).shape == (2,)
    assert pd.Frame(batch.color, batch.variance, spp=4).spp.shape == (2,)
    assert "variance=(9, 8, 3)" in repr(frame)
    assert frame.size == (9, 8)


def test_messages(color):
    with pytest.raises(ValueError, match=r"variance covers 4×8 pixels but color covers 9×8"):
        pd.Frame(color, color[:4])
    with pytest.raises(ValueError, match=r"drop the alpha channel"):
        pd.Frame(np.zeros((4, 5, 4), np.float32), None)
    with pytest.raises(ValueError, match="the channels come last here"):
        pd.Frame(np.zeros((3, 5, 7), np.float32), None)
    with pytest.raises(ValueError, match="color has dtype uint8, expected a floating-point type"):
        pd.Frame(np.zeros((4, 5, 3), np.uint8), None)
    with pytest.raises(ValueError, match="color is a list, expected a floating-point array"):
        pd.Frame([[1.0]], None)
    with pytest.raises(ValueError, match="at least one pixel"):
        pd.Frame(np.zeros((0, 5, 3), np.float32), None)
    with pytest.raises(ValueError, match=r"depth has shape \(9, 8, 3\), expected .* 1\)"):
        pd.Frame(color, color, depth=color)


def test_a_sound_frame_passes_bit_for_bit(color):
    frame = pd.Frame(color, color, albedo=color, normal=color, depth=color[..., :1])
    repaired, counts = jax.jit(pd.repair)(frame)
    for a, b in zip(jax.tree.leaves(frame), jax.tree.leaves(repaired), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not any(int(n) for n in counts)


def test_what_becomes_of_bad_values(color):
    variance = np.full_like(color, 0.01)
    bad, bad_variance = color.copy(), variance.copy()
    bad[4, 4] = np.nan
    bad[0, 0, 1] = np.inf
    bad[8, 7] = -np.inf
    bad[2, 6] = -0.25
    bad_variance[4, 5] = -1e-9
    bad_variance[1, 1] = np.nan
    normal = color.copy()
    normal[3, 3] = np.inf
    frame, counts = pd.repair(pd.Frame(bad, bad_variance, normal=normal))
    known = bad[2:7, 2:7].reshape(-1, 3)
    np.testing.assert_allclose(
        frame.color[4, 4], known[np.isfinite(known).all(1)].mean(0), rtol=1e-5
    )
    assert frame.color[0, 0, 1] == 65504
    np.testing.assert_array_equal(frame.color[2, 6], -0.25)
    np.testing.assert_array_equal(frame.variance[4, 5], 0)
    np.testing.assert_allclose(frame.variance[1, 1], 0.01, rtol=1e-6)
    # A pixel that knows nothing is as uncertain as it is bright.
    np.testing.assert_allclose(frame.variance[4, 4], frame.color[4, 4] ** 2, rtol=1e-5)
    np.testing.assert_array_equal(frame.normal[3, 3], 0)
    assert [int(n) for n in counts] == [3, 2, 1, 1, 1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frame))


def test_a_frame_of_nothing_but_nan():
    nothing = np.full((4, 4, 3), np.nan, np.float32)
    frame, counts = pd.repair(pd.Frame(nothing, nothing))
    np.testing.assert_array_equal(frame.color, 0)
    np.testing.assert_array_equal(frame.variance, 0)
    assert int(counts.nonfinite_color) == 16
