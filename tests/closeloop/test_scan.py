"""Groups of links that stand out: faults that a pivot table shows are found, and only these."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.closeloop.families import Readings
from radiotwin.closeloop.scan import scan_readings

SIDE_M, PLACE_M = 400.0, 60.0
DEVICES, RECEIVERS, FLIGHTS, STOPS = 8, 3, 5, 60


def made(seed, devices=DEVICES, receivers=RECEIVERS, flights=FLIGHTS):
    """Readings of a campaign without a fault: noise, and errors of places that differ by device and sight."""
    rng = np.random.default_rng(seed)
    device_m = np.column_stack([rng.uniform(0, SIDE_M, (devices, 2)), np.full(devices, 2.0)])
    flight, receiver, stop = (each.ravel() for each in np.mgrid[:flights, :receivers, :STOPS])
    turn = 2 * np.pi * (stop / STOPS + rng.uniform(size=(flights, receivers))[flight, receiver])
    middle = rng.uniform(0.35, 0.65, (flights, receivers, 2))[flight, receiver] * SIDE_M
    radius = rng.uniform(80, 180, (flights, receivers))[flight, receiver]
    track_m = np.column_stack([middle + radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]),
                               rng.uniform(30, 60, (flights, receivers))[flight, receiver]])
    device = np.repeat(np.arange(devices), len(stop))
    flight, receiver, stop, receiver_m = (np.tile(each, (devices,) + (1,) * (each.ndim - 1))
                                          for each in (flight, receiver, stop, track_m))
    cell = (receiver_m[:, :2] // PLACE_M).astype(int) + 5
    is_open = rng.uniform(size=(devices, 20, 20)) < 0.65
    los = is_open[device, cell[:, 0], cell[:, 1]]
    of_place = rng.normal(size=(devices, 20, 20))[device, cell[:, 0], cell[:, 1]]
    residual_db = np.where(los, 0.8 * of_place + 1.5 * rng.normal(size=len(los)),
                           4.5 * of_place + 4.0 * rng.normal(size=len(los)))
    to_m = receiver_m - device_m[device]
    level_db = -80 - 20 * np.log10(np.linalg.norm(to_m, axis=1) / 100) - np.where(los, 0, 18)
    names = {"device": [f"d{n}" for n in range(devices)], "receiver": [f"u{n}" for n in range(receivers)],
             "flight": [f"f{n}" for n in range(flights)]}
    return Readings(residual_db, np.zeros(len(los)) - 0.001, los, device, receiver, flight,
                    600.0 * flight + 5.0 * stop, receiver_m, device_m[device], receiver_m,
                    {"azimuth": np.degrees(np.arctan2(to_m[:, 1], to_m[:, 0])),
                     "elevation": np.degrees(np.arcsin(to_m[:, 2] / np.linalg.norm(to_m, axis=1))),
                     "body azimuth": np.full(len(los), np.nan)}, level_db, names)


def changed(readings, rows, change_db):
    residual_db = readings.residual_db.copy()
    residual_db[rows] += change_db if np.isscalar(change_db) else change_db[rows]
    return replace(readings, residual_db=residual_db)


def sure(readings):
    return [each for each in scan_readings(readings) if each.probability >= 0.9]


def test_nothing_stands_out_where_nothing_is_wrong():
    said = [each for seed in range(8) for each in sure(made(seed))]
    assert len(said) <= 1, said


@pytest.mark.parametrize("seed", range(2))
def test_a_device_below_the_others_is_found_with_its_size(seed):
    readings = made(seed)
    (found,) = sure(changed(readings, readings.device == 3, -6.0))
    assert (found.family, found.members, found.statistic) == ("device", {"device": ("d3",)}, "level")
    assert found.size.low - 0.5 < -6.0 < found.size.high + 0.5 and found.sight == "all"
    assert found.size.high - found.size.low < 3.0
    assert np.array_equal(found.rows, readings.device == 3)


@pytest.mark.parametrize("seed", range(2))
def test_a_garbage_flight_is_one_group_and_not_its_pairs(seed):
    readings = made(seed)
    noise_db = 12.0 * np.random.default_rng(seed).normal(size=len(readings))
    (found,) = sure(changed(readings, readings.flight == 2, noise_db))
    assert (found.family, found.members, found.statistic) == ("flight", {"flight": ("f2",)}, "scatter")
    assert found.size.unit == "times" and found.size.value > 1.5


@pytest.mark.parametrize("seed", range(2))
def test_a_receiver_on_one_flight_is_not_blamed_on_all_of_it(seed):
    readings = made(seed)
    rows = (readings.receiver == 1) & (readings.flight == 3)
    (found,) = sure(changed(readings, rows, -5.0))
    assert found.family == "receiver x flight" or found.ranges
    assert found.members["flight"] == ("f3",) and found.members["receiver"] == ("u1",)


@pytest.mark.parametrize("seed", range(2))
def test_a_device_that_moved_scatters_on_its_later_flights(seed):
    readings = made(seed)
    moved_m = np.array([80.0, 50.0, 0.0])
    before_m, after_m = (np.linalg.norm(readings.receiver_m - readings.device_m - shift, axis=1)
                         for shift in (0.0, moved_m))
    away_db = -40 * np.log10(after_m / before_m) + 7 * np.sin(readings.receiver_m[:, 0] / 15)
    found = sure(changed(readings, (readings.device == 5) & (readings.flight >= 3), away_db))
    assert found and all(each.members.get("device") == ("d5",) for each in found)


def test_a_minute_of_one_receiver_is_found_as_a_time():
    readings = made(7)
    rows = (readings.flight == 1) & (readings.receiver == 2) & (readings.time_s % 600 < 75)
    found = sure(changed(readings, rows, -8.0))
    assert [each.family for each in found] == ["time"]
    (low_s, high_s) = found[0].ranges["time_s"]
    assert found[0].members["receiver"] == ("u2",) and low_s < 640 and high_s < 720


def test_blanks_of_one_receiver_stand_out():
    readings, rng = made(3), np.random.default_rng(0)
    lost = (readings.receiver == 0) & (rng.uniform(size=len(readings)) < 0.3)
    found, *_ = sure(replace(readings, blank_excess=np.where(lost, 1.0, readings.blank_excess),
                            residual_db=np.where(lost, np.nan, readings.residual_db)))
    assert (found.family, found.statistic, found.members["receiver"]) == ("receiver", "blanks", ("u0",))
    assert found.size.value == pytest.approx(0.3, abs=0.1)


def test_too_few_readings_say_nothing():
    assert scan_readings(changed(made(1, devices=1, receivers=1, flights=1), slice(None), -20.0)) == []


@pytest.mark.parametrize("seed", range(2))
def test_a_receiver_that_drifts_to_and_fro_is_found_though_its_level_is_right(seed):
    readings = made(seed)
    drift_db = np.where(readings.receiver == 1, 4.0 * np.sin(2 * np.pi * readings.time_s / 150.0), 0.0)
    found = sure(changed(readings, np.ones(len(readings), dtype=bool), drift_db))
    assert [(each.family, each.members, each.statistic, each.along) for each in found[:1]] == [
        ("receiver", {"receiver": ("u1",)}, "curve", "time_s")]
    assert found[0].size.low < 4.0 / np.sqrt(2) < found[0].size.high + 0.5
