"""Windows: their geometry, the memory they take, and that a frame in windows is the whole frame."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from conftest import drawn, narrow_oidn
from hypothesis import given, settings
from hypothesis import strategies as st

import progden_jax as pd
from progden_jax import _windowed, memory, mixers, pipeline, survey, tiling

SIZES = st.integers(1, 700)


def mirrored(frame, height, width):
    """A larger frame without seams."""

    def grown(buffer):
        buffer = np.asarray(buffer)
        row = np.concatenate([buffer, buffer[:, ::-1]], 1)
        cell = np.concatenate([row, row[::-1]], 0)
        down, across = -(-height // cell.shape[0]), -(-width // cell.shape[1])
        return np.tile(cell, (down, across, 1))[:height, :width].copy()

    return pd.Frame(grown(frame.color), grown(frame.variance))


@given(height=SIZES, width=SIZES, reach=st.integers(0, 40), step=st.sampled_from([1, 4, 16]))
@settings(max_examples=60, deadline=None)
def test_cores_of_a_grid_make_up_the_image(height, width, reach, step):
    edge = tiling.smallest_window(reach, step) + 3 * step
    covered = np.zeros((height, width), int)
    for window in tiling.grid((height, width), (edge, edge), reach, step):
        covered[window.core] += 1
        check(window, (height, width), reach, step)
        assert window.shape == (edge, edge)
    assert (covered == 1).all()


@given(data=st.data(), height=SIZES, width=SIZES, tile=st.integers(16, 50))
@settings(max_examples=60, deadline=None)
def test_windows_cover_what_is_active_once(data, height, width, tile):
    shape = (-(-height // tile), -(-width // tile))
    share = data.draw(st.floats(0, 1))
    active = np.random.default_rng(data.draw(st.integers(0, 99))).random(shape) < share
    canvas = (tiling._up(height, 16) + 16, tiling._up(width, 16))
    cover = tiling.Cover((height, width), canvas, tile, 20, 16)
    covered = np.zeros((height, width), int)
    windows = cover.windows(active)
    for window in windows:
        covered[window.core] += 1
        check(window, (height, width), 20, 16)
        assert all(n <= c for n, c in zip(window.shape, canvas, strict=True))
    assert covered.max(initial=0) <= 1
    needed = np.kron(active, np.ones((tile, tile), int))[:height, :width]
    assert (covered >= needed).all()
    assert sum(w.area for w in windows) <= canvas[0] * canvas[1]


def assert_same(found, expected, name=""):
    """To 1e-5, relative to the whole image: where the t-bound's sum of differences crosses zero beside pixels
    without variance, single pixels hang on the last digit."""
    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    size = np.sqrt((expected**2).mean())
    assert np.sqrt(((found - expected) ** 2).mean()) < 1e-5 * size, name
    assert (np.abs(found - expected) > 1e-5 * size).mean() < 1e-3, name


def check(window, size, reach, step):
    """The window begins where pooling does, and has its margin wherever the image goes on."""
    ranges = zip(window.origin, window.shape, (window.rows, window.columns), size, strict=True)
    for first, length, (begin, end), whole in ranges:
        assert first % step == 0
        assert 0 <= first <= begin < end <= whole
        assert first == 0 or begin - first >= reach
        assert first + length >= min(end + reach, whole)


def test_windows_cost_less_than_the_whole_where_half_is_right():
    active = np.zeros((68, 120), bool)
    active[:, :60] = True
    windows = tiling.Cover((1080, 1920), (1152, 1920), 16, 126, 16).windows(active)
    assert sum(w.area for w in windows) < 0.6 * 1152 * 1920
    corners = np.zeros((68, 120), bool)
    corners[:5, :5] = corners[-5:, -5:] = True
    windows = tiling.Cover((1080, 1920), (1152, 1920), 16, 126, 16).windows(corners)
    assert len(windows) == 2
    assert sum(w.area for w in windows) < 0.1 * 1152 * 1920


@pytest.fixture(scope="module")
def denoiser():
    return pd.denoisers.load("oidn-hdr-small")


def test_a_frame_in_windows_is_the_whole_frame(real_frame):
    """With bad pixels, autoexposure, a mixer that looks far and a level of the whole; odd sizes."""
    denoiser, frame = narrow_oidn(), mirrored(real_frame, 270, 331)
    color, variance = np.array(frame.color), np.array(frame.variance)
    color[5, 7] = np.nan
    color[200:204, 160] = np.inf
    color[254:258, 100, 1] = -0.01
    variance[150, 150] = -1
    variance[255, 20] = np.nan
    frame = frame.replace(color=color, variance=variance)
    architecture = mixers.build("multiscale", {"width": 4, "blocks": 1})
    params = drawn(jax.eval_shape(architecture.init, jax.random.key(0)))
    how = {"mixer": pd.NetworkMixer(params, architecture), "key": jax.random.key(5)}
    whole = pd.progressive_denoise(frame, denoiser, **how)
    pieces = pd.progressive_denoise(frame, denoiser, **how, max_memory=63 * 2**20)
    assert isinstance(pieces.image, np.ndarray)
    assert pieces.skipped.computed > whole.skipped.computed
    for name in ("image", "denoised", "sure", "divergence"):
        assert_same(getattr(pieces, name), getattr(whole, name), name)
    assert np.quantile(np.abs(pieces.alpha - np.asarray(whole.alpha)), 0.99) < 1e-4
    assert jax.device_get(pieces.repairs) == jax.device_get(whole.repairs)
    assert sum(map(int, whole.repairs)) == 5 + 4 + 1 + 1
    for name in ("mean_alpha", "mean_sure"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=1e-4)
    assert 0 < whole.mean_alpha < 1


def test_only_what_is_asked_for_is_given(images):
    frame, denoiser = pd.Frame(images.x, images.variance), pd.FunctionDenoiser(lambda x: 0.5 * x)
    every = pd.progressive_denoise(frame, denoiser)
    some = pd.progressive_denoise(frame, denoiser, outputs=["sure", "image"])
    assert some.alpha is None
    assert some.denoised is None
    np.testing.assert_array_equal(some.sure, every.sure)
    np.testing.assert_allclose(some.image, every.image, rtol=1e-6)
    np.testing.assert_allclose(every.mean_sure, np.asarray(every.sure).mean(), rtol=1e-5)
    np.testing.assert_allclose(every.mean_alpha, np.asarray(every.alpha).mean(), rtol=1e-5)
    with pytest.raises(ValueError, match="'noise', expected one of"):
        pd.progressive_denoise(frame, denoiser, outputs=["noise"])
    with pytest.raises(ValueError, match="expected a sequence of names"):
        pd.progressive_denoise(frame, denoiser, outputs="image")


@pytest.mark.parametrize(
    ("system", "tunables", "expected"),
    [
        ("always [madvise] never", "", False),
        ("always [madvise] never", f"glibc.malloc.tcache_count=1:{memory.HUGE_PAGES}", True),
        ("[always] madvise never", "", True),
        ("always madvise [never]", memory.HUGE_PAGES, False),
        (None, memory.HUGE_PAGES, False),
    ],
)
def test_whether_memory_comes_in_huge_pages(system, tunables, expected, tmp_path, monkeypatch):
    if system is not None:
        (tmp_path / "enabled").write_text(system)
    monkeypatch.setattr(memory, "_PAGES", tmp_path / "enabled")
    monkeypatch.setenv("GLIBC_TUNABLES", tunables)
    assert memory.huge_pages() == expected


def test_the_wider_of_denoiser_and_mixer_is_what_memory_is_guessed_from(near_sighted):
    """The shipped mixer's first layer takes 54 channels and gives 32; the denoiser's last 8 and 25."""
    oidn = pd.denoisers.load("oidn-hdr")
    wide, method = mixers.default_for(oidn), pd.MonteCarlo(probes=1)
    alone = memory.guess(near_sighted, method)
    assert memory.guess(near_sighted, method, wide) == pytest.approx(alone * (54 + 32) / (8 + 25))
    assert memory.guess(near_sighted, method, pd.ClosedForm()) == alone
    assert memory.guess(oidn, method, wide) == memory.guess(oidn, method)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="bands are for CPUs")
def test_large_images_in_bands_take_less_memory_each_pixel():
    """So that a full-HD frame fits in 2 GiB as a whole."""
    oidn, method = pd.denoisers.load("oidn-hdr"), pd.MonteCarlo(probes=1)
    small, large = (memory.guess(oidn, method, None, size) for size in ((720, 1280), (1088, 1920)))
    assert large < 0.4 * small
    compiled, tried = program_of(600)
    asked = []

    def guess(pixels):
        asked.append(pixels)
        return small if pixels < 2**20 else large

    edge = memory.window_edge(10**9, 288, 16, compiled, guess=guess)
    assert tried == [edge]
    assert edge >= 1024
    assert set(asked) == {n * n for n in tiling.window_edges(288, 16)}


@pytest.mark.parametrize("name", ["oidn-hdr-alb-nrm", "unet-hdr-alb-nrm-var"])
def test_a_frame_that_is_said_to_fit_in_bands_does(name):
    """As XLA counts: of a megapixel, and with the most buffers that such networks take."""
    denoiser, size = pd.denoisers.load(name), (1024, 1024)
    frame = pd.Frame(*[np.zeros((*size, 3), np.float32)] * 4)
    job = pipeline.job_of(denoiser, None, None, None, None)
    compiled = job.program.lower(job, frame, None, tuple(map(np.int32, size))).compile()
    assert not _windowed.fits(job, frame, size, memory.bytes_of(compiled))


def test_what_cannot_be_cut_says_so(images, real_frame, denoiser):
    frame = mirrored(real_frame, 400, 400)
    with pytest.raises(ValueError, match=r"FunctionDenoiser.*cannot work on tiles"):
        pd.progressive_denoise(frame, pd.FunctionDenoiser(lambda x: x), max_memory=1000)
    with pytest.raises(ValueError, match="give it a receptive_radius"):
        pd.progressive_denoise(frame, denoiser, mixer=lambda *_, **__: 0.5, max_memory=10**6)
    with pytest.raises(ValueError, match="inside jit, vmap or grad"):
        jax.jit(lambda f: pd.progressive_denoise(f, denoiser, max_memory=10**6))(frame)


@pytest.mark.parametrize(
    ("text", "size"),
    [("4GiB", 2**32), ("500 MB", 5 * 10**8), ("2e9", 2 * 10**9), ("1.5k", 1500), ("12", 12)],
)
def test_sizes_in_words(text, size):
    assert memory.parse_size(text) == size


@pytest.mark.parametrize("text", ["", "GiB", "-1GB", "0", "3 apples", "1e-9", "1.2.3MB", "nan"])
def test_what_is_no_size(text):
    with pytest.raises(ValueError, match="expected bytes as a number with a unit"):
        memory.parse_size(text)


def program_of(per_pixel):
    tried = []

    def compiled(edge):
        tried.append(edge)
        sizes = SimpleNamespace(
            temp_size_in_bytes=per_pixel * edge**2,
            argument_size_in_bytes=0,
            output_size_in_bytes=0,
        )
        return SimpleNamespace(memory_analysis=lambda: sizes)

    return compiled, tried


def test_a_window_is_as_large_as_the_memory_allows():
    compiled, tried = program_of(1000)
    edge = memory.window_edge(10**9, 288, 16, compiled, guess=lambda _: 1100)
    assert tried == [edge]
    assert 0.5 * 10**9 < edge**2 * 1000 * memory.SLACK <= 10**9
    # A guess that is too low costs another compilation, never memory.
    compiled, tried = program_of(5000)
    assert memory.window_edge(10**9, 288, 16, compiled, guess=lambda _: 1000) < tried[0]
    assert tried[-1] ** 2 * 5000 * memory.SLACK <= 10**9
    compiled, tried = program_of(10**6)
    with pytest.raises(ValueError, match=r"288×288 pixels, takes .* GiB: give at least"):
        memory.window_edge(10**9, 288, 16, compiled, guess=lambda _: 1000)


def test_a_window_of_a_small_network_is_not_mostly_margin():
    compiled, tried = program_of(1000)
    edge = memory.window_edge(25 * 10**6, 78, 2, compiled, guess=lambda _: 1000)
    assert tried == [edge] == [128]
    for smallest in (8, 64, 78, 100, 300):
        edges = np.array(tiling.window_edges(smallest, 2))
        assert edges[0] == smallest
        assert not (edges % 2).any()
        after = edges[edges >= 64]
        assert (after[1:] <= 1.26 * after[:-1]).all()


def test_a_survey_repairs_as_the_whole_frame_would(real_frame):
    rng = np.random.default_rng(0)
    frame = mirrored(real_frame, 530, 20)
    color, variance = np.array(frame.color), np.array(frame.variance)
    albedo = rng.random(color.shape, np.float32)
    for buffer, values in (
        (color, (np.nan, np.inf, -1)),
        (variance, (np.nan, -2)),
        (albedo, (np.nan,)),
    ):
        for value in values:
            buffer[rng.random(buffer.shape[:2]) < 0.01] = value
    color[254:259, 3:9] = np.nan
    frame = frame.replace(color=color, variance=variance, albedo=albedo)
    expected, repairs = jax.jit(pd.repair)(frame)
    found = survey.survey(frame)
    for name in ("color", "variance", "albedo"):
        np.testing.assert_array_equal(found.repaired(name), getattr(expected, name))
        part = getattr(expected, name)[250:270, 5:17]
        np.testing.assert_array_equal(found.window(name, (250, 5), (20, 12)), part)
    assert np.isnan(frame.color).any()  # left as it came
    assert jax.device_get(found.repairs) == jax.device_get(repairs)
    np.testing.assert_allclose(found.mean_variance, expected.variance.mean(), rtol=1e-4)
    np.testing.assert_allclose(found.level, np.maximum(expected.color, 0).mean(), rtol=1e-4)
    untouched = mirrored(real_frame, 40, 20)
    same = survey.survey(untouched).repaired("color")
    assert np.shares_memory(same, np.asarray(untouched.color))
