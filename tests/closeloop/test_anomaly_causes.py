"""Causes of groups that stand out: a weak device, a flight that is garbage, a device that was moved."""

import numpy as np
import pandas as pd
import pytest

import radiotwin as rt
from radiotwin.links.measurements import Measurements
from tests.worlds import leave_effects

DEVICES, RECEIVERS, FLIGHTS, SLOTS = 6, 2, 5, 45
PLACES_M = np.array([[60, 80], [330, 60], [350, 330], [90, 340], [210, 190], [40, 220]], dtype=float)


def campaign(seed, moved_m=(0.0, 0.0), weak_db=0.0, garbage_db=0.0):
    """Fly loops past six devices over open ground, with shadows of 1.5 dB that stay.

    Device d2 sends less, d4 stands elsewhere on the last two flights, and flight f3 scatters.
    """
    rng, parts = np.random.default_rng(seed), []
    for flight in range(FLIGHTS):
        for receiver in range(RECEIVERS):
            phase = np.linspace(0, 2 * np.pi, SLOTS) + rng.uniform(0, 2 * np.pi)
            place_m = np.column_stack([200 + 150 * np.cos(phase), 200 + 150 * np.sin(2 * phase),
                                       np.full(SLOTS, 40.0 + 3 * receiver)])
            for device, at_m in enumerate(PLACES_M):
                true_m = at_m + np.array(moved_m) * (device == 4 and flight >= 3)
                distance_m = np.linalg.norm(place_m - [*true_m, 2.0], axis=1)
                shadow_db = 1.5 * np.sin(place_m[:, 0] / 19 + 5 * device) * np.sin(place_m[:, 1] / 27 + 3 * device)
                level_db = -38 - 23 * np.log10(distance_m) + shadow_db + rng.normal(0, 1.0, SLOTS)
                level_db -= weak_db * (device == 2)
                level_db += garbage_db * (flight == 3) * rng.normal(0, 1, SLOTS)
                parts.append(pd.DataFrame({
                    "time_s": 150.0 * flight + np.arange(SLOTS) * 1.5, "flight": f"f{flight}", "receiver": f"u{receiver}",
                    "receiver_x_m": place_m[:, 0], "receiver_y_m": place_m[:, 1], "receiver_z_m": place_m[:, 2],
                    "device": f"d{device}", "gain_db": np.round(level_db)}))
    devices = pd.DataFrame({"device": [f"d{number}" for number in range(DEVICES)], "x_m": PLACES_M[:, 0],
                            "y_m": PLACES_M[:, 1], "z_m": 2.0, "role": "anchor", "frequency_hz": 2.4e9})
    return Measurements(pd.concat(parts, ignore_index=True), devices)


@pytest.fixture(autouse=True)
def few_effects(monkeypatch):
    leave_effects(monkeypatch, "device_gain_offset", "device_moved", "device_position_error", "faulty_flight", "episode",
                  "device_drift", "receiver_gain_offset")


def named(loop):
    return [each for each in loop.after.whole.effects if each.is_cause and not each.is_declared]


def test_a_weak_device_is_named_with_its_loss():
    loop = rt.close_loop(campaign(1, weak_db=6.0), base="log-distance")
    (effect,) = named(loop)
    assert effect.name == "device_gain_offset" and effect.params.members == [2]
    assert loop.parameters[loop.after.whole.effects.index(effect)]["offset_db[d2]"].value == pytest.approx(-6, abs=0.7)
    (anomaly,) = [each for each in loop.found.anomalies if each.probability >= 0.9]
    assert anomaly.members == {"device": ("d2",)} and anomaly.causes["device_gain_offset"] > 0.5
    assert sum(anomaly.causes.values()) == pytest.approx(1)


def test_a_flight_that_is_garbage_is_one_effect_of_all_receivers():
    loop = rt.close_loop(campaign(2, garbage_db=11.0), base="log-distance")
    (effect,) = named(loop)
    assert effect.name == "faulty_flight" and effect.params.receiver is None and effect.params.flight == "f3"
    assert effect.params.noise_sd_db == pytest.approx(11, abs=2)


@pytest.mark.slow
def test_a_device_that_was_moved_is_found_where_it_went():
    loop = rt.close_loop(campaign(3, moved_m=(70.0, -40.0)), base="log-distance")
    (effect,) = named(loop)
    assert effect.name == "device_moved" and effect.params.device == 4
    assert effect.params.flights == ["f3", "f4"]
    assert np.array(effect.params.move_m) == pytest.approx([70, -40], abs=8)
    assert all(each.causes["device_moved"] > 0.5 for each in loop.found.anomalies if each.probability >= 0.9)


@pytest.mark.slow
def test_two_faults_are_told_apart():
    loop = rt.close_loop(campaign(4, weak_db=6.0, garbage_db=11.0), base="log-distance")
    assert {each.name for each in named(loop)} == {"device_gain_offset", "faulty_flight"}


def test_nothing_is_named_where_nothing_stands_out():
    loop = rt.close_loop(campaign(5), base="log-distance")
    assert named(loop) == [] and not any(each.causes for each in loop.found.anomalies)
