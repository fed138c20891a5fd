"""The final prediction: its weights, and that no held-out reading is in it."""

import numpy as np
import pytest

from radiotwin.closeloop import predictor
from radiotwin.closeloop.bases import make_bases
from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import cross_validate, training_parts
from radiotwin.closeloop.folds import make_folds
from radiotwin.closeloop.predictor import combined_prediction
from radiotwin.links import prepare_links


def predicted(measurements, hold_out="auto", with_rest=False):
    """Return the combination upon the log-distance law, without any effect."""
    links = prepare_links(measurements, None)
    folds = make_folds(links, 0, hold_out)
    model = cross_validate(links, make_bases(None, 0)["log-distance"], folds, training_parts(links, folds))
    return links, model, combined_prediction(model, with_rest, SelectionCriteria(), 0)


def rmse_db(links, mean_db):
    return float(np.sqrt(np.nanmean((links.level_db - mean_db) ** 2)))


@pytest.fixture(autouse=True)
def few_trees(monkeypatch):
    monkeypatch.setattr(predictor, "INNER_TREES", 5)


def small(world, seed=0, part=4):
    """Leave every `part`-th slot of a world."""
    keep = world.slot % part == 0
    for name in ("flight", "receiver", "device", "time_s", "slot", "receiver_m", "heading_deg", "gain_db"):
        setattr(world, name, getattr(world, name)[keep])
    return world


@pytest.mark.parametrize("seed", [0, 1])
def test_where_nothing_is_left_to_learn_nothing_is_added(open_ground, seed):
    links, model, found = predicted(open_ground.measured(small(open_ground.fly(seed))))
    assert rmse_db(links, found.mean_db) < 1.02 * model.rmse_db()
    named = found.names.index("named")
    assert found.weights[:, named].min() > 0.6
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0)
    assert (found.weights >= 0).all()


def test_of_levels_without_any_cause_the_mean_is_predicted(open_ground):
    world = small(open_ground.fly(3))
    world.gain_db = np.random.default_rng(3).normal(-80.0, 6.0, len(world.gain_db))
    links, _, found = predicted(open_ground.measured(world))
    assert rmse_db(links, found.mean_db) < 1.02 * float(np.nanstd(links.level_db))


def test_no_reading_of_a_fold_changes_its_prediction(open_ground):
    world = small(open_ground.fly(4), part=6)
    links, model, found = predicted(open_ground.measured(world))
    own = model.index == 2
    flights = {links.flight_names[i] for i in np.unique(links.flight[own])}
    mine = np.array([f"f{i}" in flights for i in world.flight])
    world.gain_db[mine] += np.random.default_rng(0).normal(0, 9, mine.sum())
    _, other_model, other = predicted(open_ground.measured(world))
    np.testing.assert_array_equal(model.index, other_model.index)
    np.testing.assert_allclose(found.mean_db[own], other.mean_db[own], atol=1e-9)
    assert not np.allclose(found.mean_db[~own], other.mean_db[~own])


def test_trees_and_kriging_win_near_measurements_and_the_law_far_from_them(open_ground):
    rng = np.random.default_rng(5)
    world = small(open_ground.fly(5, noise_db=0.5), part=2)
    # Shadowing of 40 m around three of four places, in stripes that no law has.
    world.gain_db += 7.0 * np.sign(np.sin(world.receiver_m[:, 0] / 40.0) * np.sin(world.receiver_m[:, 1] / 40.0))
    links, model, found = predicted(open_ground.measured(world), with_rest=True)
    best = min(rmse_db(links, mean_db) for mean_db in found.baselines.values())
    assert rmse_db(links, found.mean_db) < 1.02 * best
    law = [found.names.index(name) for name in ("named", "segmented_log_distance")]
    near, far = found.weights[:, law].sum(axis=1)
    assert far > near + 0.2
    assert rng is not None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_is_never_much_worse_than_the_best_of_the_others(open_ground, seed):
    rng = np.random.default_rng(seed)
    world = small(open_ground.fly(seed + 10, noise_db=1.5))
    phase, length_m = rng.uniform(0, 6), rng.uniform(30, 120)
    world.gain_db += rng.uniform(0, 6) * np.sin(world.receiver_m[:, 0] / length_m + phase)
    world.gain_db[world.device == 2] += rng.normal(0, 5)
    links, _, found = predicted(open_ground.measured(world))
    best = min(rmse_db(links, mean_db) for mean_db in found.baselines.values())
    assert rmse_db(links, found.mean_db) < 1.02 * best
