"""What is found in a folder, and what is said of one that holds nothing or something damaged."""

import json
import os
import shutil
from pathlib import Path

import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import read_run, write_report

SAMPLE = Path(__file__).parents[1] / "closeloop" / "sample" / "closeloop.json"


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


def test_a_rejected_truth_is_not_shown_by_another_way_nor_maps_over_other_lattices(run_folder, tmp_path):
    folder = shutil.copytree(run_folder / "scene", tmp_path / "scene")
    path = folder / "scene.toml"
    path.write_text(path.read_text().replace("tx_power_dbm = 0.0", "tx_power_dbm = 3.0"))
    truth = RadioMap.load(folder / "truth.nc")
    smaller = RadioMap(truth.dataset.isel(x=slice(1, None)))
    smaller.save(folder / "part.nc")
    run = read_run(folder)
    assert not run.maps and [note.split(" is not shown")[0] for note in run.notes] == [
        str(folder / "truth.nc"), str(folder / "part.nc")] and "run `radiotwin trace`" in run.notes[0]
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
    ("closeloop.json", '{"schema": "radiotwin.closeloop/3"}', "closeloop.json is damaged"),
    ("compare.json", '{"schema": "radiotwin.comparison/1", "scores": 3}', "is damaged"),
    ("compare.json", json.dumps({"schema": "radiotwin.comparison/1", "locations": [], "scores": [
        {"model": "m", "against": "a", "positions": "true", "links": "all", "n": 1, "rmse_db": 1.0, "mae_db": 1.0,
         "bias_db": "<img>"}]}), "scores.0.bias_db"),
    ("compare.json", json.dumps({"schema": "radiotwin.comparison/1", "locations": [], "scores": [
        {"model": "m", "against": "a", "positions": "true", "links": "all", "n": 1, "rmse_db": 1.0, "mae_db": 1.0,
         "bias_db": 1.0}]}), "not one row for each of all, LoS, NLoS"),
    ("config.json", '{"run": {"scene": 3}}', "scene: "), ("config.json", "[]", "is no JSON object"),
    ("closeloop.json", "[" * 10**5, "levels of nesting"), ("closeloop.json", '{"a": ' + "9" * 5000 + "}", "readable"),
    ("flights.csv", "flight,uav\nf,u\n", "column 'time_s' is missing"),
    ("twin.json", "{}", "channel.safetensors does not exist")])
def test_bad_folders_get_one_message(tmp_path, name, content, words):
    if name:
        (tmp_path / name).write_text(content)
    with pytest.raises(BadInput, match=words):
        read_run(tmp_path)


@pytest.fixture(scope="module")
def elsewhere(run_folder, tmp_path_factory):
    """A folder of all that is read of a run, in each of the places where it is looked for."""
    folder = shutil.copytree(run_folder, tmp_path_factory.mktemp("elsewhere") / "run")
    for path in (folder, folder / "closeloop"):
        path.mkdir(exist_ok=True)
        shutil.copy(SAMPLE, path)
        (path / "residuals.csv.gz").write_bytes(b"")
    for path in (folder, folder / "comparison"):
        path.mkdir(exist_ok=True)
        (path / "compare.json").write_text('{"schema": "radiotwin.comparison/1", "scores": [], "locations": []}')
    (folder / "config.json").write_text('{"run": {}}')
    for file in ("flights.csv", "comparison.csv"):
        (folder / file).write_text("flight,uav,time_s,x_m,y_m,z_m,method,trained_in,real_episodes,truth_ratio\n"
                                   "f,u,1,2,3,4,m,t,1,0.5\n")
    for file in ("twin/twin.json", "twin/channel.safetensors", "survey/devices.csv"):
        shutil.copy(folder / file, folder)
    shutil.copy(folder / "scene" / "truth.nc", folder / "map.nc")
    pd.read_csv(folder / "survey" / "measurements.csv.gz").to_csv(folder / "measurements.csv", index=False)
    return folder


LINKS = ("closeloop", "comparison", "twin", "scene", "survey", "closeloop.json", "compare.json", "twin.json",
         "config.json", "flights.csv", "comparison.csv", "measurements.csv", "residuals.csv.gz", "map.nc",
         "survey/devices.csv", "scene/scene.toml")
READ_BESIDE = {"comparison.csv": "config.json", "residuals.csv.gz": "closeloop.json"}


@pytest.mark.parametrize("name", LINKS)
def test_what_a_link_leads_to_is_not_read(elsewhere, tmp_path, name):
    """The same content is read where it lies in the folder, and refused where a link leads out of it."""
    if name in READ_BESIDE:
        shutil.copy(elsewhere / READ_BESIDE[name], tmp_path)
    if "/" in name:
        shutil.copytree((elsewhere / name).parent, (tmp_path / name).parent)
        (tmp_path / name).unlink()
    (tmp_path / name).symlink_to(elsewhere / name)
    with pytest.raises(BadInput, match="leads out of .*only files in that folder may be named"):
        read_run(tmp_path)


@pytest.mark.parametrize("name", ["closeloop.json", "twin.json", "flights.csv", "config.json", "map.nc", "measurements.csv"])
def test_pipes_are_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(BadInput, match="holds nothing to show|not a regular file|does not exist"):
        read_run(tmp_path)


def test_a_scene_that_a_run_names_is_read_below_the_current_folder_only(run_folder, tmp_path, monkeypatch):
    (tmp_path / "config.json").write_text(json.dumps({"run": {"scene": str(run_folder / "scene")}}))
    (tmp_path / "flights.csv").write_text("flight,uav,time_s,x_m,y_m,z_m\nf,u,0,1,2,3\n")
    run = read_run(tmp_path)
    assert run.scene is None and "give it with --scene" in run.notes[0] and str(run_folder) in run.notes[0]
    assert read_run(tmp_path, scene=run_folder / "scene").scene is not None
    monkeypatch.chdir(run_folder)
    assert read_run(tmp_path).scene is not None
    for named in ("x" * 5000, "a\0b", "../" * 2000):
        (tmp_path / "config.json").write_text(json.dumps({"run": {"scene": named}}))
        assert read_run(tmp_path).scene is None


@pytest.mark.parametrize("folder", ["nowhere", "x" * 300, "a\0b", "\udcff"])
def test_names_that_no_folder_has_are_bad_input(folder):
    with pytest.raises(BadInput, match="is not a folder"):
        read_run(folder)


def test_maps_have_a_budget(run_folder, tmp_path, monkeypatch):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    for number in range(3):
        shutil.copy(folder / "scene" / "truth.nc", folder / f"m{number}.nc")
    assert len(read_run(folder).maps) == 5
    monkeypatch.setenv("RADIOTWIN_MAX_PAGE_MAPS", "2")
    with pytest.raises(BadInput, match="3 radio maps; at most 2"):
        read_run(folder)
    monkeypatch.setenv("RADIOTWIN_MAX_PAGE_MAPS", "3")
    monkeypatch.setenv("RADIOTWIN_MAX_PAGE_VALUES", "9000")
    with pytest.raises(BadInput, match="values; at most 9,000"):
        read_run(folder)
    monkeypatch.setenv("RADIOTWIN_MAX_MAP_VALUES", "100")
    with pytest.raises(BadInput, match="values; at most 100"):
        read_run(folder)


def test_the_page_of_a_twin_says_how_far_its_levels_are_off_and_shows_its_law(run_folder, tmp_path):
    run = read_run(run_folder)
    law = [{"links": "LoS", "parameter": "path-loss exponent", "value": 2.1, "low": 1.9, "high": 2.3, "unit": ""}]
    errors = [{"model": name, "rmse_db": rmse_db, "by": "flight", "as_good": True}
              for name, rmse_db in (("log_distance", 4.06), ("kriging", 5.0))]
    run.twin.provenance.update(law=law, held_out=errors)
    write_report(run, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "held out by flight, is 4.1 dB (kriging 5.0 dB)." in page
    assert "Law of the channel" in page and "<td>1.90</td><td>2.30</td>" in page
