"""The folder of a small run, and a real browser."""

import shutil

import numpy as np
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.scene import Scene
from radiotwin.twin import fit_twin

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Software rendering: machines that run tests have no screen and no graphics card.
OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.fixture(scope="session")
def run_folder(small_scene, tmp_path_factory):
    """Scene, truth with places where nothing is detected, a survey, and a twin, as `radiotwin demo` leaves them."""
    folder = tmp_path_factory.mktemp("report") / "run"
    shutil.copytree(small_scene.folder, folder / "scene")
    scene = Scene.load(folder / "scene")
    truth = segmented_truth(scene)
    dataset = truth.dataset.copy(deep=True)
    dataset["gain_db"] = dataset["gain_db"].where(dataset["gain_db"] > -100.0)
    RadioMap(dataset).save(folder / "scene" / "truth.nc")
    measurements = fly_survey(scene, truth, flights=2, pattern="random-waypoint", seed=0, noise_db=0.0)
    measurements.save(folder / "survey" / "measurements.csv.gz")
    fit_twin(measurements, scene, model="log_distance", seed=0).save(folder / "twin")
    return folder


@pytest.fixture(scope="session")
def browser():
    """Chromium without a window; skips with the reason where there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    with api.sync_playwright() as playwright:
        try:
            chromium = playwright.chromium.launch(executable_path=program, args=OPTIONS)
        except api.Error as error:
            pytest.skip(f"no Chromium that starts ({str(error).splitlines()[0]}); install one, for example with "
                        "`playwright install chromium`")
        yield chromium
        chromium.close()


@pytest.fixture
def opened_raw(browser):
    """`opened_raw(path)` is the page of a file, and what it complained of or asked for."""
    pages = []

    def open_page(path):
        page, wrong = browser.new_page(viewport={"width": 720, "height": 560}), []
        page.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: wrong.append(request.url[:200]) if request.url != path.as_uri()
                and not request.url.startswith("data:image/png") else None)
        page.on("dialog", lambda dialog: wrong.append(dialog.message))
        page.set_default_timeout(120_000)  # machines that run tests may be busy
        pages.append(page)
        page.goto(path.as_uri())
        return page, wrong

    yield open_page
    for page in pages:
        page.close()


@pytest.fixture
def opened(opened_raw):
    """`opened(path)` is the page of a file, once the picture stands; it must not complain or fetch anything."""
    every = []

    def open_page(path):
        page, wrong = opened_raw(path)
        every.append(wrong)
        page.wait_for_selector("body[data-ready-ms]")
        return page

    yield open_page
    assert not any(every)


@pytest.fixture(scope="session")
def pixels():
    """`pixels(page)` is what the viewer shows, (height, width, 3)."""
    from io import BytesIO

    from PIL import Image

    def shot(page):
        page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return np.array(Image.open(BytesIO(page.locator("#viewer").screenshot())).convert("RGB")).astype(int)
    return shot
