"""Regression kriging: the segmented log-distance law plus each device's interpolated residual.

The interpolation is a Gaussian process over positions, one field for each series of links.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from typing_extensions import override

from radiotwin.inference.gaussian import Limit, standardised
from radiotwin.io.budgets import FIELD_PAIRS, ROWS
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.base import (
    MAX_DB,
    MAX_POSITION_M,
    ChannelModel,
    drop_uninformative,
    require_array,
    require_names,
    require_number,
)
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance

MIN_LENGTH_M = 1e-3  # of a correlation that is read
MAX_PAIRS = 36e6  # points squared, over all series: their matrices take 8 bytes a pair
MAX_POINTS, MIN_POINTS = 2500, 30  # range of the number of points that is kept of a longer series
MAX_POINTS_TO_FIT, MAX_SERIES_TO_FIT = 300, 400  # for the correlation; at most MAX_PAIRS again
SAME_POINT_M = 0.1  # points within a cell this wide are one [m]
COARSER = 1.5  # ratio of one width of cells to the next
BATCH = 2000  # points that are predicted at a time: bounds memory


@dataclass(frozen=True)
class _Field:
    """Residuals of one series at p points.

    Attributes:
        position_m: (p, 3) [m].
        residual: (p,) in standard deviations of the law, the mean of `count` measurements.
        kind: (p,) index of the kind that the measurements of a point belong to.
        count: (p,) measurements.
    """

    position_m: np.ndarray
    residual: np.ndarray
    kind: np.ndarray
    count: np.ndarray


class ResidualField:
    """A Gaussian process of unit variance for each series, such as the receivers of each device.

    Correlation a * exp(-r / length), the exponential model of shadowing (Gudmundson 1991,
    Electronics Letters 27), b between measurements of one kind, such as those by one phone,
    wherever they are, and a nugget 1 - a - b for noise and what changes between neighbours. The
    parameters have the highest marginal likelihood on at most MAX_POINTS_TO_FIT points of each of
    at most MAX_SERIES_TO_FIT series. Where points are too many, neighbours become their mean.

    Attributes:
        share: a, the same for all series.
        kind_share: b.
        length_m: correlation length [m].
        fields: the points of each series, by its index.
    """

    def __init__(self, max_pairs: float = MAX_PAIRS) -> None:
        """Make an empty field; of more points squared, over all series, neighbours are merged."""
        self.max_pairs = max_pairs
        self.share, self.kind_share, self.length_m = 0.5, 0.0, 50.0
        self.fields: dict[int, _Field] = {}

    def fit(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray, seed: int,
            kind: np.ndarray | None = None) -> Self:
        """Fit the correlation, store the points, and return the field itself.

        Args:
            series: (n,) index of the series that a point belongs to.
            position_m: (n, 3) [m].
            residual: (n,) of unit variance.
            seed: of the selection of points that the correlation is fitted to.
            kind: (n,) index of what has an error of its own in each series; None: nothing has.
        """
        rng = np.random.default_rng(seed)
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        rows_of_series = self._store(series, position_m, residual, kind)
        numbers = list(rows_of_series)
        if len(numbers) > MAX_SERIES_TO_FIT:
            numbers = np.sort(rng.choice(numbers, MAX_SERIES_TO_FIT, replace=False)).tolist()
        samples = [_sample(_merged(position_m[rows], residual[rows], kind[rows], SAME_POINT_M), rng)
                   for rows in (rows_of_series[number] for number in numbers)]
        self._fit_correlation(samples, len(np.unique(kind)) > 1)
        self._factor()
        return self

    def with_points(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray,
                    kind: np.ndarray | None = None) -> Self:
        """Return a field of the same correlation with other points, as of `fit`."""
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        field = type(self)(self.max_pairs)
        field.share, field.kind_share, field.length_m = self.share, self.kind_share, self.length_m
        field._store(series, position_m, residual, kind)
        field._factor()
        return field

    def _store(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray,
               kind: np.ndarray) -> dict[int, np.ndarray]:
        """Store the points, as of `fit`; return the rows of each series."""
        numbers = np.unique(series)
        limit = int(np.clip(np.sqrt(self.max_pairs / max(len(numbers), 1)), MIN_POINTS, MAX_POINTS))
        order = np.argsort(series, kind="stable")
        rows_of_series = dict(zip(map(int, numbers), np.split(
            order, np.searchsorted(series[order], numbers[1:])), strict=True))
        self.fields = {}
        for number, rows in rows_of_series.items():
            points = position_m[rows], residual[rows], kind[rows]
            field = _merged(*points, SAME_POINT_M)
            self.fields[number] = (
                field if len(field.residual) <= limit else _coarsened(*points, limit))
        return rows_of_series

    def predict(self, series: np.ndarray, position_m: np.ndarray,
                kind: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (n,) of the residual at points, as of `fit`.

        Far from points that are stored, and in unknown series, they are 0 and 1. Memory does not
        grow with n.
        """
        mean, sd = np.zeros(len(series)), np.ones(len(series))
        for number, rows, cross in self._crossing(series, position_m, kind):
            factor, weights = self._solved[number]
            mean[rows] = weights @ cross
            whitened = solve_triangular(factor, cross, lower=True, overwrite_b=True)
            sd[rows] = np.sqrt(np.maximum(1.0 - np.square(whitened).sum(axis=0), 0.0))
        return mean, sd

    def mean(self, series: np.ndarray, position_m: np.ndarray,
             kind: np.ndarray | None = None) -> np.ndarray:
        """Return the mean that `predict` returns, of the same arguments, in less time."""
        mean = np.zeros(len(series))
        for number, rows, cross in self._crossing(series, position_m, kind):
            mean[rows] = self._solved[number][1] @ cross
        return mean

    def _crossing(self, series: np.ndarray, position_m: np.ndarray, kind: np.ndarray | None,
                  ) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Give a series, some rows of it, and how its points correlate with them; in batches."""
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        for number, field in self.fields.items():
            mine = np.flatnonzero(series == number)
            for start in range(0, len(mine), BATCH):
                rows = mine[start : start + BATCH]
                yield number, rows, self._correlation(cdist(field.position_m, position_m[rows]),
                                                      field.kind, kind[rows])

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return arrays by name, and settings that JSON can hold, for `from_state`."""
        arrays = {}
        for number, field in self.fields.items():
            arrays[f"position_m/{number}"] = field.position_m
            arrays[f"residual/{number}"] = field.residual
            arrays[f"kind/{number}"] = field.kind
            arrays[f"count/{number}"] = field.count
        return arrays, {"devices": list(self.fields), "share": self.share,
                        "kind_share": self.kind_share, "length_m": self.length_m}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Return the field that `state` described."""
        field = cls()
        require_names("settings", settings, ["devices", "share", "kind_share", "length_m"])
        numbers = settings["devices"]
        if not isinstance(numbers, list) or len(set(numbers)) < len(numbers) or any(
                type(number) is not int or number < 0 for number in numbers):
            raise ValueError("devices are not different whole numbers")
        require_names("arrays", arrays, [f"{name}/{number}" for number in numbers
                                         for name in ("position_m", "residual", "kind", "count")])
        field.share = require_number(settings, "share", 0, 1)
        field.kind_share = require_number(settings, "kind_share", 0, 1 - field.share + 1e-9)
        field.length_m = require_number(settings, "length_m", MIN_LENGTH_M, MAX_POSITION_M)
        field.fields = {number: _stored(arrays, number) for number in numbers}
        points = [len(each.residual) for each in field.fields.values()]
        FIELD_PAIRS.check(sum(count**2 for count in points), "the interpolated residual")
        field._factor()
        return field

    def _correlation(self, distance_m: np.ndarray, kind: np.ndarray,
                     other: np.ndarray) -> np.ndarray:
        correlation = self.share * np.exp(-distance_m / self.length_m)
        if self.kind_share:
            return correlation + self.kind_share * (kind[:, None] == other[None])
        return correlation

    def _covariance(self, field: _Field, distance_m: np.ndarray) -> np.ndarray:
        covariance = self._correlation(distance_m, field.kind, field.kind)
        nugget = (1 - self.share - self.kind_share) / field.count
        covariance[np.diag_indices(len(covariance))] += nugget + 1e-8  # keeps it positive definite
        return covariance

    def _fit_correlation(self, fields: list[_Field], kinds: bool) -> None:
        """Maximise the marginal likelihood of the points (Rasmussen and Williams 2006, eq. 5.8)."""
        distances_m = [cdist(field.position_m, field.position_m) for field in fields]
        max_m = max(float(distance_m.max()) for distance_m in distances_m)
        if max_m == 0.0:
            return

        def assign(theta: np.ndarray) -> None:
            """Set the parameters: variances over the nugget's and the length, as logarithms."""
            of_position, of_kind = np.exp(theta[0]), np.exp(theta[2]) if kinds else 0.0
            total = 1.0 + of_position + of_kind
            self.share, self.kind_share = float(of_position / total), float(of_kind / total)
            self.length_m = float(np.exp(theta[1]))

        def objective(theta: np.ndarray) -> float:
            assign(theta)
            value = 0.0
            for field, distance_m in zip(fields, distances_m, strict=True):
                factor = cholesky(self._covariance(field, distance_m), lower=True, overwrite_a=True)
                whitened = solve_triangular(factor, field.residual, lower=True)
                value += 0.5 * whitened @ whitened + np.log(np.diag(factor)).sum()
            return value

        number = 2 + kinds
        bounds = [(-4.0, 6.0), (np.log(1.0), np.log(max(2.0, 2.0 * max_m))), (-6.0, 4.0)][:number]
        starts = [np.array([0.0, np.log(part * max_m), -1.0])[:number] for part in (0.02, 0.2)]
        start = min((np.clip(start, *np.transpose(bounds)) for start in starts), key=objective)
        simplex = np.vstack([start, start + np.diag([1.0, 0.7, 1.0])[:number, :number]])
        options = {"initial_simplex": simplex, "maxfev": 30 * number, "xatol": 0.05, "fatol": 0.1}
        assign(minimize(objective, start, method="Nelder-Mead", bounds=bounds, options=options).x)

    def _factor(self) -> None:
        """Compute the Cholesky factor (p, p) and the weights (p,) of every series."""
        self._solved = {}
        for number, field in self.fields.items():
            distance_m = cdist(field.position_m, field.position_m)
            factor = cholesky(self._covariance(field, distance_m), lower=True)
            self._solved[number] = factor, cho_solve((factor, True), field.residual)


def _stored(arrays: dict[str, np.ndarray], number: int) -> _Field:
    """Return the points of one series of a file after a check."""
    residual = require_array(arrays, f"residual/{number}", (None,), -MAX_DB, MAX_DB)
    points, most = len(residual), float(ROWS.limit)
    return _Field(
        require_array(arrays, f"position_m/{number}", (points, 3), -MAX_POSITION_M,
                      MAX_POSITION_M),
        residual, require_array(arrays, f"kind/{number}", (points,), 0, most),
        require_array(arrays, f"count/{number}", (points,), 1, most))


def _merged(position_m: np.ndarray, residual: np.ndarray, kind: np.ndarray,
            width_m: float) -> _Field:
    """Return the mean of the measurements of one kind in each cell of a width [m]."""
    cells = np.column_stack([np.round(position_m / width_m), kind])
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    means = [np.bincount(cell, values) / count for values in (*position_m.T, residual, kind)]
    return _Field(np.column_stack(means[:3]), means[3], means[4].round().astype(int), count)


def _coarsened(position_m: np.ndarray, residual: np.ndarray, kind: np.ndarray,
               limit: int) -> _Field:
    """Merge measurements in cells just wide enough that at most `limit` points are left."""
    width_m = SAME_POINT_M
    while True:
        width_m *= COARSER
        field = _merged(position_m, residual, kind, width_m)
        if len(field.residual) <= limit or width_m > np.ptp(position_m, axis=0).max():
            return field


def _sample(field: _Field, rng: np.random.Generator) -> _Field:
    if len(field.residual) <= MAX_POINTS_TO_FIT:
        return field
    rows = np.sort(rng.choice(len(field.residual), MAX_POINTS_TO_FIT, replace=False))
    return _Field(field.position_m[rows], field.residual[rows], field.kind[rows], field.count[rows])


class RegressionKriging(ChannelModel):
    """The law as trend, and for each device a Gaussian process over the receiver's position.

    The process is fitted to the residual in units of its class's standard deviation. Far from all
    measurements, and for a device without any, mean and standard deviation are the law's.

    A link that was not detected enters with its conditional mean below the limit: left out, the map
    would fill a shadow with the detected levels around it.

    A device is its index in `LinkGeometry.device`: use the same indices to fit and to predict.
    """

    name = "regression_kriging"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.field = ResidualField()

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        self.field.fit(*self._residual(links, level_db, limit_db), seed)
        return self

    def refit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit) -> Self:
        """Return a model of the same correlation that is fitted to other links, as of `fit`."""
        model = type(self)()
        model.field = self.field.with_points(*model._residual(links, level_db, limit_db))
        return model

    def _residual(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the law; return series, positions and residual of the links that a fit can use."""
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        mean_db, sd_db = self.law.predict(links)
        return links.device, links.receiver_m, standardised(level_db, mean_db, sd_db, limit_db)

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        mean_db, sd_db = self.law.predict(links)
        mean, sd = self.field.predict(links.device, links.receiver_m)
        return mean_db + sd_db * mean, sd_db * sd

    @property
    @override
    def trend(self) -> SegmentedLogDistance:
        return self.law

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, settings = self.law.state()
        field_arrays, field_settings = self.field.state()
        return arrays | field_arrays, settings | field_settings

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        model = cls()
        law = {"lines": arrays["lines"]}
        model.law = SegmentedLogDistance.from_state(law, {"borrowed": settings["borrowed"]})
        model.field = ResidualField.from_state(
            {name: array for name, array in arrays.items() if name not in law},
            {name: value for name, value in settings.items() if name != "borrowed"})
        return model
