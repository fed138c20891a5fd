"""Coverage through the real command line: of a law, of a twin, of a map; and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from radiotwin.geo import to_geographic
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
SITES = "device,x_m,y_m,z_m,tx_power_dbm\nroof,-60,-60,40,30\nmast,60,60,40,30\n"


@pytest.fixture(scope="module")
def town(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("town")
    result = run(f"build-scene {TOWN} -o scene --altitudes 1.5,3 --step 10 --extent=-60,-50,60,50 --devices 0", folder)
    assert result.returncode == 0, result.stderr
    (folder / "sites.csv").write_text(SITES)
    scene = Scene.load(folder / "scene")
    x_m, y_m = np.array([0, 60, 60, 0, 0.0]), np.array([-50, -50, 50, 50, -50.0])
    ring = np.column_stack(to_geographic(scene.config.origin, x_m, y_m)).tolist()
    (folder / "east.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"name": "east"}, "geometry": {"type": "Polygon", "coordinates": [ring]}}]}))
    return folder


def test_the_lattice_is_as_asked_for(town):
    config = Scene.load(town / "scene").config
    assert config.lattice.altitudes_m == [1.5, 3.0] and config.lattice.step_m == 10.0
    assert config.extent.bounds == (-60, 60, -50, 50)


def test_a_law_over_a_map(run, town, tmp_path):
    options = f"--transmitters {town / 'sites.csv'} --step 2 --threshold-dbm=-60 --polygon {town / 'east.geojson'}"
    result = run(f"coverage {town / 'scene'} {options} -o out --bandwidth-hz 20e6 --noise-figure-db 9 --load 0.5 --json", tmp_path)
    assert result.returncode == 0, result.stderr
    printed = json.loads(result.stdout)["coverage"]
    assert printed == json.loads((tmp_path / "out" / "coverage.json").read_text(encoding="utf-8"))
    assert printed["model"].startswith("p1411") and printed["load"] == 0.5
    assert [each["area"] for each in printed["areas"]] == ["extent", "east"]
    with xr.open_dataset(tmp_path / "out" / "coverage.nc") as opened:
        power_dbm, indoor = opened["received_power_dbm"], opened["indoor"].values.astype(bool)
        assert power_dbm.shape == (50, 60) and (np.isnan(power_dbm.values) == indoor).all()
        east = (opened["x"].values > 0)[None] & ~indoor
        for record, where in zip(printed["areas"], (~indoor, east)):
            share = next(each["share"] for each in record["received_power_dbm"] if each["threshold"] == -60)
            assert share == pytest.approx((power_dbm.values[where] >= -60).mean())
            assert record["cells"] == where.sum()
    assert (tmp_path / "out" / "received_power.png").read_bytes()[:4] == b"\x89PNG"
    again = run(f"coverage {town / 'scene'} {options} -o out --formats nc", tmp_path)
    assert again.returncode == 0 and "Share of the area" in again.stdout and "cells inside buildings are left out" in again.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"coverage.json", "coverage.csv", "coverage.nc"}


def test_a_twin_and_the_map_that_it_makes_agree(run, town, tmp_path, twin_in):
    """A twin at street level, and its radio map on a lattice that build-scene was asked for."""
    twin_in(tmp_path / "twin")
    run(f"map twin --scene {town / 'scene'} -o twin.nc --altitudes 1.5", tmp_path)
    power = "--tx-power-dbm 20 --formats nc"
    first = run(f"coverage twin --scene {town / 'scene'} {power} -o of_twin --step 10 --extent=-65,-55,65,55", tmp_path)
    second = run(f"coverage twin.nc --scene {town / 'scene'} {power} -o of_map", tmp_path)
    assert first.returncode == 0, first.stderr + second.stderr
    with xr.open_dataset(tmp_path / "of_twin" / "coverage.nc") as one, \
            xr.open_dataset(tmp_path / "of_map" / "coverage.nc") as other:
        np.testing.assert_allclose(one["x"], other["x"])
        np.testing.assert_allclose(one["received_power_dbm"], other["received_power_dbm"], atol=1e-4)
        np.testing.assert_allclose(one["coverage_probability"], other["coverage_probability"], atol=1e-5)


@pytest.fixture
def twin_in():
    from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
    from radiotwin.twin import Twin
    from radiotwin.twin.localize import TwinDevice
    from radiotwin.twin.model.model import FittedModel

    def make(folder):
        lines = {"lines": np.array([[-40.0, -3.5, 7.0], [-40.0, -2.1, 4.0]])}
        channel = SegmentedLogDistance.from_state(lines, {"borrowed": None})
        Twin(FittedModel.of_channel(channel), [TwinDevice.anchor("roof", -60.0, -50.0, 40.0)], "gain_db", None).save(folder)
    return make


BAD = {
    "no power": ("scene --model p1411 --transmitters plain.csv", ["the transmit power of mast is not known",
                                                                  "give --tx-power-dbm"]),
    "no transmitter": ("scene", ["there is no transmitter", "--transmitters"]),
    "no source": ("nothing", ["nothing is neither a folder nor a radio map"]),
    "no scene": ("map.nc", ["map.nc needs the scene's 3D map; give its folder with --scene"]),
    "two scenes": ("scene --scene scene", ["is a scene already; leave --scene out"]),
    "law of a map": ("map.nc --scene scene --model p1411", ["--model is for a scene without measurements"]),
    "unknown law": ("scene --transmitters sites.csv --model okumura", ["channel model 'okumura' is unknown"]),
    "classes": ("scene --transmitters sites.csv --classes x", ["--classes 'x' is not numbers"]),
    "rate": ("scene --transmitters sites.csv --rate 1,2", ["--rate '1,2' is not 3 numbers"]),
    "extent": ("scene --transmitters sites.csv --extent 1,2,3", ["--extent '1,2,3' is not 4 numbers"]),
    "load": ("scene --transmitters sites.csv --load 2", ["a load of 2 is not possible"]),
    "formats": ("scene --transmitters sites.csv --formats shp", ["unknown format 'shp'"]),
    "polygon": ("scene --transmitters sites.csv --polygon none.geojson", ["none.geojson does not exist"]),
    "points": ("scene --transmitters sites.csv --polygon points.geojson", ["points.geojson holds no polygon"]),
    "far away": ("scene --transmitters sites.csv --polygon far.geojson", ["'far': no cell's middle lies in it"]),
    "not degrees": ("scene --transmitters sites.csv --polygon metres.geojson", ["no longitude and latitude in degrees"]),
    "foreign files": ("scene --transmitters sites.csv -o .", ["which the new content would erase"]),
}


@pytest.mark.parametrize("what", BAD)
def test_a_mistake_is_one_message_and_nothing_is_written(run, town, tmp_path, what):
    options, parts = BAD[what]
    (tmp_path / "scene").symlink_to(town / "scene")
    (tmp_path / "sites.csv").write_text(SITES)
    (tmp_path / "plain.csv").write_text("device,x_m,y_m,z_m\nmast,0,0,40\n")
    lattice = Scene.load(town / "scene").lattice
    RadioMap.build(["d"], lattice, np.zeros((1, lattice.positions_m.shape[0])) - 90,
                   np.ones((1, lattice.positions_m.shape[0]))).save(tmp_path / "map.nc")
    feature = {"type": "Feature", "properties": {"name": "far"}}
    for name, geometry in (("points", {"type": "Point", "coordinates": [8, 47]}),
                           ("metres", {"type": "Polygon", "coordinates": [[[5e5, 6e6], [6e5, 6e6], [6e5, 7e6], [5e5, 6e6]]]}),
                           ("far", {"type": "Polygon", "coordinates": [[[9, 47], [9.1, 47], [9, 47.1], [9, 47]]]})):
        (tmp_path / f"{name}.geojson").write_text(json.dumps(
            {"type": "FeatureCollection", "features": [feature | {"geometry": geometry}]}))
    before = sorted(path.name for path in tmp_path.iterdir())
    result = run(f"coverage {options}", tmp_path)
    assert result.returncode == 2 and result.stderr.count("radiotwin:") == 1 and "Traceback" not in result.stderr, result.stderr
    for part in parts:
        assert part in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(("options", "part"), [
    ("--altitudes 0", "altitudes of 0 m are not possible"), ("--altitudes 2,2", "an altitude is given twice"),
    ("--altitudes a", "--altitudes 'a' is not numbers"), ("--step 0", "a step of 0 m is not possible"),
    ("--step 0.01 --extent=-900,-900,900,900", "RADIOTWIN_MAX_POSITIONS"),
    ("--extent 5,5,5,9", "the minimum below the maximum"), ("--extent=-1e5,0,1e5,5", "km are allowed")])
def test_an_impossible_lattice(run, tmp_path, options, part):
    result = run(f"build-scene {TOWN} -o scene {options}", tmp_path)
    assert result.returncode == 2 and part in result.stderr and "Traceback" not in result.stderr, result.stderr
    assert not list(tmp_path.iterdir())
