"""A real city of OpenStreetMap: its buildings, and the coverage of three sites at street level."""

import json
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.twin import Twin
from radiotwin.twin.localize import TwinDevice
from radiotwin.twin.model.model import FittedModel

pytestmark = pytest.mark.slow

SITES = {"kamppi": (-200.0, -100.0, 35.0), "station": (150.0, 300.0, 35.0), "harbour": (250.0, -450.0, 30.0)}
LINES = np.array([[-42.0, -3.6, 7.0], [-40.0, -2.1, 4.0]])  # without line of sight, with it
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


@pytest.mark.parametrize("with_twin", [False, True])
def test_three_sites_at_street_level_within_five_minutes(helsinki, tmp_path, with_twin):
    """Rasters, vectors and pictures of cells of 5 m, by a published law and by the law of a twin."""
    scene, _ = helsinki
    rows = ["device,x_m,y_m,z_m,tx_power_dbm", *(f"{name},{x},{y},{z},43" for name, (x, y, z) in SITES.items())]
    (tmp_path / "sites.csv").write_text("\n".join(rows) + "\n")
    source = f"{scene.folder}"
    if with_twin:
        channel = SegmentedLogDistance.from_state({"lines": LINES}, {"borrowed": None})
        Twin(FittedModel.of_channel(channel), [TwinDevice.anchor("kamppi", *SITES["kamppi"])], "gain_db",
             None).save(tmp_path / "twin")
        source = f"twin --scene {scene.folder}"
    start_s = time.monotonic()
    options = "--transmitters sites.csv -o out --bandwidth-hz 20e6 --noise-figure-db 9"
    result = subprocess.run([sys.executable, "-m", "radiotwin", "coverage", *source.split(), *options.split()],
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
        if not with_twin:
            return
        # The twin's law by hand, at random cells: the best of three sites.
        rng = np.random.default_rng(0)
        cells = np.argwhere(np.isfinite(power_dbm))
        for row, column in cells[rng.choice(len(cells), 40, replace=False)]:
            place_m = np.array([opened["x"].values[column], opened["y"].values[row], 1.5])
            levels = []
            for position_m in SITES.values():
                distance_m = np.linalg.norm(place_m - position_m)
                line = LINES[int(scene.city.line_of_sight(np.array(position_m)[None], place_m[None])[0])]
                levels.append(43.0 + line[0] + 10 * line[1] * np.log10(distance_m))
            assert power_dbm[row, column] == pytest.approx(max(levels), abs=1e-3)
