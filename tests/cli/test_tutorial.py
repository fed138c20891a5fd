"""The tutorial's commands run as they are written, and end in what it says."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest

from radiotwin.geo import to_local
from radiotwin.scene import Scene
from tests.walk import ROOT, commands, fences, page, run

TUTORIAL = page("tutorial.md")
BUILDING = {"x_m": 59.4, "y_m": 0.3, "length_m": 34.0, "width_m": 36.0, "height_m": 38.0}  # of examples/campaign/make.py


def until_the_loop(page):
    return [each for each in commands(page)[:4] if each[1] != "close-loop"]


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A copy of the campaign after the first commands of the tutorial, and what they printed."""
    folder = tmp_path_factory.mktemp("tutorial") / "try"
    shutil.copytree(ROOT / "examples" / "campaign", folder)
    return folder, [run(arguments, folder) for arguments in until_the_loop(TUTORIAL)]


def test_the_first_commands_make_a_scene_measurements_and_a_twin(walked):
    folder, said = walked
    assert [each[1] for each in until_the_loop(TUTORIAL)] == ["build-scene", "import", "fit", "map"]
    assert "39 buildings" in TUTORIAL and "height tag: 39" in said[0]
    assert "3,600 readings" in TUTORIAL and "3600 links, 271 not detected" in said[1]
    assert (folder / "level.png").stat().st_size > 10_000
    devices = json.loads((folder / "twin" / "twin.json").read_text())["devices"]
    assert _error_m(folder, devices, "n5") < 5


def test_the_settings_shown_are_those_of_the_file():
    shown, = fences(TUTORIAL, "toml")
    file = (ROOT / "examples" / "campaign" / "log.toml").read_text(encoding="utf-8")
    assert [line.split("#")[0].strip() for line in shown.splitlines()] == \
        [line.split("#")[0].strip() for line in file.splitlines() if not line.startswith("#")]


def test_the_readme_has_the_same_commands():
    readme = commands((ROOT / "README.md").read_text(encoding="utf-8"))
    missing = [each for each in commands(TUTORIAL) if each not in readme]
    assert {each[1] for each in missing} <= {"close-loop", "map"}


@pytest.mark.slow
def test_the_missing_building_and_the_node_beside_it_are_found(walked):
    folder, _ = walked
    for arguments in commands(TUTORIAL)[4:]:
        run(arguments, folder)
    loop = json.loads((folder / "loop" / "closeloop.json").read_text())
    found = [each for each in loop["effects"] if each["name"] == "missing_obstacle"]
    assert len(found) == 1 and found[0]["probability"] > 0.5
    for name, true in BUILDING.items():
        each = found[0]["parameters"][name]
        assert abs(each["value"] - true) < 6 and each["low"] - 1 < true < each["high"] + 1, name
    residuals = pd.read_csv(folder / "loop" / "residuals.csv.gz")[["before_db", "after_db"]].dropna()
    before_db, after_db = np.sqrt((residuals**2).mean())
    assert after_db < 0.65 * before_db
    for text in (TUTORIAL, (ROOT / "README.md").read_text(encoding="utf-8")):  # of the same readings
        told = re.search(r"([\d.]+) (?:→|to) ([\d.]+) dB", text)
        assert [float(each) for each in told.groups()] == pytest.approx([before_db, after_db], abs=0.15)
        assert f"same {len(residuals):,} readings" in text
    devices = json.loads((folder / "loop" / "twin" / "twin.json").read_text())["devices"]
    assert _error_m(folder, devices, "n6") < 3
    assert (folder / "corrected.tif").is_file() and (folder / "corrected" / "scene.toml").is_file()
    assert (folder / "loop" / "report.html").is_file()


def _error_m(folder, devices, name):
    """Return how far a device is from where it is [m]."""
    truth = pd.read_csv(folder / "truth.csv").set_index("device").loc[name]
    true_m = to_local(Scene.load(folder / "town").config.origin, truth["longitude"], truth["latitude"])
    found, = (each for each in devices if each["device"] == name)
    return float(np.hypot(found["x_m"] - true_m[0], found["y_m"] - true_m[1]))
