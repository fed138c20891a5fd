"""The baseline with one exponent."""

import numpy as np
import pytest

from radiotwin.propagation.laws.log_distance import LogDistance


def test_recovers_its_own_law(world):
    def law(distance_m, los, elevation_rad):
        return -33.0 - 28.0 * np.log10(distance_m)

    data = world(0, 4000, limit_db=-105.0, law=law, los_range_m=1e-3)
    model = LogDistance().fit(data.links, data.level_db, -105.0)
    assert model.line.exponent == pytest.approx(2.8, abs=0.06)
    assert model.line.sd_db == pytest.approx(5.0**0.5, rel=0.05)
    mean_db, sigma_db = model.predict(data.links)
    assert np.sqrt(np.mean((mean_db - data.mean_db) ** 2)) < 0.25
    assert sigma_db.shape == (4000,)


def test_line_of_sight_changes_nothing(world):
    data = world(0, 500)
    model = LogDistance().fit(data.links, data.level_db, None)
    flipped = data.links.select(np.arange(500))
    flipped.los[:] = ~flipped.los
    assert np.array_equal(model.predict(flipped)[0], model.predict(data.links)[0])
