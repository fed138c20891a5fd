"""The tutorials' commands and programs run as they are written, and end in what the pages say."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest

from radiotwin.geo import to_local
from radiotwin.scene import Scene
from tests.walk import ROOT, commands, fences, page, run, run_program, table

TUTORIAL, LEARNING, PLANNERS = page("tutorial.md"), page("tutorial-learning.md"), page("tutorial-planners.md")
BUILDING = {"x_m": 59.4, "y_m": 0.3, "length_m": 34.0, "width_m": 36.0, "height_m": 38.0}  # of examples/campaign/make.py
BUILD, *TRAIN = commands(LEARNING)


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


def out_of(command):
    return command[command.index("--out") + 1]


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """A folder with the scene and the run in the truth, which needs no twin and so the least time."""
    folder = tmp_path_factory.mktemp("learning")
    run(BUILD, folder)
    in_truth, = (each for each in TRAIN if out_of(each) == "runs/truth")
    run(in_truth, folder)
    return folder


@pytest.mark.slow
def test_the_run_in_the_truth_ends_where_the_page_says(learnt):
    last = pd.read_csv(learnt / "runs/truth/metrics.csv").iloc[-1]
    real, share = re.search(r"After ([\d,]+) of them it collects ([\d.]+)", LEARNING).groups()
    assert last["real_episodes"] == int(real.replace(",", ""))
    assert last["truth_ratio"] == pytest.approx(float(share), abs=0.05)  # another machine rounds otherwise


def test_programs_are_whole():
    for program in fences(LEARNING, "python"):
        compile(program, "program", "exec")
    assert [out_of(each) for each in TRAIN] == ["runs/qmix", "runs/fedqmix", "runs/truth", "runs/short"]


@pytest.mark.slow
def test_what_is_learnt_in_a_twin(learnt):
    shutil.copytree(learnt / "town", learnt / "short")
    scene = learnt / "short" / "scene.toml"
    scene.write_text(re.sub(r"^battery = .*", "battery = 20.0", scene.read_text(), flags=re.MULTILINE))
    for each in TRAIN:
        if out_of(each) != "runs/truth":
            run(each, learnt)
    found = pd.read_csv(learnt / "runs/qmix/comparison.csv").set_index("method")["truth_ratio"]
    for name, _, _, share, *_ in table(LEARNING, "## 1. Train in a twin"):
        assert found[name] == pytest.approx(float(share), abs=0.05), name
    said = [run_program(program, learnt) for program in fences(LEARNING, "python")][-1]
    assert (learnt / "figure.png").stat().st_size > 10_000
    of_d3 = dict(re.findall(r"^(\w+): (\d+)% of the data of d3", said, re.MULTILINE))
    assert int(of_d3["urgent"]) > int(of_d3["qmix"])


@pytest.mark.slow
def test_plans_collect_the_shares_of_the_page(tmp_path):
    folder = shutil.copytree(ROOT / "examples" / "campaign", tmp_path / "harvest")
    said = {each[1]: run(each, folder) for each in commands(PLANNERS)}
    printed = run_program("\n".join(fences(PLANNERS, "python")), folder)
    assert list(said) == ["build-scene", "survey", "fit", "coverage", "report"]
    assert "2 flights, 1776 links to 8 devices (3 anchors)" in said["survey"] and "1,776" in PLANNERS
    for path in ("coverage/received_power.png", "coverage/best_server.png", "twin/report.html"):
        assert (folder / path).stat().st_size > 10_000
    collected = {name: int(share) for name, share in re.findall(r"^(.*): (\d+)% collected$", printed, re.MULTILINE)}
    told = {name: int(share.removesuffix(" %")) for name, share in table(PLANNERS, "python plan.py")}
    assert list(told) == list(collected)
    for name, share in told.items():
        assert abs(collected[name] - share) <= 2, name
    assert collected["plan made in the twin"] > collected["greedy: to the nearest device"] > collected["random"]
    assert pd.read_csv(folder / "flight.csv")["uav"].nunique() == 3
