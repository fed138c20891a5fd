"""Links as they are read from measurements: what is left out and noted, geometry, and the map between the ends."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.links import (
    LinkGeometry,
    evidence_blocks,
    link_geometry,
    prepare_links,
    residual_variables,
)
from radiotwin.links.links import RESTART_NOTE
from radiotwin.scene.citymap import CityMap
from tests.worlds import synthetic_links


def test_what_cannot_be_used_is_left_out_and_noted(open_ground):
    measurements = open_ground.measured(open_ground.fly(0, limit_db=-500.0))
    table = measurements.table
    n = len(table)
    table.loc[0, "receiver_x_m"] = 5.9e6
    table.loc[1] = table.loc[2]
    table.loc[3:5, "receiver"] = "broken"
    table.loc[6:40, "receiver"] = "dead"
    table.loc[6:40, "gain_db"] = np.nan
    table.loc[41:60, "receiver"] = "stuck"
    table.loc[41:60, "gain_db"] = -77.0
    links = prepare_links(measurements, None)
    assert len(links) == n - 1 - 1 - 3 - 35 - 20 and links.receiver_names == ["r0", "r1"]
    notes = " ".join(links.notes)
    for part in ("more than 100 km", "twice", "broken has 3 only", "dead never detected", "stuck always reads -77"):
        assert part in notes, part


def test_devices_of_other_frequencies_are_mentioned(open_ground):
    measurements = open_ground.measured(open_ground.fly(0))
    own_hz = float(measurements.devices["frequency_hz"].iloc[0]) if "frequency_hz" in measurements.devices else 2.4e9
    devices = measurements.devices.assign(frequency_hz=own_hz)
    assert prepare_links(replace(measurements, devices=devices), None).notes == ()
    near = devices.assign(frequency_hz=np.where(np.arange(len(devices)) == 0, 1.05 * own_hz, own_hz))
    assert prepare_links(replace(measurements, devices=near), None).notes == ()
    two = devices.assign(frequency_hz=np.where(np.arange(len(devices)) == 0, 0.8e9, 2.6e9))
    (note,) = prepare_links(replace(measurements, devices=two), None).notes
    assert note.startswith("devices work at 0.8 to 2.6 GHz, and all are computed at 2.6 GHz")


def test_a_receiver_that_heard_once_is_not_stuck_and_equal_rows_without_a_time_are_measurements(open_ground):
    measurements = open_ground.measured(open_ground.fly(0, limit_db=-500.0))
    table, n = measurements.table, len(measurements.table)
    table.loc[:19, "receiver"] = "far"
    table.loc[:18, "gain_db"] = np.nan
    table.loc[30] = table.loc[31]
    assert len(prepare_links(measurements, None)) == n - 1
    table["time_s"] = np.nan
    links = prepare_links(measurements, None)
    assert len(links) == n and links.receiver_names == ["far", "r0", "r1"] and links.notes == ()


def test_a_value_that_means_not_detected_becomes_blank(open_ground):
    world = open_ground.fly(1)
    measurements = open_ground.measured(world)
    blank = measurements.table["gain_db"].isna()
    lowest = measurements.table["gain_db"].nsmallest(300).index
    measurements.table.loc[blank, "gain_db"] = -140.0
    measurements.table.loc[lowest, "gain_db"] = -140.0
    links = prepare_links(measurements, None)
    assert np.isnan(links.level_db).sum() == blank.sum() + 300 and "-140" in " ".join(links.notes)
    assert prepare_links(open_ground.measured(world), None).notes == ()  # an ordinary tail stays


def test_directions_are_compass_bearings(open_ground):
    world = open_ground.fly(2)
    links = prepare_links(open_ground.measured(world), None)
    east, north = links.offset_m[:, 0], links.offset_m[:, 1]
    rows = (np.abs(east) < 30) & (north > 100)
    assert rows.any() and (np.abs((links.azimuth_deg[rows] + 180) % 360 - 180) < 20).all()
    # A receiver that flies straight away from the device has it behind itself.
    away = np.abs((links.heading_deg - links.azimuth_deg + 180) % 360 - 180) < 5
    assert away.any() and (np.abs(links.body_azimuth_deg[away] - 180) < 5.01).all()


def test_a_piece_of_evidence_is_of_one_device_receiver_and_flight(open_ground):
    links = prepare_links(open_ground.measured(open_ground.fly(4)), None)
    block = evidence_blocks(links)
    for index in (links.device, links.receiver, links.flight):
        pairs = np.unique(np.column_stack([block, index]), axis=0)
        assert len(pairs) == block.max() + 1


def test_too_little_is_refused(open_ground):
    measurements = open_ground.measured(open_ground.fly(5))
    with pytest.raises(BadInput, match="at least 60 are needed"):
        prepare_links(measurements.select(np.arange(len(measurements.table)) < 40), None)


def test_buildings_in_the_way_are_measured_along_the_link():
    """A wall 10 m thick and 30 m high, in the middle of links of 100 m that pass 20 m below its top and 10 m above."""
    city = trimesh.creation.box(extents=[10, 400, 30])
    city.apply_translation([0, 0, 15])
    links = synthetic_links([[-50, 0, 10], [-50, 0, 40]], [0, 1], [[50, 0, 10], [50, 0, 40]],
                            city=CityMap(city.vertices, city.faces))
    np.testing.assert_allclose(links.metres_inside, [10, 0], atol=0.01)
    wavelength_m = 299_792_458 / 2.4e9
    assert links.diffraction_parameter[0] == pytest.approx(20 * np.sqrt(2 / wavelength_m * 2 / 50), rel=0.01)
    # Beside the wall the ground is 40 m below, near an end, where the zones are narrow: the roof is what counts.
    assert links.diffraction_parameter[1] == pytest.approx(-10 * np.sqrt(2 / wavelength_m * 2 / 50), rel=0.01)


DEVICE_M = np.array([[0.0, 0.0, 1.5], [np.nan, np.nan, 1.5], [10.0, 20.0, 0.0]])


def test_shapes_that_disagree():
    with pytest.raises(ValueError, match=r"los: shape \(3,\), expected \(2,\)"):
        LinkGeometry(np.zeros((2, 3)), np.zeros((2, 3)), np.ones(3, bool), np.zeros(2, int))


@pytest.mark.parametrize(("device", "receiver_m", "log_distance", "elevation_deg"), [
    (0, [30.0, 0.0, 41.5], 1.69897, 53.1301),  # the triangle 3, 4, 5
    (2, [10.0, 20.0, -7.0], 0.845098, -90.0), (2, [10.0, 20.0, 60.0], 1.778151, 90.0), (0, [0.0, 0.0, 1.5], 0.0, 0.0)])
def test_distance_and_elevation(device, receiver_m, log_distance, elevation_deg):
    links = link_geometry(DEVICE_M, [receiver_m], [device], None)
    assert links.log_distance[0] == pytest.approx(log_distance, abs=1e-5)
    assert np.degrees(links.elevation_rad[0]) == pytest.approx(elevation_deg, abs=1e-4)


@pytest.mark.parametrize(("device", "receiver_m", "message"), [
    ([-1, 0], np.zeros((2, 3)), "there are 3 devices"), ([3, 0], np.zeros((2, 3)), "there are 3 devices"),
    ([0, 1], np.zeros((2, 3)), "position of device row 1 is blank"), ([0, 0], [[0.0, 0, 0], [0, np.inf, 0]], "row 1")])
def test_ends_that_are_none_are_named(device, receiver_m, message):
    with pytest.raises(BadInput, match=message):
        link_geometry(DEVICE_M, receiver_m, device, None)


def test_clocks_that_restart_in_each_flight_are_noted_and_their_times_are_not_compared(open_ground):
    world = open_ground.fly(0)
    for time_s, restart in ((world.time_s, False), (world.slot, True)):
        links = prepare_links(open_ground.measured(world, time_s=time_s), None)
        assert links.time_restarts == restart and links.notes == (RESTART_NOTE,) * restart
        assert np.isnan(residual_variables(links, links.level_db)["time_s"]).all() == restart
        assert links.select(links.flight < 1).time_restarts == restart  # stays that of all the data
