"""`python -m marl.experiments`, as a user runs it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from marl.checkpoint import load_checkpoint
from marl.experiments.__main__ import main
from marl.experiments.records import Run
from marl.experiments.work import _claimed

TINY = ["--set", "episodes=40", "--set", "real_episodes=2", "--set", "batch=8", "--set", "replay=40", "--set",
        "flights=4", "--set", "selection_flights=4", "--set", "planner_iterations=200", "--set", "federate_every=20"]


@pytest.fixture(scope="module")
def curve(small_scene):
    """Options of a small study of curves."""
    return ["curve", "--seeds", "1", "--scenes", str(small_scene.folder), *TINY]


def start(words, cwd):
    return subprocess.Popen([sys.executable, "-m", "marl.experiments", *words], cwd=cwd, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, env=os.environ | {"COLUMNS": "120"})


def run(words, cwd):
    process = start(words, cwd)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def content(path):
    """A record without times."""
    record = json.loads(path.read_text())
    for name in ("cpu_s", "wall_s"):
        assert record.pop(name) >= 0
    record["curve"] = [{name: value for name, value in row.items() if not name.endswith("_s")}
                       for row in record["curve"]]
    return record


def test_a_study_writes_a_record_for_each_run_and_its_table_and_figure(curve, tmp_path, capsys):
    words = [*curve, "--only", "segmented-fedqmix,segmented-iql,segmented-greedy"]
    status, out, err = run([*words, "--jobs", "2", "--out", "results"], tmp_path)
    assert status == 0, err
    folder = tmp_path / "results"
    names = {"fedqmix-nn", "iql-truth", "greedy"}
    assert {path.name for path in (folder / "curve").iterdir()} == {f"small-segmented-{name}-s0.json" for name in names}
    assert out.count("CPU s") == len(names)
    record = json.loads((folder / "curve" / "small-segmented-fedqmix-nn-s0.json").read_text())
    assert [row["real_episodes"] for row in record["curve"]] == [1, 2]
    assert record["settings"]["run"]["episodes"] == 40 and record["settings"]["learner"]["federate_every"] == 20
    assert record["version"] and len(record["code"]) == 12 and record["cpu_s"] > 0 and record["seed"] == 0
    assert [look[:2] for look in record["looks"]] == [[1, 20], [1, 40], [2, 60], [2, 80]]
    assert 0 < record["curve"][-1]["truth_ratio"] <= 1
    table = (folder / "curve.md").read_text()
    assert f"| model-aided FedQMIX | 2 | {record['curve'][-1]['truth_ratio']:.3f} |" in table
    assert (folder / "figures" / "curve.png").stat().st_size > 10_000
    assert main([*words, "--out", str(folder)]) == 2
    err = capsys.readouterr().err
    assert f"{len(names)} finished runs" in err and "--resume" in err


def test_a_killed_study_goes_on_and_repeats_nothing(curve, tmp_path, capsys):
    words = [*curve, "--only", "segmented-iql,segmented-greedy,segmented-planner", "--set", "real_episodes=3"]
    assert main([*words, "--out", str(tmp_path / "unbroken")]) == 0
    process = start([*words, "--out", "killed"], tmp_path)
    folder = tmp_path / "killed" / "curve"
    checkpoint = folder / "unfinished" / "small-segmented-planner-nn-s0" / "checkpoint.pt"
    seconds = checkpoint.parent / "seconds"
    while process.poll() is None and not seconds.exists():  # the learner is done, the planner has flown
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    rounds = len(load_checkpoint(checkpoint)["rows"])
    finished = folder / "small-segmented-iql-truth-s0.json"
    before = finished.stat().st_mtime_ns
    kept_s = float(seconds.read_text().split()[1])
    capsys.readouterr()
    assert main([*words, "--resume", "--out", str(tmp_path / "killed")]) == 0
    out = capsys.readouterr().out
    assert 1 <= rounds <= 3 and finished.stat().st_mtime_ns == before and "iql" not in out
    assert json.loads((folder / "small-segmented-planner-nn-s0.json").read_text())["wall_s"] >= round(kept_s, 1)
    for path in sorted((tmp_path / "unbroken" / "curve").iterdir()):
        assert content(folder / path.name) == content(path)
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        path.name for path in (tmp_path / "unbroken" / "curve").iterdir())  # and no leftovers


def test_the_report_needs_the_records_only_and_the_seed_decides(curve, tmp_path, monkeypatch):
    words = [*curve, "--only", "segmented-qmix-truth,segmented-random"]
    for name in ("one", "two"):
        assert main([*words, "--out", str(tmp_path / name)]) == 0
    for path in (tmp_path / "one" / "curve").iterdir():
        assert content(path) == content(tmp_path / "two" / "curve" / path.name)
    assert main([*words, "--seeds", "2", "--resume", "--out", str(tmp_path / "two")]) == 0
    seeds = [content(tmp_path / "two" / "curve" / f"small-segmented-qmix-truth-s{seed}.json") for seed in (0, 1)]
    assert seeds[0]["curve"] != seeds[1]["curve"] and seeds[0]["settings"] == seeds[1]["settings"]
    shutil.copytree(tmp_path / "one" / "curve", tmp_path / "three" / "curve")
    monkeypatch.chdir(tmp_path)
    assert main(["curve", "--report", "--out", "three"]) == 0
    assert (tmp_path / "three" / "curve.md").read_text() == (tmp_path / "one" / "curve.md").read_text()
    assert (tmp_path / "three" / "figures" / "curve.png").read_bytes() == \
        (tmp_path / "one" / "figures" / "curve.png").read_bytes()


def test_the_lock_of_a_run_is_made_though_another_process_removes_its_folder(tmp_path, monkeypatch):
    run, made = Run("tuning", "a", "learning", {}, 0), []
    mkdir = Path.mkdir

    def once_in_vain(path, *words, **more):
        mkdir(path, *words, **more)
        made.append(path)
        if len(made) == 1:
            shutil.rmtree(path.parent)

    monkeypatch.setattr(Path, "mkdir", once_in_vain)
    with _claimed(run, tmp_path) as mine:
        assert mine and len(made) > 1


def test_what_another_study_has_run_is_not_run_again(small_scene, tmp_path, capsys):
    words = ["--seeds", "1", "--scenes", str(small_scene.folder), "--out", str(tmp_path), *TINY]
    assert main(["curve", "--only", "segmented-qmix-nn", *words]) == 0
    assert main(["federation", "--only", "qmix-800", *words]) == 0
    assert "qmix-800 seed 0: taken from curve/small-segmented-qmix-nn-s0.json" in capsys.readouterr().out
    one, other = (json.loads((tmp_path / name).read_text()) for name in
                  ("curve/small-segmented-qmix-nn-s0.json", "federation/small-segmented-qmix-800-s0.json"))
    assert all(one[name] == other[name] for name in ("curve", "code", "machine")) and other["taken_from"]
    assert "`weights`" in (tmp_path / "federation.md").read_text()


@pytest.mark.parametrize("words, parts", [
    (["magic"], ["'magic'", "curve, federation"]),
    (["curve", "--seeds", "0"], ["--seeds 0", "from 1"]),
    (["curve", "--jobs", "many"], ["--jobs many"]),
    (["curve", "--scenes", "nowhere/at/all"], ["nowhere/at/all", "radiotwin build-scene"]),
    (["curve", "--only", "magic"], ["--only magic", "rbm-traced-fedqmix-nn"]),
    (["curve", "--set", "episodes"], ["--set episodes", "NAME=VALUE"]),
    (["curve", "--set", "magic=1"], ["--set magic=1", "td_lambda"]),
    (["curve", "--set", "episodes=some"], ["--set episodes=some", "whole number"]),
    (["curve", "--set", "episodes=0"], ["--set episodes=0", "greater than or equal to 1"]),
    (["curve", "--set", "replay=8"], ["replay 8", "32 flights"]),
    (["pays", "--set", "flights=0"], ["--set flights=0", "1 or more"]),
    (["pays", "--set", "method=magic"], ["--set method=magic", "--only"]),
    (["twin", "--set", "truth=magic"], ["--set truth=magic", "traced or segmented"]),
    (["curve", "--set", "truth=segmented"], ["--set truth=segmented", "the names of the runs say that", "--only"]),
    (["curve", "--scenes", "./nowhere"], ["nowhere", "radiotwin build-scene"]),
    (["quality", "--report", "--out", "nothing"], ["nothing/quality", "no finished run"])])
def test_bad_input_is_one_message_and_leaves_nothing(words, parts, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert not out and all(part in err for part in parts), err
    assert not list(tmp_path.iterdir())


def test_records_of_other_settings_and_damaged_ones_are_refused(curve, tmp_path, capsys):
    words = [*curve, "--only", "segmented-random", "--out", str(tmp_path)]
    assert main(words) == 0
    path = tmp_path / "curve" / "small-segmented-random-s0.json"
    assert main([*words, "--resume", "--set", "noise_db=3"]) == 2
    assert f"{path} holds a run with other settings (noise_db = 1.0, not 3.0)" in capsys.readouterr().err
    path.write_text("{")
    assert main([*words, "--resume"]) == 2
    assert f"{path} is not the record of a run" in capsys.readouterr().err


def test_a_stopped_run_goes_on_with_its_own_settings_only(curve, tmp_path, capsys):
    words = [*curve, "--only", "segmented-planner", "--resume", "--out", str(tmp_path)]
    path = tmp_path / "curve" / "unfinished" / "small-segmented-planner-nn-s0" / "run.json"
    process = start(words, tmp_path)
    while process.poll() is None and not path.exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert path.is_file()
    assert main([*words, "--set", "noise_db=3"]) == 2
    assert f"{path} holds a run with other settings (noise_db = 1.0, not 3.0)" in capsys.readouterr().err
    path.write_text("{")
    assert main(words) == 2
    assert f"{path} is damaged" in capsys.readouterr().err


def test_a_study_whose_records_are_refused_holds_up_all_before_anything_is_run(small_scene, tmp_path, capsys):
    words = ["--seeds", "1", "--scenes", str(small_scene.folder), "--resume", "--out", str(tmp_path)]
    assert main(["federation", *words, *TINY, "--only", "qmix-800"]) == 0
    assert main(["all", *words]) == 2
    assert "small-segmented-qmix-800-s0.json holds a run with other settings" in capsys.readouterr().err
    assert not (tmp_path / "curve").exists()


def test_runs_whose_names_differ_behind_a_point_do_not_share_a_lock(tmp_path):
    """The second of them would be left out by whoever meets it while the first is under way."""
    first, second = (Run("tuning", f"lambda-0.{digit}", "learning", {}, 0) for digit in (6, 9))
    with _claimed(first, tmp_path) as mine, _claimed(second, tmp_path) as others, _claimed(first, tmp_path) as again:
        assert mine and others and not again
