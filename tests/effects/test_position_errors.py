"""Ends that stand elsewhere: the level changes as the law says of the new place, for the links of that end only."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.position_errors import DevicePositionError, ReceiverPositionError

DEVICES_M = np.array([[0.0, 0, 1.5], [150, 40, 1.5]])


def law_db(records, exact=False):
    return -40 - 22 * np.log10(records.distance_m)


@pytest.fixture
def records(links):
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-150, 250, (300, 2)), np.full(300, 40.0)])
    return links(DEVICES_M, receiver_m, receiver=np.repeat(np.arange(300) % 2, 2))


def moved_db(records, device_m, receiver_m):
    """What the law gives with ends elsewhere, over what it gives for where they are declared."""
    return -22 * np.log10(np.linalg.norm(receiver_m - device_m, axis=1)
                          / np.linalg.norm(records.receiver_m - DEVICES_M[records.device], axis=1))


def test_a_device_elsewhere_changes_its_own_links(records):
    term = DevicePositionError().term(records, {"device": 1, "move_m": [30.0, -20.0]}, law_db)
    expected_db = moved_db(records, (DEVICES_M + [(0, 0, 0), (30, -20, 0)])[records.device], records.receiver_m)
    np.testing.assert_allclose(term.offset_db, expected_db, atol=1e-9)
    assert np.abs(term.offset_db[records.device == 0]).max() == 0 and np.abs(expected_db).max() > 3


def test_a_receiver_elsewhere_changes_its_own_links(records):
    term = ReceiverPositionError().term(records, {"receiver": 0, "move_m": [0.0, 5.0, -25.0]}, law_db)
    place_m = records.receiver_m + np.where(records.receiver == 0, 1.0, 0.0)[:, None] * (0, 5, -25)
    np.testing.assert_allclose(term.offset_db, moved_db(records, DEVICES_M[records.device], place_m), atol=1e-9)


def test_the_one_that_is_wrong_is_proposed_with_its_direction(records, view):
    rng = np.random.default_rng(1)
    noise_db = rng.normal(0, 0.5, len(records))
    moved_m = (DEVICES_M + [(0, 0, 0), (36, -22, 0)])[records.device]
    records.level_db[:] = law_db(records) + moved_db(records, moved_m, records.receiver_m) + noise_db
    (setting,) = DevicePositionError().propose(view(records, law_db(records), 0.5, law_db))
    assert setting["device"] == 1 and np.hypot(setting["move_m"][0] - 36, setting["move_m"][1] + 22) < 15
    place_m = records.receiver_m + np.where(records.receiver == 1, 1.0, 0.0)[:, None] * (0, 0, 21)
    records.level_db[:] = law_db(records) + moved_db(records, DEVICES_M[records.device], place_m) + noise_db
    (setting,) = ReceiverPositionError().propose(view(records, law_db(records), 0.5, law_db))
    assert setting == {"receiver": 1, "move_m": [0.0, 0.0, 20.0]}


def test_what_stands_where_it_is_declared_is_left_there(records, view):
    records.level_db[:] = law_db(records) + np.random.default_rng(2).normal(0, 0.5, len(records))
    given = view(records, law_db(records), 0.5, law_db)
    assert DevicePositionError().propose(given) == [] and ReceiverPositionError().propose(given) == []


def test_sectors_on_one_mast_move_together_and_count_as_one(links, view):
    rng = np.random.default_rng(3)
    sectors_m = np.vstack([DEVICES_M, DEVICES_M[1:]])  # the third shares the mast of the second
    receiver_m = np.column_stack([rng.uniform(-150, 250, (300, 2)), np.full(300, 40.0)])
    records = links(sectors_m, receiver_m)
    assert DevicePositionError().lacks(records) is None
    moved_m = (sectors_m + [(0, 0, 0), (36, -22, 0), (36, -22, 0)])[records.device]
    expected_db = -22 * np.log10(np.linalg.norm(receiver_m.repeat(3, axis=0) - moved_m, axis=1)
                                 / np.linalg.norm(records.receiver_m - sectors_m[records.device], axis=1))
    term = DevicePositionError().term(records, {"device": 1, "move_m": [36.0, -22.0]}, law_db)
    np.testing.assert_allclose(term.offset_db, expected_db, atol=1e-9)
    records.level_db[:] = law_db(records) + expected_db + rng.normal(0, 0.5, len(records))
    (setting,) = DevicePositionError().propose(view(records, law_db(records), 0.5, law_db))
    assert setting["device"] == 1 and np.hypot(setting["move_m"][0] - 36, setting["move_m"][1] + 22) < 15
    given = replace(view(records, law_db(records), 0.5, law_db), kept=(("device_position_error", setting),))
    assert all(other["device"] == 0 for other in DevicePositionError().propose(given))
