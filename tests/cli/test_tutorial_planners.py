"""The planners' tutorial runs as it is written, and its figures are those of the run."""

import re
import shutil
import subprocess
import sys

import pandas as pd
import pytest

from tests.walk import ROOT, commands, fences, page, run, table

pytestmark = pytest.mark.slow

PAGE = page("tutorial-planners.md")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """The folder after all commands, what they printed, and what the program printed."""
    folder = tmp_path_factory.mktemp("planners") / "harvest"
    shutil.copytree(ROOT / "examples" / "campaign", folder)
    said = {each[1]: run(each, folder) for each in commands(PAGE)}
    (folder / "plan.py").write_text("\n".join(fences(PAGE, "python")), encoding="utf-8")
    done = subprocess.run([sys.executable, "plan.py"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder, said, done.stdout


def test_every_step_is_there(walked):
    folder, said, _ = walked
    assert list(said) == ["build-scene", "survey", "fit", "coverage", "report"]
    assert "2 flights, 1776 links to 8 devices (3 anchors)" in said["survey"] and "1,776" in PAGE
    for path in ("coverage/received_power.png", "coverage/best_server.png", "twin/report.html"):
        assert (folder / path).stat().st_size > 10_000


def test_shares_are_those_of_the_page(walked):
    folder, _, printed = walked
    collected = {name: int(share) for name, share in re.findall(r"^(.*): (\d+)% collected$", printed, re.MULTILINE)}
    told = {name: int(share.removesuffix(" %")) for name, share in table(PAGE, "python plan.py")}
    assert list(told) == list(collected)
    for name, share in told.items():
        assert abs(collected[name] - share) <= 2, name
    assert collected["plan made in the twin"] > collected["greedy: to the nearest device"] > collected["random"]
    flight = pd.read_csv(folder / "flight.csv")
    assert flight["uav"].nunique() == 3
