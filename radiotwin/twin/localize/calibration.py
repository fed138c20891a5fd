"""How far positions are to be believed: known devices, located as if they were unknown.

Links of one device err alike, and what was learnt on other days is not all that holds today; so the
likelihood alone is too certain. Each device of the learning set is located from the links of a fold
by the model that has not seen them. First the likelihood is raised to a power with which 90 % radii
hold 90 % of these positions (Holmes and Walker 2017, 'Assigning a value to a power likelihood in a
general Bayesian model', Biometrika 104); then radii are scaled by the 90 % quantile of error over
radius (split conformal; Lei et al. 2018, 'Distribution-free predictive inference for regression',
JASA 113).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from radiotwin.effects.arrays import subsample
from radiotwin.links import Links
from radiotwin.twin.localize.estimate import TwinDevice
from radiotwin.twin.localize.without_map import (
    CREDIBLE,
    MIN_LINKS,
    Area,
    PositionPosterior,
    fit_elsewhere,
)
from radiotwin.twin.model.model import FittedModel

POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08)  # of the likelihood, that are tried
MAX_TRIALS, MAX_TRIALS_WITH_MAP = 100, 24  # positions; over a map each takes seconds
MAX_LINKS_WITH_MAP = 200  # of a trial
MIN_DEVICES = 50  # fewer do not tell the power apart from chance
PRIOR_TRIALS = 2  # that the radii of the likelihood are worth, where trials are few
MAX_Z = 6.0  # an outlier counts as this many scales


@dataclass(frozen=True)
class RadiusCalibration:
    """Corrections of radii, calibrated by locating devices of known position.

    Attributes:
        likelihood_power: to which likelihoods are raised for radii.
        radius_factor: by which radii are wider yet; at least 1.
        typical_misfit: median misfit of their links, see `misfit`; NaN where there was no trial.
    """

    likelihood_power: float = 1.0
    radius_factor: float = 1.0
    typical_misfit: float = np.nan


def calibrate_radii(models: list[FittedModel], held_out: list[Links], area_m: Area,
                    seed: int) -> RadiusCalibration:
    """Locate devices of known position, each from links that its model has not seen.

    Args:
        models: one a fold, each learnt without it.
        held_out: links of each fold, devices at their true positions; only anchors are tried that
            were heard there.
        area_m: as of `locate`.
        seed: of which devices are taken.
    """
    with_map = held_out[0].city is not None
    trials = [(model, links, device) for model, links in zip(models, held_out, strict=True)
              for device in _enough_links(links) if device in links.anchors]
    most = MAX_TRIALS_WITH_MAP if with_map else MAX_TRIALS
    found, truth_m, misfits = [], [], []
    for number in np.random.default_rng(seed).permutation(len(trials))[:most]:
        model, links, device = trials[number]
        rows = np.flatnonzero(links.device == device)
        own = links.select(subsample(rows, MAX_LINKS_WITH_MAP) if with_map else rows)
        found.append(PositionPosterior.of(model, own, area_m, POWERS[-1]))
        truth_m.append(links.device_m[device, :2])
        misfits.append(misfit(model, own, found[-1].estimate(1.0)))
    if not found:
        return RadiusCalibration()

    def ratios(power: float) -> np.ndarray:
        estimates = [each.estimate(power) for each in found]
        return np.array([np.hypot(each.x_m - x_m, each.y_m - y_m) / each.credible_radius_m
                         for each, (x_m, y_m) in zip(estimates, truth_m, strict=True)])

    power = 1.0
    if len(np.unique(np.concatenate([links.device for links in held_out]))) >= MIN_DEVICES:
        enough = [each for each in POWERS if (ratios(each) <= 1).mean() >= CREDIBLE]
        power = enough[0] if enough else POWERS[-1]
    return RadiusCalibration(power, radius_factor(ratios(power)), float(np.median(misfits)))


def _enough_links(links: Links) -> np.ndarray:
    """Return devices with links enough to be located, of which at least one was heard."""
    count, heard = (np.bincount(links.device[rows], minlength=len(links.device_names))
                    for rows in (slice(None), np.isfinite(links.level_db)))
    return np.flatnonzero((count >= MIN_LINKS) & (heard > 0))


def radius_factor(ratios: np.ndarray) -> float:
    """Return by how much 90 % radii have to be wider, at least 1.

    Args:
        ratios: (n,) error over 90 % radius of devices that were located.
    """
    rank = int(np.ceil(CREDIBLE * (len(ratios) + 1)))
    if rank <= len(ratios):
        return max(float(np.sort(ratios)[rank - 1]), 1.0)
    # Too few for a quantile: errors within a 90 % radius r of a normal distribution have the mean
    # square r² / ln 10.
    square = PRIOR_TRIALS + np.log(10) * (ratios**2).sum()
    return max(float(np.sqrt(square / (PRIOR_TRIALS + len(ratios)))), 1.0)


def misfit(model: FittedModel, own: Links, place: TwinDevice) -> float:
    """Return the mean square of residuals over their scale, of the links of a located device.

    The device's own level, as far as it may have one, counts as no misfit.
    """
    fit = fit_elsewhere(model, own, np.array([[place.x_m, place.y_m]]))
    problem = fit.model.regression()
    residual_db, scale_db = problem.residual_db(fit), problem.predict(fit).scale_db
    seen = np.isfinite(own.level_db)
    if model.device_sd_db > 0 and seen.any():
        precision = (1 / scale_db[seen]**2).sum() + 1 / model.device_sd_db**2
        residual_db = residual_db - (residual_db[seen] / scale_db[seen]**2).sum() / precision
    return float(np.mean(np.minimum(np.abs(residual_db / scale_db), MAX_Z)[seen]**2))
