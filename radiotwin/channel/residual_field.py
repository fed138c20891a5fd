"""Interpolation of what a law leaves over: a Gaussian process over positions, one field for each series of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

MAX_POINTS = 1500
MAX_POINTS_TO_FIT = 300
SAME_POINT_M = 0.1
BATCH = 2000


@dataclass(frozen=True)
class _Field:
    """What one series left over: position_m (p, 3), residual (p,) in sigmas of the law."""

    position_m: np.ndarray
    residual: np.ndarray


class ResidualField:
    """A Gaussian process of unit variance for each series of points, such as the receivers' places for each device.

    Correlation a * exp(-r / length), the exponential model of shadowing (Gudmundson 1991, Electronics Letters 27), and
    a nugget 1 - a for noise and what changes between neighbouring points. `share` a and `length_m` are common to all
    series and have the highest marginal likelihood on at most MAX_POINTS_TO_FIT points of each.
    """

    def __init__(self) -> None:
        self.share, self.length_m = 0.5, 50.0
        self.fields: dict[int, _Field] = {}

    def fit(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray, seed: int) -> Self:
        """Learn from points.

        Args:
            series: (n,) index of the series that a point belongs to.
            position_m: (n, 3) [m].
            residual: (n,) of unit variance.
            seed: picks points where there are too many.
        """
        rng = np.random.default_rng(seed)
        self.fields = {}
        for number in np.unique(series):
            mask = series == number
            self.fields[int(number)] = _thinned(_merged(position_m[mask], residual[mask]), MAX_POINTS, rng)
        self._fit_correlation([_thinned(field, MAX_POINTS_TO_FIT, rng) for field in self.fields.values()])
        self._factor()
        return self

    def predict(self, series: np.ndarray, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n,) and standard deviation (n,) of the residual; 0 and 1 far from all points and in unknown series.

        In batches of BATCH points, so that maps of any size fit.
        """
        mean, sigma = np.zeros(len(series)), np.ones(len(series))
        for number, field in self.fields.items():
            factor, weights = self._solved[number]
            mine = np.flatnonzero(series == number)
            for start in range(0, len(mine), BATCH):
                rows = mine[start : start + BATCH]
                cross = self.share * np.exp(-cdist(field.position_m, position_m[rows]) / self.length_m)
                mean[rows] = weights @ cross
                explained = np.square(solve_triangular(factor, cross, lower=True, overwrite_b=True)).sum(axis=0)
                sigma[rows] = np.sqrt(np.maximum(1.0 - explained, 0.0))
        return mean, sigma

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays by name, and what JSON can hold: all that `from_state` needs."""
        arrays = {}
        for number, field in self.fields.items():
            arrays[f"position_m/{number}"] = field.position_m
            arrays[f"residual/{number}"] = field.residual
        return arrays, {"devices": list(self.fields), "share": self.share, "length_m": self.length_m}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """What `state` gave."""
        field = cls()
        field.share, field.length_m = settings["share"], settings["length_m"]
        field.fields = {number: _Field(arrays[f"position_m/{number}"], arrays[f"residual/{number}"])
                        for number in settings["devices"]}
        field._factor()
        return field

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
        """What predictions need of every series: Cholesky factor (p, p) and weights (p,)."""
        self._solved = {}
        for number, field in self.fields.items():
            covariance = _covariance(cdist(field.position_m, field.position_m), self.share, self.length_m)
            factor = cholesky(covariance, lower=True)
            self._solved[number] = factor, cho_solve((factor, True), field.residual)


def _covariance(distance_m: np.ndarray, share: float, length_m: float) -> np.ndarray:
    covariance = share * np.exp(-distance_m / length_m)
    np.fill_diagonal(covariance, 1.0 + 1e-8)
    return covariance


def _merged(position_m: np.ndarray, residual: np.ndarray) -> _Field:
    """Repeated visits of one point become their mean."""
    _, first, group, count = np.unique(np.round(position_m / SAME_POINT_M), axis=0, return_index=True,
                                       return_inverse=True, return_counts=True)
    return _Field(position_m[first], np.bincount(group.ravel(), residual) / count)


def _thinned(field: _Field, most: int, rng: np.random.Generator) -> _Field:
    if len(field.residual) <= most:
        return field
    rows = np.sort(rng.choice(len(field.residual), most, replace=False))
    return _Field(field.position_m[rows], field.residual[rows])
