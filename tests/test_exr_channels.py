"""Which channels are taken as what: renderers' conventions, ambiguity, the user's map."""

import numpy as np
import OpenEXR
import pytest
from exr_files import (
    HEIGHT,
    WIDTH,
    plane,
    planes,
    stack,
    window,
    write,
    write_parts,
    write_raw,
)

from progden_jax.exr import (
    ExrError,
    describe_exr,
    parse_channel_map,
    read_exr,
    read_exr_with_info,
)

# Renderer -> what its files hold (~ is a blank), and what is expected of it.
CONVENTIONS = {
    "this project": (
        "R G B Variance.R/G/B Albedo.R/G/B Normal.X/Y/Z Depth.Z",
        {
            "color": "R/G/B",
            "variance": "Variance.R/G/B",
            "albedo": "Albedo.R/G/B",
            "normal": "Normal.X/Y/Z",
            "depth": "Depth.Z",
        },
    ),
    "pbrt-v4": (
        "R G B Albedo.R/G/B P.X/Y/Z u v dzdx dzdy N.X/Y/Z Ns.X/Y/Z Variance.R/G/B "
        "RelativeVariance.R/G/B",
        {
            "color": "R/G/B",
            "variance": "Variance.R/G/B",
            "albedo": "Albedo.R/G/B",
            "normal": "Ns.X/Y/Z",
        },
    ),
    "pbrt-v4, geometric normals only": (
        "R G B N.X/Y/Z P.X/Y/Z",
        {"color": "R/G/B", "normal": "N.X/Y/Z"},
    ),
    "Mitsuba 3, aov": (
        "R G B alb.R/G/B dd.T img.R/G/B/A nn.X/Y/Z pp.X/Y/Z",
        {"color": "R/G/B", "albedo": "alb.R/G/B", "normal": "nn.X/Y/Z", "depth": "dd.T"},
    ),
    "Mitsuba 3, moment of aov": (
        "R G B a.X/Y/Z a.alb.R/G/B a.dd.T a.img.R/G/B/A a.sh_normal.X/Y/Z m2_a.X/Y/Z "
        "m2_a.alb.R/G/B m2_a.dd.T m2_a.img.R/G/B/A m2_a.sh_normal.X/Y/Z",
        {
            "color": "R/G/B",
            "albedo": "a.alb.R/G/B",
            "normal": "a.sh_normal.X/Y/Z",
            "depth": "a.dd.T",
        },
    ),
    "Cycles with denoising": (
        "ViewLayer.Combined.R/G/B/A ViewLayer.Noisy~Image.R/G/B ViewLayer.Denoising~Albedo.R/G/B "
        "ViewLayer.Denoising~Normal.X/Y/Z ViewLayer.Denoising~Depth.Z ViewLayer.Normal.X/Y/Z "
        "ViewLayer.Depth.Z ViewLayer.DiffCol.R/G/B",
        {
            "color": "ViewLayer.Noisy Image.R/G/B",
            "alpha": "ViewLayer.Combined.A",
            "albedo": "ViewLayer.Denoising Albedo.R/G/B",
            "normal": "ViewLayer.Denoising Normal.X/Y/Z",
            "depth": "ViewLayer.Denoising Depth.Z",
        },
    ),
    "Cycles without denoising": (
        "ViewLayer.Combined.R/G/B/A ViewLayer.Normal.X/Y/Z ViewLayer.Depth.Z "
        "ViewLayer.DiffCol.R/G/B ViewLayer.DiffDir.R/G/B",
        {
            "color": "ViewLayer.Combined.R/G/B",
            "alpha": "ViewLayer.Combined.A",
            "albedo": "ViewLayer.DiffCol.R/G/B",
            "normal": "ViewLayer.Normal.X/Y/Z",
            "depth": "ViewLayer.Depth.Z",
        },
    ),
    "Cycles with compositor output": (
        "Composite.Combined.R/G/B/A ViewLayer.Combined.R/G/B/A",
        {"color": "ViewLayer.Combined.R/G/B", "alpha": "ViewLayer.Combined.A"},
    ),
    "Tungsten": ("R G B", {"color": "R/G/B"}),
    "Arnold": (
        "R G B A variance.R/G/B N.X/Y/Z Z denoise_albedo.R/G/B diffuse_albedo.R/G/B "
        "diffuse.R/G/B specular.R/G/B",
        {
            "color": "R/G/B",
            "alpha": "A",
            "variance": "variance.R/G/B",
            "albedo": "denoise_albedo.R/G/B",
            "normal": "N.X/Y/Z",
            "depth": "Z",
        },
    ),
    "Arnold, layer names kept": (
        "RGBA.R/G/B/A RGBA_variance.R/G/B N.R/G/B diffuse_albedo.R/G/B",
        {
            "color": "RGBA.R/G/B",
            "alpha": "RGBA.A",
            "variance": "RGBA_variance.R/G/B",
            "albedo": "diffuse_albedo.R/G/B",
            "normal": "N.R/G/B",
        },
    ),
    "RenderMan": (
        "Ci.r/g/b a albedo.r/g/b albedo_var.r/g/b mse.r/g/b normal.x/y/z z",
        {
            "color": "Ci.r/g/b",
            "alpha": "a",
            "variance": "mse.r/g/b",
            "albedo": "albedo.r/g/b",
            "normal": "normal.x/y/z",
            "depth": "z",
        },
    ),
    "Karma": ("C.R/G/B/A albedo.R/G/B N.X/Y/Z", {"color": "C.R/G/B", "alpha": "C.A"}),
    "V-Ray": (".R .G .B .A VisibleNormals.X/Y/Z", {"color": ".R/G/B", "alpha": ".A"}),
    "long component names": (
        "red green blue albedo.red/green/blue",
        {"color": "red/green/blue", "albedo": "albedo.red/green/blue"},
    ),
    "lower case": (
        "r g b variance.r/g/b normals.x/y/z depth",
        {
            "color": "r/g/b",
            "variance": "variance.r/g/b",
            "normal": "normals.x/y/z",
            "depth": "depth",
        },
    ),
    "upper case": (
        "R G B VARIANCE.R/G/B ALBEDO.R/G/B NORMALS.X/Y/Z DEPTH.Z",
        {"variance": "VARIANCE.R/G/B", "albedo": "ALBEDO.R/G/B", "depth": "DEPTH.Z"},
    ),
    "others, 1": (
        "R G B VisibleDiffuse.R/G/B OptixNormals.R/G/B",
        {"albedo": "VisibleDiffuse.R/G/B", "normal": "OptixNormals.R/G/B"},
    ),
    "others, 2": (
        "R G B diffuse.R/G/B Normals.X/Y/Z Depth.V",
        {"albedo": "diffuse.R/G/B", "normal": "Normals.X/Y/Z", "depth": "Depth.V"},
    ),
    "grey": ("Y A Variance.Y", {"color": "Y", "alpha": "A", "variance": "Variance.Y"}),
    "one unknown layer": ("lighting.R/G/B Albedo.R/G/B", {"color": "lighting.R/G/B"}),
    "variance below the colour": (
        "Beauty.R/G/B Beauty.Variance.R/G/B Specular.Variance.R/G/B",
        {"color": "Beauty.R/G/B", "variance": "Beauty.Variance.R/G/B"},
    ),
}


def names(notation: str) -> tuple[str, ...]:
    layer, dot, components = notation.rpartition(".")
    return tuple(layer + dot + c for c in components.split("/"))


@pytest.mark.parametrize("dtype", ["float32", "float16"])
@pytest.mark.parametrize("renderer", CONVENTIONS)
def test_conventions(tmp_path, renderer, dtype):
    held, expected = CONVENTIONS[renderer]
    channels = planes(held, dtype)
    path = write(tmp_path / "a.exr", channels)
    frame, info = read_exr_with_info(path, variance_of="mean" if "dzdx" in channels else None)
    for role, notation in expected.items():
        assert info.roles[role].channels == names(notation), role
        if role != "alpha":
            image = stack(channels, notation)
            image = image if role == "depth" else np.broadcast_to(image, (*image.shape[:2], 3))
            np.testing.assert_array_equal(getattr(frame, role), image)
    if len(expected) > 3:
        for role in {"variance", "albedo", "normal", "depth"} - expected.keys():
            assert getattr(frame, role) is None, role
            assert info.roles[role].reason


def test_reflected_light_is_no_albedo(tmp_path):
    path = write(tmp_path / "a.exr", planes("R G B diffuse.R/G/B specular.R/G/B"))
    assert read_exr(path).albedo is None


def test_auxiliary_can_be_left_out(tmp_path):
    held = "R G B Variance.R/G/B Albedo.R/G/B Normal.X/Y/Z Depth.Z A.Albedo.R/G/B"
    frame = read_exr(write(tmp_path / "a.exr", planes(held)), auxiliary=False)
    assert frame.variance is not None
    assert frame.albedo is frame.normal is frame.depth is None


class TestParts:
    def test_roles_in_parts_named_after_them(self, tmp_path):
        parts = {
            "rgba": planes("R G B A"),
            "albedo": planes("R G B", "float16"),
            "N": planes("X Y Z"),
            "variance": planes("R G B"),
            "Z": planes("Y"),
        }
        frame, info = read_exr_with_info(write_parts(tmp_path / "a.exr", parts))
        np.testing.assert_array_equal(frame.color, stack(parts["rgba"], "R/G/B"))
        np.testing.assert_array_equal(frame.albedo, stack(parts["albedo"], "R/G/B"))
        np.testing.assert_array_equal(frame.normal, stack(parts["N"], "X/Y/Z"))
        np.testing.assert_array_equal(frame.variance, stack(parts["variance"], "R/G/B"))
        np.testing.assert_array_equal(frame.depth[..., 0], parts["Z"]["Y"])
        assert info.roles["albedo"].part == 1
        assert info.roles["alpha"].channels == ("A",)

    def test_layers_in_parts(self, tmp_path):
        parts = {
            "ViewLayer.Combined": planes("ViewLayer.Combined.R/G/B/A"),
            "ViewLayer.Denoising Albedo": planes("ViewLayer.Denoising~Albedo.R/G/B"),
        }
        frame = read_exr(write_parts(tmp_path / "a.exr", parts))
        albedo = parts["ViewLayer.Denoising Albedo"]
        np.testing.assert_array_equal(
            frame.albedo, stack(albedo, "ViewLayer.Denoising Albedo.R/G/B")
        )

    def test_several_pictures_need_the_part(self, tmp_path):
        parts = {"left": planes("R G B Albedo.R/G/B"), "right": planes("R G B Albedo.R/G/B")}
        path = write_parts(tmp_path / "a.exr", parts)
        message = (
            r"a\.exr: color: several layers with equal right: R/G/B in part 0 'left', "
            r"R/G/B in part 1 'right'; choose with channels=.*--channels \"color=left\".*"
            r"part=0 \(--part 0\)\. The file holds part 0 'left': R, G, B, Albedo\.R/G/B; part 1"
        )
        with pytest.raises(ExrError, match=message):
            read_exr(path)
        assert "--part 0" in describe_exr(path).roles["color"].reason
        for part in ("right", 1, "1"):
            frame = read_exr(path, part=part)
            np.testing.assert_array_equal(frame.color, stack(parts["right"], "R/G/B"))
            np.testing.assert_array_equal(frame.albedo, stack(parts["right"], "Albedo.R/G/B"))

    def test_unknown_part(self, tmp_path):
        path = write_parts(tmp_path / "a.exr", {"left": planes("R G B"), "right": planes("R G B")})
        for part in ("middle", 2, -1):
            with pytest.raises(
                ExrError, match=r"part \(--part\) is .*; the file holds part 0 'left'"
            ):
                read_exr(path, part=part)

    def test_other_sizes_play_no_role(self, tmp_path):
        small = {"dataWindow": window(0, 0, 2, 1), "displayWindow": window(0, 0, 9, 9)}
        moved = {"dataWindow": window(1, 1, WIDTH, HEIGHT), "displayWindow": window(0, 0, 9, 9)}
        full = {"displayWindow": window(0, 0, 9, 9)}
        parts = {
            "rgba": planes("R G B"),
            "albedo": planes("R G B", size=(2, 3)),
            "normal": planes("X Y Z"),
        }
        path = write_parts(
            tmp_path / "a.exr",
            parts,
            rgba=full | {"dataWindow": window(0, 0, WIDTH - 1, HEIGHT - 1)},
            albedo=small,
            normal=moved,
        )
        frame, info = read_exr_with_info(path)
        assert frame.albedo is frame.normal is None
        assert "in part 1 'albedo', whose data window is not" in info.roles["albedo"].reason
        with pytest.raises(ExrError, match=r"albedo \(R/G/B\) is 2×3 pixels but color is 6×5"):
            read_exr(path, channels={"albedo": "albedo"})
        reported = describe_exr(path, channels={"albedo": "albedo"}).roles["albedo"]
        assert reported.problem
        assert reported.reason.startswith("albedo (R/G/B) is 2×3 pixels")


class TestAmbiguity:
    def test_view_layers(self, tmp_path):
        held = "Day.Combined.R/G/B/A Day.Normal.X/Y/Z Night.Combined.R/G/B/A Night.Normal.X/Y/Z"
        channels = planes(held)
        path = write(tmp_path / "a.exr", channels)
        with pytest.raises(ExrError, match=r"equal right: Day\.Combined\.R/G/B, Night\.Combined"):
            read_exr(path)
        frame, info = read_exr_with_info(path, channels="color=Night.Combined")
        np.testing.assert_array_equal(frame.color, stack(channels, "Night.Combined.R/G/B"))
        assert info.roles["normal"].channels[0] == "Night.Normal.X"
        assert info.roles["alpha"].channels == ("Night.Combined.A",)

    def test_auxiliary(self, tmp_path):
        channels = planes("R G B Albedo.R/G/B alb.R/G/B")
        path = write(tmp_path / "a.exr", channels)
        with pytest.raises(
            ExrError,
            match=r"albedo: several layers with equal right: Albedo\.R/G/B, alb\.R/G/B; choose with "
            r'channels=\{"albedo": "Albedo"\} \(--channels "albedo=Albedo"\), or leave it out with '
            r"albedo=none\. The file holds R, G, B, Albedo",
        ):
            read_exr(path)
        assert describe_exr(path).roles["albedo"].problem
        assert read_exr(path, channels={"albedo": None}).albedo is None
        assert read_exr(path, auxiliary=False).albedo is None
        frame = read_exr(path, channels={"albedo": "alb"})
        np.testing.assert_array_equal(frame.albedo, stack(channels, "alb.R/G/B"))

    def test_unknown_layers(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("key.R/G/B fill.R/G/B"))
        with pytest.raises(ExrError, match=r"equal right: fill\.R/G/B, key\.R/G/B"):
            read_exr(path)

    def test_no_colour(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("Albedo.R/G/B Z foo"))
        with pytest.raises(
            ExrError,
            match=r'color: no channels of a known name; name them with channels=\{"color": "LAYER"\} '
            r'\(--channels "color=LAYER"\)\. The file holds Z, foo, Albedo\.R/G/B\.',
        ):
            read_exr(path)
        info = describe_exr(path)
        assert info.roles["color"].problem
        assert info.variance == "none without a colour"

    def test_chroma(self, tmp_path):
        channels = {"Y": (plane(size=(4, 4)), 1)}
        channels |= {name: (plane(size=(2, 2)), 2) for name in ("RY", "BY")}
        path = write_raw(tmp_path / "a.exr", channels, (4, 4))
        with pytest.raises(ExrError, match="luminance and chroma .*write the render as RGB"):
            read_exr(path)

    def test_whole_numbers_are_no_radiance(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B", "uint32"))
        with pytest.raises(ExrError, match="color: no channels of a known name"):
            read_exr(path)
        with pytest.raises(ExrError, match="R holds whole numbers"):
            read_exr(path, channels="color=R/G/B")

    def test_many_layers_are_cut_short(self, tmp_path):
        path = write(tmp_path / "a.exr", planes(" ".join(f"layer{i:02}.x" for i in range(50))))
        with pytest.raises(ExrError, match="layer39.x and 10 layers more"):
            read_exr(path)


class TestMap:
    held = "R G B Beauty.R/G/B/A Ext.DiffCol.R/G/B odd.n1/n2/n3 m.v Distance.F"

    @pytest.fixture
    def file(self, tmp_path):
        channels = planes(self.held)
        return write(tmp_path / "a.exr", channels), channels

    def test_every_form(self, file):
        path, channels = file
        frame, info = read_exr_with_info(
            path,
            channels={
                "color": "Beauty",
                "albedo": "diffcol",
                "normal": ["odd.n1", "odd.n2", "odd.n3"],
                "variance": "m",
                "depth": "Distance.F",
            },
        )
        np.testing.assert_array_equal(frame.color, stack(channels, "Beauty.R/G/B"))
        np.testing.assert_array_equal(frame.albedo, stack(channels, "Ext.DiffCol.R/G/B"))
        np.testing.assert_array_equal(frame.normal, stack(channels, "odd.n1/n2/n3"))
        np.testing.assert_array_equal(frame.variance, np.repeat(stack(channels, "m.v"), 3, -1))
        np.testing.assert_array_equal(frame.depth[..., 0], channels["Distance.F"])
        assert info.roles["alpha"].channels == ("Beauty.A",)

    def test_text_form(self, file):
        path, channels = file
        text = "color=Beauty, albedo=Ext.DiffCol, normal=odd.n1/odd.n2/odd.n3, variance=none"
        frame = read_exr(path, channels=text)
        np.testing.assert_array_equal(frame.color, stack(channels, "Beauty.R/G/B"))
        np.testing.assert_array_equal(frame.normal, stack(channels, "odd.n1/n2/n3"))
        assert frame.variance is None
        info = describe_exr(path, channels=text)
        assert info.variance == "none, left out on request"
        assert info.roles["variance"].reason == "left out on request"

    def test_it_beats_every_convention(self, tmp_path):
        channels = planes("R G B Albedo.R/G/B other.R/G/B")
        path = write(tmp_path / "a.exr", channels)
        frame = read_exr(path, channels="color=other,albedo=R/G/B")
        np.testing.assert_array_equal(frame.color, stack(channels, "other.R/G/B"))
        np.testing.assert_array_equal(frame.albedo, stack(channels, "R/G/B"))

    def test_parse(self):
        assert parse_channel_map("color=A b, depth=Z") == {"color": "A b", "depth": "Z"}

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("color", "'color' is not of the form ROLE=LAYER; example: color=Beauty"),
            ("color=", "'color=' is not of the form"),
            ("", "'' is not of the form"),
            ("color=A,color=B", "color is given twice"),
            ("albdo=A", "'albdo' is no role; the roles are color, variance, albedo, normal, depth"),
            ("albdo=A", r"Did you mean albedo\?"),
            ("colour=A", r"Did you mean color\?"),
        ],
    )
    def test_wrong_text(self, text, message):
        with pytest.raises(ExrError, match=message):
            parse_channel_map(text)

    @pytest.mark.parametrize(
        ("channels", "message"),
        [
            (
                {"color": "Beaty"},
                r"no layer or channel 'Beaty'\. Close: Beauty\. The file holds R, G",
            ),
            ({"color": "R/G/X"}, "no layer or channel 'X'"),
            ({"color": "R/G"}, r"color is given 2 channels \(R, G\), expected 1 or 3"),
            ({"depth": "R/G/B"}, "depth is given 3 channels .* expected 1"),
            ({"normal": "odd"}, "layer 'odd' holds n1, n2, n3, from which no normal can be made"),
            ({"color": None}, "color=none leaves nothing to denoise"),
            ({"picture": "R"}, "'picture' is no role"),
        ],
    )
    def test_wrong_map(self, file, channels, message):
        for read in (read_exr, describe_exr):
            with pytest.raises(ExrError, match=message):
                read(file[0], channels=channels)

    def test_one_layer_in_several_parts(self, tmp_path):
        parts = {"left": planes("x.R x.G x.B"), "right": planes("x.R x.G x.B")}
        path = write_parts(tmp_path / "a.exr", parts)
        for value in ("x", "x.R/x.G/x.B"):
            with pytest.raises(
                ExrError, match=r"fits several layers, in part 0 'left', part 1 'right'"
            ):
                read_exr(path, channels={"color": value})
            frame = read_exr(path, channels={"color": value}, part="right")
            np.testing.assert_array_equal(frame.color, stack(parts["right"], "x.R/G/B"))


class TestOtherFiles:
    def test_roles_from_one_file_each(self, tmp_path, monkeypatch):
        color = planes("R G B")
        path = write(tmp_path / "beauty.exr", color)
        albedo, aovs = planes("R G B"), planes("Normal.X/Y/Z DiffCol.R/G/B Albedo.R/G/B")
        depth, noise = planes("Y"), planes("R G B")
        write(tmp_path / "albedo.exr", albedo)
        write(tmp_path / "aovs.exr", aovs)
        write(tmp_path / "depth.exr", depth)
        write(tmp_path / "beautyVariance.exr", noise)
        text = (
            "albedo=albedo.exr,normal=aovs.exr,depth=depth.exr,"
            f"variance={tmp_path / 'beautyVariance.exr'}"
        )
        frame, info = read_exr_with_info(path, channels=text)
        np.testing.assert_array_equal(frame.albedo, stack(albedo, "R/G/B"))
        np.testing.assert_array_equal(frame.normal, stack(aovs, "Normal.X/Y/Z"))
        np.testing.assert_array_equal(frame.depth[..., 0], depth["Y"])
        np.testing.assert_array_equal(frame.variance, stack(noise, "R/G/B"))
        assert info.roles["albedo"].file == str(tmp_path / "albedo.exr")
        frame = read_exr(path, channels="albedo=aovs.exr:DiffCol")
        np.testing.assert_array_equal(frame.albedo, stack(aovs, "DiffCol.R/G/B"))
        assert "beautyVariance.exr" in describe_exr(path).variance

    def test_errors(self, tmp_path):
        path = write(tmp_path / "a.exr", planes("R G B"))
        write(tmp_path / "small.exr", planes("R G B", size=(2, 2)))
        write(tmp_path / "odd.exr", planes("p q"))
        with pytest.raises(ExrError, match="none.exr: there is no such file"):
            read_exr(path, channels="albedo=none.exr")
        with pytest.raises(ExrError, match=r"albedo \(.*small.exr: R/G/B\) is 2×2 pixels"):
            read_exr(path, channels="albedo=small.exr")
        with pytest.raises(ExrError, match=r"variance \(.*small.exr: R/G/B\) is 2×2 pixels"):
            read_exr(path, channels="variance=small.exr")
        assert "2×2 pixels" in describe_exr(path, channels="variance=small.exr").variance
        with pytest.raises(ExrError, match=r"which of its channels are the albedo\?.*holds p, q"):
            read_exr(path, channels="albedo=odd.exr")
        with pytest.raises(ExrError, match="no layer or channel 'Beaut'"):
            read_exr(path, channels="albedo=odd.exr:Beaut")


def test_settings_are_checked(tmp_path):
    path = write(tmp_path / "a.exr", planes("R G B"))
    with pytest.raises(TypeError, match="unknown settings"):
        read_exr_with_info(path, chanels="color=R/G/B")  # pyright: ignore
    assert OpenEXR.isOpenExrFile(str(path))
