"""The regression against data drawn from its own assumptions, and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import t as student

from radiotwin.effects.catalogue.noise_floor import floored
from radiotwin.inference.censored_regression import (
    CensoredRegression,
    _slope_and_hessian,
    fit,
)
from radiotwin.inference.student import Losses, ReadingLaw


def problem(level_db, columns, limit_db=-np.inf, dof=5.0, split=1, paths=None, receiver=None, prior_sd_db=np.inf):
    n, p = columns.shape
    return CensoredRegression(level_db, np.full(n, limit_db), np.zeros(n), columns[:, :split], paths, np.zeros(n),
                              columns[:, split:], np.full(p, prior_sd_db), np.zeros(n, int), receiver, dof)


def covariance(problem, result):
    """Return the covariance of the coefficients from the curvature at the maximum."""
    precision = 1.0 / np.square(problem.prior_sd_db)
    return np.linalg.inv(_slope_and_hessian(problem, problem.predict(result), precision)[1])


def draw(seed, dof=5.0, n=4000, scale=3.0):
    rng = np.random.default_rng(seed)
    columns = np.column_stack([np.ones(n), rng.normal(size=(n, 2))])
    truth = np.array([-80.0, 5.0, -4.0])
    return columns, truth, columns @ truth + scale * rng.standard_t(dof, n)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("blank_share", [0.0, 0.2, 0.5])
def test_coefficients_and_scale_are_found_also_where_many_levels_are_blank(seed, blank_share):
    columns, truth, level_db = draw(seed)
    limit_db = np.quantile(level_db, blank_share) if blank_share else -np.inf
    given = problem(np.where(level_db < limit_db, np.nan, level_db), columns, limit_db)
    found = fit(given)
    sd_db = np.sqrt(np.diag(covariance(given, found)))
    assert (np.abs(found.coefficients - truth) < 4.5 * sd_db).all() and sd_db.max() < 0.2
    assert found.scale_db[0] == pytest.approx(3.0, rel=0.08)


def test_the_solution_is_the_maximum_of_the_likelihood_written_with_scipy():
    columns, _, level_db = draw(0, n=400)
    limit_db = np.quantile(level_db, 0.3)
    blank = level_db < limit_db
    given = problem(np.where(blank, np.nan, level_db), columns, limit_db)
    found = fit(given)

    def objective(theta):
        mean, scale = columns @ theta[:3], np.exp(theta[3])
        return -(student.logpdf((level_db - mean) / scale, 5)[~blank] - np.log(scale)).sum() \
            - student.logcdf((limit_db - mean) / scale, 5)[blank].sum()

    best = minimize(objective, np.r_[found.coefficients, np.log(found.scale_db)], method="BFGS")
    assert objective(np.r_[found.coefficients, np.log(found.scale_db)]) == pytest.approx(best.fun, abs=0.05)
    assert given.nll(found).sum() == pytest.approx(best.fun, abs=0.05)


def test_outliers_do_not_bias_it():
    columns, truth, level_db = draw(1, dof=50.0)
    level_db[:200] += 60
    found = fit(problem(level_db, columns, dof=3.0))
    assert np.abs(found.coefficients - truth).max() < 0.4
    plain = np.linalg.lstsq(columns, level_db, rcond=None)[0]
    assert abs(plain[0] - truth[0]) > 2


def test_a_narrow_prior_holds_a_coefficient_back():
    columns, _, level_db = draw(2, n=50)
    free, held = fit(problem(level_db, columns)), fit(problem(level_db, columns, prior_sd_db=0.01))
    assert np.abs(held.coefficients).max() < 0.1 < np.abs(free.coefficients).max()


def test_a_blank_without_a_limit_says_nothing():
    columns, _, level_db = draw(3)
    blank = np.arange(len(level_db)) % 3 == 0
    with_blanks = fit(problem(np.where(blank, np.nan, level_db), columns))
    without = fit(problem(level_db[~blank], columns[~blank]))
    np.testing.assert_allclose(with_blanks.coefficients, without.coefficients, atol=0.02)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("lost", ["links", "levels"])
def test_links_lost_and_levels_dropped_at_random_do_not_bias_it(seed, lost):
    """Half of the links lose three readings in ten; or a quarter of the levels drop by 18 dB."""
    columns, truth, level_db = draw(seed)
    rng, limit_db = np.random.default_rng(seed), -np.inf
    if lost == "links":
        limit_db, losses = np.quantile(level_db, 0.2), Losses(blank=np.where(np.arange(len(level_db)) % 2, 0.3, 0.0))
        hit = rng.random(len(level_db)) < losses.blank
        read_db = np.where((level_db < limit_db) | hit, np.nan, level_db)
    else:
        losses, hit = Losses(drop=0.25, drop_db=18.0), rng.random(len(level_db)) < 0.25
        read_db = level_db - 18.0 * hit
    plain = problem(read_db, columns, limit_db)
    known, naive = replace(plain, losses=losses), fit(plain)
    found = fit(known)
    sd_db = np.sqrt(np.diag(covariance(known, found)))
    assert (np.abs(found.coefficients - truth) < 4.5 * sd_db).all() and sd_db.max() < 0.2
    assert found.scale_db[0] == pytest.approx(3.0, rel=0.08)
    residual_db = known.residual_db(found)[hit], plain.residual_db(found)[hit]
    if lost == "links":  # a strong link that is blank dropped out; it is not thought to be weak
        assert abs(naive.coefficients[0] - truth[0]) > 1
        strong = (columns @ truth)[hit] > limit_db + 10
        assert residual_db[0][strong].min() > -0.5 and residual_db[1][strong].max() < -9
    else:
        assert naive.scale_db[0] > 4 and abs(residual_db[0].mean()) < 1 and residual_db[1].mean() < -10


@pytest.mark.parametrize(("share", "drop"), [(0.0, 0.0), (0.03, 0.0), (0.6, 0.0), (0.0, 0.2), (0.1, 0.4)])
def test_derivatives_are_those_of_the_likelihood_also_where_links_are_lost(share, drop):
    """Slope and curvature against differences in the mean, and the term of the scale against those in its logarithm."""
    rng = np.random.default_rng(5)
    level_db = rng.uniform(-100, -60, 300)
    level_db[::2] = np.nan
    given = replace(problem(level_db, np.ones((300, 1)), -95.0), losses=Losses(np.full(300, share), np.full(300, drop), np.full(300, 12.0)))
    mean, scale, step = rng.uniform(-110, -70, 300), 3.0, 1e-3
    slope, curvature, scale_slope = given.reading_law(mean, np.full(300, scale)).derivatives(level_db)
    around = [given.nll_at(mean + way * step, np.full(300, scale)) for way in (-1, 0, 1)]
    np.testing.assert_allclose(slope, (around[0] - around[2]) / (2 * step), atol=1e-5)
    blank = np.isnan(level_db)
    exact = (around[0] - 2 * around[1] + around[2]) / step**2
    np.testing.assert_allclose(curvature[blank], np.maximum(exact[blank], 0), atol=1e-5)
    assert curvature.min() > 0
    if not drop:
        assert exact[blank].min() < 0  # far from the limit the likelihood is not concave
    wider, narrower = (given.nll_at(mean, np.full(300, scale * np.exp(way * step))) for way in (1, -1))
    np.testing.assert_allclose(scale_slope, (narrower - wider) / (2 * step), atol=1e-5)


def test_the_likelihood_of_a_level_that_may_have_dropped_is_that_of_a_mixture():
    given = replace(problem(np.array([-80.0, -99.0, np.nan]), np.ones((3, 1)), -110.0),
                    losses=Losses(0.1, np.array([0.0, 0.3, 0.3]), 16.0))
    found = given.nll_at(np.full(3, -84.0), np.full(3, 4.0))
    seen = 0.7 * student.pdf(-15 / 4, 5) + 0.3 * student.pdf(1 / 4, 5)
    below = 0.7 * student.cdf(-26 / 4, 5) + 0.3 * student.cdf(-10 / 4, 5)
    np.testing.assert_allclose(found, -np.log([0.9 * student.pdf(1, 5) / 4, 0.9 * seen / 4, 0.1 + 0.9 * below]))


@pytest.mark.parametrize("limit_db", [-np.inf, -100.0])
def test_mean_and_probability_of_detection_count_both_states(limit_db):
    """Against a million draws."""
    rng = np.random.default_rng(1)
    level_db = -85 + 4 * rng.standard_t(5, 10**6) - 20 * (rng.random(10**6) < 0.3)
    seen = (level_db > limit_db) & (rng.random(10**6) > 0.2)
    law = ReadingLaw(np.array([-85.0]), np.array([4.0]), np.array([limit_db]), 5, Losses(0.2, 0.3, 20.0))
    assert law.detection_probability[0] == pytest.approx(seen.mean(), abs=0.002)
    assert law.reading_db[0] == pytest.approx(level_db[seen].mean(), abs=0.03)


def test_what_paths_add_and_receivers_compress_is_undone():
    columns, truth, _ = draw(4, n=6000)
    rng = np.random.default_rng(4)
    added = 10 ** (rng.uniform(-95, -70, 6000) / 10)
    law = 10 ** ((columns[:, 0] * truth[0] + columns[:, 1] * truth[1]) / 10)
    arriving = 10 * np.log10(law + added) + truth[2] * columns[:, 2]
    level_db = np.where(arriving > -72, -72 + 0.5 * (arriving + 72), arriving) + rng.normal(0, 0.5, 6000)

    def paths(mean):
        total = 10 * np.log10(10 ** (mean / 10) + added)
        return total, 10 ** ((mean - total) / 10)

    def receiver(mean):
        strong = mean > -72
        return np.where(strong, -72 + 0.5 * (mean + 72), mean), np.where(strong, 0.5, 1.0)

    given = problem(level_db, columns, split=2, paths=paths, receiver=receiver, dof=30.0)
    found = fit(given)
    np.testing.assert_allclose(found.coefficients, truth, atol=0.15)
    assert np.sqrt(np.mean(given.residual_db(found) ** 2)) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("random_effect_sd_db", [0.0, 6.0])
def test_what_is_read_near_a_floor_is_the_mean_of_what_may_arrive(random_effect_sd_db):
    """Against draws: levels scatter before the receiver adds its floor."""
    rng = np.random.default_rng(7)
    arriving_db = np.array([-120.0, -100.0, -92.0, -85.0, -60.0])
    given = replace(problem(np.zeros(5), arriving_db[:, None], receiver=lambda level: floored(level, -90.0)),
                    random_effect_sd_db=np.full(5, random_effect_sd_db))
    expected = given.linearise(np.ones(1), np.array([7.0]))
    drawn_db = floored(arriving_db + np.hypot(7.0, random_effect_sd_db) * rng.normal(size=(200_000, 5)), -90.0)[0]
    np.testing.assert_allclose(expected.mean_db, drawn_db.mean(axis=0), atol=0.15)
    assert (np.diff(expected.scale_db) > 0).all() and 3.5 <= expected.scale_db[0] < 4
    assert expected.scale_db[-1] == pytest.approx(np.hypot(7.0, random_effect_sd_db), rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_a_law_under_a_floor_is_found(seed):
    """Three links in four lie below the floor of the receiver; a law without it would be half as steep."""
    rng = np.random.default_rng(seed)
    columns = np.column_stack([np.ones(4000), rng.uniform(1.5, 3.5, 4000)])
    arriving_db = columns @ [-20.0, -32.0] + 6.0 * rng.standard_t(5, 4000)
    level_db = floored(arriving_db, -85.0)[0] + rng.normal(0, 1.0, 4000)
    given = problem(level_db, columns, receiver=lambda level: floored(level, -85.0))
    assert fit(given).coefficients[1] == pytest.approx(-32.0, abs=4.0)
    assert fit(replace(given, receiver=None)).coefficients[1] > -22
