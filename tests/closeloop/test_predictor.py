"""The final prediction: its weights, and that no held-out reading is in it."""


import numpy as np
import pytest

from radiotwin.closeloop import crossfit as cross_validation
from radiotwin.closeloop.predict import predictor
from radiotwin.closeloop.predict.predictor import combined_prediction
from radiotwin.closeloop.predict.weights import Combination
from radiotwin.links import prepare_links
from radiotwin.twin.model.blend import FORESTS, LEVEL_FORESTS
from tests.closeloop.looking import based


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(predictor, "AWAY_TREES", 5)
    monkeypatch.setattr(cross_validation, "best_dof", lambda *_: 5.0)  # which the base learns of all links


def flown(open_ground, seed, part=6, **options):
    """Fly over open ground, and keep every `part`-th slot."""
    world = open_ground.fly(seed, **options)
    keep = world.slot % part == 0
    for name in ("flight", "receiver", "device", "time_s", "slot", "receiver_m", "heading_deg", "gain_db"):
        setattr(world, name, getattr(world, name)[keep])
    return world


def predicted(links, with_shadowing=False):
    """Return folds and the combination upon the log-distance law, without any effect."""
    model, _ = based(links)
    return model, combined_prediction(model, with_shadowing, 0)


def rmse_db(links, mean_db):
    return float(np.sqrt(np.nanmean((links.level_db - mean_db) ** 2)))


def ratio(links, found):
    """Return its error over that of the best other model."""
    return rmse_db(links, found.reading_db) / min(rmse_db(links, each) for each in found.baselines.values())


def test_of_levels_without_any_cause_the_mean_is_predicted(open_ground):
    world = flown(open_ground, 3)
    world.gain_db = np.random.default_rng(3).normal(-80.0, 6.0, len(world.gain_db))
    links = prepare_links(open_ground.measured(world), None)
    _, found = predicted(links)
    assert rmse_db(links, found.reading_db) < 1.02 * float(np.nanstd(links.level_db))
    weights = np.array(list(found.combination.weights.values()))
    np.testing.assert_allclose(weights.sum(axis=0), 1.0)
    assert (weights >= 0).all()


def test_neither_members_nor_weights_of_a_fold_see_its_readings(open_ground, monkeypatch):
    links = prepare_links(open_ground.measured(flown(open_ground, 4, part=12)), None)
    given, weights = [], Combination({"named": (0.5, 0.5), "kriging": (0.5, 0.5)}, 50.0, (1.0, 1.0))
    monkeypatch.setattr(predictor, "combination", lambda held_out, *_: given.append(held_out) or weights)
    model, found = predicted(links)
    own = model.index == 2
    level_db = links.level_db + own * np.random.default_rng(0).normal(0, 9, len(links))
    _, other = predicted(links.with_columns(level_db=level_db))
    np.testing.assert_allclose(found.reading_db[own], other.reading_db[own], atol=1e-6)
    assert not np.allclose(found.reading_db[~own], other.reading_db[~own])
    assert len(given) == 2 * (len(model.folds) + 1)
    for number, weighed in enumerate(given[:len(model.folds)]):
        assert number not in weighed.fold and len(weighed) == (model.index != number).sum()


@pytest.mark.slow
def test_on_levels_that_hold_nothing_the_reported_error_is_not_below_theirs(open_ground):
    ratios = []
    for seed in range(8):
        world = flown(open_ground, seed, part=24)
        world.gain_db = np.random.default_rng(seed).normal(-80.0, 6.0, len(world.gain_db))
        links = prepare_links(open_ground.measured(world), None)
        model, found = predicted(links, with_shadowing=True)
        seen = np.isfinite(links.level_db)
        mean_db = np.array([links.level_db[seen & (model.index != fold)].mean() for fold in model.index])
        ratios.append(rmse_db(links, found.reading_db) / rmse_db(links, mean_db))
    assert np.mean(ratios) > 0.995  # each scatters by 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_it_is_never_much_worse_than_the_best_of_the_others(open_ground, seed, monkeypatch):
    monkeypatch.undo()
    rng = np.random.default_rng(seed)
    world = flown(open_ground, seed + 10, part=2, noise_db=1.5)
    phase, length_m = rng.uniform(0, 6), rng.uniform(30, 120)
    world.gain_db += rng.uniform(0, 6) * np.sin(world.receiver_m[:, 0] / length_m + phase)
    world.gain_db[world.device == 2] += rng.normal(0, 5)
    links = prepare_links(open_ground.measured(world), None)
    assert ratio(links, predicted(links)[1]) < 1.02


@pytest.mark.slow
def test_near_measurements_interpolation_wins_and_far_from_them_no_tree(open_ground, monkeypatch):
    monkeypatch.undo()
    world = flown(open_ground, 5, part=1, noise_db=0.5)
    world.gain_db += 7.0 * np.sign(np.sin(world.receiver_m[:, 0] / 40) * np.sin(world.receiver_m[:, 1] / 40))
    links = prepare_links(open_ground.measured(world), None)
    _, found = predicted(links, with_shadowing=True)
    weights = found.combination.weights
    interpolated = sum(weights.get(name, (0.0, 0.0))[0] for name in ("named_and_rest", "kriging"))
    grown_far = sum(far for name, (_, far) in weights.items() if name in (*FORESTS, *LEVEL_FORESTS))
    assert ratio(links, found) < 1.02 and interpolated > 0.8 and grown_far < 0.1
