"""A real city of OpenStreetMap: its buildings, and the coverage of three sites at street level."""

import json
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map

pytestmark = pytest.mark.slow

SITES = {"kamppi": (-200.0, -100.0, 35.0), "station": (150.0, 300.0, 35.0), "harbour": (250.0, -450.0, 30.0)}
MAX_S = 300.0


@pytest.fixture(scope="module")
def helsinki(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("helsinki") / "scene"
    report = build_scene_from_map(folder("helsinki_osm") / "helsinki.osm.pbf", out,
                                  BuildOptions(altitudes_m=(1.5,), step_m=5.0))
    return Scene.load(out), report


def test_every_building_has_its_height_and_where_it_is_from(helsinki):
    scene, report = helsinki
    facts = dict(report.facts)
    assert facts["buildings"].startswith("549 in ")
    assert facts["heights from"] == "building:levels × 3 m: 226, height tag: 31, default: 292 (10 m)"
    table = pd.read_csv(scene.folder / "buildings.csv")
    assert table["building"].nunique() == 549
    assert scene.config.lattice.altitudes_m == [1.5] and scene.config.lattice.step_m == 5.0


def test_three_sites_at_street_level_within_five_minutes(helsinki, tmp_path):
    """Rasters, vectors and pictures of cells of 5 m, by a published law."""
    scene, _ = helsinki
    rows = ["device,x_m,y_m,z_m,tx_power_dbm", *(f"{name},{x},{y},{z},43" for name, (x, y, z) in SITES.items())]
    (tmp_path / "sites.csv").write_text("\n".join(rows) + "\n")
    start_s = time.monotonic()
    options = "--transmitters sites.csv -o out --bandwidth-hz 20e6 --noise-figure-db 9"
    result = subprocess.run([sys.executable, "-m", "radiotwin", "coverage", str(scene.folder), *options.split()],
                            cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    assert time.monotonic() - start_s < MAX_S
    record = json.loads((tmp_path / "out" / "coverage.json").read_text(encoding="utf-8"))
    assert record["cells"] == 208 * 336 and 0.25 < record["cells_left_out_indoors"] / record["cells"] < 0.3
    assert {"received_power.tif", "sinr.png", "coverage.gpkg", "coverage.kmz"} <= {
        path.name for path in (tmp_path / "out").iterdir()}
    with xr.open_dataset(tmp_path / "out" / "coverage.nc") as opened:
        power_dbm = opened["received_power_dbm"].values
        assert (np.isnan(power_dbm) == opened["indoor"].values.astype(bool)).all()
