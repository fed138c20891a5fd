"""The interpolation against the closed form of a few points, and kinds that differ where they meet."""

import numpy as np
import pytest

from radiotwin.propagation.laws import kriging as residual_field
from radiotwin.propagation.laws.kriging import ResidualField


def drawn(seed, n=500, offset=1.5):
    """Two kinds on one field of 60 m: the second reads `offset` more, and is mostly where the field is low."""
    rng = np.random.default_rng(seed)
    position_m = np.column_stack([rng.uniform(0, 600, (n, 2)), np.zeros(n)])
    apart_m = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    field = np.linalg.cholesky(np.exp(-apart_m / 60.0) + 1e-9 * np.eye(n)) @ rng.normal(size=n)
    kind = (rng.random(n) < np.where(field < 0, 0.8, 0.2)).astype(int)
    return position_m, field, kind, field + offset * kind + 0.3 * rng.normal(size=n)


@pytest.mark.parametrize("seed", range(3))
def test_kinds_that_meet_are_distinguished_though_they_went_to_other_positions(seed):
    position_m, field, kind, value = drawn(seed)
    learned, asked = np.arange(500) < 350, np.arange(500) >= 350
    mean, sigma = value[learned].mean(), value[learned].std()
    assert abs(value[kind == 1].mean() - value[kind == 0].mean()) < 0.9  # a plain comparison is deceived

    def error(kinds):
        fitted = ResidualField().fit(np.zeros(350, int), position_m[learned], (value[learned] - mean) / sigma, 0,
                                     None if kinds is None else kinds[learned])
        expected, sd = fitted.predict(np.zeros(150, int), position_m[asked], None if kinds is None else kinds[asked])
        z = ((value[asked] - mean) / sigma - expected) / sd
        return np.sqrt(np.mean((mean + sigma * expected - value[asked]) ** 2)), z.std(), fitted
    plain, _, without = error(None)
    by_kind, calibration, fitted = error(kind)
    assert by_kind < 0.9 * plain and 0.8 < calibration < 1.25
    assert without.kind_share == 0 and fitted.kind_share > 0.1
    at_half_way = fitted.predict(np.zeros(1, int), np.full((1, 3), 300.0), np.array([-1]))[0]
    both = [fitted.predict(np.zeros(1, int), np.full((1, 3), 300.0), np.array([k]))[0] for k in (0, 1)]
    assert both[0] < at_half_way < both[1] and sigma * (both[1] - both[0]) == pytest.approx(1.5, abs=0.5)


def test_two_points_are_as_the_closed_form_says():
    field = ResidualField()
    field.fit(np.zeros(2, int), np.array([[0.0, 0, 0], [30, 0, 0]]), np.array([1.0, -0.5]), 0)
    field.share, field.length_m = 0.8, 40.0
    field._factor()
    near, across, far = 0.8 * np.exp(-10 / 40), 0.8 * np.exp(-30 / 40), 0.8 * np.exp(-20 / 40)
    weights = np.linalg.solve([[1.0, across], [across, 1.0]], [near, far])
    mean, sigma = field.predict(np.zeros(1, int), np.array([[10.0, 0, 0]]))
    assert mean[0] == pytest.approx(weights @ [1.0, -0.5], abs=1e-6)
    assert sigma[0] ** 2 == pytest.approx(1 - weights @ [near, far], abs=1e-6)
    assert np.array(field.predict(np.ones(1, int), np.zeros((1, 3)))).tolist() == [[0.0], [1.0]]


def test_many_series_stay_within_the_memory_that_is_said(monkeypatch):
    """200 series of 150 points on fields of 60 m: coarser than measured, fitted to some, and the length is found."""
    monkeypatch.setattr(residual_field, "MAX_SERIES_TO_FIT", 20)
    rng = np.random.default_rng(5)
    other_m, values = [], []
    for _ in range(200):
        position_m = np.column_stack([rng.uniform(0, 600, (150, 2)), np.zeros(150)])
        apart_m = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
        values.append(np.linalg.cholesky(np.exp(-apart_m / 60.0) + 1e-6 * np.eye(150)) @ rng.normal(size=150))
        other_m.append(position_m)
    field = ResidualField(200 * 70**2).fit(np.repeat(np.arange(200), 150), np.concatenate(other_m), np.concatenate(values), 0)
    sizes = np.array([len(each.residual) for each in field.fields.values()])
    assert len(sizes) == 200 and (sizes**2).sum() <= field.max_pairs and sizes.min() > 20
    assert field.length_m == pytest.approx(60.0, rel=0.25) and field.share > 0.9
    mean, _ = field.predict(np.arange(200), np.array([position_m[0] for position_m in other_m]))
    assert np.corrcoef(mean, [value[0] for value in values])[0, 1] > 0.7
