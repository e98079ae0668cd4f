"""The report in headless Chromium, from file://: real clicks and keys, and the pixels that they bring."""

import io
import shutil
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import parse_qs

import numpy as np
import pytest
from report_run import HEIGHT, METHODS, SCENES, SPPS, WIDTH, make_run
from scipy import stats

from progden_jax import metrics, sheet
from progden_jax.report import build_report
from progden_jax.report.images import to_half

playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="needs Chromium (apt-get install chromium)"
)

FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--force-color-profile=srgb",
    # WebGL in software, which Chromium does not offer unasked.
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
]
VIEWPORT = {"width": 760, "height": 520}
SCENE = SCENES[1]  # the one with markup in its name


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The run, the URL of its report, and one browser for all tests."""
    run = make_run(tmp_path_factory.mktemp("run") / "a run")
    output = tmp_path_factory.mktemp("report") / "site"
    build_report(run.folder, output, title="<i>odd</i> & title")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield SimpleNamespace(run=run, url=(output / "index.html").as_uri(), browser=browser)
        browser.close()


@pytest.fixture
def visit(built):
    """Opens the report at a hash; fails on console errors, and on requests that are no files."""
    problems, contexts = [], []

    def open_page(hash="", query="", **options):
        context = built.browser.new_context(viewport=VIEWPORT, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda m: _is_problem(m) and problems.append(m.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on(
            "request",
            lambda r: r.url.startswith(("file:", "blob:", "data:")) or problems.append(r.url),
        )
        page.goto(f"{built.url}{query}#{hash}")
        settle(page)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []


def _is_problem(message) -> bool:
    # The driver of WebGL in software tells what reading a screenshot costs.
    return message.type in ("error", "warning") and "GL Driver Message" not in message.text


def settle(page):
    """Wait until what was asked for is drawn: a frame has passed and no image is on its way."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_function(
        "document.getElementById('images').hidden"
        " || document.getElementById('stage').dataset.state === 'ready'"
    )


def press(page, *keys):
    for key in keys:
        page.keyboard.press(key)
    settle(page)


def pixels(page) -> np.ndarray:
    """The canvas as it is on screen, (H, W, 3) bytes."""
    from PIL import Image

    page.mouse.move(0, 0)
    shot = page.locator("#stage").screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def panels(page) -> list[dict]:
    return page.evaluate(
        "progden.viewer.panels().map(({ rect, origin, zoom }) => ({ rect, origin, zoom }))"
    )


def shown(page, panel=0) -> np.ndarray:
    """The colour of each image pixel of a panel, seen in its middle; NaN outside the panel."""
    canvas, found = pixels(page), panels(page)[panel]
    rect, origin, zoom = found["rect"], found["origin"], found["zoom"]
    x = np.floor(origin["x"] + (np.arange(WIDTH) + 0.5) * zoom).astype(int)
    y = np.floor(origin["y"] + (np.arange(HEIGHT) + 0.5) * zoom).astype(int)
    rows = (y >= rect["y"]) & (y < rect["y"] + rect["height"])
    columns = (x >= rect["x"]) & (x < rect["x"] + rect["width"])
    colors = np.full((HEIGHT, WIDTH, 3), np.nan)
    colors[np.ix_(rows, columns)] = canvas[np.ix_(y[rows], x[columns])]
    return colors


def stored(image):
    half, scale = to_half(image)
    return half.astype("f8") * scale


def expected(built, image, stops=0.0):
    """The bytes of an image at its scene's exposure and so many stops more."""
    exposure = sheet.exposure_for(built.run.references[SCENE])
    return 255 * sheet.display(stored(image), exposure * 2**stops)


def at(view="images", **state):
    from urllib.parse import urlencode

    return urlencode({"view": view, "scene": SCENE, **state})


def state_of(page) -> dict:
    page.wait_for_timeout(250)  # the hash is written with a delay
    return {k: v[0] for k, v in parse_qs(page.evaluate("location.hash.slice(1)")).items()}


@pytest.mark.parametrize(("query", "renderer"), [("?webgl", "webgl"), ("?canvas", "canvas")])
def test_exposure_and_tone_change_pixels_as_computed(built, visit, query, renderer):
    image = built.run.images[SCENE, 8, "denoised"]
    page = visit(at(spp=8, method="denoised"), query)
    assert page.locator("#stage").get_attribute("data-renderer") == renderer
    np.testing.assert_allclose(shown(page), expected(built, image), atol=1)
    press(page, "e", "e", "e")
    np.testing.assert_allclose(shown(page), expected(built, image, 1.5), atol=1)
    press(page, *"EEEEE")
    np.testing.assert_allclose(shown(page), expected(built, image, -1), atol=1)
    press(page, "t")
    reinhard = metrics.tone_map(stored(image) * sheet.exposure_for(built.run.references[SCENE]) / 2)
    np.testing.assert_allclose(shown(page), 255 * np.asarray(reinhard), atol=1)


@pytest.mark.parametrize("query", ["?webgl", "?canvas"])
def test_maps_have_the_colours_of_their_values(built, visit, query):
    from matplotlib import colormaps

    row = (SCENE, 8, "mix MonteCarlo(1)")
    image, truth = stored(built.run.images[row]), stored(built.run.references[SCENE])
    layers = {n: stored(layer).mean(-1) for n, layer in built.run.layers[row].items()}
    full = 1 / sheet.exposure_for(built.run.references[SCENE])
    relative = np.abs(image - truth) / (np.abs(image) + np.abs(truth) + 0.01)
    bent = {s: lambda v, s=s: np.arcsinh(s * v) / np.arcsinh(s) for s in (100, 1e4)}
    flip = metrics.flip_map(built.run.images[row], built.run.references[SCENE])
    places = {
        "signed": ("RdBu_r", 0.5 + 0.5 * bent[100]((image - truth).mean(-1) / full)),
        "absolute": ("inferno", bent[100](np.abs(image - truth).mean(-1) / full)),
        "relative": ("inferno", relative.mean(-1)),
        "flip": ("magma", flip),
        "alpha": ("cividis", layers["alpha"]),
        "sure": ("RdBu_r", 0.5 + 0.5 * bent[1e4](layers["sure"] / full**2)),
    }
    page = visit(at(spp=8, method=row[2]), query)
    for name, (colors, place) in places.items():
        press(page, "m")
        assert page.locator("#map").input_value() == name
        # Values may fall to either side of a step between two of the 256 colours.
        near = [colormaps[colors](np.clip(place + d, 0, 1))[..., :3] for d in (-0.003, 0, 0.003)]
        seen = shown(page)
        off = np.min([np.abs(seen - 255 * n).max(-1) for n in near], axis=0)
        assert off.max() <= 3, name
        assert np.ptp(seen, axis=(0, 1)).max() > 20
    press(page, "m")
    assert page.locator("#map").input_value() == "image"


def test_number_keys_flip_in_place_and_load_when_looked_at(built, visit):
    page = visit(at(spp=2))
    loaded = []
    page.on("request", lambda request: loaded.append(request.url))
    before = panels(page)
    for key, method in zip("213", (METHODS[1], METHODS[0], METHODS[2]), strict=True):
        press(page, key)
        image = built.run.images[SCENE, 2, method]
        np.testing.assert_allclose(shown(page), expected(built, image), atol=1)
        assert page.locator(".label .name").text_content() == method
        error = built.run.errors[SCENE, 2, method]["rmse"]
        assert f"RMSE {error:.3f}"[:9] in page.locator(".label .error").text_content()
    # The first was there already.
    assert len(loaded) == 2
    press(page, "r")
    truth = built.run.references[SCENE]
    np.testing.assert_allclose(shown(page), expected(built, truth), atol=1)
    press(page, "]")
    np.testing.assert_allclose(
        shown(page), expected(built, built.run.images[SCENE, 2, "render"]), atol=1
    )
    press(page, ".")
    np.testing.assert_allclose(
        shown(page), expected(built, built.run.images[SCENE, 8, "render"]), atol=1
    )
    assert panels(page) == before
    press(page, "9")
    assert state_of(page) == {"scene": SCENE, "spp": "8"}


def test_wheel_zooms_about_the_cursor_and_dragging_pans_all_panels(built, visit):
    page = visit(at(spp=8, layout="side"))
    names = ["Reference", *METHODS]
    assert page.locator(".label .name").all_text_contents() == names
    images = [built.run.references[SCENE], *(built.run.images[SCENE, 8, m] for m in METHODS)]
    before = panels(page)
    stage = page.locator("#stage").bounding_box()
    first = before[0]
    # The middle of image pixel (6, 4), in the first panel.
    place = [first["origin"]["x"] + 6.5 * first["zoom"], first["origin"]["y"] + 4.5 * first["zoom"]]
    page.mouse.move(stage["x"] + place[0], stage["y"] + place[1])
    settle(page)
    assert "pixel 6, 4" in page.locator("#readout").text_content()
    page.mouse.wheel(0, -200)
    settle(page)
    assert "pixel 6, 4" in page.locator("#readout").text_content()
    zoomed = panels(page)
    for old, new in zip(before, zoomed, strict=True):
        assert new["zoom"] == 2 * old["zoom"]
        under = [new["origin"]["x"] - new["rect"]["x"], new["origin"]["y"] - new["rect"]["y"]]
        assert under == [
            zoomed[0]["origin"]["x"] - first["rect"]["x"],
            zoomed[0]["origin"]["y"] - first["rect"]["y"],
        ]
    assert abs(zoomed[0]["origin"]["x"] + 6.5 * zoomed[0]["zoom"] - place[0]) <= 1
    page.mouse.down()
    page.mouse.move(stage["x"] + place[0] + 20, stage["y"] + place[1] - 10, steps=3)
    page.mouse.up()
    settle(page)
    dragged = panels(page)
    for panel, (old, new, image) in enumerate(zip(zoomed, dragged, images, strict=True)):
        assert new["origin"]["x"] - old["origin"]["x"] == pytest.approx(20, abs=1)
        assert new["origin"]["y"] - old["origin"]["y"] == pytest.approx(-10, abs=1)
        seen = shown(page, panel)
        inside = np.isfinite(seen)
        assert 30 < inside[..., 0].sum() < HEIGHT * WIDTH
        np.testing.assert_allclose(seen[inside], expected(built, image)[inside], atol=1)


def test_keys_zoom_and_pan(visit):
    page = visit(at())
    fit = panels(page)[0]["zoom"]
    press(page, "+", "+")
    zoom = panels(page)[0]["zoom"]
    assert np.log2(zoom) % 1 == 0
    assert fit < zoom / 2 < 2 * fit
    page.locator("#stage").focus()
    before = panels(page)[0]
    press(page, "ArrowRight", "ArrowDown")
    after = panels(page)[0]
    assert before["origin"]["x"] - after["origin"]["x"] == pytest.approx(
        before["rect"]["width"] / 8, abs=1
    )
    assert before["origin"]["y"] > after["origin"]["y"]
    # Without a pointer, the values are those of the middle.
    assert "pixel" in page.locator("#readout").text_content()
    press(page, "0")
    assert panels(page)[0]["zoom"] == fit


def test_values_under_the_cursor_are_the_linear_ones(built, visit):
    page = visit(at(spp=8, method="denoised", exposure=4))
    box, panel = page.locator("#stage").bounding_box(), panels(page)[0]
    x = box["x"] + panel["origin"]["x"] + 3.5 * panel["zoom"]
    y = box["y"] + panel["origin"]["y"] + 2.5 * panel["zoom"]
    page.mouse.move(x, y)
    values = [float(v) for v in page.locator(".label .values").text_content().split()]
    np.testing.assert_allclose(values, built.run.images[SCENE, 8, "denoised"][2, 3], atol=6e-3)


def test_state_comes_back_on_reload(built, visit):
    page = visit()
    page.locator("#scene").select_option(label=SCENE)
    page.locator("#spp").select_option("8")
    page.locator("#stage").focus()
    press(page, "3", "e", "+", "+", "ArrowLeft", "d")
    before, panel = state_of(page), panels(page)
    assert before["scene"] == SCENE
    assert before["method"] == METHODS[2]
    assert before["spp"] == "8"
    assert before["exposure"] == "0.5"
    colors = shown(page)
    page.reload()
    settle(page)
    assert panels(page) == panel
    np.testing.assert_array_equal(shown(page), colors)
    assert np.isfinite(colors).any()
    assert state_of(page) == before
    assert page.evaluate("document.documentElement.dataset.scheme") == "dark"
    # Whatever a link says, something is shown.
    page.goto(f"{built.url}#scene=none&spp=7&method=x&zoom=-1&hide=a&view=cellar&metric=y")
    page.reload()
    settle(page)
    assert panels(page)


def test_odd_names_are_text(visit):
    page = visit(at())
    assert page.title() == page.locator("h1").text_content() == "<i>odd</i> & title"
    assert SCENE in page.locator("#scene option").all_text_contents()
    press(page, "p")
    assert SCENE in page.locator("#scene-plots h3").all_text_contents()
    press(page, "a")
    assert SCENE in page.locator("tbody td:first-child").all_text_contents()
    assert page.locator("main b, h1 i").count() == 0


def test_tables_sort_by_click_and_key(built, visit):
    page = visit(at("tables"))
    head = page.locator('th:has([data-column="rmse"])')

    def column():
        cells = page.locator("tbody td:nth-child(4)").all_text_contents()
        return [float(cell) for cell in cells]

    assert sorted(column()) == pytest.approx(
        sorted(e["rmse"] for e in built.run.errors.values()), abs=6e-3
    )
    page.locator('[data-column="rmse"]').click()
    settle(page)
    assert head.get_attribute("aria-sort") == "ascending"
    assert column() == sorted(column())
    press(page, "Enter")
    assert head.get_attribute("aria-sort") == "descending"
    assert column() == sorted(column(), reverse=True)
    press(page, "2")
    assert "denoised" not in {
        c.strip() for c in page.locator("tbody td:nth-child(3)").all_text_contents()
    }
    assert len(column()) == len(SCENES) * len(SPPS) * 2


def test_csv_holds_the_table_in_full(built, visit):
    import csv

    page = visit(at("tables"))
    with page.expect_download() as download:
        page.locator("#csv").click()
    text = Path(download.value.path()).read_text("utf-8")
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == len(built.run.errors)
    for row in rows:
        errors = built.run.errors[row["scene"], int(row["spp"]), row["method"]]
        assert float(row["RMSE"]) == errors["rmse"]
        assert float(row["1 − SSIM"]) == 1 - errors["ssim"]


def test_means_and_intervals_are_those_of_scipy(built, visit):
    page = visit(at("tables", rows="methods", metric="rmse", baseline="denoised"))
    cells = [
        [c.strip() for c in row.locator("td").all_text_contents()]
        for row in page.locator("tbody tr").all()
    ]
    assert len(cells) == len(SPPS) * len(METHODS)
    for spp, method, count, *numbers in cells:
        of = [built.run.errors[s, int(spp), method]["rmse"] for s in SCENES]
        base = [built.run.errors[s, int(spp), "denoised"]["rmse"] for s in SCENES]
        logs = np.log(np.divide(of, base))
        low = high = 0.0
        if method != "denoised":
            low, high = stats.t.interval(0.95, len(logs) - 1, logs.mean(), stats.sem(logs))
        known = [stats.gmean(of), *np.exp([logs.mean(), low, high])]
        assert count == str(len(SCENES))
        assert [float(n) for n in numbers] == pytest.approx(known, abs=6e-3, rel=6e-3)


def test_convergence_plots_show_what_is_switched_on(built, visit):
    page = visit(at("plots"))
    assert page.locator("#scene-plots figure").count() == len(SCENES)
    assert page.locator("#mean-plot .curve").count() == len(METHODS)
    titles = page.locator("#mean-plot .curve[data-method=denoised] title").all_text_contents()
    means = [
        stats.gmean([built.run.errors[s, n, "denoised"]["rmse"] for s in SCENES]) for n in SPPS
    ]
    shown = [float(title.rpartition(" ")[2]) for title in titles]
    assert shown == pytest.approx(means, abs=6e-3)
    page.locator(".chip", has_text="denoised").click()
    settle(page)
    assert page.locator("#mean-plot .curve").count() == len(METHODS) - 1
    page.locator("#baseline").select_option(label="render")
    settle(page)
    titles = page.locator("#mean-plot .curve[data-method=render] title").all_text_contents()
    assert all(": 1.00" in title for title in titles)
    assert page.locator("#mean-plot .baseline").count() == 1
    page.locator("#metric").select_option("mse")
    settle(page)
    assert page.locator("#mean-plot .curve").count() == len(METHODS) - 1


def test_schemes_follow_the_system_and_the_switch(visit):
    def paper(page):
        return page.evaluate("getComputedStyle(document.documentElement).backgroundColor")

    page = visit(at("tables"), color_scheme="dark")
    dark = paper(page)
    page.emulate_media(color_scheme="light")
    settle(page)
    light = paper(page)
    assert (dark, light) == ("rgb(23, 24, 27)", "rgb(255, 255, 255)")
    page.locator("#scheme").click()
    settle(page)
    assert paper(page) == dark
    assert state_of(page)["scheme"] == "dark"


def test_everything_can_be_reached_by_tab_and_help_opens(visit):
    page = visit(at())
    reached = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
    wanted = {"tab-images", "scheme", "help-open", "chip", "scene", "spp", "map", "tone", "stage"}
    assert wanted | {"exposure", "layout-side", "zoom-in", "zoom-fit"} <= reached
    page.locator("#stage").focus()
    press(page, "?")
    assert page.locator("#help").is_visible()
    assert page.locator("#help dt").count() > 10
    before = state_of(page)
    press(page, "2")
    press(page, "Escape")
    assert not page.locator("#help").is_visible()
    assert state_of(page) == before
    unnamed = page.evaluate(
        "[...document.querySelectorAll('button, select, input')].filter((e) =>"
        " !(e.textContent.trim() || e.ariaLabel || e.labels?.length)).map((e) => e.outerHTML)"
    )
    assert unnamed == []


def test_narrow_screens_need_no_sideways_scrolling(visit):
    page = visit(at(layout="side"))
    page.set_viewport_size({"width": 400, "height": 800})
    for key in "ipa":
        press(page, key)
        assert page.evaluate("document.documentElement.scrollWidth") <= 400


def test_halves_decode_as_they_were(visit):
    """Every half float there is, through the page's own decoder."""
    import base64

    from progden_jax.report.images import encode

    bits = np.arange(65536, dtype="u2").reshape(128, -1, 1)
    text = base64.b64encode(encode(bits.view("f2"))).decode()
    page = visit()
    got = page.evaluate(
        """async (text) => {
          const halves = await progden.images.decode(text, 65536, 1);
          return [halves.join(), progden.images.floats.join()];
        }""",
        text,
    )
    bits = bits.ravel()
    np.testing.assert_array_equal(np.array(got[0].split(","), "u2"), bits)
    np.testing.assert_array_equal(np.array(got[1].split(","), "f4"), bits.view("f2").astype("f4"))


def test_images_that_are_lost_are_told(built, visit, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(Path(built.url.removeprefix("file://")).parent, folder)
    for path in (folder / "images").iterdir():
        path.unlink()
    page = built.browser.new_page()
    page.goto((folder / "index.html").as_uri())
    settle(page)
    assert "missing or damaged" in page.locator(".label .status").text_content()
    page.close()


def test_a_report_without_images_opens_with_its_plots(built, visit, tmp_path):
    build_report(built.run.folder, tmp_path / "site", images=False)
    page = built.browser.new_page()
    page.goto((tmp_path / "site" / "index.html").as_uri())
    settle(page)
    assert page.locator("#mean-plot .curve").count() == len(METHODS)
    assert page.locator("#tab-images").is_disabled()
    page.close()
