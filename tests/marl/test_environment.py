"""The mission's rules against the same rules written slowly, on random missions."""


import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl.environment import CorrelatedField, Environment, assign
from marl.flights import fly
from marl.heuristics import HeuristicPolicy
from marl.mission import HOVER
from marl.planner import PlanPolicy

FEW = settings(max_examples=40, deadline=None)


@given(st.data(), st.integers(0, 2**32 - 1))
@FEW
def test_a_flight_follows_the_rules_slot_by_slot(missions, slow, data, seed):
    mission, rng = data.draw(missions), np.random.default_rng(seed)
    environment = Environment(mission, 2, np.random.default_rng(seed))
    homes = [slow.ways_home(mission, u) for u in range(mission.uavs)]
    frame = environment.reset()
    assert (frame.cell == mission.start).all() and (frame.battery == mission.battery).all()
    np.testing.assert_allclose(frame.data_units, np.tile(mission.data_units, (2, 1)), rtol=1e-6)
    while not environment.done.all():
        action = np.zeros((2, mission.uavs), dtype=int)
        for e in range(2):
            links = slow.usable(mission, frame, e)
            served = slow.assign(links, mission.max_rate)
            assert {u: int(k) for u, k in enumerate(frame.assigned[e]) if k >= 0} == served
            for u in range(mission.uavs):
                can = slow.feasible(homes[u], *frame.cell[e, u], int(frame.battery[e, u]))
                action[e, u] = rng.choice(np.flatnonzero(can))
        before = frame.copy()
        collected = environment.step(action)
        for e in range(2):
            left = before.data_units[e].astype(float)
            for u in range(mission.uavs):
                k = before.assigned[e, u]
                expected = 0.0
                if k >= 0:
                    expected = min(slow.rate(before.snr_db[e, u, k], mission.rate_scale), left[k])
                    left[k] -= expected
                assert collected[e, u] == pytest.approx(expected, rel=1e-5, abs=1e-3)
                step = slow.steps[action[e, u]]
                assert tuple(frame.cell[e, u]) == (before.cell[e, u, 0] + step[0], before.cell[e, u, 1] + step[1])
                assert frame.battery[e, u] == before.battery[e, u] - slow.hovers[action[e, u]]
            np.testing.assert_allclose(frame.data_units[e], left, rtol=1e-5, atol=1e-3)
    assert (environment.step(action) == 0).all()  # whoever has landed collects no more


@given(st.data(), st.sampled_from(["random", "greedy"]), st.integers(0, 2**32 - 1))
@FEW
def test_data_is_conserved_and_every_uav_gets_home(missions, data, name, seed):
    mission = data.draw(missions)
    environment = Environment(mission, 4, np.random.default_rng(seed))
    flights = fly(environment, HeuristicPolicy(name, np.random.default_rng(seed)))
    left = environment.frame.data_units.sum(axis=1, dtype=float)
    total = flights.collected.sum(axis=(1, 2), dtype=float) + left
    np.testing.assert_allclose(total, mission.data_units.sum(), rtol=1e-5)
    assert (left >= 0).all() and (flights.collected >= 0).all()
    cell = environment.frame.cell
    for u in range(mission.uavs):
        # On the map at every slot, never inside a building, and home at the end.
        flown = np.arange(flights.action.shape[1]) < flights.length[:, None]
        rows, columns = flights.frames.cell[..., u, 0][flown], flights.frames.cell[..., u, 1][flown]
        assert (mission.steps_home[u][rows, columns] < 2**50).all() and (rows >= 0).all() and (columns >= 0).all()
        assert (mission.steps_home[u, cell[:, u, 0], cell[:, u, 1]] == 0).all()
    assert (environment.frame.battery == 0).all()


@pytest.mark.parametrize("max_rate, expected", [(False, [0, 1]), (True, [0, -1])])
def test_a_uav_that_loses_its_best_device_gets_another_or_idles(max_rate, expected):
    strength, out = np.array([[30.0, 12.0], [25.0, 11.0]]), np.zeros(2, dtype=np.int16)
    assign(strength, max_rate, out)
    assert out.tolist() == expected


@given(st.data(), st.integers(0, 2**32 - 1))
@FEW
def test_below_the_limit_of_detection_nothing_is_seen_and_nothing_collected(missions, data, seed):
    mission = data.draw(missions)._replace(detection_db=15.0)  # above the threshold
    flights = fly(Environment(mission, 2, np.random.default_rng(seed)),
                  HeuristicPolicy("random", np.random.default_rng(seed)))
    snr_db = flights.frames.snr_db
    assert ((snr_db >= 15) | np.isneginf(snr_db)).all()
    for e, t, u in np.argwhere(flights.collected > 0):
        assert snr_db[e, t, u, flights.frames.assigned[e, t, u]] >= 15


def test_fields_are_normal_and_their_correlation_falls_exponentially():
    fields = CorrelatedField((30, 24), 20.0, 80.0).draw(3001, np.random.default_rng(0))
    assert fields.shape == (3001, 30, 24) and fields.dtype == np.float32
    assert abs(fields.mean()) < 0.02 and fields.var() == pytest.approx(1, abs=0.02)
    for rows, columns in ((0, 1), (1, 0), (3, 0), (0, 8), (4, 3), (20, 0), (0, 23)):
        product = (fields[:, rows:, columns:] * fields[:, :30 - rows, :24 - columns]).mean()
        assert product == pytest.approx(np.exp(-20 * np.hypot(rows, columns) / 80), abs=0.04)
    # The real and the imaginary part of a transform know nothing of each other.
    assert abs((fields[:1500] * fields[1501:3001]).mean()) < 0.02
    # The distribution is normal at a point.
    assert np.mean(np.abs(fields[:, 5, 5]) < 1) == pytest.approx(0.6827, abs=0.03)


@pytest.mark.parametrize("length_m", [1.0, 5000.0])
def test_very_short_and_very_long_correlations_have_fields_too(length_m):
    fields = CorrelatedField((12, 9), 20.0, length_m).draw(600, np.random.default_rng(0))
    assert fields.var() == pytest.approx(1, abs=0.25)
    assert (fields[:, 1:] * fields[:, :-1]).mean() == pytest.approx(np.exp(-20 / length_m) * fields.var(), abs=0.05)


def test_a_share_of_the_shadowing_lasts_for_a_flight_and_the_rest_for_a_slot(tiny):
    mission = tiny(0, uavs=2, devices=2, snr_db=20.0, sigma_db=np.array([3.0, 0.0]).reshape(1, 2, 1, 1),
                   battery=(8, 8), data_units=[1e9, 1e9])
    hover = PlanPolicy(np.full((8, 2), HOVER))
    for share in (0.0, 0.6, 1.0):
        world = mission._replace(shadowing_share=share, shadowing_m=60.0)
        shown_db = fly(Environment(world, 3000, np.random.default_rng(1)), hover).frames.snr_db
        off_db = shown_db[:, :, :, 0] - 20
        assert off_db.std() == pytest.approx(3, abs=0.15)
        between_slots = np.corrcoef(off_db[:, 0, 0], off_db[:, 5, 0])[0, 1]
        assert between_slots == pytest.approx(share, abs=0.06)
        # Both UAVs hover over the same cell, at other heights: what stays is the same for both.
        assert np.corrcoef(off_db[:, 0, 0], off_db[:, 0, 1])[0, 1] == pytest.approx(share, abs=0.06)
        assert (shown_db[..., 1] == 20).all()
        assert abs(np.corrcoef(off_db[:-1, 0, 0], off_db[1:, 0, 0])[0, 1]) < 0.06  # another flight, another world


def test_a_new_flight_draws_new_shadowing_and_the_others_keep_theirs(tiny):
    mission = tiny(0, uavs=1, devices=1, snr_db=20.0, sigma_db=3.0, battery=(8,))._replace(shadowing_share=1.0)
    environment = Environment(mission, 4, np.random.default_rng(0))
    before = environment.reset().snr_db.copy()
    after = environment.reset(np.array([True, False, False, True])).snr_db
    assert ((before != after).ravel() == [True, False, False, True]).all()


def test_the_same_seed_draws_the_same_shadowing(tiny):
    mission = tiny(0, sigma_db=4.0)._replace(shadowing_share=0.7)
    one, same, other = (fly(Environment(mission, 5, np.random.default_rng(seed)),
                            HeuristicPolicy("greedy", np.random.default_rng(9))).frames.snr_db for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one[:, 0], other[:, 0])
