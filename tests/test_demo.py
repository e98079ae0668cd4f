"""The bundled series: what is in it, that the mix wins on it, and the picture sheet."""

import contextlib
import io

import numpy as np
import pytest
from exr_files import read_channels, stack

import progden_jax as pd
from progden_jax import demo, sheet
from progden_jax.cli import main
from progden_jax.exr import read_exr


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The folder that `progden demo` made, and what it printed."""
    folder = tmp_path_factory.mktemp("demo") / "progden-demo"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        patch.chdir(folder.parent)
        patch.setattr(pd, "enable_compilation_cache", lambda: None)
        assert main(["demo"]) == 0
    return folder, out.getvalue()


@pytest.fixture
def rows():
    rng = np.random.default_rng(0)
    reference = rng.gamma(2, 0.2, (12, 20, 3)).astype("f4")
    noisy, denoised, mixed = (
        (reference + s * rng.normal(size=reference.shape)).astype("f4") for s in (0.3, 0.1, 0.05)
    )
    alpha = rng.random(reference.shape).astype("f4")
    return [sheet.Row(f"{n} spp", noisy, denoised, mixed, alpha) for n in (8, 32)], reference


def test_series_is_small_and_complete():
    assert list(demo.renders()) == [8, 32, 128]
    assert sum(p.stat().st_size for p in demo.FOLDER.iterdir()) < 3e6
    for spp, path in demo.renders().items():
        frame = read_exr(path)
        assert int(frame.spp) == spp
        assert all(getattr(frame, n) is not None for n in ("variance", "albedo", "normal"))
        assert frame.color.shape == demo.reference().shape


def test_the_mix_beats_render_and_denoiser(ran):
    truth = demo.reference()
    errors = []
    for (_, path), name in zip(demo.renders().items(), demo.outputs(), strict=False):
        denoised = stack(read_channels(ran[0] / name)[0], "denoised.R/G/B")
        images = (read_exr(path).color, denoised, read_exr(ran[0] / name).color)
        errors.append([float(pd.metrics.rmse(np.asarray(i), truth)) for i in images])
        assert errors[-1][2] < min(errors[-1][:2]), name
    noisy, denoised, mixed = np.mean(errors, axis=0)
    assert mixed < min(noisy, denoised)
    assert mixed < 0.7 * denoised
    for row in errors:
        for value in row:
            assert f"{value:.4f}" in ran[1]


def test_command_leaves_and_prints_what_it_should(ran, capsys):
    folder, out = ran
    for text in ("8 spp", "32 spp", "128 spp", "noisy", "denoised", "mixed", "SMAPE", "FLIP"):
        assert text in out
    assert {p.name for p in folder.iterdir()} == set(demo.outputs())
    picture = (folder / demo.SHEET).read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert main(["demo", "-o", str(folder)]) == 1
    assert "--force" in capsys.readouterr().err
    assert (folder / demo.SHEET).read_bytes() == picture


def test_command_into_a_place_that_is_taken(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert main(["demo", "-o", str(tmp_path / "file" / "demo")]) == 1
    assert "cannot be made" in capsys.readouterr().err


def test_sheet_labels_every_picture(rows):
    figure = sheet.draw_sheet(*rows, title="a title")
    pictures = [a for a in figure.axes if a.images]
    assert len(pictures) == 16
    heads = [a.get_title() for a in pictures if a.get_title()]
    assert heads[:5] == ["noisy", "denoised", "mixed", "reference", "α"]
    captions = [t.get_text() for a in pictures for t in a.texts]
    rmse = np.sqrt(np.mean((rows[0][0].mixed - rows[1]) ** 2))
    assert f"RMSE {rmse:.4f}" in captions
    bold = [t.get_text() for a in pictures for t in a.texts if t.get_weight() == "bold"]
    assert bold == [f"RMSE {rmse:.4f}"] * 2
    assert {"8 spp", "32 spp", "a title"} <= {t.get_text() for t in figure.texts}


def test_sheet_shares_its_scales(rows):
    pictures = [a.images[0] for a in sheet.draw_sheet(*rows).axes if a.images]
    errors = [p for i, p in enumerate(pictures) if i % 8 > 4]
    assert len({(p.norm.vmin, p.norm.vmax) for p in errors}) == 1
    shown = np.asarray(pictures[3].get_array())
    np.testing.assert_array_equal(shown, np.asarray(pictures[11].get_array()))
    assert shown.min() >= 0
    assert shown.max() <= 1


@pytest.mark.parametrize("value", [0.0, 1e6, np.nan])
def test_sheet_of_degenerate_images(tmp_path, value):
    image = np.full((1, 5, 3), value, "f4")
    black = np.zeros_like(image)
    sheet.save_sheet(tmp_path / "s.png", [sheet.Row("x", image, black, black, black)], black)
    assert (tmp_path / "s.png").stat().st_size > 1000


def test_sheet_refuses_what_does_not_fit(rows):
    with pytest.raises(ValueError, match="at least one"):
        sheet.draw_sheet([], rows[1])
    with pytest.raises(ValueError, match="'8 spp' has shape"):
        sheet.draw_sheet(rows[0], rows[1][:5])


def test_display_is_monotonic_and_in_range():
    radiance = np.linspace(-1, 3, 300, dtype="f4").reshape(1, 100, 3)
    shown = sheet.display(radiance, 0.5)
    assert shown.min() == 0
    assert 1 - 1e-6 < shown.max() <= 1
    assert (np.diff(shown.ravel()) >= 0).all()
    assert sheet.exposure_for(np.zeros((2, 2, 3), "f4")) == 1
    assert sheet.exposure_for(np.full((2, 2, 3), 1.4, "f4")) == pytest.approx(0.5)
