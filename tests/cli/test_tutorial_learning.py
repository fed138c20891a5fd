"""The tutorial for research on learning: a run of it ends in the figures of the page."""

import re
import shutil
import subprocess
import sys

import pandas as pd
import pytest

from tests.walk import commands, fences, page, run, table

PAGE = page("tutorial-learning.md")
BUILD, *TRAIN = commands(PAGE)


def out_of(command):
    return command[command.index("--out") + 1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the scene and the run in the truth, which needs no twin and so the least time."""
    folder = tmp_path_factory.mktemp("learning")
    run(BUILD, folder)
    in_truth, = (each for each in TRAIN if out_of(each) == "runs/truth")
    run(in_truth, folder)
    return folder


@pytest.mark.slow
def test_the_run_in_the_truth_ends_where_the_page_says(folder):
    last = pd.read_csv(folder / "runs/truth/metrics.csv").iloc[-1]
    real, share = re.search(r"After ([\d,]+) of them it collects ([\d.]+)", PAGE).groups()
    assert last["real_episodes"] == int(real.replace(",", ""))
    assert last["truth_ratio"] == pytest.approx(float(share), abs=0.05)  # another machine rounds otherwise


def test_programs_are_whole():
    for program in fences(PAGE, "python"):
        compile(program, "program", "exec")
    assert [out_of(each) for each in TRAIN] == ["runs/qmix", "runs/fedqmix", "runs/truth", "runs/short"]


@pytest.mark.slow
def test_all_of_it(folder):
    shutil.copytree(folder / "town", folder / "short")
    scene = folder / "short" / "scene.toml"
    scene.write_text(re.sub(r"^battery = .*", "battery = 20.0", scene.read_text(), flags=re.MULTILINE))
    for each in TRAIN:
        if out_of(each) != "runs/truth":
            run(each, folder)
    told = {row[0]: float(row[3]) for row in table(PAGE, "## 1. Train in a twin")}
    found = pd.read_csv(folder / "runs/qmix/comparison.csv").set_index("method")["truth_ratio"]
    for name, share in told.items():
        assert found[name] == pytest.approx(share, abs=0.05), name
    for number, program in enumerate(fences(PAGE, "python")):
        (folder / f"program{number}.py").write_text(program, encoding="utf-8")
        done = subprocess.run([sys.executable, f"program{number}.py"], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert (folder / "figure.png").stat().st_size > 10_000
    of_d3 = dict(re.findall(r"^(\w+): (\d+)% of the data of d3", done.stdout, re.MULTILINE))
    assert int(of_d3["urgent"]) > int(of_d3["qmix"])
