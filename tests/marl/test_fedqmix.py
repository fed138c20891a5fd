"""`python -m marl.fedqmix`, as a user runs it."""

import csv
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time

import pytest

from marl.checkpoint import load_checkpoint
from marl.settings import settings_of
from radiotwin.runtime import cuda
from tests.command_line import run_planning

SMALL = ("--truth segmented --real-episodes 2 --episodes 20 --batch 8 --replay 20 --flights 4 --selection-flights 8 "
         "--planner-iterations 100 ")


@pytest.fixture(scope="module")
def scene_option(small_scene):
    return f"--scene {shlex.quote(str(small_scene.folder))} "


def start(words, cwd):
    return subprocess.Popen([sys.executable, "-m", "marl.fedqmix", *shlex.split(words)], cwd=cwd,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            env=os.environ | {"COLUMNS": "120"})


def run(words, cwd):
    process = start(words, cwd)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def metrics(path):
    with path.open() as file:
        return [{name: value for name, value in row.items() if not name.endswith("_s")} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def unbroken(scene_option, tmp_path_factory):
    """The folder of a whole run, and what it printed."""
    folder = tmp_path_factory.mktemp("unbroken")
    status, out, err = run(scene_option + SMALL + "--compare truth --out result", folder)
    assert status == 0, err
    return folder / "result", out


def test_a_whole_run_writes_everything_and_ends_in_the_table(unbroken):
    folder, out = unbroken
    first, last = out.split("Collected in the truth")
    # What needs no training is told first, after one real flight; then the run itself; then the table.
    assert [line.split(",")[0] for line in first.splitlines()[:5]] == [
        "greedy", "heuristic", "planner in the NN twin", "fedqmix in the NN twin", "qmix in the log-distance twin"]
    lines = [line for line in last.splitlines() if line.strip().startswith(("fedqmix", "qmix", "planner", "heuristic", "greedy",
                                                                               "random"))]
    assert [line.split()[:2] for line in lines] == [["fedqmix", "NN"], ["qmix", "log-distance"], ["qmix", "the"],
                                                    ["planner", "NN"], ["heuristic", "2"], ["greedy", "2"], ["random", "0"]]
    # Trained in the truth, every episode is a real one, and so are three looks at the policy.
    assert lines[2].split()[3:8] == ["0", "+", "40", "+", str(3 * 8)]
    for name in ("config.json", "metrics.csv", "checkpoint.safetensors", "comparison.csv", "curve.png", "trajectories.png",
                 "flight.gif", "flights.csv", "twin/twin.json", "compare/truth/metrics.csv"):
        assert (folder / name).is_file(), name
    assert list((folder / "tensorboard").iterdir())
    config = json.loads((folder / "config.json").read_text())
    assert config["run"]["real_episodes"] == 2 and config["learner"]["batch"] == 8
    with (folder / "comparison.csv").open() as file:
        ratios = {(row["method"], row["trained_in"]): float(row["truth_ratio"]) for row in csv.DictReader(file)}
    assert all(0 < ratio <= 1 for ratio in ratios.values()), ratios
    assert ratios["planner", "NN twin"] > ratios["random", ""]


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_result_bit_for_bit(unbroken, scene_option, tmp_path):
    words = scene_option + SMALL + "--compare none "
    process = start(words + "--out killed", tmp_path)
    checkpoint = tmp_path / "killed" / "checkpoint.safetensors"
    for _ in range(1200):
        if checkpoint.exists() or process.poll() is not None:
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL and len(load_checkpoint(checkpoint)["rows"]) < 2
    status, _, err = run(words + "--out killed --resume", tmp_path)
    assert status == 0, err
    killed, whole = tmp_path / "killed", unbroken[0]
    assert metrics(killed / "metrics.csv") == metrics(whole / "metrics.csv")
    ends = [load_checkpoint(folder / "checkpoint.safetensors") for folder in (killed, whole)]
    for one, other in zip(*(flat(end["strategy"]) for end in ends), strict=True):
        assert one == other
    for name in ("trajectories.png", "flights.csv", "twin/twin.json"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()
    status, _, err = run(words + "--out killed --resume --learning-rate 0.1", tmp_path)
    assert status == 2 and "--learning-rate 0.1" in err and "0.002" in err
    status, _, err = run(words + "--out killed", tmp_path)
    assert status == 2 and "--resume" in err


@pytest.mark.slow
def test_a_learner_may_train_in_a_twin_that_follows_paths(small_scene, tmp_path):
    scene = shutil.copytree(small_scene.folder, tmp_path / "scene") / "scene.toml"
    text = scene.read_text()
    unknown = text.count('"unknown"')
    scene.write_text(text.replace('"unknown"', '"anchor"', unknown - 1))  # to look for each takes seconds
    status, out, err = run("--scene scene " + SMALL + "--real-episodes 1 --twin paths --compare none "
                           "--algorithm qmix --out result", tmp_path)
    assert status == 0, err
    twin = json.loads((tmp_path / "result" / "twin" / "twin.json").read_text())
    assert twin["channel"]["model"] == "paths" and len(twin["provenance"]["flights"]) == 1
    assert all(0 < float(row["truth_ratio"]) <= 1 for row in metrics(tmp_path / "result" / "metrics.csv"))


def flat(value):
    """All numbers of a nested state as texts of their bytes."""
    if isinstance(value, dict):
        return [item for name in value for item in (str(name), *flat(value[name]))]
    if isinstance(value, list):
        return [item for each in value for item in flat(each)]
    return [value.tobytes() if hasattr(value, "tobytes") else value.numpy().tobytes() if hasattr(value, "numpy")
            else repr(value)]


@pytest.mark.parametrize("words, parts", [
    ("--scene nowhere", ["nowhere", "radiotwin build-scene"]),
    ("--episodes 0", ["--episodes 0", "≥ 1"]),
    ("--compare true", ["--compare true", "none|twins|truth"]),
    ("--twin magic", ["--twin magic", "nn|log-distance|kriging|paths|path_kriging|truth"]),
    ("--algorithm magic", ["--algorithm magic", "fedqmix|qmix|iql|greedy|heuristic|policy|planner|belief|random"]),
    ("--fly-again true", ["No such option: --fly-again"]),
    ("--batch 64 --replay 32", ["replay 32", "64"]),
    pytest.param("--device cuda", ["--device cuda: ", "radiotwin doctor"], marks=pytest.mark.skipif(
        cuda.torch_refusal() is None, reason="there is a GPU")),
    ("--device tpu", ["--device tpu", "auto|cpu|cuda"]),
    ("--out result --resume", ["nothing to resume"])])
def test_bad_input_is_one_message_and_leaves_nothing(words, parts, small_scene, tmp_path):
    given = words if "--scene" in words else f"--scene {shlex.quote(str(small_scene.folder))} --truth segmented {words}"
    done = run_planning(shlex.split(given), tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr and not done.stdout
    assert all(part in done.stderr for part in parts), done.stderr
    assert not list(tmp_path.iterdir())


def test_the_preset_paper_measures_and_trains_as_the_paper_does_unless_options_differ():
    run, learner = settings_of({"preset": "paper"})
    assert (run.real_episodes, run.episodes) == (30, 1000)
    assert (run.first_flight, run.measure, run.twin_shadowing) == ("random", "policy", "slot")
    assert learner.excursion_slots == 1 and learner.td_lambda == 0
    run, _ = settings_of({"preset": "paper", "first_flight": "waypoints"})
    assert (run.first_flight, run.measure, run.twin_shadowing) == ("waypoints", "policy", "slot")
    run, _ = settings_of({})
    assert (run.real_episodes, run.first_flight, run.measure) == (10, "waypoints", "waypoints")
    assert run.twin_shadowing == "fitted"
