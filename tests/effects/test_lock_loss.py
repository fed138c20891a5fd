"""Lost lock: links that are blank or weaker at random, and worlds with other causes that look alike."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.catalogue.lock_loss import LockLoss

LIMIT_DB, DEVICES, DROP_DB = -110.0, 5, 20.0


@pytest.fixture
def lost(make_links, view):
    """Make the view of two receivers in turn over five devices; `blank(links, level_db, rng)` (n,) is lost besides."""
    def make(blank, slots=400, scale_db=2.0):
        rng = np.random.default_rng(0)
        device_m = np.column_stack([rng.uniform(0, 400, (DEVICES, 2)), np.full(DEVICES, 1.5)])
        receiver_m = np.column_stack([rng.uniform(0, 400, (slots, 2)), np.full(slots, 60.0)])
        number = np.repeat(np.arange(slots), DEVICES)
        links = make_links(device_m, receiver_m, receiver=number % 2, flight=4 * number // slots, limit_db=LIMIT_DB)
        mean_db = -35 - 28 * np.log10(links.distance_m)
        level_db = mean_db + rng.normal(0, scale_db, len(links))
        level_db[level_db < LIMIT_DB] = np.nan
        level_db[blank(links, level_db, rng)] = np.nan
        links.level_db[:] = level_db
        return view(links, mean_db, scale_db)
    return make


@pytest.fixture
def dropped(make_links, view):
    """Make the view of two receivers that fly side by side; `low(links, slot, rng)` (n,) lose 20 dB."""
    def make(low, seed=0, slots=300, scale_db=3.0):
        rng = np.random.default_rng(seed)
        device_m = np.column_stack([rng.uniform(0, 400, (DEVICES, 2)), np.full(DEVICES, 1.5)])
        along = np.repeat(np.linspace(0, 400, slots)[:, None], 2, axis=0)
        receiver_m = np.column_stack([along, np.tile([150.0, 250.0], slots)[:, None], np.full((2 * slots, 1), 60.0)])
        number = np.repeat(np.arange(2 * slots), DEVICES)
        slot = number // 2
        links = make_links(device_m, receiver_m, receiver=number % 2, time_s=slot.astype(float))
        mean_db = -35 - 28 * np.log10(links.distance_m)
        links.level_db[:] = mean_db + rng.normal(0, scale_db, len(links)) - DROP_DB * low(links, slot, rng)
        return view(links, mean_db, scale_db)
    return make


def runs(rng, slots=300, share=0.2, mean_length=5):
    """Draw the slots (slots,) of a receiver that is in its second state for some slots in a row."""
    leave = {True: 1 / mean_length, False: share / (1 - share) / mean_length}
    state, out = False, np.zeros(slots, dtype=bool)
    for slot in range(slots):
        state ^= rng.random() < leave[state]
        out[slot] = state
    return out


def test_the_dropout_probability_is_the_share_of_blanks_far_above_the_limit(lost):
    given = lost(lambda links, level_db, rng: (links.receiver == 1) & (rng.random(len(links)) < 0.07))
    (params,) = LockLoss().propose(given)
    assert list(params.receivers) == [1]
    strong = (given.links.receiver == 1) & (given.mean_db > LIMIT_DB + 10)
    assert params.receivers[1] == pytest.approx(np.isnan(given.links.level_db[strong]).mean(), rel=0.25)
    losses = LockLoss().with_params(params).losses(given.links)
    np.testing.assert_array_equal(losses.blank, np.where(given.links.receiver == 1, params.receivers[1], 0.0))
    assert not losses.drop.any()


def test_whole_slots_that_are_lost_are_found_as_well(lost):
    (params,) = LockLoss().propose(lost(lambda links, level_db, rng: np.repeat(
        (np.arange(400) // 8 % 6 == 0) & (np.arange(400) % 2 == 0), DEVICES)))
    assert list(params.receivers) == [0] and params.receivers[0] == pytest.approx(1 / 6, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_drops_are_found_with_their_share_and_size(seed, dropped):
    out = runs(np.random.default_rng(100 + seed))
    (params,) = LockLoss().propose(dropped(lambda links, slot, _: out[slot] & (links.receiver == 1), seed))
    assert list(params.receivers) == list(params.drops_db) == [1]
    assert params.receivers[1] == pytest.approx(out.mean(), abs=0.01)
    assert params.drops_db[1] == pytest.approx(DROP_DB, abs=1.0)


@pytest.mark.parametrize("blank", [
    lambda links, level_db, rng: np.zeros(len(links), bool),
    lambda links, level_db, rng: (links.receiver == 0) & (level_db < LIMIT_DB + 10),  # less sensitive than declared
    lambda links, level_db, rng: (links.device == 3) & (rng.random(len(links)) < 0.6),  # a device that is off
    lambda links, level_db, rng: (links.receiver_m[:, 0] < 250) & (links.device < 2),  # a wall
], ids=["nothing", "deaf", "device", "wall"])
def test_what_is_blank_for_other_reasons_is_not_lost_lock(lost, blank):
    assert LockLoss().propose(lost(blank)) == []


@pytest.mark.parametrize("low", [
    lambda links, slot, rng: np.zeros(len(links), bool),
    lambda links, slot, rng: (slot > 100) & (slot < 160) & (links.receiver == 1),  # an episode
    lambda links, slot, rng: (slot > 200) & (links.receiver == 1),  # a step
    lambda links, slot, rng: slot // 12 % 4 == 0,  # of all receivers: the places'
    lambda links, slot, rng: (links.device < 2) & (slot // 12 % 4 == 0) & (links.receiver == 1),  # walls
    lambda links, slot, rng: np.abs(rng.standard_t(1.5, len(links))).clip(0, 40) / DROP_DB,  # heavy tails
], ids=["nothing", "episode", "step", "places", "walls", "tails"])
def test_what_is_low_for_other_reasons_is_not_lost_lock(low, dropped):
    assert LockLoss().propose(dropped(low)) == []


@pytest.mark.parametrize("without", ["line of sight", "limit"])
def test_a_blank_without_a_limit_or_line_of_sight_has_no_meaning(lost, without):
    given = lost(lambda links, level_db, rng: (np.arange(len(links)) % 3 == 0) & (rng.random(len(links)) < 0.5))
    assert LockLoss().propose(given)
    if without == "limit":
        given.links.limit_db[:] = -np.inf
    else:
        given = replace(given, links=given.links.with_los(np.arange(len(given.links)) % 3 > 0))
    assert LockLoss().propose(given) == []


@pytest.mark.slow
def test_links_lost_at_random_are_named_and_counted(open_ground, loop):
    world, rng = open_ground.fly(23), np.random.default_rng(23)
    measurements = open_ground.measured(world)
    blank = (world.receiver == 1) & (rng.random(len(world.gain_db)) < 0.05)
    measurements.table.loc[blank, "gain_db"] = np.nan
    found = loop(measurements)
    assert found.names == ["lock_loss"] and set(found.first) == {"lost_share[r1]"}
    share = found.first["lost_share[r1]"]
    assert share.low < 0.05 < share.high and share.high - share.low < 0.03
    assert found.error["after"]["nll"] < found.error["before"]["nll"] - 0.02


@pytest.mark.slow
def test_drops_are_named_with_their_size(open_ground, loop):
    world, rng = open_ground.fly(29), np.random.default_rng(29)
    measurements = open_ground.measured(world)
    table = measurements.table
    low = np.repeat(rng.random(len(table)) < 1 / 6, 3)[:len(table)]
    low = table.assign(low=low).groupby(["flight", "time_s"])["low"].transform("first").to_numpy() & (world.receiver == 1)
    table.loc[low, "gain_db"] -= 25.0
    found = loop(measurements)
    assert found.names == ["lock_loss"] and set(found.first) == {"lost_share[r1]", "drop_db[r1]"}
    share, drop_db = found.first["lost_share[r1]"], found.first["drop_db[r1]"]
    assert share.low < low.sum() / (world.receiver == 1).sum() < share.high
    assert drop_db.low < 25.0 < drop_db.high and drop_db.high - drop_db.low < 3
