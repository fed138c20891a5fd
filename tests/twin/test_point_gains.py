"""Losses for ns-3: those of the twin or the map, for each pair, with positive sign."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import radiotwin as rt
from radiotwin.cli.commands import app
from radiotwin.io.forms import Origin
from radiotwin.scene import Scene
from radiotwin.twin.point_gains import gains_at

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


def test_a_map_needs_devices_with_positions_and_its_place(small_scene, tmp_path):
    truth = rt.segmented_truth(small_scene)
    bare = Scene(small_scene.folder, small_scene.config.model_copy(update={"devices": [], "uavs": []}))
    with pytest.raises(rt.BadInput, match="declares none of the map's devices .d0, d1.* give the twin"):
        rt.export_ns3(truth, bare, POINTS_M[:2], tmp_path / "ns3")
    here, there = (placed_at(small_scene, latitude_deg) for latitude_deg in (47.0, 47.1))
    with pytest.raises(rt.BadInput, match="is a map of another place"):
        gains_at(truth.with_origin(here.config.origin), there, POINTS_M[:2], ["d0"])


def placed_at(scene, latitude_deg):
    origin = Origin(latitude_deg=latitude_deg, longitude_deg=8.0, altitude_m=0.0)
    return Scene(scene.folder, scene.config.model_copy(update={"origin": origin}))


def test_a_twin_knows_its_frame(small_scene, tmp_path):
    here, there = placed_at(small_scene, 47.0), placed_at(small_scene, 47.1)
    flown = rt.fly_survey(here, "segmented", flights=1)
    made = rt.fit_twin(flown, here, model="log_distance")
    made.save(tmp_path / "twin")
    twin = rt.Twin.load(tmp_path / "twin")
    assert twin.origin == here.config.origin
    assert np.isfinite(gains_at(twin, here, POINTS_M[:2], ["d0"])).all()
    for use in (lambda: gains_at(twin, there, POINTS_M[:2], ["d0"]), lambda: twin.radio_map(there),
                lambda: rt.fit_twin(replace(flown, origin=None), there, model="log_distance", start=twin)):
        with pytest.raises(rt.BadInput, match="the twin is in the frame about 47, 8, the scene .* about 47.1, 8"):
            use()


def test_received_powers_are_gains_above_the_power_that_is_told(small_scene):
    """With 14 dBm sent, levels are 14 dB above the gains; and the readings' own limit of detection is the map's."""
    flown = rt.fly_survey(small_scene, "segmented", flights=1)
    table = flown.table.assign(rssi_dbm=flown.table["gain_db"] + 14).drop(columns="gain_db")
    radio = small_scene.config.radio.model_copy(update={"tx_power_dbm": 14.0})
    told = Scene(small_scene.folder, small_scene.config.model_copy(update={"radio": radio}))
    gains = rt.fit_twin(flown, small_scene, model="log_distance")
    powers = rt.fit_twin(replace(flown, table=table), told, model="log_distance")
    own_db = gains_at(gains, small_scene, POINTS_M[:2], ["d0", "d1"])
    np.testing.assert_allclose(gains_at(powers, told, POINTS_M[:2], ["d0", "d1"]), own_db, atol=0.05)
    attributes = powers.radio_map(told).dataset.attrs
    assert attributes["tx_power_dbm"] == 14 and attributes["gain_limit_db"] == pytest.approx(powers.limit_db - 14)
    assert "tx_power_dbm" not in gains.radio_map(small_scene).dataset.attrs
    with pytest.warns(UserWarning, match="nobody declared: 0 dBm is assumed"):
        too_high_db = gains_at(powers, small_scene, POINTS_M[:2], ["d0", "d1"])
    np.testing.assert_allclose(too_high_db, own_db + 14, atol=0.05)
