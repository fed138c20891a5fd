"""The page in a real browser: it shows the run's own numbers, and its controls move what they say."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from radiotwin.report import Run, read_run, write_report
from radiotwin.report.viewer_data import marks

BUTTONS = ("oblique", "above")


@pytest.fixture(scope="module")
def run(run_folder):
    return read_run(run_folder)


@pytest.fixture(scope="module")
def path(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(run, path)
    return path


def choose(page, control, label):
    page.select_option(f"#control-{control}", label=label)


def shown_db(page):
    """Levels of the slice as the page has them; None where nothing is detected."""
    return np.array(page.evaluate("levelsOf(view())"), dtype=float)


def test_each_device_and_altitude_shows_its_own_map(opened, run, path, pixels, tmp_path):
    page, truth = opened(path), run.maps["truth"]
    pictures = []
    for device, z in (("d0", 0), ("d3", 0), ("d3", 1)):
        choose(page, "view", "truth: gain")
        choose(page, "device", device)
        choose(page, "altitude", f"{truth.lattice.z_m[z]:g} m")
        expected_db = truth.gain_db[truth.devices.index(device), z].ravel()
        assert 0 < np.isnan(expected_db).sum() < len(expected_db)
        np.testing.assert_allclose(shown_db(page), expected_db, atol=0.006)
        cells = page.evaluate("[...stage.slice.material.uniforms.cells.value.image.data]")
        opacity = np.array(cells).reshape(-1, 4)[:, 3]
        np.testing.assert_array_equal(opacity > 0, np.isfinite(expected_db))
        pictures.append(pixels(page))
    for one, other in zip(pictures, pictures[1:]):
        assert (np.abs(one - other).max(axis=-1) > 20).mean() > 0.02, "the picture changes with the selectors"
    picture = tmp_path / "report.png"
    page.screenshot(path=picture, full_page=True)
    assert picture.stat().st_size > 20_000


def test_line_of_sight_and_the_error_are_shown(opened, run, path):
    page, truth, twin = opened(path), run.maps["truth"], run.maps["twin"]
    choose(page, "view", "truth: line of sight")
    choose(page, "device", "d5")
    np.testing.assert_array_equal(shown_db(page), truth.los[truth.devices.index("d5"), 0].ravel())
    choose(page, "view", "twin: error (model − truth)")
    assert page.evaluate("control('device').selectedOptions[0].text") == "d5", "a chosen device stays chosen"
    error_db = (twin.gain_db[twin.devices.index("d5"), 0] - truth.gain_db[truth.devices.index("d5"), 0]).ravel()
    np.testing.assert_allclose(shown_db(page), error_db, atol=0.02)


def test_the_slider_moves_the_uavs(opened, run, path, pixels):
    page = opened(path)
    tracks = run.tracks
    second = tracks[tracks["flight"] == "f1"]
    start_s, end_s = second["time_s"].min(), second["time_s"].max()
    choose(page, "flight", "f1")
    pictures = []
    for share in (0.0, 0.31, 1.0):
        time_s = share * (end_s - start_s)
        page.evaluate("time => { control('time').value = time; control('time').oninput(); }", time_s)
        time_s = page.evaluate("chosen('time')")  # the slider has a thousand steps
        for uav in page.evaluate("uavsNow()"):
            track = second[second["uav"] == uav["name"]]
            expected_m = [np.interp(start_s + time_s, track["time_s"], track[f"{axis}_m"]) for axis in "xyz"]
            np.testing.assert_allclose(uav["position"], expected_m, atol=0.01)
        pictures.append(pixels(page))
    assert page.inner_text("#control-clock") == f"{end_s - start_s:.0f} of {end_s - start_s:.0f} s"
    for one, other in zip(pictures, pictures[1:]):
        assert (np.abs(one - other).max(axis=-1) > 20).sum() > 100
    page.click("#control-play")
    for _ in range(100):
        page.wait_for_timeout(50)
        time_s = page.evaluate("chosen('time')")
        if time_s > 0:
            break
    assert 0 < time_s < end_s - start_s


def test_the_city_turns_and_zooms(opened, path, pixels):
    page = opened(path)
    before = pixels(page)
    box = page.locator("#viewer").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 120, middle[1] + 30, steps=3)
    page.mouse.up()
    turned = pixels(page)
    far_m = page.evaluate("stage.far")
    page.mouse.wheel(0, 300)  # scrolls the page
    page.wait_for_timeout(300)
    assert page.evaluate("[stage.far, scrollY > 0]") == [far_m, True]
    page.evaluate("scrollTo(0, 0)")
    page.keyboard.down("Control")
    page.mouse.wheel(0, -400)
    page.keyboard.up("Control")
    for _ in range(100):
        page.wait_for_timeout(50)
        if page.evaluate("stage.far") < 0.9 * far_m:
            break
    assert page.evaluate("stage.far") < 0.9 * far_m
    assert (np.abs(turned - before).max(axis=-1) > 20).mean() > 0.1
    assert (np.abs(pixels(page) - turned).max(axis=-1) > 20).mean() > 0.1
    for button in BUTTONS:
        page.click(f"#control-{button}")
        pixels(page)  # once it is drawn
        corners = page.evaluate("(([x0, x1, y0, y1]) => [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]"
                                ".map(([x, y]) => stage.pixel(x, y, 0)))(data.bounds)")
        assert ((np.array(corners) > 0) & (corners < np.array([box["width"], box["height"]]))).all(), "all is in view"
        assert np.ptp(corners, axis=0).max() > 0.5 * box["height"], "and fills it"
    page.mouse.move(*middle)
    text = page.inner_text("#control-hover")
    assert "m: " in text and ("dB" in text or "not detected" in text)
    page.uncheck("#control-buildings")
    assert page.evaluate("stage.city.visible") is False
    assert page.evaluate("stage.renderer.context.getContextAttributes().antialias") is False
    assert page.evaluate("stage.renderer.getPixelRatio()") == 1, "no more than needed without a graphics card"


def test_a_click_on_a_link_tells_its_levels(opened, tmp_path):
    links = pd.DataFrame({f"{end}_{axis}_m": [0.0, 80.0] if end == "receiver" else 40.0
                          for end in ("receiver", "device") for axis in "xyz"})
    links = links.assign(time_s=[5.0, 9.0], flight=["f0", "f1"], receiver="u", device="a", los=1, before_db=[4.0, -2.0],
                         after_db=[1.0, -1.0], measured_db=[-70.0, -80.0])
    tracks = links.rename(columns={"receiver": "uav"} | {f"receiver_{axis}_m": f"{axis}_m" for axis in "xyz"})
    write_report(Run(tmp_path, residuals=links, tracks=tracks), tmp_path / "page.html")
    page = opened(tmp_path / "page.html")
    choose(page, "view", "held-out residual: after")
    page.locator("#viewer").scroll_into_view_if_needed()
    box, at = page.locator("#viewer").bounding_box(), page.evaluate("stage.pixel(0, 0, 0)")
    page.mouse.click(box["x"] + at[0], box["y"] + at[1])
    assert page.inner_text("#control-hover") == "a, f0, 0 s, LoS: measured −70.0, predicted −71.0 (90 %: −71.9 to −70.1) dB"
    assert page.evaluate("linksOf(view())") == [0, 1]
    page.check("#control-only")
    assert page.evaluate("linksOf(view())") == [0], "of the chosen flight"
    page.evaluate("data.links.paths = {link: [4, 0], end: [2, 5], points: Float32Array.from({length: 15}, (_, n) => n)}")
    assert page.evaluate("pathsOf(0)") == [[[6, 7, 8], [9, 10, 11], [12, 13, 14]]]


def test_keys_turn_and_zoom_and_print_has_the_picture(opened, path):
    page = opened(path)
    page.focus("#viewer")
    turn, far_m = page.evaluate("[stage.turn, stage.far]")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("+")
    assert page.evaluate("stage.turn") < turn and page.evaluate("stage.far") < far_m
    ticks = [float(text.replace("−", "-")) for text in page.locator("#control-colours span").all_inner_texts()]
    assert len(ticks) >= 3 and ticks == sorted(ticks)
    page.pdf()
    assert page.evaluate("document.querySelector('.printed').naturalWidth") > 100


@pytest.mark.parametrize("width", [375, 1280])
def test_nothing_is_wider_than_the_page(opened, path, width):
    page = opened(path)
    page.set_viewport_size({"width": width, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.emulate_media(color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 25, 30)"


@pytest.mark.parametrize("is_true_known", [True, False])
def test_orange_circles_are_explained_where_true_positions_are_drawn(run, is_true_known):
    said = " ".join(marks(run if is_true_known else replace(run, scene=None)))
    assert ("Orange circles" in said) == is_true_known
    assert "Diamonds" in said and "Red crosses" in said
