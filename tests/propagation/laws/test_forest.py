"""Regression trees as plain arrays."""

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor

from radiotwin.errors import BadInput
from radiotwin.propagation.laws.forest import Forest

WIDTH = 4


@pytest.fixture(scope="module", params=["extra_trees", "boosting"])
def grown(request):
    """Return features, the library's prediction of them, and our arrays."""
    rng = np.random.default_rng(0)
    features = rng.normal(0, 100, (400, WIDTH)).astype(np.float32)
    features[:, 3] = features[:, 3] > 0
    target = np.where(features[:, 0] > features[:, 1], -80, -100) + rng.normal(0, 3, 400)
    if request.param == "boosting":
        fitted = HistGradientBoostingRegressor(max_iter=12, random_state=0).fit(features, target)
        forest = Forest.of_boosting(fitted)
    else:
        fitted = ExtraTreesRegressor(12, min_samples_leaf=2, random_state=0).fit(features, target)
        forest = Forest.of_extra_trees(fitted)
    asked = np.concatenate([features, rng.normal(0, 200, (500, WIDTH)).astype(np.float32)])
    return asked, fitted.predict(asked), forest


def test_it_predicts_what_the_library_predicts(grown):
    asked, expected, forest = grown
    np.testing.assert_allclose(forest.predict(asked), expected, rtol=0, atol=1e-9)


def test_what_is_stored_predicts_the_same(grown):
    asked, _, forest = grown
    again = Forest.from_state(*forest.state(), WIDTH)
    np.testing.assert_array_equal(again.predict(asked), forest.predict(asked))


@pytest.mark.parametrize("change, message", [
    (lambda arrays: arrays["left"].__setitem__(1, 0), "cycle"),
    (lambda arrays: arrays["feature"].__setitem__(0, WIDTH), "feature holds"),
    (lambda arrays: arrays["value"].__setitem__(3, np.nan), "value holds"),
    (lambda arrays: arrays.pop("right"), "missing"),
    (lambda arrays: arrays.update(root=arrays["root"] + 0.5), "integers|root holds"),
    (lambda arrays: arrays["root"].__setitem__(0, 10**6), "root holds")])
def test_damaged_trees_are_refused(grown, change, message):
    arrays, settings = grown[2].state()
    arrays = {name: array.copy() for name, array in arrays.items()}
    change(arrays)
    with pytest.raises(ValueError, match=message):
        Forest.from_state(arrays, settings, WIDTH)


def test_too_many_nodes_are_refused(grown, monkeypatch):
    monkeypatch.setenv("RADIOTWIN_MAX_TREE_NODES", "10")
    with pytest.raises(BadInput, match="RADIOTWIN_MAX_TREE_NODES"):
        Forest.from_state(*grown[2].state(), WIDTH)
