"""Gains at any points: the file of points, and why nothing is detected."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.runtime import pieces
from radiotwin.trace import SolverSettings, read_points, trace_gains, trace_points

SETTINGS = SolverSettings(batch_receivers=4)


def write(path, text):
    path.write_text(text)
    return path


def test_reads_the_columns_it_needs(tmp_path):
    path = write(tmp_path / "points.csv", "name, z_m, x_m,y_m\na,3,1,2\nb,30.5,-1e1,0\n")
    assert read_points(path).tolist() == [[1, 2, 3], [-10, 0, 30.5]]


@pytest.mark.parametrize(("text", "message"), [
    ("x_m,y_m\n1,2\n", "row 2: has no height"),
    ("x_m,y_m,z_m\n1,2,3\n1,two,3\n", "row 3, column y_m: 'two' is not a number"),
    ("x_m,y_m,z_m\n1,2,inf\n", "row 2, column z_m: 'inf' is not finite"),
    ("x_m,y_m,z_m\n1,,3\n", "row 2: has no position"),
    ("x_m,y_m,z_m\n", "has no rows"),
    ("", "is empty"),
    ("x_m,y_m,z_m\n1,2,3\n10,20,1.5,7\n", "row 3 has 4 fields, the header has 3"),
    ("x_m,y_m,z_m\n0,0,0\n0,-1e308,1\n", "row 3.* too far "),
])
def test_bad_points_name_row_and_column(tmp_path, text, message):
    path = write(tmp_path / "points.csv", text)
    with pytest.raises(BadInput, match=message) as error:
        read_points(path)
    assert str(path) in str(error.value)


def test_each_link_has_a_gain_or_a_reason(small_scene, law, tmp_path):
    lattice_m = small_scene.lattice.positions_m[::9]
    low_m = np.column_stack([lattice_m[:, :2], np.full(len(lattice_m), 2.0)])
    points_m = np.concatenate([lattice_m, low_m])
    out = tmp_path / "gains.csv"
    table = trace_points(small_scene, points_m, SETTINGS, out, devices=["d3", "d0"])
    assert list(table.columns) == ["device", "x_m", "y_m", "z_m", "gain_db", "los", "reason"]
    assert list(dict.fromkeys(table["device"])) == ["d3", "d0"] and len(table) == 2 * len(points_m)
    assert set(table["reason"]) == {"", "no path", "inside a building"}
    assert (table["gain_db"].isna() == (table["reason"] != "")).all()
    inside = np.tile(small_scene.city.inside(points_m), 2)
    assert ((table["reason"] == "inside a building") == inside).all()
    read = pd.read_csv(out, keep_default_na=False)
    assert (read["gain_db"] == "").sum() == table["gain_db"].isna().sum()
    assert (read["reason"] == table["reason"]).all()


def test_an_impossible_and_a_weak_gain_have_their_reasons(small_scene, law):
    points_m = small_scene.lattice.positions_m
    law.impossible_m, law.offset_db = points_m[[1, 4]].tolist(), -30.0
    table = trace_points(small_scene, points_m, SETTINGS, devices=["d0"])
    assert (table["reason"] == "impossible gain").to_numpy().nonzero()[0].tolist() == [1, 4]
    assert (table["gain_db"].isna() == (table["reason"] != "")).all()
    assert (table["reason"] == "below sensitivity").sum() > 10
    assert table["gain_db"].min() >= small_scene.config.gain_limit_db


def test_what_cannot_be_traced_is_refused_before_the_work(small_scene, law, tmp_path, monkeypatch):
    with pytest.raises(BadInput, match="allowed are .csv"):
        trace_points(small_scene, np.ones((1, 3)), SETTINGS, tmp_path / "gains.xlsx")
    with pytest.raises(BadInput, match="averages over lattice cells"):
        trace_points(small_scene, np.ones((1, 3)), SolverSettings(solver="map"))
    monkeypatch.setenv("RADIOTWIN_MAX_ROWS", "5")
    with pytest.raises(BadInput, match="points times devices: 6 rows; at most 5"):
        trace_points(small_scene, np.ones((3, 3)), SETTINGS, devices=["d0", "d1"])
    assert law.calls == 0


@pytest.mark.filterwarnings("ignore:divide by zero")
def test_points_that_no_gain_is_for(small_scene, law):
    """Rationale: within a wavelength of a device a number would be wrong, and below the ground none has a meaning."""
    x_m, y_m, z_m = small_scene.device_m[0]
    points_m = np.array([[x_m, y_m, z_m], [x_m + 0.1, y_m, z_m], [x_m + 0.2, y_m, z_m], [x_m, y_m, -0.5]])
    table = trace_points(small_scene, points_m, SETTINGS, devices=["d0"])
    assert table["reason"].tolist() == ["within a wavelength", "within a wavelength", "", "below the ground"]
    assert table["gain_db"].notna().tolist() == [False, False, True, False]


def test_points_in_degrees(tmp_path):
    origin = Origin(latitude_deg=47.5, longitude_deg=8.7)
    path = write(tmp_path / "points.csv", "longitude_deg,latitude_deg,z_m\n8.7,47.5,3\n8.7,47.501,4\n")
    points_m = read_points(path, origin)
    assert points_m == pytest.approx(np.array([[0, 0, 3], [0, 111.19, 4]]), abs=0.02)
    with pytest.raises(BadInput, match=r"need the origin of the frame of the scene"):
        read_points(path)
    with pytest.raises(BadInput, match="row 3, column latitude_deg: '91' is no latitude; allowed are -90 to 90"):
        read_points(write(tmp_path / "far.csv", "latitude_deg,longitude_deg,z_m\n1,1,1\n91,0,1\n"), origin)
    with pytest.raises(BadInput, match="latitude and longitude are given together or not at all"):
        read_points(write(tmp_path / "half.csv", "latitude_deg,z_m\n1,1\n"), origin)
    with pytest.raises(BadInput, match=r"row 2: x, y = 50, 0 is 50 m from its latitude and longitude"):
        read_points(write(tmp_path / "two.csv", "x_m,y_m,z_m,latitude_deg,longitude_deg\n50,0,3,47.5,8.7\n"), origin)


def test_killed_gains_go_on_after_the_last_batch(small_scene, law, tmp_path, monkeypatch):
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    points_m = small_scene.lattice.positions_m[:30]
    trace_points(small_scene, points_m, SETTINGS, tmp_path / "whole.csv", ["d0", "d3"])
    total, solve = law.calls, law.solve

    def killed(self, *args):
        if law.calls == 5:
            raise KeyboardInterrupt
        return solve(self, *args)

    law.calls, law.solve = 0, killed
    with pieces.keep_pieces(), pytest.raises(KeyboardInterrupt):
        trace_points(small_scene, points_m, SETTINGS, tmp_path / "killed.csv", ["d0", "d3"])
    assert not (tmp_path / "killed.csv").exists()
    law.calls, law.solve = 0, solve
    with pieces.keep_pieces() as store:
        trace_points(small_scene, points_m, SETTINGS, tmp_path / "killed.csv", ["d0", "d3"])
    assert law.calls == total - 5 and store.earlier == 5
    assert (tmp_path / "killed.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()


def test_gains_of_another_scene_or_other_rays_are_others(own_scene, law, monkeypatch):
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    points_m, device_m = own_scene.lattice.positions_m[:4], own_scene.device_m[:1]
    mesh = next(own_scene.folder.glob("meshes/*"))
    with pieces.keep_pieces() as store:
        trace_gains(own_scene, device_m, points_m, SETTINGS)
        trace_gains(own_scene, device_m, points_m, SolverSettings(batch_receivers=4, seed=7))
        mesh.write_bytes(mesh.read_bytes() + b"\n")
        trace_gains(own_scene, device_m, points_m, SETTINGS)
    assert store.made == 3
