"""Receivers compared where both were, in walks whose places confound a regression over all links."""

import numpy as np
import pytest

from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.residual_tests import noise_floor_db
from radiotwin.effects.catalogue.gain_drift import DeviceDrift, Drift, ReceiverDrift
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.effects.params import Parameter
from radiotwin.links.sites import end_notes, inseparable_pairs, receiver_differences, shared_names
from tests.worlds import synthetic_links

OFFSET_DB, SQUARE_M = -4.0, 100.0


def walked(seed, offset_db=OFFSET_DB, limit_db=-np.inf, devices=4):
    """Two phones on the same streets, apart by GPS; the second is also where levels are 8 dB higher."""
    rng = np.random.default_rng(seed)
    device_m = np.column_stack([rng.uniform(0, 1000, (devices, 2)), np.full(devices, 20.0)])
    street_m = np.arange(0.0, 1000.0, 2.0)
    shadow_db = rng.normal(0, 8, (devices, 2, 11))  # of a device in each piece of a street

    def levels(place_m, device, street):
        distance_m = np.linalg.norm(place_m - device_m[device], axis=1)
        return -40 - 30 * np.log10(distance_m) + shadow_db[device, street, (place_m[:, 0] // SQUARE_M).astype(int)]

    rows = []
    for receiver, streets in ((0, (0,)), (1, (0, 1))):
        for street in streets:
            for device in range(devices):
                there_m = np.column_stack([street_m, np.full((len(street_m), 1), 400.0 * street),
                                           np.full(len(street_m), 1.5)])
                level_db = levels(there_m, np.full(len(street_m), device), np.full(len(street_m), street))
                level_db += receiver * offset_db + 8.0 * street + rng.normal(0, 2, len(street_m))
                told_m = there_m + np.append(rng.normal(0, 0.5, (len(street_m), 2)), np.zeros((len(street_m), 1)), 1)
                rows.append((told_m, np.full(len(street_m), device), np.full(len(street_m), receiver), level_db))
    receiver_m, device, receiver, level_db = (np.concatenate(part) for part in zip(*rows))
    level_db = np.where(level_db < limit_db, np.nan, level_db)
    return synthetic_links(device_m, device, receiver_m, level_db=level_db, limit_db=limit_db, receiver=receiver,
                           frequency_hz=3.6e9, is_gain=False)


@pytest.mark.parametrize("seed", range(3))
def test_the_difference_is_that_of_shared_places(seed):
    links = walked(seed)
    (found,) = receiver_differences(links)
    assert found.low_db < OFFSET_DB < found.high_db
    assert found.difference_db == pytest.approx(OFFSET_DB, abs=0.4) and found.high_db - found.low_db < 2.0
    assert found.pairs > 1500 and found.places > 100
    over_all_db = np.mean(links.level_db[links.receiver == 1]) - np.mean(links.level_db[links.receiver == 0])
    assert abs(over_all_db - OFFSET_DB) > 2.0


def test_intervals_hold_as_often_as_they_say():
    hits = [found.low_db <= OFFSET_DB <= found.high_db for seed in range(20)
            for found in receiver_differences(walked(seed, devices=2))]
    assert len(hits) == 20 and np.mean(hits) >= 0.75


def test_devices_that_differ_by_themselves_widen_the_interval():
    links = walked(0)
    each_db = np.array([-6.0, -2.0, 3.0, 6.0])
    links.level_db[links.receiver == 1] += each_db[links.device[links.receiver == 1]]
    (found,) = receiver_differences(links)
    assert found.high_db - found.low_db > 6.0


def test_a_limit_of_detection_does_not_choose_the_pairs():
    links = walked(1, limit_db=-130.0)
    assert 0.1 < np.isnan(links.level_db).mean() < 0.6
    (found,) = receiver_differences(links)
    assert found.difference_db == pytest.approx(OFFSET_DB, abs=0.6)


def test_receivers_that_never_met_are_not_compared():
    links = walked(0)
    links.receiver_m[links.receiver == 1] += [0.0, 50.0, 0.0]
    assert receiver_differences(links) == []


def test_ends_that_never_part_are_said_to_be_one():
    """d2 and r2 are read by nobody else; d0 and d1 share r0 and r1. A blank of r0 tells nothing of d2."""
    device, receiver = (np.repeat(each, 40) for each in ([0, 0, 1, 1, 2, 2], [0, 1, 0, 1, 2, 0]))
    assert inseparable_pairs(device[:200], receiver[:200]) == {2: 2} and inseparable_pairs(device, receiver) == {}
    level_db = np.where(np.arange(240) < 200, -90.0, np.nan)
    links = synthetic_links([[0.0, 0, 10], [90.0, 0, 10], [0.0, 90, 10]], device, np.tile([50.0, 50.0, 1.5], (240, 1)),
                            level_db=level_db, receiver=receiver)
    (note,) = end_notes(links)
    assert note.startswith("device and receiver are never apart (d2 and r2)")
    for effect, end, rival in ((ReceiverDrift, "receivers", ["device_drift"]), (DeviceDrift, "devices", ["receiver_drift"])):
        found = {member: effect().with_params(effect.Params.model_validate({end: {member: Drift("ageing", 0.0)}}))
                 for member in (0, 2)}
        assert found[2].rivals(links, {}) == rival and found[0].rivals(links, {}) == []
    offsets = ReceiverGainOffset().with_params(ReceiverGainOffset.Params(members=[0, 1, 2], offsets_sd_db=2.0))
    for sizes_db, rivals in (((0.1, 0.3, -5.0), ["device_gain_offset"]), ((0.1, 5.0, 0.2), [])):
        values = {f"offset_db[r{each}]": Parameter(size, None, None, "dB") for each, size in enumerate(sizes_db)}
        assert offsets.rivals(links, values) == rivals


@pytest.mark.parametrize("timed", [True, False])
def test_two_cells_of_one_name_are_told_and_are_no_noise(timed):
    """Of four cells the last is two, 10 dB apart: readings repeat within 1 dB otherwise."""
    rng = np.random.default_rng(0)
    place_m = np.column_stack([rng.uniform(0, 300, (60, 2)), np.full(60, 1.5)])
    device, place = np.repeat(np.arange(4), 120), np.tile(np.repeat(np.arange(60), 2), 4)
    level_db = -80.0 + rng.normal(0, 1.0, 480) - 10.0 * (device == 3) * (np.arange(480) % 2)
    times = {"time_s": 10.0 * place} if timed else {}
    links = synthetic_links(rng.uniform(0, 300, (4, 3)), device, place_m[place], level_db=level_db, **times)
    assert list(shared_names(links)) == [3]
    (note,) = [each for each in end_notes(links) if "two transmitters" in each]
    assert note.startswith("device d3 may be two transmitters") and f"at one {'time' if timed else 'place'}" in note
    assert noise_floor_db(links, SelectionCriteria()) == pytest.approx(1.0, abs=0.1)
    links.level_db[(device == 3) & (np.arange(480) % 2 == 1)] += 10.0
    assert shared_names(links) == {}
