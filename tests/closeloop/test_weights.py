"""Weights of a combination, on made errors whose best combination is known."""

import numpy as np
import pytest

from radiotwin.closeloop.predict.weights import HeldOut, combination, half_distance_m
from radiotwin.inference.student import ReadingLaw

NAMES = ["named", "smooth", "law"]


def held_out(n, sds_db, away_m, seed, limit_db=-np.inf, scale_db=4.0):
    """Return n links whose members are off by normal errors of sizes (3,) [dB], independent ones."""
    rng = np.random.default_rng(seed)
    level_db = rng.normal(-90.0, 8.0, n)
    predicted_db = level_db[:, None] + rng.normal(size=(n, len(sds_db))) * sds_db
    nothing = np.zeros(n)
    return HeldOut(np.where(level_db < limit_db, np.nan, level_db), np.full(n, limit_db), predicted_db,
                   np.full((n, len(sds_db)), scale_db), nothing,
                   np.full(n, float(away_m)), nothing, nothing, nothing, np.arange(n) % 5)


def test_near_and_far_part_where_the_campaign_does():
    """Places a kilometre apart are as near to each other as anything gets there."""
    near, far = (held_out(50, [1, 1, 1], away_m, 0) for away_m in (500.0, 4500.0))
    assert half_distance_m(near, far) == pytest.approx(1500.0)
    assert half_distance_m(near, held_out(50, [1, 1, 1], np.inf, 0)) == 50.0


@pytest.mark.parametrize("away_m", [110.0, 3000.0])
@pytest.mark.parametrize("seed", range(3))
def test_what_is_best_held_out_is_kept_though_quadrants_are_predicted_badly_by_it(away_m, seed):
    near, far = held_out(400, [8.0, 3.0, 6.0], 100.0, seed), held_out(1600, [9.0, 40.0, 30.0], away_m, seed + 9)
    found = combination(near, far, NAMES, half_distance_m(near, far), 10.0)
    share = 100.0 / (100.0 + found.half_m)
    weights = np.array([found.weights.get(name, (0.0, 0.0)) for name in NAMES])
    error_db = near.level_db - near.predicted_db @ ((1 - share) * weights[:, 0] + share * weights[:, 1])
    assert np.sqrt(np.mean(error_db**2)) < 1.02 * 3.0
    if away_m > 1000.0:
        assert weights[0, 1] > 0.8  # far away the other one is


def test_errors_are_as_wide_as_they_were_though_half_of_the_links_are_blank():
    near, far = (held_out(3000, [2.0, 50.0, 50.0], away_m, seed, limit_db=-90.0) for away_m, seed in ((1.0, 0), (2.0, 1)))
    found = combination(near, far, NAMES, 1.4, 1e4)
    assert found.sd_ratio == pytest.approx((0.5, 0.5), rel=0.1)


def test_what_extrapolation_costs_widens_errors_far_away_only():
    near, far = held_out(500, [2.0, 50.0, 50.0], 10.0, 0), held_out(500, [12.0, 50.0, 50.0], 1000.0, 1)
    found = combination(near, far, NAMES, 100.0, 1e4)
    assert found.sd_ratio[0] < 1.0 and found.sd_ratio[1] > 2.5


def test_ranks_of_readings_are_uniform_where_the_law_is_right():
    rng = np.random.default_rng(0)
    mean_db = rng.uniform(-100.0, -80.0, 20_000)
    level_db = mean_db + 3.0 * rng.standard_t(5.0, 20_000)
    level_db[level_db < -95.0] = np.nan
    law = ReadingLaw(mean_db, np.full(20_000, 3.0), np.full(20_000, -95.0), 5.0)
    rank = law.rank(level_db)
    known = rank[np.isfinite(rank)]
    assert len(known) == np.isfinite(level_db).sum()
    np.testing.assert_allclose(np.quantile(known, [0.05, 0.5, 0.95]), [0.05, 0.5, 0.95], atol=0.012)
    assert np.nanmean(level_db - law.reading_db) == pytest.approx(0.0, abs=0.1)
