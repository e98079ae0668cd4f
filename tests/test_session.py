"""A session beside a growing render: the results of single calls, few programs, no copies too many."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import counting_compilations
from test_tiling import assert_same, mirrored

import progden_jax as pd

SIZE = (50, 333)


@pytest.fixture(scope="module")
def growing(real_frame):
    """A render that becomes right from the left."""
    frame = mirrored(real_frame, *SIZE)
    variance, frames = np.asarray(frame.variance), []
    for right in (0, 170, 260, 333):
        left = variance.copy()
        left[:, :right] = 0
        frames.append(frame.replace(variance=left))
    return frames


@pytest.fixture(scope="module")
def session(near_sighted):
    return pd.Session(near_sighted, SIZE, mixer=pd.ClosedForm(), outputs=("image", "alpha"))


def alone(frame, denoiser):
    return pd.progressive_denoise(
        frame, denoiser, mixer=pd.ClosedForm(), outputs=("image", "alpha"), skip=False
    )


def test_updates_are_single_calls(growing, near_sighted, session):
    for frame in growing:
        session.update(frame)
    session.wait()
    for frame, share in zip(growing, (0, 0.45, 0.7, 1), strict=True):
        found, expected = session.update(frame), alone(frame, near_sighted)
        assert_same(found.image, expected.image)
        assert np.quantile(np.abs(found.alpha - expected.alpha), 0.99) < 1e-4
        np.testing.assert_allclose(found.mean_alpha, expected.mean_alpha, rtol=1e-4, atol=1e-7)
        assert found.skipped.pixels >= share * SIZE[0] * SIZE[1] - 33 * SIZE[0]
        assert (found.skipped.pixels > 0) == (share > 0)
        assert found.denoised is None
    assert found.skipped.computed == 0
    np.testing.assert_array_equal(found.image, growing[-1].color)


def test_windows_only_where_noise_is(growing, session):
    session.update(growing[2])
    session.wait()
    whole = session.update(growing[0])
    part = session.update(growing[2])
    assert part.skipped.computed < 0.6 * whole.skipped.computed
    assert "standard error is at most" in part.skipped.reason


def test_nothing_is_compiled_in_the_callers_time(growing, session):
    for frame in growing:
        session.update(frame)
    session.wait()
    with counting_compilations() as compiled:
        for frame in growing:
            session.update(frame)
    assert compiled == []


def test_the_whole_frame_until_the_windows_program_is_there(growing, near_sighted):
    held = pd.Session(near_sighted, SIZE, mixer=pd.ClosedForm(), outputs=("image",))
    held.wait()
    first = held.update(growing[2])
    held.wait()
    second = held.update(growing[2])
    assert first.skipped.pixels == 0
    assert second.skipped.pixels > 0
    assert_same(first.image, second.image)


@pytest.mark.parametrize("outputs", [("alpha",), pd.pipeline.OUTPUTS])
def test_bad_pixels_auxiliary_buffers_and_every_output(real_frame, outputs):
    buffers = {
        name: np.array(getattr(real_frame, name))[:50, :70]
        for name in ("color", "variance", "albedo", "normal", "depth")
    }
    buffers["color"][3, 4], buffers["color"][9, 9, 1] = np.nan, -1
    frame = pd.Frame(**buffers)
    denoiser = pd.denoisers.KPCN.init(
        jax.random.key(0), inputs=("albedo", "normal"), layers=1, width=4
    )
    session = pd.Session(denoiser, (50, 70), mixer=pd.ClosedForm(), outputs=outputs)
    found = session.update(frame)
    expected = pd.progressive_denoise(frame, denoiser, mixer=pd.ClosedForm())
    for name in outputs:
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-6, err_msg=name
        )
    assert jax.device_get(found.repairs) == jax.device_get(expected.repairs)


def test_frames_are_given_up_only_if_told(growing):
    """Where the frame needs no padding its own arrays could be overwritten."""
    session = pd.Session(pd.FunctionDenoiser(lambda x: 0.5 * x), SIZE, skip=False)
    frame = jax.tree.map(jnp.array, growing[0])
    kept = session.update(frame).image
    assert not frame.color.is_deleted()
    again = session.update(frame, donate=True).image
    assert frame.color.is_deleted()
    np.testing.assert_array_equal(again, kept)
    np.testing.assert_array_equal(kept, again)  # the first result is whole still


def test_denoisers_that_are_no_pytrees(growing):
    class Halved:
        def __call__(self, frame):
            return self.bind(frame)(frame.color)

        def bind(self, frame):
            return lambda x: 0.5 * x

    denoiser = Halved()
    session = pd.Session(denoiser, SIZE, mixer=pd.ClosedForm())
    found = session.update(growing[1])
    assert_same(found.image, alone(growing[1], denoiser).image)
    assert np.array_equal(session.update(growing[-1]).image, growing[-1].color)


def test_what_a_session_refuses(growing, near_sighted, session):
    with pytest.raises(ValueError, match=r"64×32 pixels \(width × height\).* are 333×50"):
        session.update(
            pd.Frame(np.zeros((32, 64, 3), np.float32), np.zeros((32, 64, 3), np.float32))
        )
    with pytest.raises(ValueError, match=r"has no variance, expected color, variance"):
        session.update(pd.Frame(growing[0].color, None))
    with pytest.raises(ValueError, match="size is"):
        pd.Session(near_sighted, (0, 5))
    with pytest.raises(ValueError, match="'noise', expected one of"):
        pd.Session(near_sighted, (8, 8), outputs=["noise"])
