"""The censored log-distance line: least squares where nothing is censored, unbiased where much is."""

import numpy as np
import pytest
from scipy.stats import norm

from radiotwin.inference.gaussian import LogDistanceLine, fit_line, fit_sd_db, shift_line

TRUE = np.array([-35.0, 3.04, 5.0**0.5])
LIMIT_DB = -107.0


def draw(seed, n=600):
    rng = np.random.default_rng(seed)
    x = rng.uniform(np.log10(60.0), np.log10(800.0), n)
    return x, TRUE[0] - 10.0 * TRUE[1] * x + TRUE[2] * rng.standard_normal(n)


def parameters(line):
    return np.array([line.intercept_db, line.exponent, line.sd_db])


def test_without_censoring_it_is_least_squares():
    x, y = draw(0)
    slope, intercept = np.polyfit(x, y, 1)
    expected = [intercept, -slope / 10.0, np.std(y - intercept - slope * x)]
    assert parameters(fit_line(x, y, None)) == pytest.approx(expected, abs=2e-3)


def test_with_half_of_the_levels_blank_the_law_is_found_within_4_standard_errors():
    censored, ignored, share = [], [], []
    for seed in range(30):
        x, y = draw(seed)
        y[y < LIMIT_DB] = np.nan
        share.append(np.isnan(y).mean())
        censored.append(parameters(fit_line(x, y, LIMIT_DB)))
        seen = ~np.isnan(y)
        ignored.append(parameters(fit_line(x[seen], y[seen], None)))
    assert 0.4 < np.mean(share) < 0.6

    def standard_errors(estimates):
        mean_sd = np.std(estimates, axis=0, ddof=1) / np.sqrt(len(estimates))
        return np.abs(np.mean(estimates, axis=0) - TRUE) / mean_sd

    assert (standard_errors(censored) < 4.0).all()
    assert (standard_errors(ignored)[:2] > 10.0).all()
    assert np.abs(np.array(censored)[:, 1] - TRUE[1]).max() < 0.25


def test_the_line_is_the_maximum_of_a_likelihood_written_with_scipy():

    x, y = draw(3)
    y[y < LIMIT_DB] = np.nan
    line, seen = fit_line(x, y, LIMIT_DB), ~np.isnan(y)

    def log_likelihood(theta):
        mean = theta[0] - 10.0 * theta[1] * x
        return (norm.logpdf(y[seen], mean[seen], theta[2]).sum()
                + norm.logcdf(LIMIT_DB, mean[~seen], theta[2]).sum())

    best = log_likelihood(parameters(line))
    for step in np.diag([0.05, 0.005, 0.05]):
        assert log_likelihood(parameters(line) + step) < best
        assert log_likelihood(parameters(line) - step) < best


def test_one_distance_only_gives_the_priors_exponent():
    y = -80.0 + 0.5 * np.random.default_rng(0).standard_normal(50)
    line = fit_line(np.full(50, 2.0), y, None)
    assert line.exponent == pytest.approx(3.0, abs=0.1)
    assert line.mean_db(np.array(2.0)) == pytest.approx(y.mean(), abs=0.01)


LINE = LogDistanceLine(-30.0, 2.5, 4.0)


@pytest.mark.parametrize(("n", "level_db", "least", "most"), [
    (0, 0.0, -50.001, -49.999), (500, -87.0, -37.1, -36.9), (10, np.nan, -np.inf, -55.0)])
def test_a_shift_follows_the_prior_without_levels_many_levels_and_blanks(n, level_db, least, most):
    shifted = shift_line(LINE, np.full(n, 2.0), np.full(n, level_db), -110.0, -20.0, 10.0)
    assert least < shifted.intercept_db < most


def test_sigma_of_censored_levels():
    rng = np.random.default_rng(5)
    mean_db = rng.uniform(-115.0, -95.0, 4000)
    level_db = mean_db + 3.0 * rng.standard_normal(4000)
    level_db[level_db < -105.0] = np.nan
    assert fit_sd_db(level_db, mean_db, -105.0) == pytest.approx(3.0, rel=0.06)
