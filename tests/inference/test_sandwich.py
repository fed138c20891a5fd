"""Covariances of rows that err alike, against closed forms and against repeated draws."""

import numpy as np
import pytest
from scipy.stats import norm, t

from radiotwin.inference.sandwich import Scores


def scores_of(columns, error, sd=1.0, precision=None):
    """Return the scores of a linear regression with known scale at its least-squares solution."""
    precision = np.zeros(columns.shape[1]) if precision is None else precision
    weight = 1 / sd**2
    beta = np.linalg.solve(weight * columns.T @ columns + np.diag(precision), weight * columns.T @ error)
    left = error - columns @ beta
    return beta, Scores(weight * columns * left[:, None], np.sqrt(weight) * columns, precision, precision)


def test_without_clusters_it_is_the_covariance_of_least_squares():
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(50, 3))
    _, scores = scores_of(columns, rng.normal(size=50), sd=2.0)
    assert scores.covariances([])[0] == pytest.approx(4.0 * np.linalg.inv(columns.T @ columns))


def test_rows_that_are_copies_count_once():
    """Ten copies of 40 rows: the mean's sd is that of 40, with Student's t of 39."""
    rng = np.random.default_rng(1)
    error = np.repeat(rng.normal(size=40), 10)
    _, scores = scores_of(np.ones((400, 1)), error)
    sd = np.sqrt(max(each[0, 0] for each in scores.covariances([np.repeat(np.arange(40), 10)])))
    expected = error.std(ddof=1) / np.sqrt(400 / 10) * np.sqrt(400 / 399 * 39 / 40) * np.sqrt(40 / 39)
    assert sd == pytest.approx(expected * t.ppf(0.95, 39) / norm.ppf(0.95), rel=0.02)


@pytest.mark.parametrize("clusters", (6, 30))
def test_intervals_hold_nine_in_ten_with_clusters_of_unequal_size(clusters):
    rng = np.random.default_rng(2)
    inside = []
    for _ in range(300):
        size = rng.integers(5, 40, clusters)
        label = np.repeat(np.arange(clusters), size)
        columns = np.column_stack([np.ones(len(label)), rng.normal(size=clusters)[label]])
        error = rng.normal(size=clusters)[label] + 0.5 * rng.normal(size=len(label))
        beta, scores = scores_of(columns, error, sd=error.std())
        sd = np.sqrt(np.max([np.diag(each) for each in scores.covariances([label])], axis=0))
        inside.append(np.abs(beta) <= 1.645 * sd)
    assert (np.mean(inside, axis=0) > 0.8).all() and (np.mean(inside, axis=0) < 0.97).all()
