"""Interpolation of what a law leaves over: a Gaussian process over positions, one field for each series of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

MAX_POINTS, MIN_POINTS = 2500, 30  # of a series, where there are more
MAX_PAIRS = 36e6  # of all series: their matrices take 8 bytes a pair
MAX_POINTS_TO_FIT, MAX_SERIES_TO_FIT = 300, 400  # MAX_PAIRS again
SAME_POINT_M = 0.1
COARSER = 1.5  # times, from one width of cells to the next
BATCH = 2000


@dataclass(frozen=True)
class _Field:
    """What one series left over at p points.

    Attributes:
        position_m: (p, 3).
        residual: (p,) in sigmas of the law, the mean of `count` measurements.
        kind: (p,) what the measurements of a point have in common.
        count: (p,).
    """

    position_m: np.ndarray
    residual: np.ndarray
    kind: np.ndarray
    count: np.ndarray


class ResidualField:
    """A Gaussian process of unit variance for each series of points, such as the receivers' places for each device.

    Correlation a * exp(-r / length), the exponential model of shadowing (Gudmundson 1991, Electronics Letters 27), b
    between measurements of one kind, such as those by one phone, wherever they are, and a nugget 1 - a - b for noise
    and what changes between neighbouring points. `share` a, `kind_share` b and `length_m` are common to all series and
    have the highest marginal likelihood on at most MAX_POINTS_TO_FIT points of each of at most MAX_SERIES_TO_FIT. Where
    points are too many, neighbours become their mean.
    """

    def __init__(self) -> None:
        self.share, self.kind_share, self.length_m = 0.5, 0.0, 50.0
        self.fields: dict[int, _Field] = {}

    def fit(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray, seed: int,
            kind: np.ndarray | None = None) -> Self:
        """Learn from points.

        Args:
            series: (n,) index of the series that a point belongs to.
            position_m: (n, 3) [m].
            residual: (n,) of unit variance.
            seed: picks the points that share and length are fitted to.
            kind: (n,) index of what has an error of its own in each series; None: nothing has.
        """
        rng = np.random.default_rng(seed)
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        numbers = np.unique(series)
        most = int(np.clip(np.sqrt(MAX_PAIRS / max(len(numbers), 1)), MIN_POINTS, MAX_POINTS))
        fitted = numbers
        if len(numbers) > MAX_SERIES_TO_FIT:
            fitted = np.sort(rng.choice(numbers, MAX_SERIES_TO_FIT, replace=False))
        order = np.argsort(series, kind="stable")
        self.fields, some = {}, []
        for number, mask in zip(numbers, np.split(order, np.searchsorted(series[order], numbers[1:])), strict=True):
            points = position_m[mask], residual[mask], kind[mask]
            every = _merged(*points, SAME_POINT_M)
            if number in fitted:
                some.append(_some(every, rng))
            self.fields[int(number)] = every if len(every.residual) <= most else _coarsened(*points, most)
        self._fit_correlation(some, len(np.unique(kind)) > 1)
        self._factor()
        return self

    def predict(self, series: np.ndarray, position_m: np.ndarray,
                kind: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n,) and standard deviation (n,) of the residual; 0 and 1 far from all points and in unknown series.

        In batches of BATCH points, so that maps of any size fit.
        """
        mean, sigma = np.zeros(len(series)), np.ones(len(series))
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        for number, field in self.fields.items():
            factor, weights = self._solved[number]
            mine = np.flatnonzero(series == number)
            for start in range(0, len(mine), BATCH):
                rows = mine[start : start + BATCH]
                cross = self._correlation(cdist(field.position_m, position_m[rows]), field.kind, kind[rows])
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
            arrays[f"kind/{number}"] = field.kind
            arrays[f"count/{number}"] = field.count
        return arrays, {"devices": list(self.fields), "share": self.share, "kind_share": self.kind_share,
                        "length_m": self.length_m}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """What `state` gave."""
        field = cls()
        field.share, field.kind_share = settings["share"], settings["kind_share"]
        field.length_m = settings["length_m"]
        field.fields = {number: _Field(*(arrays[f"{name}/{number}"] for name in
                                         ("position_m", "residual", "kind", "count")))
                        for number in settings["devices"]}
        field._factor()
        return field

    def _correlation(self, distance_m: np.ndarray, kind: np.ndarray, other: np.ndarray) -> np.ndarray:
        correlation = self.share * np.exp(-distance_m / self.length_m)
        return correlation + self.kind_share * (kind[:, None] == other[None]) if self.kind_share else correlation

    def _covariance(self, field: _Field, distance_m: np.ndarray) -> np.ndarray:
        covariance = self._correlation(distance_m, field.kind, field.kind)
        covariance[np.diag_indices(len(covariance))] += (1 - self.share - self.kind_share) / field.count + 1e-8
        return covariance

    def _fit_correlation(self, fields: list[_Field], kinds: bool) -> None:
        """Shares and length of highest marginal likelihood (Rasmussen and Williams 2006, equation 5.8)."""
        apart_m = [cdist(field.position_m, field.position_m) for field in fields]
        greatest_m = max(float(distance.max()) for distance in apart_m)
        if greatest_m == 0.0:
            return

        def take(theta: np.ndarray) -> None:
            of_place, of_kind = np.exp(theta[0]), np.exp(theta[2]) if kinds else 0.0
            total = 1.0 + of_place + of_kind
            self.share, self.kind_share = float(of_place / total), float(of_kind / total)
            self.length_m = float(np.exp(theta[1]))

        def objective(theta: np.ndarray) -> float:
            take(theta)
            value = 0.0
            for field, distance in zip(fields, apart_m, strict=True):
                factor = cholesky(self._covariance(field, distance), lower=True, overwrite_a=True)
                whitened = solve_triangular(factor, field.residual, lower=True)
                value += 0.5 * whitened @ whitened + np.log(np.diag(factor)).sum()
            return value

        number = 2 + kinds
        bounds = [(-4.0, 6.0), (np.log(1.0), np.log(max(2.0, 2.0 * greatest_m))), (-6.0, 4.0)][:number]
        starts = [np.array([0.0, np.log(part * greatest_m), -1.0])[:number] for part in (0.02, 0.2)]
        start = min((np.clip(start, *np.transpose(bounds)) for start in starts), key=objective)
        simplex = np.vstack([start, start + np.diag([1.0, 0.7, 1.0])[:number, :number]])
        options = {"initial_simplex": simplex, "maxfev": 30 * number, "xatol": 0.05, "fatol": 0.1}
        take(minimize(objective, start, method="Nelder-Mead", bounds=bounds, options=options).x)

    def _factor(self) -> None:
        """What predictions need of every series: Cholesky factor (p, p) and weights (p,)."""
        self._solved = {}
        for number, field in self.fields.items():
            factor = cholesky(self._covariance(field, cdist(field.position_m, field.position_m)), lower=True)
            self._solved[number] = factor, cho_solve((factor, True), field.residual)


def _merged(position_m: np.ndarray, residual: np.ndarray, kind: np.ndarray, width_m: float) -> _Field:
    """Visits of one cell become their mean."""
    cells = np.column_stack([np.round(position_m / width_m), kind])
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    means = [np.bincount(cell, values) / count for values in (*position_m.T, residual, kind)]
    return _Field(np.column_stack(means[:3]), means[3], means[4].round().astype(int), count)


def _coarsened(position_m: np.ndarray, residual: np.ndarray, kind: np.ndarray, most: int) -> _Field:
    """The same in cells just wide enough for so many points."""
    width_m = SAME_POINT_M
    while True:
        width_m *= COARSER
        field = _merged(position_m, residual, kind, width_m)
        if len(field.residual) <= most or width_m > np.ptp(position_m, axis=0).max():
            return field


def _some(field: _Field, rng: np.random.Generator) -> _Field:
    if len(field.residual) <= MAX_POINTS_TO_FIT:
        return field
    rows = np.sort(rng.choice(len(field.residual), MAX_POINTS_TO_FIT, replace=False))
    return _Field(field.position_m[rows], field.residual[rows], field.kind[rows], field.count[rows])
