"""Other models on the folds of the loop."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingRegressor
from threadpoolctl import ThreadpoolController

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.output.result_file import compare_with_baselines
from radiotwin.closeloop.predict.baselines import (
    BOOSTING,
    EXTRA_TREES,
    Part,
    grow_trees,
    held_out_baselines,
    published_laws,
)
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.links import prepare_links
from radiotwin.links.variables import feature_count, link_features
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin.model.model import Model


@pytest.fixture
def links(open_ground):
    return prepare_links(open_ground.measured(open_ground.fly(0)), None)


def test_trees_are_told_places_and_labels_but_neither_time_nor_quality(links):
    features = link_features(links)
    assert features.shape == (len(links), 14 + 5 + 2) and np.isfinite(features).all()
    np.testing.assert_allclose(features[:, :3], links.receiver_m, rtol=1e-6)
    np.testing.assert_array_equal(features[:, 14:19].argmax(axis=1), links.device)
    np.testing.assert_array_equal(Part(links).common, link_features(links, receivers=False))
    assert feature_count(5, False) == 19 and feature_count(1, False) == feature_count(5000, False) == 14


def test_trees_are_told_the_angle_off_a_declared_azimuth(links):
    """Two of five devices declare one; whether a link is to the left or the right of it says nothing."""
    declared = links.with_ends(boresight_deg=np.array([90.0, np.nan, -180.0, np.nan, np.nan]))
    features = link_features(declared)
    assert features.shape == (len(links), 14 + 2 + 5 + 2) and feature_count(5, True) == 14 + 2 + 5
    first, third, other = (np.flatnonzero(links.device == device) for device in (0, 2, 1))
    east, north = (links.offset_m / np.hypot(*links.offset_m.T[:2])[:, None]).T[:2]
    np.testing.assert_allclose(features[first, 14], east[first], atol=1e-6)
    np.testing.assert_allclose(features[third, 14], -north[third], atol=1e-6)
    np.testing.assert_allclose(features[first, 15], abs(north[first]), atol=1e-6)
    assert (features[other, 14:16] == 0).all()
    np.testing.assert_array_equal(np.delete(features, [14, 15], axis=1), link_features(links))
    np.testing.assert_array_equal(Part(declared).common, link_features(declared, receivers=False))


@pytest.mark.parametrize("kind", [EXTRA_TREES, BOOSTING])
def test_trees_learn_a_step_and_repeat_to_the_bit(links, kind):
    features = link_features(links)[:400]
    step_db = np.where(features[:, 0] > 250, -70.0, -90.0)
    first, second = (grow_trees(kind, features, step_db, 3, 5).predict(features) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - step_db).mean() < 2.0


def test_published_laws_are_compared_where_they_hold(links):
    found = [law.name for law in published_laws(links)]
    assert "tr36777_uma" in found and "p1411" not in found  # which needs a map
    assert not published_laws(replace(links, world=replace(links.world, is_gain=False)))


def scores(rmse_db, n=100):
    return {"rmse_db": rmse_db, "n": n}


@pytest.mark.parametrize(("combined_db", "after_db", "baselines_db", "said", "is_behind"), [
    (3.0, 4.0, {"log_distance": 9.0, "regression_kriging": 3.61}, ["17 % better", "kriging alone: 3.61 dB", "kriging: 4.00 dB"], True),
    (3.6, 3.6, {"regression_kriging": 3.61}, ["a plain regression would do: kriging 3.61 dB"], False),
    (5.0, 5.1, {"p1411": 5.05}, ["a published law would do: p1411 5.05 dB"], False),  # 2 % more is as good
    (5.0, 5.16, {"p1411": 5.05}, ["is behind p1411: 5.16 dB"], True),
    (0.0, 0.0, {"log_distance": 0.0}, ["would do: the log-distance law 0.00 dB"], False)])
def test_the_advice_compares_the_best_other_model(combined_db, after_db, baselines_db, said, is_behind):
    error = {"combined": scores(combined_db), "after": scores(after_db)}
    found = compare_with_baselines(error, {name: scores(rmse_db) for name, rmse_db in baselines_db.items()})
    assert found["best_baseline"] == min(baselines_db, key=baselines_db.get)
    assert all(part in found["advice"] for part in said) and ("is behind" in found["advice"]) == is_behind


def test_a_model_of_fewer_links_is_not_compared():
    error = {"combined": scores(3.6), "after": scores(3.6)}
    assert compare_with_baselines(error, {"regression_kriging": scores(1.0, 50)}) is None
    assert compare_with_baselines({"combined": scores(None, 0), "after": scores(None, 0)}, {}) is None


def test_boosting_has_one_thread_and_leaves_those_of_others(monkeypatch):
    """Threads of OpenMP wait for each other busily, which takes a hundred times as long on a core with other work."""
    openmp = ThreadpoolController().select(user_api="openmp")
    seen, fit = [], HistGradientBoostingRegressor.fit
    monkeypatch.setattr(HistGradientBoostingRegressor, "fit", lambda *given: (
        seen.extend(each["num_threads"] for each in openmp.info()), fit(*given))[1])
    rng = np.random.default_rng(0)
    with openmp.limit(limits=2):
        grow_trees(BOOSTING, rng.normal(size=(100, 3)), rng.normal(size=100), 0, 2)
        after = {each["num_threads"] for each in openmp.info()}
    assert set(seen) == {1} and after == {2}


def test_published_laws_say_nothing_of_devices_that_are_nowhere(links):
    """A lost device stands at 0, 0 in the arrays, which no law may be judged by."""
    device_m = links.device_m.copy()
    device_m[3] = np.nan
    folds = [Model.build(links, LogDistance(LogDistanceLine(-35.0, 2.6, 2.0)), 5.0, device_m=device_m,
                             train=links.flight != flight).fit() for flight in range(6)]
    model = CrossFit(folds[0], tuple(folds), links.flight, None)
    found, _ = held_out_baselines(model, [Part(each.links) for each in folds], 0)
    known = links.device != 3
    for name, mean_db in found.items():
        assert np.isfinite(mean_db[known]).all() and np.isnan(mean_db[~known]).all(), name
    assert "tr36777_uma" in found
