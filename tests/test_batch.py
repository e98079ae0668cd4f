"""Many frames: the same results as one by one, in order, from few programs."""

import resource
import threading

import jax
import numpy as np
import pytest
from conftest import counting_compilations
from hypothesis import given, settings
from hypothesis import strategies as st

import progden_jax as pd
from progden_jax import batch, memory, pipeline, tiling


@pytest.fixture(scope="module")
def denoiser():
    return pd.denoisers.KPCN.init(jax.random.key(0), layers=1, width=4)


@pytest.fixture(scope="module")
def frames(real_frame):
    sizes = [(40, 50), (50, 40), (33, 47), (64, 64), (20, 70), (40, 50), (64, 64)]
    return [
        pd.Frame(np.asarray(real_frame.color)[:h, :w], np.asarray(real_frame.variance)[:h, :w])
        for h, w in sizes
    ]


def test_batched_is_single_in_order_and_few_programs(frames, denoiser):
    with counting_compilations() as compiled:
        found = list(pd.denoise_batch(frames, denoiser, outputs=("image", "alpha"), skip=False))
    assert compiled.count("progressive") <= batch.PROGRAMS, compiled
    for frame, result in zip(frames, found, strict=True):
        assert result.image.shape == frame.color.shape
    for frame, result in list(zip(frames, found, strict=True))[1:3]:
        alone = pd.progressive_denoise(frame, denoiser)
        np.testing.assert_allclose(result.image, alone.image, rtol=1e-4, atol=1e-6)
        assert result.denoised is None


def test_windows_around_noise_do_not_multiply_programs(frames, denoiser, monkeypatch):
    variance = np.array(frames[3].variance)
    variance[:, :32] = 0
    half = frames[3].replace(variance=variance)
    covers = []

    def cover(*arguments, **rest):
        covers.append(real(*arguments, **rest))
        return covers[-1]

    real = tiling.Cover
    monkeypatch.setattr(tiling, "Cover", cover)
    (small,) = pd.denoise_batch([half], denoiser, outputs=("image", "alpha"))
    assert covers == []
    assert small.skipped.pixels == 0
    monkeypatch.setattr(pipeline, "_WORTH_COMPILING", 0)
    list(pd.denoise_batch(iter([half]), denoiser, outputs=("image", "alpha")))
    assert [len(lengths) <= 2 for cover in covers for lengths in cover.lengths] == [True, True]


def test_frames_are_read_on_threads_and_only_when_needed(frames, denoiser):
    read = []

    def reader(n):
        def call():
            read.append((n, threading.current_thread()))
            return frames[0]

        return call

    results = pd.denoise_batch((reader(n) for n in range(50)), denoiser, at_once=2)
    first = next(results)
    assert first.image.shape == frames[0].color.shape
    assert all(thread is not threading.main_thread() for _, thread in read)
    results.close()
    assert len(read) < 10
    assert sorted(n for n, _ in read) == list(range(len(read)))


def test_what_a_frame_raises_comes_in_its_turn(frames, denoiser):
    wrong = frames[1].replace(variance=None)
    results = pd.denoise_batch([frames[0], wrong, frames[0]], denoiser)
    next(results)
    with pytest.raises(ValueError, match="no variance"):
        next(results)
    with pytest.raises(ValueError, match="at_once is 0"):
        next(pd.denoise_batch(frames, denoiser, at_once=0))


def test_more_small_frames_are_in_work(frames):
    small = batch.shared_canvases([f.size for f in frames])
    large = batch.shared_canvases([(64, 64), (1080, 1920)])
    assert batch.at_once_of(small) > batch.at_once_of(large) == batch.at_once_of({}) == 2


def test_small_frames_keep_what_they_free_until_the_last(frames, denoiser, monkeypatch):
    said = []
    monkeypatch.setattr(memory, "_is_ours_to_set", lambda: True)
    monkeypatch.setattr(memory, "_set", said.append)
    two = [pd.denoise_batch(frames[:2], denoiser) for _ in range(2)]
    assert said == []
    for results in two:
        next(results)
    assert said == [memory._KEEP]
    two[0].close()
    assert said == [memory._KEEP]
    list(two[1])
    assert said == [memory._KEEP, memory._USUAL]
    # Of unknown size, or where memory is bounded, nothing is kept.
    list(pd.denoise_batch(iter(frames[:1]), denoiser))
    list(pd.denoise_batch(frames[:1], denoiser, max_memory=10**10))
    assert len(said) == 2


@pytest.mark.skipif(not memory._is_ours_to_set(), reason="no glibc, or told by the environment")
def test_what_is_kept_is_not_touched_anew():
    size = 48 << 20

    def faults():
        begun = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(8):
            bytearray(b"x") * size
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - begun

    before = faults()
    with memory.kept():
        held = memory.resident()
        assert faults() < before / 3
        assert memory.resident() > held + size / 2
    assert memory.resident() < held + size / 2
    assert faults() > before / 2


def test_a_canvas_must_hold_the_frame(frames, denoiser):
    with pytest.raises(ValueError, match=r"canvas is \(48, 16\), expected .* at least \(40, 50\)"):
        pd.progressive_denoise(frames[0], denoiser, canvas=(48, 16))


@given(st.lists(st.tuples(st.integers(1, 3000), st.integers(1, 3000)), max_size=30))
@settings(max_examples=50, deadline=None)
def test_shapes_hold_their_frames_and_are_few(sizes):
    shapes = batch.shared_canvases(sizes)
    assert len(set(shapes.values())) <= batch.PROGRAMS
    for size in sizes:
        own = batch.canvas_of(size)
        assert all(n >= m for n, m in zip(shapes[own], own, strict=True))


def test_shapes_are_joined_where_that_pays():
    small = [(256, 256)] * 5 + [(272, 256)] * 5
    assert set(batch.shared_canvases(small).values()) == {(288, 256)}
    apart = [(256, 256)] * 100 + [(1080, 1920)] * 100
    assert len(set(batch.shared_canvases(apart).values())) == 2
