"""Levels of a receiver that are lower now and then: worlds with lost lock, and worlds that look alike."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.lock_loss import LockLoss

SCALE_DB, SLOTS, DEVICES, DROP_DB = 3.0, 300, 5, 20.0


def runs(rng, share=0.2, mean_length=5):
    """Draw the slots (SLOTS,) of a receiver that is in its second state for some slots in a row."""
    leave = {True: 1 / mean_length, False: share / (1 - share) / mean_length}
    state, out = False, np.zeros(SLOTS, dtype=bool)
    for slot in range(SLOTS):
        state ^= rng.random() < leave[state]
        out[slot] = state
    return out


@pytest.fixture
def seen(make_links, view):
    """Make the view of two receivers that fly side by side; `low(links, slot, rng)` (n,) lose 20 dB."""
    def make(low, seed=0):
        rng = np.random.default_rng(seed)
        device_m = np.column_stack([rng.uniform(0, 400, (DEVICES, 2)), np.full(DEVICES, 1.5)])
        along = np.repeat(np.linspace(0, 400, SLOTS)[:, None], 2, axis=0)
        receiver_m = np.column_stack([along, np.tile([150.0, 250.0], SLOTS)[:, None], np.full((2 * SLOTS, 1), 60.0)])
        number = np.repeat(np.arange(2 * SLOTS), DEVICES)
        slot = number // 2
        links = make_links(device_m, receiver_m, receiver=number % 2, flight=np.zeros(len(number), int),
                           time_s=slot.astype(float))
        mean_db = -35 - 28 * np.log10(links.distance_m)
        links.level_db[:] = mean_db + rng.normal(0, SCALE_DB, len(links)) - DROP_DB * low(links, slot, rng)
        return view(links, mean_db, SCALE_DB)
    return make


@pytest.mark.parametrize("seed", range(3))
def test_drops_are_found_with_their_share_and_size(seed, seen):
    rng = np.random.default_rng(100 + seed)
    out = runs(rng)
    (params,) = LockLoss().propose(seen(lambda links, slot, _: out[slot] & (links.receiver == 1), seed))
    assert list(params.receivers) == list(params.drops_db) == [1]
    assert params.receivers[1] == pytest.approx(out.mean(), abs=0.01)
    assert params.drops_db[1] == pytest.approx(DROP_DB, abs=1.0)


@pytest.mark.parametrize("low", [
    lambda links, slot, rng: np.zeros(len(links), bool),
    lambda links, slot, rng: (slot > 100) & (slot < 160) & (links.receiver == 1),  # an episode
    lambda links, slot, rng: (slot > 200) & (links.receiver == 1),  # a step
    lambda links, slot, rng: slot // 12 % 4 == 0,  # of all receivers: the places'
    lambda links, slot, rng: (links.device < 2) & (slot // 12 % 4 == 0) & (links.receiver == 1),  # walls
    lambda links, slot, rng: np.abs(rng.standard_t(1.5, len(links))).clip(0, 40) / DROP_DB,  # heavy tails
], ids=["nothing", "episode", "step", "places", "walls", "tails"])
def test_what_is_low_for_other_reasons_is_not_lost_lock(low, seen):
    assert LockLoss().propose(seen(low)) == []


@pytest.mark.slow
def test_drops_are_named_with_their_size(open_ground, loop):
    world, rng = open_ground.fly(29), np.random.default_rng(29)
    measurements = open_ground.measured(world)
    table = measurements.table
    low = np.repeat(rng.random(len(table)) < 1 / 6, 3)[:len(table)]
    keys = [*{"flight", "time_s"} & set(table)]
    low = table.assign(low=low).groupby(keys)["low"].transform("first").to_numpy() & (world.receiver == 1)
    table.loc[low, "gain_db"] -= 25.0
    found = loop(measurements)
    assert found.names == ["lock_loss"] and set(found.first) == {"lost_share[r1]", "drop_db[r1]"}
    share, drop_db = found.first["lost_share[r1]"], found.first["drop_db[r1]"]
    assert share.low < low.sum() / (world.receiver == 1).sum() < share.high
    assert drop_db.low < 25.0 < drop_db.high and drop_db.high - drop_db.low < 3
