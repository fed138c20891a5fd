"""The censored likelihood against scipy.stats, and far in its tails."""

import numpy as np
import pytest
import torch
from scipy.stats import norm, truncnorm

from radiotwin.inference.gaussian import (
    gaussian_nll,
    gaussian_nll_torch,
    mean_if_detected,
    standardised,
)


def test_equals_density_of_the_seen_and_probability_of_the_rest():
    level_db = np.array([-80.0, np.nan, -101.0])
    mean_db, sigma_db = np.array([-83.0, -108.0, -99.0]), np.array([2.0, 4.0, 3.0])
    expected = [-norm.logpdf(-80, -83, 2), -norm.logcdf(-110, -108, 4), -norm.logpdf(-101, -99, 3)]
    assert gaussian_nll(level_db, mean_db, sigma_db, -110.0) == pytest.approx(expected, rel=1e-12)
    assert gaussian_nll(level_db, mean_db, sigma_db, None)[1] == 0.0, "a blank without a limit"


@pytest.mark.parametrize("mean_db", [-20.0, 300.0])
def test_stays_finite_far_above_the_limit(mean_db):
    # -log Phi(-z) ~ z^2 / 2 + log(z sqrt(2 pi)) for large z
    z = (mean_db + 120.0) / 1.0
    value = gaussian_nll(np.array([np.nan]), np.array([mean_db]), 1.0, -120.0)[0]
    assert value == pytest.approx(0.5 * z**2 + np.log(z * np.sqrt(2 * np.pi)), rel=1e-4)


@pytest.mark.parametrize("mean_db", [-90.0, -118.0, -120.0, -135.0, -300.0])
def test_means_above_and_below_the_limit_are_those_of_the_truncated_normal(mean_db):
    limit = (-120.0 - mean_db) / 6.0
    expected = truncnorm.mean(limit, np.inf, loc=mean_db, scale=6.0)
    assert mean_if_detected(np.array([mean_db]), 6.0, -120.0)[0] == pytest.approx(expected, abs=1e-6)
    found = standardised(np.array([np.nan, -100.0]), np.full(2, mean_db), np.full(2, 6.0), -120.0)
    assert found == pytest.approx([truncnorm.mean(-np.inf, limit), (-100.0 - mean_db) / 6.0], abs=1e-6)


def test_torch_agrees_and_its_gradients_are_finite_differences():
    rng = np.random.default_rng(0)
    mean_db, sigma_db = rng.uniform(-130, -60, 200), rng.uniform(0.5, 8, 200)
    level_db = mean_db + sigma_db * rng.standard_normal(200)
    level_db[::3] = np.nan
    censored = np.isnan(level_db)

    mean, log_sigma = (torch.tensor(v, requires_grad=True) for v in (mean_db, np.log(sigma_db)))
    nll = gaussian_nll_torch(
        torch.tensor(np.where(censored, -110.0, level_db)), mean, log_sigma, torch.tensor(censored)
    )
    assert nll.detach().numpy() == pytest.approx(gaussian_nll(level_db, mean_db, sigma_db, -110.0), rel=1e-9)

    nll.sum().backward()
    step = 1e-6
    for tensor, up, down in (
        (mean, (mean_db + step, sigma_db), (mean_db - step, sigma_db)),
        (log_sigma, (mean_db, sigma_db * np.exp(step)), (mean_db, sigma_db * np.exp(-step))),
    ):
        slope = (gaussian_nll(level_db, *up, -110.0) - gaussian_nll(level_db, *down, -110.0)) / (2 * step)
        assert tensor.grad.numpy() == pytest.approx(slope, rel=1e-4, abs=1e-4)


def test_torch_gradients_survive_extremes_in_single_precision():
    mean = torch.tensor([500.0, -900.0, 500.0], requires_grad=True)
    log_sigma = torch.zeros(3, requires_grad=True)
    nll = gaussian_nll_torch(torch.full((3,), -120.0), mean, log_sigma, torch.tensor([True, True, False]))
    nll.sum().backward()
    assert torch.isfinite(nll).all()
    assert torch.isfinite(mean.grad).all()
    assert torch.isfinite(log_sigma.grad).all()
