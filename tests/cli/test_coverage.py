"""Coverage through the real command line: of a law, of a twin, of a map; and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from radiotwin.geo import to_geographic
from radiotwin.scene import Scene
from tests.coverage.conftest import make_twin

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


def test_a_twin_and_the_map_that_it_makes_agree(run, town, tmp_path):
    """A twin at street level, and its radio map on a lattice that build-scene was asked for."""
    make_twin([("roof", -60.0, -50.0, 40.0)], exponent=3.0, sd_db=5.0).save(tmp_path / "twin")
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
