"""The variance of the mean from everything that renderers write, and the samples per pixel."""

import logging

import numpy as np
import pytest
from exr_files import plane, planes, stack, write

from progden_jax.exr import ExrError, describe_exr, read_exr, read_exr_with_info
from progden_jax.exr._statistics import are_halves, from_moments, from_renders, from_samples

PBRT = "R G B Variance.R/G/B RelativeVariance.R/G/B Ns.X/Y/Z dzdx dzdy"


def samples(spp, size=(4, 3), seed=0):
    """Skewed radiance samples (spp, H, W, 3), as light paths give them."""
    return np.random.default_rng(seed).gamma(0.5, 2.0, (spp, *size, 3))


def as_channels(layer, image, dtype="float32"):
    return {f"{layer}{c}": np.ascontiguousarray(image[..., i], dtype) for i, c in enumerate("RGB")}


class TestMeanings:
    def test_mean_is_the_default(self, tmp_path):
        channels = planes("R G B Variance.R/G/B")
        path = write(tmp_path / "a.exr", channels)
        for meaning in (None, "mean"):
            frame, info = read_exr_with_info(path, variance_of=meaning)
            np.testing.assert_array_equal(frame.variance, stack(channels, "Variance.R/G/B"))
            assert info.variance == "Variance.R/G/B, of the mean"

    def test_samples(self, tmp_path):
        values = samples(16)
        mean, variance = values.mean(0), values.var(0, ddof=1)
        channels = as_channels("", mean) | as_channels("Variance.", variance)
        path = write(tmp_path / "a.exr", channels)
        frame, info = read_exr_with_info(path, variance_of="samples", spp=16)
        np.testing.assert_allclose(frame.variance, variance / 16, rtol=1e-6)
        assert int(frame.spp) == 16
        assert info.variance == "Variance.R/G/B, of samples, 16 spp by the caller (--spp)"

    def test_std(self, tmp_path):
        channels = planes("R G B Std.R/G/B Variance.R/G/B")
        path = write(tmp_path / "a.exr", channels)
        frame = read_exr(path, variance_of="std")
        np.testing.assert_array_equal(frame.variance, stack(channels, "Std.R/G/B") ** 2)
        del channels["Std.R"], channels["Std.G"], channels["Std.B"]
        frame = read_exr(write(tmp_path / "b.exr", channels), variance_of="std")
        np.testing.assert_array_equal(frame.variance, stack(channels, "Variance.R/G/B") ** 2)

    @pytest.mark.parametrize("nested", [False, True])
    def test_second_moments(self, tmp_path, nested):
        values = samples(16)
        mean, second = values.mean(0), (values**2).mean(0)
        name = "a.img." if nested else "img."
        channels = as_channels("", mean) | as_channels("m2_" + name, second)
        if nested:
            channels |= as_channels(name, mean) | planes(
                "a.alb.R/G/B m2_a.alb.R/G/B m2_a.X/Y/Z", size=(4, 3)
            )
        path = write(tmp_path / "a.exr", channels)
        frame, info = read_exr_with_info(path, variance_of="second-moment", spp=16)
        np.testing.assert_allclose(frame.variance, values.var(0, ddof=1) / 16, rtol=1e-4)
        assert info.variance.startswith(f"m2_{name}R/G/B, second moments, 16 spp")
        assert info.warnings == ()

    def test_second_moments_use_their_own_means(self, tmp_path):
        """R, G, B may have gone through a wider pixel filter than the moments' layer."""
        values = samples(8)
        mean, second = values.mean(0), (values**2).mean(0)
        channels = as_channels("", mean * 0) | as_channels("img.", mean)
        path = write(tmp_path / "a.exr", channels | as_channels("m2_img.", second))
        frame = read_exr(path, variance_of="second-moment", spp=8)
        np.testing.assert_allclose(frame.variance, values.var(0, ddof=1) / 8, rtol=1e-4)

    def test_second_moments_in_half_warn_and_never_go_negative(self, tmp_path, caplog):
        mean = np.full((4, 3, 3), 1.7)
        channels = as_channels("", mean, "float16") | as_channels(
            "m2_x.", mean**2 - 0.01, "float16"
        )
        path = write(tmp_path / "a.exr", channels)
        with caplog.at_level(logging.WARNING):
            frame = read_exr(path, variance_of="second-moment", spp=4)
        assert "moments in half precision lose the variance" in caplog.text
        assert float(frame.variance.min()) == 0
        info = describe_exr(path, variance_of="second-moment", spp=4)
        assert "36 variances that rounding had made negative are 0" in info.notes
        assert any("half precision" in text for text in info.warnings)

    def test_second_moments_of_xyz_are_refused(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B img.X/Y/Z m2_img.X/Y/Z"))
        message = r"m2_img\.X/Y/Z are of CIE XYZ.*nest the integrators as moment > aov > path"
        with pytest.raises(ExrError, match=message):
            read_exr(path, variance_of="second-moment", spp=4)
        assert "nest the integrators" in describe_exr(path).variance

    def test_several_second_moments(self, tmp_path):
        channels = planes("R G B a.R/G/B b.R/G/B m2_a.R/G/B m2_b.R/G/B")
        path = write(tmp_path / "a.exr", channels)
        with pytest.raises(ExrError, match=r"variance: several layers.*m2_a\.R/G/B, m2_b\.R/G/B"):
            read_exr(path, variance_of="second-moment", spp=4)
        frame = read_exr(path, variance_of="second-moment", spp=5, channels={"variance": "m2_b"})
        first, second = (stack(channels, f"{n}.R/G/B").astype("f8") for n in ("b", "m2_b"))
        np.testing.assert_allclose(frame.variance, np.maximum(second - first**2, 0) / 4, rtol=1e-6)

    def test_bad_values_stay(self, tmp_path):
        channels = planes("R G B Variance.R/G/B")
        channels["Variance.R"][0, :3] = np.nan, np.inf, -1
        path = write(tmp_path / "a.exr", channels)
        for meaning, third in (("mean", -1), ("samples", -0.25), ("std", 1)):
            frame = read_exr(path, variance_of=meaning, spp=4)
            np.testing.assert_array_equal(frame.variance[0, :3, 0], [np.nan, np.inf, third])

    def test_one_sample(self, tmp_path):
        path = write(tmp_path / "a_000001spp.exr", planes("R G B Variance.R/G/B"))
        info = describe_exr(path, variance_of="samples")
        assert "with 1 sample per pixel the spread of samples says nothing" in info.warnings

    def test_missing_variance(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"))
        frame, info = read_exr_with_info(path)
        assert frame.variance is None
        assert "progressive denoising needs one" in info.variance
        assert "--variance-from" in info.variance
        for meaning in ("mean", "samples", "std", "second-moment"):
            with pytest.raises(ExrError, match=r"variance: no .*variance=LAYER.*holds R, G, B"):
                read_exr(path, variance_of=meaning, spp=4)

    def test_hints_at_what_is_there(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B x.R/G/B m2_x.R/G/B stddev.R/G/B"))
        variance = describe_exr(path).variance
        assert "second moments are here, m2_x.R/G/B" in variance
        assert 'stddev.R/G/B is here: variance_of="std"' in variance
        for half in "AB":
            write(tmp_path / f"a{half}.exr", planes("R G B"))
        assert "--variance-from aA.exr aB.exr" in describe_exr(path).variance

    def test_wrong_meaning(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"))
        with pytest.raises(
            ExrError, match="variance_of .* is 'stdev', expected one of mean, samples"
        ):
            read_exr(path, variance_of="stdev")  # pyright: ignore


class TestPbrt:
    def test_the_meaning_must_be_said(self, tmp_path):
        path = write(tmp_path / "a.exr", planes(PBRT))
        message = (
            r'looks like pbrt-v4.*pass variance_of="samples" \(with spp=N; --variance-of samples '
            r'--spp N\), or variance_of="mean" \(--variance-of mean\)'
        )
        with pytest.raises(ExrError, match=message):
            read_exr(path)
        info = describe_exr(path)
        assert info.variance.startswith("unusable: this looks like pbrt-v4")
        assert info.roles["variance"].channels[0] == "Variance.R"

    @pytest.mark.parametrize("held", ["R G B Variance.R/G/B dzdx dzdy", PBRT])
    def test_spp_of_its_attribute(self, tmp_path, held):
        channels = planes(held)
        path = write(tmp_path / "a.exr", channels, samplesPerPixel=64)
        with pytest.raises(ExrError, match="--variance-of samples; 64 spp by attribute samplesPer"):
            read_exr(path)
        expected = stack(channels, "Variance.R/G/B")
        frame = read_exr(path, variance_of="samples")
        np.testing.assert_array_equal(frame.variance, expected / 64)
        np.testing.assert_array_equal(read_exr(path, variance_of="mean").variance, expected)
        assert read_exr(path, channels="variance=none").variance is None


class TestSpp:
    @pytest.mark.parametrize(
        ("name", "attributes", "spp", "source"),
        [
            ("a.exr", {}, None, ""),
            ("a_000032spp.exr", {}, 32, "the file's name"),
            ("a_32SPP.exr", {}, 32, "the file's name"),
            ("a_0spp.exr", {}, None, ""),
            ("a32spp.exr", {}, None, ""),
            ("a_000032spp.exr", {"samplesPerPixel": 16}, 16, "attribute samplesPerPixel"),
            ("a.exr", {"spp": "16"}, 16, "attribute spp"),
            ("a.exr", {"spp": 2.5}, 2.5, "attribute spp"),
            ("a.exr", {"spp": "many"}, None, ""),
            ("a.exr", {"spp": -4}, None, ""),
            ("a_8spp.exr", {"spp": 3, "samples": 4}, 8, "the file's name"),
        ],
    )
    def test_found(self, tmp_path, name, attributes, spp, source):
        path = write(tmp_path / name, planes("R G B"), **attributes)
        frame, info = read_exr_with_info(path)
        assert (info.spp, info.spp_from) == (spp, source)
        assert (None if frame.spp is None else float(frame.spp)) == spp

    def test_explicit_wins(self, tmp_path):
        path = write(tmp_path / "a_8spp.exr", planes("R G B"), samplesPerPixel=4)
        info = describe_exr(path, spp=2)
        assert (info.spp, info.spp_from) == (2, "the caller (--spp)")

    def test_cycles_stamps_each_view_layer(self, tmp_path):
        held = "Day.Combined.R/G/B Night.Combined.R/G/B"
        stamps = {"cycles.Day.samples": "128", "cycles.Night.samples": "64"}
        path = write(tmp_path / "a.exr", planes(held), **stamps)
        info = describe_exr(path, channels="color=Night.Combined")
        assert (info.spp, info.spp_from) == (64, "attribute cycles.Night.samples")

    @pytest.mark.parametrize("meaning", ["samples", "second-moment"])
    def test_needed(self, tmp_path, meaning):
        path = write(tmp_path / "a.exr", planes("R G B Variance.R/G/B m2_x.R/G/B"))
        with pytest.raises(
            ExrError, match=r"neither an attribute samplesPerPixel .*spp=N \(--spp N\)"
        ):
            read_exr(path, variance_of=meaning)
        assert describe_exr(path, variance_of=meaning).variance.startswith("unusable: variance_of")

    @pytest.mark.parametrize("spp", [0, -1, float("nan"), float("inf"), "8", True])
    def test_wrong(self, tmp_path, spp):
        path = write(tmp_path / "a.exr", planes("R G B"))
        with pytest.raises(ExrError, match=r"spp \(--spp\) is .*expected a positive number"):
            read_exr(path, spp=spp)


class TestOtherRenders:
    def renders(self, tmp_path, count, names=None, dtype="float32", **attributes):
        images = samples(count, (8, 6)).astype(dtype).astype("float32")
        names = names or [f"seed{i}.exr" for i in range(count)]
        return images, [
            write(tmp_path / name, as_channels("", image, dtype), **attributes)
            for name, image in zip(names, images, strict=True)
        ]

    @pytest.mark.parametrize("dtype", ["float32", "float16"])
    def test_half_buffers(self, tmp_path, dtype):
        (a, b), paths = self.renders(tmp_path, 2, dtype=dtype)
        held = as_channels("", (a + b) / 2, dtype) | planes("Variance.R/G/B", size=(8, 6))
        path = write(tmp_path / "mean.exr", held)
        frame, info = read_exr_with_info(path, variance_from=paths, spp=8)
        np.testing.assert_allclose(frame.variance, (a - b) ** 2 / 4, rtol=1e-5, atol=1e-12)
        np.testing.assert_array_equal(frame.color, stack(held, "R/G/B"))
        assert info.variance == "2 buffers of which the colour is the mean"
        assert info.spp == 8
        assert any("off by about 141 % at every pixel" in text for text in info.warnings)

    def test_many_buffers(self, tmp_path):
        images, paths = self.renders(tmp_path, 5)
        path = write(tmp_path / "mean.exr", as_channels("", images.mean(0)))
        frame, info = read_exr_with_info(path, variance_from=paths)
        np.testing.assert_allclose(frame.variance, images.var(0, ddof=1) / 5, rtol=1e-5)
        assert info.warnings == ()

    def test_other_seeds(self, tmp_path):
        images, paths = self.renders(tmp_path, 3, samplesPerPixel=4)
        frame, info = read_exr_with_info(paths[0], variance_from=paths[1:])
        np.testing.assert_allclose(frame.color, images.mean(0), rtol=1e-6)
        np.testing.assert_allclose(frame.variance, images.var(0, ddof=1) / 3, rtol=1e-5)
        assert (int(frame.spp), info.spp) == (12, 12)
        assert info.variance == "3 renders, the input among them"
        assert "the colour is the mean of the input and 2 other renders" in info.notes

    def test_one_other_seed_and_a_single_path(self, tmp_path):
        (a, b), paths = self.renders(tmp_path, 2)
        frame = read_exr(paths[0], variance_from=str(paths[1]))
        np.testing.assert_allclose(frame.variance, (a - b) ** 2 / 4, rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(frame.color, (a + b) / 2, rtol=1e-6)
        assert frame.spp is None

    def test_the_map_holds_for_the_other_files_too(self, tmp_path):
        images = samples(2, (8, 6)).astype("float32")
        paths = [
            write(tmp_path / f"{i}.exr", as_channels("Lit.", image) | planes("R G B", size=(8, 6)))
            for i, image in enumerate(images)
        ]
        frame = read_exr(paths[0], variance_from=paths[1:], channels="color=Lit,albedo=R/G/B")
        np.testing.assert_allclose(frame.color, images.mean(0), rtol=1e-6)

    def test_bad_pixels_stay_bad(self, tmp_path):
        images, _ = self.renders(tmp_path, 2)
        images[0, 0, 0, 0], images[1, 1, 1, 1] = np.nan, np.inf
        paths = [write(tmp_path / f"{i}.exr", as_channels("", im)) for i, im in enumerate(images)]
        frame = read_exr(paths[0], variance_from=paths[1:])
        assert np.isnan(frame.color[0, 0, 0])
        assert np.isnan(frame.variance[0, 0, 0])
        assert np.isinf(frame.color[1, 1, 1])
        assert int((~np.isfinite(frame.variance)).sum()) == 2

    def test_sizes_must_be_equal(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"))
        other = write(tmp_path / "b.exr", planes("R G B", size=(2, 2)))
        with pytest.raises(ExrError, match=r"b\.exr: variance_from .*: 2×2 pixels, but .* has 6×5"):
            read_exr(path, variance_from=[other])

    def test_the_same_render_twice(self, tmp_path):
        _, (a, b) = self.renders(tmp_path, 2)
        for paths in ([a], [b, b], [b, a]):
            with pytest.raises(
                ExrError, match="the same image as .*independent renders are needed"
            ):
                read_exr(a, variance_from=paths)

    def test_black_renders_are_no_twins(self, tmp_path):
        black = {c: np.zeros((4, 4), np.float32) for c in "RGB"}
        paths = [write(tmp_path / f"{i}.exr", black) for i in range(2)]
        frame = read_exr(paths[0], variance_from=paths[1:])
        np.testing.assert_array_equal(frame.variance, 0)

    def test_spp_must_be_equal(self, tmp_path):
        _, paths = self.renders(tmp_path, 2, ["a_000004spp.exr", "b_000008spp.exr"])
        with pytest.raises(ExrError, match="have 4, 8 samples per pixel; renders of equal spp"):
            read_exr(paths[0], variance_from=paths[1:])
        assert int(read_exr(paths[0], variance_from=paths[1:], spp=4).spp) == 8

    def test_not_with_variance_of(self, tmp_path):
        _, paths = self.renders(tmp_path, 2)
        with pytest.raises(ExrError, match="give one of them"):
            read_exr(paths[0], variance_from=paths[1:], variance_of="mean")

    def test_other_file_is_missing_or_has_no_colour(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"))
        with pytest.raises(ExrError, match=r"none\.exr: there is no such file"):
            read_exr(path, variance_from=[tmp_path / "none.exr"])
        other = write(tmp_path / "b.exr", planes("Albedo.R/G/B"))
        with pytest.raises(ExrError, match=r"b\.exr: color: no channels of a known name"):
            read_exr(path, variance_from=[other])
        assert "b.exr: color: no channels" in describe_exr(path, variance_from=[other]).variance


def repeated(estimate, spp, count=20000):
    """Mean of `estimate` over `count` pixels, and its standard error."""
    values = estimate(samples(spp, (count, 1), seed=3)[..., :1])
    return values.mean(), values.std() / np.sqrt(count)


@pytest.mark.parametrize("spp", [2, 5, 32])
@pytest.mark.parametrize(
    "estimate",
    [
        lambda x: from_samples(x.var(0, ddof=1), len(x)),
        lambda x: from_moments(x.mean(0), (x**2).mean(0), len(x))[0],
        lambda x: from_renders(list(x))[1],
    ],
    ids=["samples", "second-moment", "renders"],
)
def test_every_variance_is_unbiased(estimate, spp):
    """Gamma(1/2, 2) has variance 2; a missing Bessel factor would be off by half at 2 spp."""
    mean, error = repeated(estimate, spp)
    assert abs(mean - 2 / spp) < 4 * error


@pytest.mark.parametrize("relative", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("count", [2, 3, 8])
def test_halves_are_told_from_other_seeds(relative, count):
    rng = np.random.default_rng(5)
    truth = rng.gamma(1, 1, (16, 16, 3))
    renders = [truth * (1 + relative * rng.standard_normal(truth.shape)) for _ in range(count)]
    mean = np.mean(renders, 0)
    assert are_halves(mean.astype("float32"), renders)
    assert are_halves(mean.astype("float16"), [r.astype("float16") for r in renders])
    assert not are_halves(renders[0], renders[1:])
    renders[0][0, 0] = np.inf
    assert are_halves(mean.astype("float32"), renders)


def test_plane_values_fit_half():
    """What makes the exact comparisons above fair."""
    values = plane()
    np.testing.assert_array_equal(values.astype("float16").astype("float32"), values)
