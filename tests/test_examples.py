"""The examples run as they are, and print what their text says."""

import json
import re
import runpy
from pathlib import Path

import pytest

from tests.worlds import quickened

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example in a folder of its own, in this process; what it printed."""
    def run(name):
        monkeypatch.chdir(tmp_path)
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out
    return run


def test_city_to_map(run, tmp_path):
    out = run("city_to_map")
    assert "7 devices" in out and " dB\n" in out
    for name in ("map.csv", "map.png", "report.html", "map.nc"):
        assert (tmp_path / "city_to_map" / name).stat().st_size > 1000


def test_find_devices(run, tmp_path):
    out = run("find_devices")
    medians = {row.split()[0]: float(row.split()[2]) for row in out.splitlines() if "log_distance" in row}
    assert medians["segmented_log_distance"] < 0.5 * medians["log_distance"]
    assert len(re.findall(r"^d\d: .* within", out, re.MULTILINE)) == 4
    assert (tmp_path / "find_devices" / "twin" / "twin.json").is_file()


@pytest.mark.slow
def test_close_the_loop(run):
    with quickened():
        out = run("close_the_loop")
    assert "verdict: effect" in out and "receiver_gain_offset" in out
    before, after = map(float, re.search(r"([\d.]+) dB before, ([\d.]+) dB after", out).groups())
    assert after < before
    assert out.splitlines()[-1].startswith("segmented_log_distance with ")  # the saved twin


def test_plan_with_your_twin(run):
    out = run("plan_with_your_twin")
    shares = {found[1:]: int(found[0]) for found in (
        (share, name, where) for name, share, where in re.findall(r"(\w+) flights collect (\d+)% .* the (\w+)", out))}
    assert shares["greedy", "truth"] > shares["random", "truth"]
    assert "hovering at the start collects" in out or "radiotwin[rl]" in out


def test_first_map(tmp_path, monkeypatch, capsys):
    """The notebook's cells in one process, as a kernel runs them; it is stored without outputs."""
    notebook = json.loads((EXAMPLES / "first_map.ipynb").read_text(encoding="utf-8"))
    cells = [each for each in notebook["cells"] if each["cell_type"] == "code"]
    assert not any(each["outputs"] or each["execution_count"] for each in cells)
    monkeypatch.chdir(tmp_path)
    names = {}
    for number, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
    errors_db = [float(each) for each in re.findall(r": ([\d.]+) dB", capsys.readouterr().out)]
    assert errors_db[0] < 2 < errors_db[1], "the twin's and the log-distance model's"
    for name in ("map.csv", "report.html", "twin/twin.json"):
        assert (tmp_path / "first_map" / name).stat().st_size > 1000


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_they_are_in_cells(path):
    cells = path.read_text(encoding="utf-8").split("# %%")
    assert cells[0] == "" and cells[1].startswith(" [markdown]\n# # ") and len(cells) > 4
