"""Losses for ns-3: those of the twin or the map, for each pair, with positive sign."""

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import radiotwin as rt
from radiotwin.cli.commands import app

INSIDE_M, POINTS_M = [30.0, 60.0, 5.0], np.array([[80.0, 120.0, 55.0], [200.0, 120.0, 55.0], [30.0, 60.0, 5.0]])


@pytest.fixture(scope="module")
def twin(small_scene):
    return rt.fit_twin(rt.fly_survey(small_scene, "segmented", flights=1), small_scene, model="log_distance")


def read(folder):
    """The pairs of a folder: (device, x, y, z) -> loss [dB], as a program without radiotwin joins the two tables."""
    nodes, losses = pd.read_csv(folder / "nodes.csv").set_index("node"), pd.read_csv(folder / "losses.csv")
    return nodes, {(nodes.loc[row.device_node, "name"], *nodes.loc[row.point_node, ["x_m", "y_m", "z_m"]]): row.loss_db
                   for row in losses.itertuples()}


def test_losses_of_a_twin_follow_its_law(small_scene, twin, tmp_path):
    """A log-distance law is linear in the logarithm of the distance: two coefficients give every loss."""
    assert rt.export_ns3(twin, small_scene, POINTS_M, tmp_path) == 7 * 2, "nobody is in the building"
    nodes, losses = read(tmp_path)
    assert nodes.index.tolist() == list(range(10)) and nodes["name"].tolist()[7:] == ["point0", "point1", "point2"]
    assert not any(key[1:] == tuple(INSIDE_M) for key in losses) and min(losses.values()) > 40
    at_m = nodes.set_index("name")[["x_m", "y_m", "z_m"]]
    distance_m = [np.linalg.norm(at_m.loc[name].to_numpy() - np.array(end)) for name, *end in losses]
    law = np.polyfit(np.log10(distance_m), list(losses.values()), 1)
    assert np.abs(np.polyval(law, np.log10(distance_m)) - list(losses.values())).max() < 0.01 and 15 < law[0] < 60


def test_losses_of_a_map_are_its_gains_on_the_lattice_only(small_scene, tmp_path):
    truth = rt.segmented_truth(small_scene)
    assert rt.export_ns3(truth, small_scene, POINTS_M[:2], tmp_path, devices=["d3", "d0"]) == 4
    nodes, losses = read(tmp_path)
    assert nodes["name"].tolist() == ["d3", "d0", "point0", "point1"]
    gain_db = float(truth.dataset["gain_db"].sel(device="d3", x=80, y=120, z=55))
    assert losses["d3", 80.0, 120.0, 55.0] == pytest.approx(-gain_db, abs=1e-3)
    with pytest.raises(rt.BadInput, match="not on the lattice"):
        rt.export_ns3(truth, small_scene, [[81.0, 120.0, 55.0]], tmp_path)


@pytest.mark.parametrize("points_m, devices, part", [
    ([INSIDE_M], None, "no pair"), (POINTS_M, ["d9"], "'d9' has no position here")])
def test_nothing_is_written_where_there_is_nothing(small_scene, twin, tmp_path, points_m, devices, part):
    with pytest.raises(rt.BadInput, match=part):
        rt.export_ns3(twin, small_scene, points_m, tmp_path / "ns3", devices=devices)
    assert not (tmp_path / "ns3").exists()


def test_the_command(small_scene, twin, tmp_path):
    twin.save(tmp_path / "twin")
    pd.DataFrame(POINTS_M, columns=["x_m", "y_m", "z_m"]).to_csv(tmp_path / "points.csv", index=False)
    options = ["--scene", str(small_scene.folder), "--points", str(tmp_path / "points.csv"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["export", str(tmp_path / "twin"), *options])
    assert done.exit_code == 0 and "14 pairs" in done.output and (tmp_path / "out" / "losses.csv").is_file()
    refused = CliRunner().invoke(app, ["export", str(tmp_path / "twin"), *options, "--to", "ns4"])
    assert isinstance(refused.exception, rt.BadInput) and "allowed is ns3" in str(refused.exception)
