"""Strong links that are blank: worlds with dropouts, and worlds with other causes that look alike."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.catalogue.lock_loss import LockLoss

LIMIT_DB, SCALE_DB, SLOTS, DEVICES = -110.0, 2.0, 400, 5


@pytest.fixture
def seen(make_links, view):
    """Make the view of two receivers in turn over five devices; `lost(links, level_db, rng)` (n,) is blank besides."""
    def make(lost, seed=0):
        rng = np.random.default_rng(seed)
        device_m = np.column_stack([rng.uniform(0, 400, (DEVICES, 2)), np.full(DEVICES, 1.5)])
        receiver_m = np.column_stack([rng.uniform(0, 400, (SLOTS, 2)), np.full(SLOTS, 60.0)])
        number = np.repeat(np.arange(SLOTS), DEVICES)
        links = make_links(device_m, receiver_m, receiver=number % 2, flight=4 * number // SLOTS, limit_db=LIMIT_DB)
        mean_db = -35 - 28 * np.log10(links.distance_m)
        level_db = mean_db + rng.normal(0, SCALE_DB, len(links))
        level_db[level_db < LIMIT_DB] = np.nan
        level_db[lost(links, level_db, rng)] = np.nan
        links.level_db[:] = level_db
        return view(links, mean_db, SCALE_DB)
    return make


def test_the_dropout_probability_is_the_share_of_blanks_far_above_the_limit(seen):
    given = seen(lambda links, level_db, rng: (links.receiver == 1) & (rng.random(len(links)) < 0.07))
    (params,) = LockLoss().propose(given)
    assert list(params.receivers) == [1]
    strong = (given.links.receiver == 1) & (given.mean_db > LIMIT_DB + 10)
    counted = np.isnan(given.links.level_db[strong]).mean()
    assert params.receivers[1] == pytest.approx(counted, rel=0.25)
    losses = LockLoss().with_params(params).losses(given.links)
    np.testing.assert_array_equal(losses.blank, np.where(given.links.receiver == 1, params.receivers[1], 0.0))
    assert not losses.drop.any()


def test_whole_slots_that_are_lost_are_found_as_well(seen):
    (params,) = LockLoss().propose(seen(lambda links, level_db, rng: np.repeat(
        (np.arange(SLOTS) // 8 % 6 == 0) & (np.arange(SLOTS) % 2 == 0), DEVICES)))
    assert list(params.receivers) == [0] and params.receivers[0] == pytest.approx(1 / 6, rel=0.2)


@pytest.mark.parametrize("lost", [
    lambda links, level_db, rng: np.zeros(len(links), bool),
    lambda links, level_db, rng: (links.receiver == 0) & (level_db < LIMIT_DB + 10),  # less sensitive than declared
    lambda links, level_db, rng: (links.device == 3) & (rng.random(len(links)) < 0.6),  # a device that is off
    lambda links, level_db, rng: (links.receiver_m[:, 0] < 250) & (links.device < 2),  # a wall
], ids=["nothing", "deaf", "device", "wall"])
def test_what_is_blank_for_other_reasons_is_not_lost_lock(seen, lost):
    given = seen(lost)
    assert LockLoss().propose(given) == []


def test_behind_buildings_links_may_be_blank_for_want_of_a_path(seen):
    """Links without line of sight are not evidence, those with it are."""
    given = seen(lambda links, level_db, rng: (np.arange(len(links)) % 3 == 0) & (rng.random(len(links)) < 0.5))
    assert LockLoss().propose(given)
    hidden = given.links.with_los(np.arange(len(given.links)) % 3 > 0)
    assert LockLoss().propose(replace(given, links=hidden)) == []


def test_without_a_limit_a_blank_has_no_meaning(seen):
    given = seen(lambda links, level_db, rng: rng.random(len(links)) < 0.2)
    assert LockLoss().propose(given)
    given.links.limit_db[:] = -np.inf
    assert LockLoss().propose(given) == []


@pytest.mark.slow
def test_links_lost_at_random_are_named_and_counted(open_ground, loop):
    world, rng = open_ground.fly(23), np.random.default_rng(23)
    measurements = open_ground.measured(world)
    lost = (world.receiver == 1) & (rng.random(len(world.gain_db)) < 0.05)
    measurements.table.loc[lost, "gain_db"] = np.nan
    found = loop(measurements)
    assert found.names == ["lock_loss"] and set(found.first) == {"lost_share[r1]"}
    share = found.first["lost_share[r1]"]
    assert share.low < 0.05 < share.high and share.high - share.low < 0.03
    assert found.error["after"]["nll"] < found.error["before"]["nll"] - 0.02
