"""The channel that follows paths over a map that may be wrong."""

import json

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.propagation.laws.map_error import MapError, estimate_map_error
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.propagation.laws.registry import decode_both, encode_channel
from tests.propagation.laws.houses import flight, houses, levels, links_over


@pytest.mark.slow
@pytest.mark.parametrize(("move_m", "rise_m"), [(0.0, 0.0), (2.0, 0.0), (0.0, 4.0)])
def test_the_size_of_a_maps_errors_is_found(move_m, rise_m):
    """Rationale: the same paths over three other maps; only how the map was made wrong is not shared."""
    receiver_m, device = flight(300, 3)
    level_db, blamed, outside = levels(houses(), receiver_m, device, 5, diffuse=1e-13), 0, 0
    seeds = (11, 12, 13) if move_m or rise_m else (11,)
    for seed in seeds:
        wrong = links_over(houses(move_m=move_m, rise_m=rise_m, seed=seed), receiver_m, device)
        found, _ = estimate_map_error(wrong, level_db, None, 0)
        for (size_m, low_m, high_m), true_m in ((found.wall_m, move_m), (found.height_m, rise_m)):
            assert low_m <= size_m <= high_m
            if not found.is_shifted:  # of nine houses the mean error is large enough to be called a shift
                outside += not low_m - 1.0 <= true_m <= high_m + 1.0  # nine houses are few draws
        blamed += found.is_seen or found.is_shifted
    assert blamed >= 2 if move_m or rise_m else not blamed, "a map is blamed if it is wrong"
    assert outside <= len(seeds) // 2, "an interval of 90 % misses one map in three at most"


def test_few_links_say_nothing_of_a_map():
    receiver_m, device = flight(20, 3)
    links = links_over(houses(), receiver_m, device)
    assert estimate_map_error(links, np.full(20, -90.0), None, 0)[0] == MapError()


def test_error_of_a_map_is_kept_and_strange_ones_are_refused():
    error = MapError((1.5, 1.0, 2.0), (3.0, 2.0, 4.5), (-2.0, 1.5, 0.5), (-6.0, 1.0))
    assert MapError.from_state(json.loads(json.dumps(error.state()))) == error
    for bad in (None, {"wall_m": [1, 2, 3]}, error.state() | {"wall_m": [1, 2]}, error.state() | {"wall_m": [1, 2, "x"]},
                error.state() | {"height_m": [1e9, 0, 0]}):
        with pytest.raises(ValueError):
            MapError.from_state(bad)


@pytest.fixture(scope="module")
def judged():
    """A model of 200 links over the true map, one over nine other houses, and 300 links to judge on."""
    receiver_m, device = flight(200, 1)
    level_db = levels(houses(), receiver_m, device, 2, diffuse=1e-13)
    there_m, to = flight(300, 8)
    true_db = levels(houses(), there_m, to, 9, diffuse=1e-13, noise_db=0.0)
    found = {}
    for name, city in (("right", houses()), ("wrong", houses(shift_m=(30.0, 30.0)))):
        links, held = links_over(city, receiver_m, device), links_over(city, there_m, to)
        model = PathKriging().fit(links, level_db, None, 0)
        law = RegressionKriging().fit(links, level_db, None, 0)
        found[name] = model, held, law
    return found, true_db


def rms(error_db):
    return float(np.sqrt(np.mean(error_db**2)))


@pytest.mark.slow
def test_paths_over_the_true_map_are_relied_on_and_a_map_of_another_place_is_not(judged):
    models, true_db = judged
    model, held, law = models["right"]
    assert not model.map_error.is_seen and model.weight.min() > 0.9
    assert rms(model.predict(held)[0] - true_db) < 1.5 < rms(law.predict(held)[0] - true_db)
    model, held, law = models["wrong"]
    assert model.map_error.is_seen
    assert rms(model.predict(held)[0] - true_db) < 1.1 * rms(law.predict(held)[0] - true_db)
    for model, held, _ in models.values():
        mean_db, sd_db = model.predict(held)
        assert 0.8 < np.mean(np.abs(true_db - mean_db) < 1.645 * sd_db)


def test_a_damaged_file_is_refused():
    model = PathKriging()
    model.kriging.law = model.kriging.law.from_state({"lines": np.array([[-30.0, -2.0, 2.0]] * 2)}, {"borrowed": None})
    assert decode_both(encode_channel(model), "test")[0].weight.tolist() == [1.0, 1.0]
    model.weight = np.array([2.0, 0.0])
    with pytest.raises(BadInput, match="not a whole channel model"):
        decode_both(encode_channel(model), "test")
