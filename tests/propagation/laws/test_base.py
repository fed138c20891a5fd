"""What no model can be fitted to."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.propagation.laws import channel_models, check_fit_data
from radiotwin.propagation.laws.published import PublishedLaw

MODELS = {name: kind for name, kind in channel_models().items() if not issubclass(kind, PublishedLaw)}
EVERY = pytest.mark.parametrize("name", MODELS)


@EVERY
def test_nothing_detected(name, world):
    data = world(0, 60)
    with pytest.raises(BadInput, match="nothing detected: all 60 links are blank"):
        MODELS[name]().fit(data.links, np.full(60, np.nan), -120.0, seed=0)


@EVERY
def test_too_little_detected(name, world):
    data = world(0, 60)
    data.level_db[19:] = np.nan
    with pytest.raises(BadInput, match="only 19 of 60 links were detected, a channel needs at least 20"):
        MODELS[name]().fit(data.links, data.level_db, -120.0, seed=0)


@EVERY
def test_infinite_level_is_named(name, world):
    data = world(0, 60)
    data.level_db[7] = -np.inf
    with pytest.raises(BadInput, match="level of link 7 is -inf dB"):
        MODELS[name]().fit(data.links, data.level_db, -120.0, seed=0)


def test_all_links_nlos_is_refused_only_where_line_of_sight_matters(world):
    data = world(0, 60, los_range_m=1e-3)
    with pytest.raises(BadInput, match="all links NLoS: not one of the 60 detected"):
        check_fit_data(data.links, data.level_db, needs_los=True)
    check_fit_data(data.links, data.level_db, needs_los=False)


def test_a_los_link_that_was_not_detected_does_not_count(world):
    data = world(0, 60)
    data.level_db[data.links.los] = np.nan
    with pytest.raises(BadInput, match="all links NLoS"):
        check_fit_data(data.links, data.level_db, needs_los=True)


def test_without_a_limit_the_undetected_are_left_out_loudly(world):
    data = world(1, 300, limit_db=-105.0)
    missing = int(np.isnan(data.level_db).sum())
    with pytest.warns(UserWarning, match=f"{missing} of 300 links were not detected and are left out"):
        loose = MODELS["log_distance"]().fit(data.links, data.level_db, None, seed=0)
    seen = ~np.isnan(data.level_db)
    same = MODELS["log_distance"]().fit(data.links.select(seen), data.level_db[seen], -105.0, seed=0)
    assert loose.line == same.line
