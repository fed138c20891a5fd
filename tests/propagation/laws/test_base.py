"""Links that no channel can be fitted to."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.propagation.laws import channel_models, check_fit_data
from radiotwin.propagation.laws.published import PublishedLaw

MODELS = {name: kind for name, kind in channel_models().items() if not issubclass(kind, PublishedLaw)}


@pytest.mark.parametrize("rows, level_db, message", [
    (slice(None), np.nan, "nothing detected: all 60 links are blank"),
    (slice(19, None), np.nan, "only 19 of 60 links were detected, a channel needs at least 20"),
    (slice(7, 8), -np.inf, "level of link 7 is -inf dB")])
@pytest.mark.parametrize("name", MODELS)
def test_levels_that_no_channel_can_be_fitted_to_are_refused(name, world, rows, level_db, message):
    data = world(0, 60)
    data.level_db[rows] = level_db
    with pytest.raises(BadInput, match=message):
        MODELS[name]().fit(data.links, data.level_db, -120.0, seed=0)


def test_line_of_sight_of_detected_links_is_required_only_if_it_matters(world):
    hidden, undetected = world(0, 60, los_range_m=1e-3), world(0, 60)
    undetected.level_db[undetected.links.los] = np.nan
    for data in (hidden, undetected):
        with pytest.raises(BadInput, match="all links NLoS: not one of the .* detected"):
            check_fit_data(data.links, data.level_db, needs_los=True)
        check_fit_data(data.links, data.level_db, needs_los=False)


def test_without_a_limit_the_undetected_are_left_out_loudly(world):
    data = world(1, 300, limit_db=-105.0)
    missing = int(np.isnan(data.level_db).sum())
    with pytest.warns(UserWarning, match=f"{missing} of 300 links were not detected and are left out"):
        loose = MODELS["log_distance"]().fit(data.links, data.level_db, None, seed=0)
    seen = ~np.isnan(data.level_db)
    same = MODELS["log_distance"]().fit(data.links.select(seen), data.level_db[seen], -105.0, seed=0)
    assert loose.line == same.line
