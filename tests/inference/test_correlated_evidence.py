"""Evidence beside a correlated rest, against closed forms and brute force."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from radiotwin.inference import correlated_evidence
from radiotwin.inference.correlated_evidence import Columns, CorrelatedEvidence

NOTHING = Columns(np.zeros((240, 0)), np.zeros(0))


def gain_nats(evidence, z, values, prior_sd):
    return evidence.log_evidence(z, Columns(values, np.array([prior_sd]))) - evidence.log_evidence(z, NOTHING)


def field(rng, sd, length_m, series=2, points=120, side_m=400.0):
    """Return series, positions and a field of exponential correlation plus white noise of sd 1."""
    label, position_m = np.repeat(np.arange(series), points), rng.uniform(0, side_m, (series * points, 3)) * [1, 1, 0]
    z = rng.normal(size=series * points)
    for number in range(series):
        mine = label == number
        covariance = sd**2 * np.exp(-cdist(position_m[mine], position_m[mine]) / length_m)
        z[mine] += np.linalg.cholesky(covariance + 1e-9 * np.eye(points)) @ rng.normal(size=points)
    return label, position_m, z


def test_the_marginal_likelihood_is_that_of_the_normal_distribution():
    rng = np.random.default_rng(0)
    label, position_m, z = field(rng, 1.5, 60.0)
    columns = Columns(rng.normal(size=(240, 3)), np.array([0.5, 2.0, 1.0]))
    evidence = CorrelatedEvidence.fit(label, position_m, z, NOTHING, 0)
    theta = np.array([0.3, 0.7])
    rows = evidence.rows
    correlation = np.exp(-cdist(position_m[rows], position_m[rows]) / evidence.length_m)
    covariance = np.exp(0.3) * (np.eye(240) + np.exp(0.7) * correlation * (label[rows][:, None] == label[rows]))
    covariance += columns.values[rows] * columns.prior_sd**2 @ columns.values[rows].T
    own = evidence.rotated(z), evidence.rotated(columns.values), columns.prior_sd
    found, slope = evidence.at(*own, theta)
    assert found == pytest.approx(multivariate_normal.logpdf(z[rows], cov=covariance), abs=1e-6)
    numerical = approx_fprime(theta, lambda each: evidence.at(*own, each)[0], 1e-6)
    np.testing.assert_allclose(slope, numerical, rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_the_variances_are_the_likeliest(seed):
    rng = np.random.default_rng(seed)
    label, position_m, z = field(rng, 10 ** rng.uniform(-1.5, 1.0), 60.0)
    evidence = CorrelatedEvidence.fit(label, position_m, 3 * z, NOTHING, 0)
    columns = evidence.rotated(rng.normal(size=(240, 5)))
    own = evidence.rotated(3 * z), columns, np.ones(5)
    found, theta = evidence.of_rotated(*own)
    scan = [evidence.at(*own, np.array([noise, field]))[0] for noise in np.linspace(-3, 4, 36)
            for field in np.linspace(-7, 7, 29)]
    assert found == pytest.approx(evidence.at(*own, theta)[0], abs=1e-6)
    assert max(scan) < found + 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_smooth_rest_is_no_evidence_for_a_smooth_pattern(seed):
    """Counted link by link it would be: hundreds of nats for a ramp that is not there."""
    rng = np.random.default_rng(seed)
    label, position_m, z = field(rng, 3.0, 30.0)
    evidence = CorrelatedEvidence.fit(label, position_m, z, NOTHING, 0)
    assert gain_nats(evidence, z, (position_m[:, :1] - 200) / 200, 3.0) < 3.0


@pytest.mark.parametrize("seed", range(4))
def test_a_pattern_that_no_field_has_is_evidence(seed):
    rng = np.random.default_rng(seed)
    label, position_m, z = field(rng, 3.0, 150.0)
    pattern = rng.normal(size=(240, 1))
    evidence = CorrelatedEvidence.fit(label, position_m, z, NOTHING, 0)
    assert gain_nats(evidence, z + pattern[:, 0], pattern, 3.0) > 20


def test_information_is_twice_the_expected_log_likelihood_ratio():
    rng = np.random.default_rng(1)
    pattern, gains = rng.normal(size=240), []
    label, position_m, z = field(rng, 1.0, 60.0)
    evidence = CorrelatedEvidence.fit(label, position_m, z, NOTHING, 0)
    own, theta, none = evidence.rotated(pattern), np.array([0.0, 0.0]), np.zeros((240, 0))
    information = evidence.information(own, none, np.zeros(0), theta)
    for seed in range(40):
        _, _, z = field(np.random.default_rng(seed), 1.0, evidence.length_m)
        without, exact = evidence.rotated(z + 0.4 * pattern), evidence.rotated(z)
        gains.append(evidence.at(exact, none, np.zeros(0), theta)[0] - evidence.at(without, none, np.zeros(0), theta)[0])
    assert np.mean(gains) == pytest.approx(0.5 * 0.4**2 * information, rel=0.25)


def test_long_series_are_thinned_and_cut_into_parts_and_blank_rows_are_left_out(monkeypatch):
    monkeypatch.setattr(correlated_evidence, "MAX_ROWS", 1000)
    rng = np.random.default_rng(2)
    position_m, z = rng.uniform(0, 300, (5000, 3)), rng.normal(size=5000)
    z[::3] = np.nan
    evidence = CorrelatedEvidence.fit(np.zeros(5000, dtype=int), position_m, z, Columns(np.zeros((5000, 0)), np.zeros(0)), 0)
    assert len(evidence.rows) == len(set(evidence.rows)) == 1000 and np.isfinite(z[evidence.rows]).all()
    assert [part.stop - part.start for part in evidence.parts] == [250] * 4
    extent_m = [np.prod(np.ptp(position_m[evidence.rows[part]], axis=0)) for part in evidence.parts]
    assert np.sum(extent_m) < 1.05 * 300.0**3  # parts are boxes beside each other
    nothing = CorrelatedEvidence.fit(np.zeros(240, dtype=int), np.zeros((240, 3)), np.full(240, np.nan), NOTHING, 0)
    assert nothing.log_evidence(np.zeros(240), NOTHING) == 0.0


def test_a_series_in_parts_is_worth_nearly_what_it_is_in_one(monkeypatch):
    found = []
    for most in (400, 40):
        monkeypatch.setattr(correlated_evidence, "MAX_POINTS", most)
        rng = np.random.default_rng(3)
        label, position_m, z = field(rng, 1.0, 20.0)
        pattern = rng.normal(size=(240, 1))
        z += 0.5 * pattern[:, 0]
        found.append(gain_nats(CorrelatedEvidence.fit(label, position_m, z, NOTHING, 0), z, pattern, 1.0))
    assert found[0] > 5 and found[1] == pytest.approx(found[0], rel=0.2)
