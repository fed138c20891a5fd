"""`radiotwin demo` through the real command line, on a city small enough for a test."""

import re
from pathlib import Path

import pytest

from radiotwin.trace import SolverSettings

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"


@pytest.mark.llvm
def test_the_whole_chain_ends_in_a_page(run, tmp_path, monkeypatch):
    monkeypatch.setattr("radiotwin.cli.demo.DEVICES", 4)
    monkeypatch.setattr("radiotwin.cli.demo.FLIGHTS", 3)
    monkeypatch.setattr("radiotwin.cli.demo.SolverSettings.of_quality", lambda _, **others: SolverSettings(samples_per_src=3_000, **others))
    result = run(f"demo --scene {TOWN} -o out", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<img ") == 3 and not re.search(r'<[^>]*(src|href)="(?!data:)', page), "nothing from a network"
    assert 'id="radiotwin-data"' in page
    for model, label in (("log_distance", "log-distance"), ("segmented_nn", "segmented NN"), ("kriging", "kriging")):
        assert model in result.stdout and label in page
    for name in ("scene/truth.nc", "survey/devices.csv", "twin/twin.json", "comparison/compare.json"):
        assert (tmp_path / "out" / name).is_file()

    again = run("demo --scene preset:small -o out", cwd=tmp_path)
    assert again.returncode == 2 and "choose another folder" in again.stderr
