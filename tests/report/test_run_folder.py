"""What is found in a folder, and what is said of one that holds nothing or something damaged."""

import json
import shutil

import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.radiomap import RadioMap
from radiotwin.report import read_run, write_report


def test_everything_in_a_demos_folder_is_found(run_folder):
    run = read_run(run_folder)
    assert list(run.maps) == ["truth", "twin"] and run.twin is not None and run.notes == []
    assert run.tracks.groupby("flight")["uav"].nunique().tolist() == [2, 2]


def test_a_twin_alone_takes_the_scene_that_is_given(run_folder, tmp_path):
    alone = read_run(run_folder / "twin")
    assert alone.scene is None and not alone.maps and "--scene" in alone.notes[0]
    write_report(alone, tmp_path / "page.html")
    run = read_run(run_folder / "twin", scene=run_folder / "scene", truth="segmented",
                   measurements=run_folder / "survey" / "measurements.csv.gz")
    assert list(run.maps) == ["truth", "twin"] and run.tracks is not None
    assert run.maps["truth"].dataset.attrs["source"] == "segmented"


def test_a_truth_of_another_scene_is_not_shown(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    text = (folder / "scene" / "scene.toml").read_text()
    (folder / "scene" / "scene.toml").write_text(text.replace("tx_power_dbm = 0.0", "tx_power_dbm = 3.0"))
    with pytest.warns(UserWarning, match="another scene"):
        run = read_run(folder)
    assert "truth" not in run.maps and "run `radiotwin trace`" in run.notes[0]


def test_a_rejected_truth_is_not_shown_by_another_way_nor_maps_over_other_lattices(run_folder, tmp_path):
    folder = shutil.copytree(run_folder / "scene", tmp_path / "scene")
    path = folder / "scene.toml"
    path.write_text(path.read_text().replace("tx_power_dbm = 0.0", "tx_power_dbm = 3.0"))
    truth = RadioMap.read(folder / "truth.nc")
    smaller = RadioMap(truth.dataset.isel(x=slice(1, None)))
    smaller.write(folder / "part.nc")
    run = read_run(folder)
    assert not run.maps and [note.split(" is not shown")[0] for note in run.notes] == [
        str(folder / "truth.nc"), str(folder / "part.nc")]
    with pytest.raises(BadInput, match="part.nc is not over the lattice"):
        read_run(folder, truth=str(folder / "part.nc"))


def test_a_planning_run_shows_its_flights_and_its_table(run_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(run_folder)  # a scene that a run names is read there, see below
    (tmp_path / "config.json").write_text(json.dumps({"run": {"scene": str(run_folder / "scene"),
                                                              "truth": "segmented"}}))
    pd.DataFrame({"method": ["qmix", "<i>"], "trained_in": ["NN twin", None], "real_episodes": [10, 0],
                  "truth_ratio": [0.85, 0.4]}).to_csv(tmp_path / "comparison.csv", index=False)
    pd.DataFrame({"flight": "f7", "uav": "a", "time_s": [0.0, 2], "x_m": [0.0, 20], "y_m": 0.0, "z_m": 50.0}).to_csv(
        tmp_path / "flights.csv", index=False)
    run = read_run(tmp_path)
    assert list(run.maps) == ["truth"] and run.tracks["flight"].tolist() == ["f7", "f7"]
    write_report(run, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "0.850" in page and "&lt;i&gt;" in page and "<i>" not in page


@pytest.mark.parametrize("name, content, words", [
    (None, None, "holds nothing to show"), ("closeloop.json", "{", "is not readable JSON"),
    ("closeloop.json", "[]", "is no JSON object"), ("closeloop.json", '{"schema": "x"}', "this version reads"),
    ("compare.json", '{"schema": "radiotwin.comparison/1", "scores": 3}', "is damaged"),
    ("flights.csv", "flight,uav\nf,u\n", "column 'time_s' is missing"), ("twin.json", "{}", "is damaged")])
def test_bad_folders_get_one_message(tmp_path, name, content, words):
    if name:
        (tmp_path / name).write_text(content)
    with pytest.raises(BadInput, match=words):
        read_run(tmp_path)


def test_a_close_loop_without_its_entries_is_bad_input(tmp_path):
    (tmp_path / "closeloop.json").write_text('{"schema": "radiotwin.closeloop/1"}')
    with pytest.raises(BadInput, match="closeloop.json is damaged"):
        write_report(read_run(tmp_path), tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_no_folder_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match="is not a folder"):
        read_run(tmp_path / "nowhere")
