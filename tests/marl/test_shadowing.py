"""How long a twin's doubt lasts: fields against their closed form, and what is learnt of fields drawn another way."""

import numpy as np
import pandas as pd
import pytest

from marl.environment import Environment
from marl.flights import HeuristicPolicy, fly
from marl.mission import HOVER
from marl.planner import PlanPolicy
from marl.shadowing import CorrelatedField, Shadowing, fit_shadowing, twin_shadowing
from radiotwin.measurements import Measurements
from radiotwin.radiomap import RadioMap
from radiotwin.scene.lattice import Lattice
from radiotwin.survey import fly_survey, segmented_truth
from radiotwin.twin import fit_twin

LIMIT_DB = -115.0


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


def walks(lattice, rng, flights=6, slots=80):
    """Cells (row, column) of random walks over the lattice."""
    most = np.array([len(lattice.y_m), len(lattice.x_m)]) - 1
    steps = rng.integers(-1, 2, (flights, slots, 2))
    return np.clip(rng.integers(0, most + 1, (flights, 1, 2)) + steps.cumsum(axis=1), 0, most).reshape(-1, 2)


def measured(share, length_m, seed):
    """A map of two devices, and measurements off it by shadowing made with a Cholesky factor, point by point."""
    rng = np.random.default_rng(seed)
    lattice = Lattice(np.arange(0, 500, 20.0), np.arange(0, 600, 20.0), np.array([50.0]))
    gain_db = np.broadcast_to(np.linspace(-90, -110, 2)[:, None, None, None], (2, *lattice.shape))
    sigma_db = np.broadcast_to(np.array([3.0, 9.0])[:, None, None, None], gain_db.shape)
    radio_map = RadioMap.build(["a", "b"], lattice, gain_db, np.zeros(gain_db.shape), sigma_db)
    cell = walks(lattice, rng)
    x_m, y_m = lattice.x_m[cell[:, 1]], lattice.y_m[cell[:, 0]]
    apart_m = np.hypot(x_m[:, None] - x_m, y_m[:, None] - y_m)
    factor = np.linalg.cholesky(share * np.exp(-apart_m / length_m) + 1e-6 * np.eye(len(cell)))
    tables = []
    for number, name in enumerate("ab"):
        unit = factor @ rng.standard_normal(len(cell)) + np.sqrt(1 - share) * rng.standard_normal(len(cell))
        level_db = gain_db[number, 0, 0, 0] + sigma_db[number, 0, 0, 0] * unit
        tables.append(pd.DataFrame({"receiver_x_m": x_m, "receiver_y_m": y_m, "receiver_z_m": 50.0, "device": name,
                                    "gain_db": np.where(level_db < LIMIT_DB, np.nan, level_db)}))
    return radio_map, Measurements(pd.concat(tables, ignore_index=True), pd.DataFrame({"device": ["b", "c", "a"]}))


@pytest.mark.parametrize("seed", range(3))
def test_share_and_length_are_learnt_from_what_is_left_over(seed):
    lasting = fit_shadowing(*measured(0.8, 80.0, seed), LIMIT_DB, 0)
    assert lasting.share == pytest.approx(0.8, abs=0.15)
    assert 40 < lasting.length_m < 160
    of_a_slot = fit_shadowing(*measured(0.0, 80.0, seed), LIMIT_DB, 0)
    assert of_a_slot.share < 0.15


def test_what_stays_stays_for_a_flight_and_the_rest_for_a_slot(tiny):
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


def test_a_flight_that_begins_anew_meets_a_new_world_and_the_others_keep_theirs(tiny):
    mission = tiny(0, uavs=1, devices=1, snr_db=20.0, sigma_db=3.0, battery=(8,))._replace(shadowing_share=1.0)
    environment = Environment(mission, 4, np.random.default_rng(0))
    before = environment.reset().snr_db.copy()
    after = environment.reset(np.array([True, False, False, True])).snr_db
    assert ((before != after).ravel() == [True, False, False, True]).all()


def test_the_same_seed_meets_the_same_worlds(tiny):
    mission = tiny(0, sigma_db=4.0)._replace(shadowing_share=0.7)
    one, same, other = (fly(Environment(mission, 5, np.random.default_rng(seed)),
                            HeuristicPolicy("greedy", np.random.default_rng(9))).frames.snr_db for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one[:, 0], other[:, 0])


def test_a_twin_that_interpolates_says_itself_how_long_it_is_wrong(small_scene):
    truth = segmented_truth(small_scene)
    measurements = fly_survey(small_scene, truth, flights=1, pattern="random-waypoint", seed=0)
    for model in ("regression_kriging", "segmented_log_distance"):
        twin = fit_twin(measurements, small_scene, model=model, seed=0)
        found = twin_shadowing(twin, twin.radio_map(small_scene), measurements, small_scene.config.gain_limit_db, 0)
        # The statistical truth draws all of it anew in every slot.
        assert found.share * np.exp(-small_scene.lattice.step_m / found.length_m) < 0.1
        assert found.share == 0 or found.length_m >= small_scene.lattice.step_m
        if model == "regression_kriging":
            twin.channel.field.share, twin.channel.field.length_m = 0.7, 70.0
            found = twin_shadowing(twin, twin.radio_map(small_scene), measurements, -120.0, 0)
            assert found == Shadowing(0.7, 70.0)
