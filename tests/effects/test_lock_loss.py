"""Links that are blank although they are strong, in worlds that lose some, and in those that only look like it."""

import numpy as np
import pytest

from radiotwin.effects.lock_loss import LockLoss

LIMIT_DB, SCALE_DB, SLOTS, DEVICES = -110.0, 2.0, 400, 5


@pytest.fixture
def seen(links, view):
    """Two receivers in turn over five devices; `lost` (n,) or a function of records and level is blank besides."""
    def make(lost, seed=0):
        rng = np.random.default_rng(seed)
        device_m = np.column_stack([rng.uniform(0, 400, (DEVICES, 2)), np.full(DEVICES, 1.5)])
        receiver_m = np.column_stack([rng.uniform(0, 400, (SLOTS, 2)), np.full(SLOTS, 60.0)])
        number = np.repeat(np.arange(SLOTS), DEVICES)
        records = links(device_m, receiver_m, receiver=number % 2, flight=4 * number // SLOTS, limit_db=LIMIT_DB)
        mean_db = -35 - 28 * np.log10(records.distance_m)
        level_db = mean_db + rng.normal(0, SCALE_DB, len(records))
        level_db[level_db < LIMIT_DB] = np.nan
        level_db[lost(records, level_db, rng)] = np.nan
        records.level_db[:] = level_db
        return view(records, mean_db, SCALE_DB)
    return make


def test_the_share_of_lost_links_is_that_of_blank_ones_far_above_the_limit(seen):
    given = seen(lambda records, level_db, rng: (records.receiver == 1) & (rng.random(len(records)) < 0.07))
    (setting,) = LockLoss().propose(given)
    assert list(setting["receivers"]) == ["1"]
    strong = (given.records.receiver == 1) & (given.mean_db > LIMIT_DB + 10)
    counted = np.isnan(given.records.level_db[strong]).mean()
    assert setting["receivers"]["1"] == pytest.approx(counted, rel=0.25)
    share = LockLoss().loses(given.records, setting)
    np.testing.assert_array_equal(share, np.where(given.records.receiver == 1, setting["receivers"]["1"], 0.0))


def test_whole_slots_that_are_lost_are_found_as_well(seen):
    (setting,) = LockLoss().propose(seen(lambda records, level_db, rng: np.repeat(
        (np.arange(SLOTS) // 8 % 6 == 0) & (np.arange(SLOTS) % 2 == 0), DEVICES)))
    assert list(setting["receivers"]) == ["0"] and setting["receivers"]["0"] == pytest.approx(1 / 6, rel=0.2)


@pytest.mark.parametrize("lost", [
    lambda records, level_db, rng: np.zeros(len(records), bool),
    lambda records, level_db, rng: (records.receiver == 0) & (level_db < LIMIT_DB + 10),  # is deafer than declared
    lambda records, level_db, rng: (records.device == 3) & (rng.random(len(records)) < 0.6),  # a device that is off
    lambda records, level_db, rng: (records.receiver_m[:, 0] < 250) & (records.device < 2),  # a wall
], ids=["nothing", "deaf", "device", "wall"])
def test_what_is_blank_for_other_reasons_is_not_lost_lock(seen, lost):
    given = seen(lost)
    assert LockLoss().lacks(given.records) is None and LockLoss().propose(given) == []


def test_behind_buildings_links_may_be_blank_for_want_of_a_path(seen):
    """What has no line of sight says nothing, and what has it speaks for itself."""
    given = seen(lambda records, level_db, rng: (np.arange(len(records)) % 3 == 0) & (rng.random(len(records)) < 0.5))
    assert LockLoss().propose(given)
    given.records.__dict__["los"] = np.arange(len(given.records)) % 3 > 0
    assert LockLoss().propose(given) == []


def test_it_is_not_looked_for_where_a_blank_tells_nothing(links):
    records = links([[0.0, 0, 1.5]], np.ones((80, 3)))
    assert "limit" in LockLoss().lacks(records)
    assert "blank" in LockLoss().lacks(links([[0.0, 0, 1.5]], np.ones((80, 3)), limit_db=-100.0))


def test_links_lost_at_random_are_named_and_counted(open_ground, loop):
    world, rng = open_ground.fly(23), np.random.default_rng(23)
    measurements = open_ground.measured(world)
    lost = (world.receiver == 1) & (rng.random(len(world.gain_db)) < 0.05)
    measurements.table.loc[lost, "gain_db"] = np.nan
    found = loop(measurements)
    assert found.names == ["lock_loss"] and set(found.first) == {"lost_share[r1]"}
    share = found.first["lost_share[r1]"]
    assert share.low < 0.05 < share.high and share.high - share.low < 0.03
    assert found.report["error"]["after"]["nll"] < found.report["error"]["before"]["nll"] - 0.02
