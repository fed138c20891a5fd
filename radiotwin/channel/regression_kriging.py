"""Regression kriging: the segmented log-distance law plus an interpolation of what each device leaves over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr

from radiotwin.channel.base import ChannelModel, drop_uninformative
from radiotwin.channel.likelihood import HALF_LOG_2PI
from radiotwin.channel.links import Links
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance

MAX_POINTS = 1500
MAX_POINTS_TO_FIT = 300
SAME_POINT_M = 0.1
BATCH = 2000


@dataclass(frozen=True)
class _Field:
    """What one device left over: position_m (p, 3) of receivers, residual (p,) in sigmas of the law."""

    position_m: np.ndarray
    residual: np.ndarray


class RegressionKriging(ChannelModel):
    """Law as trend, and per device a Gaussian process over the receiver's position on the residual.

    The residual is in units of its class's sigma and has unit variance: correlation a * exp(-r / length), the
    exponential model of shadowing (Gudmundson 1991, Electronics Letters 27), and a nugget 1 - a for noise and what
    changes between neighbouring points. `share` a and `length_m` are common to all devices and have the highest
    marginal likelihood on at most MAX_POINTS_TO_FIT points of each. Far from all measurements, and for a device
    without any, mean and sigma are the law's.

    A link that was not detected enters with its conditional mean below the limit: left out, the map would fill a
    shadow with the detected levels around it.

    A device is its index in `Links.device`: use the same indices for fitting and predicting.
    """

    name = "regression_kriging"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.share, self.length_m = 0.5, 50.0
        self.fields: dict[int, _Field] = {}

    def fit(self, links: Links, level_db: np.ndarray, limit_db: float | None, seed: int = 0) -> Self:
        """Law first, then the process on its residual; see ChannelModel.fit. The seed picks points where there are
        too many."""
        links, level_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        mean_db, sigma_db = self.law.predict(links)
        residual = (level_db - mean_db) / sigma_db
        missing = np.isnan(residual)
        if missing.any():
            below = (limit_db - mean_db[missing]) / sigma_db[missing]
            residual[missing] = -np.exp(-0.5 * below**2 - HALF_LOG_2PI - log_ndtr(below))
        rng = np.random.default_rng(seed)
        self.fields = {}
        for device in np.unique(links.device):
            mask = links.device == device
            field = _merged(links.receiver_m[mask], residual[mask])
            self.fields[int(device)] = _thinned(field, MAX_POINTS, rng)
        self._fit_correlation([_thinned(field, MAX_POINTS_TO_FIT, rng) for field in self.fields.values()])
        self._factor()
        return self

    def _fit_correlation(self, fields: list[_Field]) -> None:
        """Share and length of highest marginal likelihood (Rasmussen and Williams 2006, equation 5.8)."""
        apart_m = [cdist(field.position_m, field.position_m) for field in fields]
        greatest_m = max(float(distance.max()) for distance in apart_m)
        if greatest_m == 0.0:
            return

        def objective(theta: np.ndarray) -> float:
            share, length_m = 1.0 / (1.0 + np.exp(-theta[0])), np.exp(theta[1])
            value = 0.0
            for field, distance in zip(fields, apart_m, strict=True):
                factor = cholesky(_covariance(distance, share, length_m), lower=True, overwrite_a=True)
                whitened = solve_triangular(factor, field.residual, lower=True)
                value += 0.5 * whitened @ whitened + np.log(np.diag(factor)).sum()
            return value

        bounds = [(-4.0, 6.0), (np.log(1.0), np.log(max(2.0, 2.0 * greatest_m)))]
        starts = [np.array([0.0, np.log(part * greatest_m)]) for part in (0.02, 0.2)]
        start = min((np.clip(start, *np.transpose(bounds)) for start in starts), key=objective)
        simplex = start + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.7]])
        options = {"initial_simplex": simplex, "maxfev": 60, "xatol": 0.05, "fatol": 0.1}
        theta = minimize(objective, start, method="Nelder-Mead", bounds=bounds, options=options).x
        self.share, self.length_m = float(1.0 / (1.0 + np.exp(-theta[0]))), float(np.exp(theta[1]))

    def _factor(self) -> None:
        """What predictions need of every device: Cholesky factor (p, p) and weights (p,)."""
        self._solved = {}
        for device, field in self.fields.items():
            covariance = _covariance(cdist(field.position_m, field.position_m), self.share, self.length_m)
            factor = cholesky(covariance, lower=True)
            self._solved[device] = factor, cho_solve((factor, True), field.residual)

    def predict(self, links: Links) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB], (n,) each; in batches of BATCH links, so that maps of any size fit."""
        mean_db, sigma_db = self.law.predict(links)
        for device, field in self.fields.items():
            factor, weights = self._solved[device]
            mine = np.flatnonzero(links.device == device)
            for start in range(0, len(mine), BATCH):
                rows = mine[start : start + BATCH]
                cross = self.share * np.exp(-cdist(field.position_m, links.receiver_m[rows]) / self.length_m)
                mean_db[rows] += sigma_db[rows] * (weights @ cross)
                explained = np.square(solve_triangular(factor, cross, lower=True, overwrite_b=True)).sum(
                    axis=0
                )
                sigma_db[rows] *= np.sqrt(np.maximum(1.0 - explained, 0.0))
        return mean_db, sigma_db

    @property
    def trend(self) -> SegmentedLogDistance:
        """The law, which is all that a device without measurements gets."""
        return self.law

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """See ChannelModel.state."""
        arrays, settings = self.law.state()
        for device, field in self.fields.items():
            arrays[f"position_m/{device}"] = field.position_m
            arrays[f"residual/{device}"] = field.residual
        own = {"devices": list(self.fields), "share": self.share, "length_m": self.length_m}
        return arrays, settings | own

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """See ChannelModel.from_state."""
        model = cls()
        model.law = SegmentedLogDistance.from_state(arrays, settings)
        model.share, model.length_m = settings["share"], settings["length_m"]
        model.fields = {
            device: _Field(arrays[f"position_m/{device}"], arrays[f"residual/{device}"])
            for device in settings["devices"]
        }
        model._factor()
        return model


def _covariance(distance_m: np.ndarray, share: float, length_m: float) -> np.ndarray:
    covariance = share * np.exp(-distance_m / length_m)
    np.fill_diagonal(covariance, 1.0 + 1e-8)
    return covariance


def _merged(position_m: np.ndarray, residual: np.ndarray) -> _Field:
    """Repeated visits of one point become their mean."""
    _, first, group, count = np.unique(
        np.round(position_m / SAME_POINT_M),
        axis=0,
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    return _Field(position_m[first], np.bincount(group.ravel(), residual) / count)


def _thinned(field: _Field, most: int, rng: np.random.Generator) -> _Field:
    if len(field.residual) <= most:
        return field
    rows = np.sort(rng.choice(len(field.residual), most, replace=False))
    return _Field(field.position_m[rows], field.residual[rows])
