"""`python -m studies`: rows, resuming, selection, and messages."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from studies import runner
from studies.__main__ import app
from studies.runner import Study, code_version, read_rows

RESULTS = Path(__file__).parents[2] / "docs" / "results"
OF_VERSION_0_1 = ("-fly-again", "-restart-0.3", "-measure-planner")  # options that are gone
CALLS: list[tuple[int, str]] = []
STOP: list[str] = []  # a row that is interrupted


def measure(seed, settings):
    CALLS.append((seed, settings["kind"]))
    if settings["kind"] in STOP:
        raise KeyboardInterrupt
    return {"value": np.float64(seed + settings["add"]), "seen": np.array([1.23456, np.nan]), "flag": np.bool_(True)}


def cases(seed):
    return {f"city-{kind}": {"kind": kind, "add": add} for kind, add in (("one", 1), ("two", 2), ("three", 3))}


FAKE = Study("What is it?", measure, cases, lambda rows: f"mean {rows['value'].mean():.1f}",
             lambda rows: {"fake": Figure()}, seeds=2)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Call the command line on a fake study, with results in `tmp_path`."""
    monkeypatch.setattr(runner, "load_study", lambda name: FAKE)
    monkeypatch.setattr(runner, "MODULES", {"fake": "fake"})
    CALLS.clear()
    STOP.clear()

    def call(*words):
        return CliRunner().invoke(app, ["fake", "--out", str(tmp_path), *words])
    return call


def test_a_study_writes_its_rows_table_and_figure(run, tmp_path):
    result = run()
    assert result.exit_code == 0, result.output
    assert len(CALLS) == 6 and "fake city-one seed 0:" in result.output
    rows = read_rows("fake", tmp_path)
    assert [(row["name"], row["seed"]) for row in rows] == sorted((row["name"], row["seed"]) for row in rows)
    first = rows[0]
    assert first["study"] == "fake" and first["settings"] == {"kind": "one", "add": 1}
    assert first["results"] == {"value": 1.0, "seen": [1.2346, None], "flag": True}
    assert first["version"] == code_version() and first["date"] and first["cpu_s"] >= 0 and first["wall_s"] >= 0
    text = (tmp_path / "fake.md").read_text()
    assert text.startswith("# What is it?\n\n`python -m studies fake`. 6 rows of 3 kinds") and "mean 2.5" in text
    assert (tmp_path / "figures" / "fake.png").is_file()
    assert len((tmp_path / "fake.json").read_text().splitlines()) == 6 + 2  # a row a line


def test_only_and_seeds_choose_rows(run, tmp_path):
    assert run("--only", "one,three:1", "--seeds", "3").exit_code == 0
    assert sorted(CALLS) == [(0, "one"), (1, "one"), (1, "three"), (2, "one")]
    assert run("--only", "two", "--resume", "--seeds", "1").exit_code == 0
    assert len(CALLS) == 5 and len(read_rows("fake", tmp_path)) == 5


def test_a_study_that_was_interrupted_goes_on_with_resume_and_repeats_nothing(run, tmp_path):
    STOP.append("three")
    result = run("--seeds", "1")
    assert result.exit_code == 130 and "--resume" in result.output
    before = read_rows("fake", tmp_path)
    assert [row["name"] for row in before] == ["city-one", "city-two"]
    STOP.clear()
    CALLS.clear()
    result = run("--seeds", "1")
    assert result.exit_code == 2 and "2 finished rows" in result.output and not CALLS
    assert run("--seeds", "1", "--resume").exit_code == 0
    assert CALLS == [(0, "three")]
    rows = read_rows("fake", tmp_path)
    assert [row for row in rows if row["name"] != "city-three"] == before


def test_several_processes_do_the_same(run, tmp_path):
    assert run("--jobs", "2", "--seeds", "1").exit_code == 0
    assert not CALLS  # in this process
    assert [row["results"]["value"] for row in read_rows("fake", tmp_path)] == [1.0, 3.0, 2.0]


def test_a_killed_process_leaves_whole_rows(tmp_path):
    words = ["curve", "--only", "-traced-greedy,-traced-random", "--seeds", "1", "--out", str(tmp_path)]
    process = subprocess.Popen([sys.executable, "-m", "studies", *words], cwd=RESULTS.parents[1],
                               stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"})
    while process.poll() is None and not (tmp_path / "curve.json").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=60)
    kept = read_rows("curve", tmp_path)
    assert kept
    result = CliRunner().invoke(app, [*words, "--resume"])
    assert result.exit_code == 0, result.output
    rows = read_rows("curve", tmp_path)
    assert len(rows) == 4 and all(row in rows for row in kept)
    committed = {(row["name"], row["seed"]): row["results"]["curve"] for row in read_rows("curve", RESULTS)}
    for row in rows:  # the same numbers as those that are kept
        name, ratio = (row["name"], row["seed"]), row["results"]["curve"]["truth_ratio"]
        assert ratio == pytest.approx(committed[name]["truth_ratio"], abs=2e-4)


def test_rows_of_other_settings_and_damaged_files_are_refused(run, tmp_path):
    assert run("--only", "one").exit_code == 0
    path = tmp_path / "fake.json"
    whole = path.read_text()
    path.write_text(whole.replace('"add": 1', '"add": 7'))
    result = run("--resume")
    assert result.exit_code == 2 and "city-one:0 with other settings (add = 7, not 1)" in result.output
    for damaged, part in ((whole[:50], "is not the record"), (whole.replace("study/1", "study/0"), "schema is")):
        path.write_text(damaged)
        result = run("--resume")
        assert result.exit_code == 2 and part in result.output.replace("\n", " ")


@pytest.mark.parametrize("words, parts", [
    (["magic"], ["'magic'", "curve, federation"]),
    ([], ["--list"]),
    (["curve", "--only", "segmented-greedy", "--out", "new"], ["no scene runs/paper_rbm, runs/paper_rdm", "--only"]),
    (["curve", "--only", "magic"], ["--only magic", "rbm-traced-fedqmix-nn"]),
    (["models", "--report", "--out", "nothing"], ["nothing/models.json holds no finished row"]),
    (["curve", "--seeds", "0"], ["--seeds"])])
def test_bad_input_is_one_message_and_leaves_nothing(words, parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2 and all(part in result.output for part in parts), result.output
    assert not list(tmp_path.iterdir())


def test_all_studies_are_listed():
    result = CliRunner().invoke(app, ["--list"])
    assert result.exit_code == 0 and all(f"{name} " in result.output for name in runner.MODULES)


def test_the_report_remakes_the_committed_tables_and_figures(tmp_path, monkeypatch):
    """Figures are compared by size: fonts differ between machines."""
    for name in runner.MODULES:
        shutil.copy(RESULTS / f"{name}.json", tmp_path)
    monkeypatch.chdir(RESULTS.parents[1])
    result = CliRunner().invoke(app, ["--report", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    for name in runner.MODULES:
        assert (tmp_path / f"{name}.md").read_text() == (RESULTS / f"{name}.md").read_text(), name
    drawn = [path.name for path in (tmp_path / "figures").iterdir()]
    assert {"curve.png", "foreign.png", "readings.png"} <= set(drawn)
    for name in drawn:
        sizes = [(folder / "figures" / name).stat().st_size for folder in (tmp_path, RESULTS)]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.1), name


@pytest.mark.parametrize("name", runner.MODULES)
def test_committed_rows_are_those_of_todays_studies(name):
    """So that --resume goes on from them."""
    study, rows = runner.load_study(name), read_rows(name, RESULTS)
    assert rows
    for row in rows:
        if not row["name"].endswith(OF_VERSION_0_1):
            assert study.cases(row["seed"])[row["name"]] == row["settings"], row["name"]
        assert row["study"] == name and row["version"] and json.dumps(row["results"], allow_nan=False)
