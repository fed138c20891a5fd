import numpy as np

from radiotwin.twin.localize.likelihood import DeviceResiduals, design_effect, residual_correlation


def residuals(z, receiver_m):
    away = receiver_m[:, :2] - (205.0, 195.0)
    return DeviceResiduals(receiver_m, z, away / np.sum(away**2, axis=1, keepdims=True))


def lattice():
    x, y = np.meshgrid(np.arange(0, 401, 20.0), np.arange(0, 401, 20.0))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 60.0)])


def test_independent_residuals_count_in_full():
    rng = np.random.default_rng(0)
    data = [residuals(rng.standard_normal(441), lattice()) for _ in range(5)]
    correlation = residual_correlation(data)
    assert not correlation.any()
    assert max(design_effect(each, correlation) for each in data) < 1.2


def test_correlation_is_found_and_costs_what_sandwich_says():
    """Exponential correlation, 60 m: the estimate is near it, and the factor near the one from the true matrix."""
    rng = np.random.default_rng(1)
    receiver_m = lattice()
    apart = np.linalg.norm(receiver_m[:, None] - receiver_m, axis=2)
    rho = np.exp(-apart / 60)
    shadow = np.linalg.cholesky(rho) @ rng.standard_normal((441, 20))
    data = [residuals(z, receiver_m) for z in shadow.T]
    correlation = residual_correlation(data)
    assert np.isclose(correlation[1], np.exp(-24 / 60), atol=0.1)
    slope = data[0].slope
    truth = np.trace(np.linalg.solve(slope.T @ slope, slope.T @ rho @ slope)) / 2
    assert 0.6 < np.median([design_effect(each, correlation) for each in data]) / truth < 1.5


def test_too_small_a_sigma_costs_too():
    rng = np.random.default_rng(2)
    data = residuals(2.0 * np.clip(rng.standard_normal(441), -1.4, 1.4), lattice())
    assert np.isclose(design_effect(data, np.zeros(20)), np.mean(data.z**2))


def test_nothing_detected():
    empty = DeviceResiduals(np.empty((0, 3)), np.empty(0), np.empty((0, 2)))
    assert not residual_correlation([empty.thinned()]).any()
    assert design_effect(empty.thinned(), np.zeros(20)) == 1.0
