"""Calibrate the radii of located devices by locating known devices as if they were unknown.

Errors of a device's links are correlated, and the channel changes between days, so the likelihood
alone is overconfident. Each known device is located from the links of a fold, by the model fitted
without that fold. First the likelihood is raised to a power with which 90 % radii hold 90 % of
these positions (Holmes and Walker 2017, 'Assigning a value to a power likelihood in a general
Bayesian model', Biometrika 104). Then radii are scaled by the 90 % quantile of error over radius
(split conformal; Lei et al. 2018, 'Distribution-free predictive inference for regression',
JASA 113).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from radiotwin.effects.arrays import subsample
from radiotwin.links import Links
from radiotwin.twin.localize.estimate import CREDIBLE, TwinDevice
from radiotwin.twin.localize.without_map import (
    MIN_LINKS,
    Area,
    PositionPosterior,
    fit_elsewhere,
)
from radiotwin.twin.model.correlated_shadowing import MAX_Z
from radiotwin.twin.model.model import FittedModel

POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08)  # tried powers of the likelihood
MAX_TRIALS, MAX_TRIALS_WITH_MAP = 100, 24  # devices located; with a map each takes seconds
MAX_LINKS_WITH_MAP = 200  # links of a device that is located with a map
MIN_DEVICES = 50  # devices needed to fit the power
PRIOR_TRIALS = 2  # weight of the likelihood's radii, in trials, if trials are few


@dataclass(frozen=True)
class RadiusCalibration:
    """Corrections of radii, calibrated by locating devices of known position.

    Attributes:
        likelihood_power: power to which likelihoods are raised for radii.
        radius_factor: factor on the radii after that, at least 1.
        typical_misfit: median `misfit` of the located devices; NaN without a trial.
    """

    likelihood_power: float = 1.0
    radius_factor: float = 1.0
    typical_misfit: float = np.nan


def calibrate_radii(models: list[FittedModel], held_out: list[Links], area_m: Area,
                    seed: int) -> RadiusCalibration:
    """Calibrate 90 % radii by locating anchors from held-out links as if they were unknown.

    There is a model for each fold, fitted to the other folds, and the fold's links. The power is 1
    with fewer than `MIN_DEVICES` devices; of many anchors, some are drawn.
    """
    with_map = held_out[0].city is not None
    trials = [(model, links, device) for model, links in zip(models, held_out, strict=True)
              for device in _enough_links(links) if device in links.anchors]
    max_trials = MAX_TRIALS_WITH_MAP if with_map else MAX_TRIALS
    found, truth_m, misfits = [], [], []
    for number in np.random.default_rng(seed).permutation(len(trials))[:max_trials]:
        model, links, device = trials[number]
        rows = np.flatnonzero(links.device == device)
        device_links = links.select(subsample(rows, MAX_LINKS_WITH_MAP) if with_map else rows)
        found.append(PositionPosterior.of(model, device_links, area_m, POWERS[-1]))
        truth_m.append(links.device_m[device, :2])
        misfits.append(misfit(model, device_links, found[-1].estimate(1.0)))
    if not found:
        return RadiusCalibration()

    def ratios(power: float) -> np.ndarray:
        """Return position error over radius of the located anchors."""
        estimates = [posterior.estimate(power) for posterior in found]
        return np.array([np.hypot(device.x_m - x_m, device.y_m - y_m) / device.credible_radius_m
                         for device, (x_m, y_m) in zip(estimates, truth_m, strict=True)])

    power = 1.0
    if len(np.unique(np.concatenate([links.device for links in held_out]))) >= MIN_DEVICES:
        power = next((tried for tried in POWERS if (ratios(tried) <= 1).mean() >= CREDIBLE),
                     POWERS[-1])
    return RadiusCalibration(power, radius_factor(ratios(power)), float(np.median(misfits)))


def _enough_links(links: Links) -> np.ndarray:
    """Return the devices with MIN_LINKS links, of which at least one was detected."""
    count, detected = (np.bincount(links.device[rows], minlength=len(links.device_names))
                       for rows in (slice(None), np.isfinite(links.level_db)))
    return np.flatnonzero((count >= MIN_LINKS) & (detected > 0))


def radius_factor(ratios: np.ndarray) -> float:
    """Return the factor, at least 1, by which 90 % radii must grow to hold 90 % of the devices.

    Ratios (n,) are position error over 90 % radius.
    """
    rank = int(np.ceil(CREDIBLE * (len(ratios) + 1)))
    if rank <= len(ratios):
        return max(float(np.sort(ratios)[rank - 1]), 1.0)
    # Too few for a quantile. A normal distribution with 90 % radius r has the mean square error
    # r² / ln 10.
    square = PRIOR_TRIALS + np.log(10) * (ratios**2).sum()
    return max(float(np.sqrt(square / (PRIOR_TRIALS + len(ratios)))), 1.0)


def misfit(model: FittedModel, device_links: Links, device: TwinDevice) -> float:
    """Return the mean square of a device's residuals in error scales, clipped; NaN: none detected.

    The device's own level is first estimated and subtracted, with shrinkage.
    """
    fit = fit_elsewhere(model, device_links, np.array([[device.x_m, device.y_m]]))
    problem = fit.model.regression()
    residual_db, scale_db = problem.residual_db(fit), problem.predict(fit).scale_db
    seen = np.isfinite(device_links.level_db)
    if model.device_sd_db > 0 and seen.any():
        precision = (1 / scale_db[seen]**2).sum() + 1 / model.device_sd_db**2
        residual_db = residual_db - (residual_db[seen] / scale_db[seen]**2).sum() / precision
    return float(np.mean(np.minimum(np.abs(residual_db / scale_db), MAX_Z)[seen]**2))
