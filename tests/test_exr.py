"""Reading and writing OpenEXR: round trips, storage kinds, damage, attributes, alpha."""

import dataclasses
import json
import os
import resource
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from exr_files import (
    HEIGHT,
    SHARED,
    WIDTH,
    needs_shared,
    plane,
    planes,
    read_channels,
    stack,
    window,
    write,
    write_parts,
    write_raw,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from progden_jax import Frame
from progden_jax.exr import ExrError, describe_exr, read_exr, read_exr_with_info, write_exr

LOSSLESS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "ZSTD", "LJ2K", "HTJ2K32", "HTJ2K256")
LOSSY = {"PXR24": 1e-4, "B44": 0.1, "B44A": 0.1, "DWAA": 0.3, "DWAB": 0.3}


def bits(value):
    return np.asarray(value).view(np.uint32)


def floats(shape):
    """Every float32 there is: NaN with payloads, infinities, denormals, both zeros."""
    return arrays(np.uint32, shape).map(lambda a: a.view(np.float32))


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_frame_round_trip_is_exact(tmp_path_factory, data):
    size = data.draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    buffers = {"color": data.draw(floats((*size, 3)))}
    for name in ("variance", "albedo", "normal", "depth"):
        if data.draw(st.booleans()):
            buffers[name] = data.draw(floats((*size, 1 if name == "depth" else 3)))
    spp = data.draw(st.none() | st.integers(1, 10**6))
    frame = Frame(**{"variance": None, **buffers}, spp=spp)
    path = tmp_path_factory.mktemp("exr") / "frame.exr"
    compression = data.draw(st.sampled_from(["none", "rle", "zips", "zip", "piz"]))
    assert write_exr(path, frame, compression=compression) == ()
    back = read_exr(path)
    for name in ("color", "variance", "albedo", "normal", "depth"):
        was, now = getattr(frame, name), getattr(back, name)
        assert (was is None) == (now is None), name
        if was is not None:
            assert now.dtype == jnp.float32
            np.testing.assert_array_equal(bits(was), bits(now), err_msg=name)
    assert (None if back.spp is None else int(back.spp)) == spp


@pytest.mark.parametrize("kind", LOSSLESS)
def test_lossless_compressions_read_exactly(tmp_path, kind):
    if not hasattr(OpenEXR, f"{kind}_COMPRESSION"):
        pytest.skip(f"this OpenEXR has no {kind}")
    size = (40, 37)
    channels = planes("R G B", size=size) | planes("Albedo.R/G/B", "float16", size)
    channels |= {"id": np.arange(40 * 37, dtype=np.uint32).reshape(size)}
    frame = read_exr(write(tmp_path / "a.exr", channels, kind))
    np.testing.assert_array_equal(frame.color, stack(channels, "R/G/B"))
    np.testing.assert_array_equal(frame.albedo, stack(channels, "Albedo.R/G/B"))
    assert frame.color.dtype == frame.albedo.dtype == jnp.float32


@pytest.mark.parametrize(("kind", "tolerance"), LOSSY.items())
def test_lossy_compressions_read_closely(tmp_path, kind, tolerance):
    y, x = np.mgrid[0:40, 0:37].astype(np.float32)
    channels = {
        c: (1 + 0.3 * np.sin(x / 9 + y / 7 + i)).astype("float16") for i, c in enumerate("RGB")
    }
    frame = read_exr(write(tmp_path / "a.exr", channels, kind))
    np.testing.assert_allclose(frame.color, stack(channels, "R/G/B"), rtol=tolerance)


def test_tiled_file(tmp_path):
    channels = planes("R G B", size=(70, 50))
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    path = write(tmp_path / "a.exr", channels, **tiles)
    np.testing.assert_array_equal(read_exr(path).color, stack(channels, "R/G/B"))
    write_exr(tmp_path / "b.exr", read_exr(path), like=path)
    assert read_channels(tmp_path / "b.exr")[1]["type"] == OpenEXR.scanlineimage


def test_frame_is_the_data_window_and_output_keeps_both_windows(tmp_path):
    channels = planes("R G B")
    windows = {
        "dataWindow": window(-3, 5, -3 + WIDTH - 1, 5 + HEIGHT - 1),
        "displayWindow": window(0, 0, 99, 49),
    }
    path = write(tmp_path / "a.exr", channels, **windows)
    frame = read_exr(path)
    assert frame.size == (HEIGHT, WIDTH)
    np.testing.assert_array_equal(frame.color, stack(channels, "R/G/B"))
    write_exr(tmp_path / "b.exr", frame.color, like=path)
    info = describe_exr(tmp_path / "b.exr")
    assert info.parts[0].data_window == (-3, 5, 1, 10)
    assert info.parts[0].display_window == (0, 0, 99, 49)
    assert info.parts[0].size == (HEIGHT, WIDTH)


@pytest.mark.parametrize("size", [(1, 1), (1, 17), (17, 1)])
def test_tiny_images(tmp_path, size):
    image = np.stack([plane(size=size) for _ in range(3)], -1)
    write_exr(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr").color, image)


def test_bad_values_are_read_as_they_are_and_counted(tmp_path):
    channels = planes("R G B")
    channels["R"][0, :4] = np.nan, np.inf, -np.inf, -2
    path = write(tmp_path / "a.exr", channels)
    np.testing.assert_array_equal(read_exr(path).color, stack(channels, "R/G/B"))
    values = {c.name: c.values for c in describe_exr(path).parts[0].channels}
    red = values["R"]
    assert (red.nan, red.inf, red.negative) == (1, 2, 2)
    finite = channels["R"][np.isfinite(channels["R"])].astype(np.float64)
    expected = (finite.min(), np.median(finite), finite.mean(), finite.max())
    assert (red.minimum, red.median, red.mean, red.maximum) == expected
    assert (values["G"].nan, values["G"].inf, values["G"].negative) == (0, 0, 0)


def test_no_finite_value_has_no_range(tmp_path):
    channels = planes("R G B") | {"R": np.full((HEIGHT, WIDTH), np.nan, np.float32)}
    values = describe_exr(write(tmp_path / "a.exr", channels)).parts[0].channels[-1].values
    assert (values.nan, values.minimum, values.mean) == (HEIGHT * WIDTH, None, None)


def test_subsampled_channels_are_repeated_and_noted(tmp_path):
    full = planes("R G", size=(6, 4))
    quarter = plane(size=(3, 2))
    channels = {"R": (full["R"], 1), "G": (full["G"], 1), "B": (quarter, 2)}
    frame, info = read_exr_with_info(write_raw(tmp_path / "a.exr", channels, (6, 4)))
    np.testing.assert_array_equal(frame.color[..., 0], full["R"])
    np.testing.assert_array_equal(frame.color[..., 2], quarter.repeat(2, 0).repeat(2, 1))
    assert info.notes == ("B is subsampled 2×2; its pixels were repeated",)


class TestDamage:
    @pytest.fixture
    def whole(self, tmp_path):
        return write(tmp_path / "whole.exr", planes("R G B", size=(64, 40))).read_bytes()

    @pytest.mark.parametrize("keep", [5, 60, 250, 400, 0.5, 0.9, -1])
    def test_truncated(self, tmp_path, whole, capfd, keep):
        keep = int(keep * len(whole)) if isinstance(keep, float) else keep
        (tmp_path / "cut.exr").write_bytes(whole[:keep])
        for read in (read_exr, describe_exr):
            with pytest.raises(ExrError, match=r"cut\.exr: .*(cut off|damaged)"):
                read(tmp_path / "cut.exr")
        assert capfd.readouterr() == ("", "")

    def test_corrupt_pixels(self, tmp_path, whole, capfd):
        middle = len(whole) // 2
        broken = whole[:middle] + bytes(b ^ 0x5A for b in whole[middle : middle + 200])
        (tmp_path / "bad.exr").write_bytes(broken + whole[middle + 200 :])
        with pytest.raises(ExrError, match=r"bad\.exr: its pixels are cut off, damaged"):
            read_exr(tmp_path / "bad.exr")
        assert capfd.readouterr() == ("", "")

    def test_truncated_second_part(self, tmp_path):
        path = write_parts(
            tmp_path / "a.exr", {"beauty": planes("R G B"), "normal": planes("X Y Z")}
        )
        path.write_bytes(path.read_bytes()[:-30])
        with pytest.raises(ExrError, match="part normal is cut off"):
            read_exr(path)

    def test_tiled_truncated(self, tmp_path):
        tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
        path = write(tmp_path / "a.exr", planes("R G B", size=(70, 50)), **tiles)
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(ExrError, match="cut off, damaged"):
            read_exr(path)

    def test_claimed_size_beyond_memory(self, tmp_path, whole, capfd):
        at = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        huge = np.array([0, 0, 400000, 400000], "<i4").tobytes()
        (tmp_path / "huge.exr").write_bytes(whole[:at] + huge + whole[at + 16 :])
        with pytest.raises(ExrError, match="larger than memory"):
            read_exr(tmp_path / "huge.exr")
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "the file is empty"),
            (b"\x89PNG\r\n\x1a\n" + bytes(99), "not an OpenEXR file; it looks like PNG"),
            (b"\xff\xd8\xff\xe0" + bytes(99), "it looks like JPEG"),
            (b"#?RADIANCE\n", "it looks like Radiance HDR"),
            (b"hello, world", "not an OpenEXR file. Denoising needs linear radiance"),
        ],
    )
    def test_not_an_exr(self, tmp_path, content, message):
        (tmp_path / "a.exr").write_bytes(content)
        with pytest.raises(ExrError, match=message):
            read_exr(tmp_path / "a.exr")

    def test_paths(self, tmp_path):
        with pytest.raises(ExrError, match=r"none\.exr: there is no such file\.$"):
            read_exr(tmp_path / "none.exr")
        with pytest.raises(ExrError, match=r"nor does the folder .*sub"):
            read_exr(tmp_path / "sub" / "none.exr")
        with pytest.raises(ExrError, match="this is a folder"):
            read_exr(tmp_path)

    def test_deep(self, tmp_path):
        samples = np.empty((2, 3), object)
        for index in np.ndindex(2, 3):
            samples[index] = np.ones(2, np.float32)
        header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
        path = tmp_path / "deep.exr"
        OpenEXR.File(header, {"R": samples, "G": samples, "B": samples}).write(str(path))
        with pytest.raises(ExrError, match=r"color: deep data .* flatten it .* holds R, G, B"):
            read_exr(path)
        info = describe_exr(path)
        assert info.roles["color"].problem
        assert {c.dtype for c in info.parts[0].channels} == {"deep"}

    def test_other_output_is_passed_on(self, tmp_path, whole, capfd):
        """What another thread prints during a read must not be lost with the library's noise."""
        from progden_jax.exr._file import quiet

        with quiet() as printed:
            print("a result")
            os.write(2, b"progress 10 %\n")
            os.write(2, b"a.exr: (EXR_ERR_FILE_ACCESS) Unable to open.\n")
            assert printed() == "Unable to open"
        assert capfd.readouterr() == ("a result\n", "progress 10 %\n")


class TestWrite:
    image = np.stack([plane() for _ in range(3)], -1)

    def test_existing_file_stays_unless_overwritten(self, tmp_path):
        path = tmp_path / "a.exr"
        write_exr(path, self.image)
        before = path.read_bytes()
        with pytest.raises(ExrError, match=r"overwrite=True \(--force\)"):
            write_exr(path, self.image + 1)
        assert path.read_bytes() == before
        write_exr(path, self.image + 1, overwrite=True)
        np.testing.assert_array_equal(read_exr(path).color, self.image + 1)
        assert os.listdir(tmp_path) == ["a.exr"]

    def test_unwritable_places(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(ExrError, match="there is no folder"):
            write_exr(tmp_path / "no" / "a.exr", self.image)
        with pytest.raises(ExrError, match="there is no folder"):
            write_exr(tmp_path / "file" / "a.exr", self.image)
        with pytest.raises(ExrError, match="it exists and is not a file"):
            write_exr(tmp_path, self.image, overwrite=True)
        with pytest.raises(ExrError, match="it exists and is not a file"):
            write_exr("/dev/full", self.image, overwrite=True)

    @pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")
    def test_folder_that_refuses_files(self):
        with pytest.raises(ExrError, match=r"/proc/.*cannot be written .* nothing was left behind"):
            write_exr("/proc/self/a.exr", self.image)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_folder_without_permission(self, tmp_path):
        tmp_path.chmod(0o500)
        try:
            with pytest.raises(ExrError, match="Permission denied"):
                write_exr(tmp_path / "a.exr", self.image)
        finally:
            tmp_path.chmod(0o700)

    @pytest.mark.parametrize("overwrite", [False, True])
    def test_full_disk_leaves_nothing_behind(self, tmp_path, overwrite, capfd):
        path = tmp_path / "a.exr"
        if overwrite:
            write_exr(path, self.image)
        before = {name: (tmp_path / name).read_bytes() for name in os.listdir(tmp_path)}
        noise = np.random.default_rng(0).random((200, 200, 3), np.float32)
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20000, hard))
        try:
            with pytest.raises(ExrError, match=r"cannot be written .*too large.*nothing was left"):
                write_exr(path, noise, overwrite=overwrite)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert {name: (tmp_path / name).read_bytes() for name in os.listdir(tmp_path)} == before
        assert capfd.readouterr() == ("", "")

    def test_a_write_that_is_cut_short_silently_is_noticed(self, tmp_path, monkeypatch):
        class Cut(OpenEXR.File):
            def write(self, path):
                super().write(path)
                os.truncate(path, os.path.getsize(path) - 7)

        monkeypatch.setattr(OpenEXR, "File", _CutOnWrite(Cut))
        with pytest.raises(ExrError, match=r"a\.exr: cannot be written .*cut off"):
            write_exr(tmp_path / "a.exr", self.image)
        assert os.listdir(tmp_path) == []

    def test_permissions_follow_the_umask(self, tmp_path):
        old = os.umask(0o027)
        try:
            write_exr(tmp_path / "a.exr", self.image)
        finally:
            os.umask(old)
        assert (tmp_path / "a.exr").stat().st_mode & 0o777 == 0o640

    def test_symbolic_link_keeps_pointing(self, tmp_path):
        write_exr(tmp_path / "a.exr", self.image)
        (tmp_path / "link.exr").symlink_to(tmp_path / "a.exr")
        write_exr(tmp_path / "link.exr", self.image + 1, overwrite=True)
        assert (tmp_path / "link.exr").is_symlink()
        np.testing.assert_array_equal(read_exr(tmp_path / "a.exr").color, self.image + 1)

    def test_layers(self, tmp_path):
        layers = {
            "alpha": self.image / 2,
            "alpha.bound": self.image[..., 0],
            "sure": -self.image[..., :1],
        }
        write_exr(tmp_path / "a.exr", self.image, layers=layers)
        channels, _ = read_channels(tmp_path / "a.exr")
        names = "R G B alpha.R alpha.G alpha.B alpha.bound.Y sure.Y"
        assert set(channels) == set(names.split())
        np.testing.assert_array_equal(stack(channels, "alpha.R/G/B"), self.image / 2)
        np.testing.assert_array_equal(channels["sure.Y"], -self.image[..., 0])
        np.testing.assert_array_equal(read_exr(tmp_path / "a.exr").color, self.image)

    def test_half(self, tmp_path):
        frame = Frame(self.image * 1e5, self.image * 1e9, albedo=self.image / 3, spp=3)
        notes = write_exr(tmp_path / "a.exr", frame, half=True)
        over = int((self.image * 1e5 > 65504).sum())
        assert notes == (
            f"{over} values of the image are beyond half precision and were clipped to 65504",
        )
        channels, _ = read_channels(tmp_path / "a.exr")
        assert channels["R"].dtype == channels["Albedo.G"].dtype == np.float16
        assert channels["Variance.R"].dtype == np.float32
        back = read_exr(tmp_path / "a.exr")
        np.testing.assert_array_equal(back.variance, frame.variance)
        np.testing.assert_array_equal(back.albedo, np.float16(self.image / 3))
        assert float(back.color.max()) == 65504

    def test_half_for_some_layers_and_texts_in_the_header(self, tmp_path):
        ones = np.ones((3, 4, 3), "f4")
        frame = Frame(ones, ones, ones, ones)
        path = tmp_path / "a.exr"
        write_exr(path, frame, half=("Albedo", "Normal"), attributes={"madeBy": "a test"})
        channels, header = read_channels(path)
        halves = {name for name, pixels in channels.items() if pixels.dtype == np.float16}
        assert halves == {n for n in channels if n.startswith(("Albedo.", "Normal."))}
        assert len(halves) == 6
        assert header["madeBy"] == "a test"

    def test_half_keeps_bad_values(self, tmp_path):
        image = self.image.copy()
        image[0, 0] = np.nan, np.inf, -np.inf
        assert write_exr(tmp_path / "a.exr", image, half=True) == ()
        np.testing.assert_array_equal(read_exr(tmp_path / "a.exr").color[0, 0], image[0, 0])

    @pytest.mark.parametrize("kind", ["none", "pxr24", "dwab"])
    def test_compression_by_name(self, tmp_path, kind):
        write_exr(tmp_path / "a.exr", self.image, compression=kind)
        assert describe_exr(tmp_path / "a.exr").parts[0].compression == kind.replace("none", "no")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"image": np.ones((4, 4), np.float32)}, r"image has shape \(4, 4\), expected"),
            ({"image": np.ones((4, 4, 4), np.float32)}, r"image has shape \(4, 4, 4\)"),
            ({"image": np.ones((0, 4, 3), np.float32)}, r"image has shape \(0, 4, 3\)"),
            ({"image": np.ones((4, 4, 3), np.uint8)}, "image has dtype uint8, expected floating"),
            ({"layers": {"a": np.ones((2, 2), np.float32)}}, "is 2×2 pixels but the image is 6×5"),
            ({"layers": {"a": np.ones((6, 5, 2), np.float32)}}, r"layers\['a'\] has shape"),
            ({"layers": {"": np.ones((6, 5), np.float32)}}, "'' cannot name a layer"),
            ({"layers": {"a.": np.ones((6, 5), np.float32)}}, "cannot name a layer"),
            ({"compression": "jpeg"}, "compression is 'jpeg', expected one of none, rle"),
        ],
    )
    def test_wrong_arguments(self, tmp_path, change, message):
        arguments = {"image": self.image, **change}
        with pytest.raises(ExrError, match=message):
            write_exr(tmp_path / "a.exr", **arguments)
        assert os.listdir(tmp_path) == []

    def test_wrong_frames(self, tmp_path):
        with pytest.raises(ExrError, match=r"batch \(2,\): write its frames one by one"):
            write_exr(tmp_path / "a.exr", Frame(np.stack([self.image] * 2), None))
        frame = Frame(self.image, self.image)
        with pytest.raises(ExrError, match="writes a layer 'Variance' itself"):
            write_exr(tmp_path / "a.exr", frame, layers={"Variance": self.image})


class _CutOnWrite:
    """OpenEXR.File that truncates what it writes, and reads as ever."""

    def __init__(self, cut):
        self.cut, self.real = cut, OpenEXR.File

    def __call__(self, *args, **kwargs):
        return (self.cut if isinstance(args[0], dict) else self.real)(*args, **kwargs)


class TestLike:
    attributes = {  # noqa: RUF012
        "pixelAspectRatio": 2.0,
        "screenWindowWidth": 1.5,
        "chromaticities": (0.625, 0.375, 0.25, 0.5, 0.125, 0.0625, 0.25, 0.5),
        "owner": "a studio",
        "comments": "é",
        "colorSpace": "ACEScg",
        "worldToCamera": np.arange(16, dtype=np.float32).reshape(4, 4),
        "multiView": ["left", "right"],
        "samplesPerPixel": 16,
    }

    def test_attributes_are_kept_and_storage_is_not(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"), "PIZ", **self.attributes)
        write_exr(tmp_path / "b.exr", read_exr(path), like=path)
        _, header = read_channels(tmp_path / "b.exr")
        for name, value in self.attributes.items():
            np.testing.assert_array_equal(np.asarray(header[name]), np.asarray(value), name)
        assert header["compression"] == OpenEXR.ZIP_COMPRESSION

    def test_unknown_and_rare_attributes(self, tmp_path):
        rare = [
            ("framesPerSecond", "rational", np.array([24, 1], "<i4").tobytes()),
            ("studio", "studiotype", b"abc"),
            ("nothing", "floatvector", b""),
            ("preview", "preview", np.array([1, 1], "<u4").tobytes() + b"abcd"),
        ]
        channels = {name: (value, 1) for name, value in planes("R G B").items()}
        path = write_raw(tmp_path / "a.exr", channels, (HEIGHT, WIDTH), rare)
        write_exr(tmp_path / "b.exr", read_exr(path), like=path)
        content = (tmp_path / "b.exr").read_bytes()
        for name, kind, data in rare[:2]:
            expected = f"{name}\0{kind}\0".encode() + np.array([len(data)], "<i4").tobytes() + data
            assert expected in content
        assert b"preview\0" not in content

    def test_alpha_is_carried_through(self, tmp_path):
        channels = planes("R G B") | planes("A", "float16")
        path = write(tmp_path / "a.exr", channels)
        frame, info = read_exr_with_info(path)
        assert info.roles["alpha"].channels == ("A",)
        for like in (path, info):
            write_exr(tmp_path / "b.exr", frame.color, like=like, overwrite=True)
            written, _ = read_channels(tmp_path / "b.exr")
            assert written["A"].dtype == np.float16
            np.testing.assert_array_equal(written["A"], channels["A"])

    def test_info_remembers_the_part_and_layer(self, tmp_path):
        parts = {
            "left": planes("R G B A"),
            "right": planes("R G B A"),
        }
        headers = {"left": {"owner": "L"}, "right": {"owner": "R"}}
        path = write_parts(tmp_path / "a.exr", parts, **headers)
        frame, info = read_exr_with_info(path, part="right")
        write_exr(tmp_path / "b.exr", frame, like=info)
        written, header = read_channels(tmp_path / "b.exr")
        assert header["owner"] == "R"
        assert header.get("name", "") == ""
        np.testing.assert_array_equal(written["A"], parts["right"]["A"])

    def test_ambiguous_like_gives_the_first_parts_attributes(self, tmp_path):
        parts = {"left": planes("R G B"), "right": planes("R G B")}
        path = write_parts(tmp_path / "a.exr", parts, left={"owner": "L"})
        write_exr(tmp_path / "b.exr", stack(parts["left"], "R/G/B"), like=path)
        assert read_channels(tmp_path / "b.exr")[1]["owner"] == "L"

    def test_spp_comes_from_the_argument_then_frame_then_like(self, tmp_path):
        path = write(tmp_path / "a_000008spp.exr", planes("R G B"))
        frame, info = read_exr_with_info(path)
        write_exr(tmp_path / "b.exr", frame.color, like=info)
        assert int(read_exr(tmp_path / "b.exr").spp) == 8
        write_exr(tmp_path / "c.exr", frame.replace(spp=9), like=info)
        assert int(read_exr(tmp_path / "c.exr").spp) == 9
        write_exr(tmp_path / "d.exr", frame, like=info, spp=2.5)
        assert float(read_exr(tmp_path / "d.exr").spp) == 2.5

    def test_size_must_fit(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"))
        with pytest.raises(ExrError, match="the image is 2×2 pixels but like has 6×5"):
            write_exr(tmp_path / "b.exr", np.ones((2, 2, 3), np.float32), like=path)

    def test_onto_itself(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B A"), owner="me")
        color = read_exr(path).color + 1
        write_exr(path, color, like=path, overwrite=True)
        np.testing.assert_array_equal(read_exr(path).color, color)
        assert read_channels(path)[1]["owner"] == "me"


def test_info_is_json(tmp_path):
    channels = planes("R G B Albedo.R/G/B") | {"R": np.full((HEIGHT, WIDTH), np.inf, np.float32)}
    info = describe_exr(write(tmp_path / "a.exr", channels), spp=np.float32(4))
    text = json.dumps(dataclasses.asdict(info), allow_nan=False)
    back = json.loads(text)
    assert back["spp"] == 4
    assert back["roles"]["albedo"]["channels"] == ["Albedo.R", "Albedo.G", "Albedo.B"]
    assert back["parts"][0]["size"] == [HEIGHT, WIDTH]


@needs_shared
def test_real_series():
    files = sorted(SHARED.glob("*spp.exr"))
    assert files
    for path in files:
        frame, info = read_exr_with_info(path)
        channels, _ = read_channels(path)
        np.testing.assert_array_equal(frame.color, stack(channels, "R/G/B"))
        np.testing.assert_array_equal(frame.variance, stack(channels, "Variance.R/G/B"))
        assert (info.spp, info.spp_from) == (int(path.stem[-9:-3]), "the file's name")
        if "Albedo.R" in channels:
            np.testing.assert_array_equal(frame.albedo, stack(channels, "Albedo.R/G/B"))
            np.testing.assert_array_equal(frame.normal, stack(channels, "Normal.X/Y/Z"))
            np.testing.assert_array_equal(frame.depth[..., 0], channels["Depth.Z"])
        else:
            assert frame.albedo is None
        assert info.warnings == info.notes == ()


@needs_shared
def test_real_file_round_trip(tmp_path):
    path = next(SHARED.glob("*000008spp.exr"))
    frame, info = read_exr_with_info(path)
    write_exr(tmp_path / "out.exr", frame, like=info)
    back = read_exr(tmp_path / "out.exr")
    for name in ("color", "variance", "albedo", "normal", "depth", "spp"):
        np.testing.assert_array_equal(getattr(back, name), getattr(frame, name))


def test_damaged_file_prints_nothing_in_a_fresh_process(tmp_path):
    """The library prints through C streams, which only a real process shows in full."""
    path = write(tmp_path / "a.exr", planes("R G B", size=(64, 40)))
    path.write_bytes(path.read_bytes()[:-50])
    program = (
        "import sys, progden_jax.exr as e\n"
        "try: e.read_exr(sys.argv[1])\n"
        "except e.ExrError: pass\n"
        "else: sys.exit(3)"
    )
    done = subprocess.run([sys.executable, "-c", program, path], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


@pytest.mark.parametrize("chosen", [0, 3])
def test_all_cores_decompress_and_a_forked_process_does_not_wait_for_them(tmp_path, chosen):
    """Of the library's threads a forked process has none, and would wait for them forever."""
    if not hasattr(OpenEXR, "set_global_thread_count"):
        pytest.skip("OpenEXR before 3.5 has one thread")
    path = write(tmp_path / "a.exr", planes("R G B", size=(300, 40)))
    program = (
        "import os, sys, OpenEXR, progden_jax.exr as e\n"
        "path, chosen = sys.argv[1], int(sys.argv[2])\n"
        "File, counts = OpenEXR.File, []\n"
        "def noted(*args, **how):\n"
        "    counts.append(OpenEXR.global_thread_count())\n"
        "    return File(*args, **how)\n"
        "OpenEXR.set_global_thread_count(chosen)\n"
        "OpenEXR.File = noted\n"
        "color = e.read_exr(path).color\n"
        "print(max(counts), OpenEXR.global_thread_count())\n"
        "child = 0 if chosen else os.fork()\n"
        "if not child:\n"
        "    e.write_exr(path + '-copy.exr', e.read_layers(path)[''])\n"
        "    if not chosen: os._exit(0)\n"
        "else: assert os.waitpid(child, 0)[1] == 0\n"
        "assert (e.read_layers(path + '-copy.exr')[''] == color).all()"
    )
    command = [sys.executable, "-W", "ignore", "-c", program, path, str(chosen)]
    done = subprocess.run(command, capture_output=True, check=True, timeout=100, text=True)
    used = chosen or min(len(os.sched_getaffinity(0)), 16)
    assert done.stdout.split() == [str(used), str(chosen)]
