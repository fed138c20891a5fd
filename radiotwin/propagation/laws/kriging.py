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
from scipy.spatial import cKDTree
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
SAME_PLACE_M = 1.0  # a receiver that stands still is within it
SAME_POINT_M = 0.1  # points within a cell this wide are one [m]
LOCAL_POINTS = 400  # nearest ones of a series that has too many, see `ResidualField`
LOCAL_ROWS = 200  # places at most that share them
LOCAL_SPREAD = 0.5  # how far apart these may be, relative to how far the points reach
COARSER = 1.5  # ratio of one width of cells to the next
BATCH = 2000  # points that are predicted at a time: bounds memory


_Solved = tuple[np.ndarray, np.ndarray]


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
    at most MAX_SERIES_TO_FIT series. Where points of a series are too many, neighbours become their
    mean; or, in a local field, each place is predicted by the LOCAL_POINTS nearest ones (moving
    neighbourhood: Chiles and Delfiner 2012, Geostatistics, section 3.6).

    Attributes:
        share: a, the same for all series.
        kind_share: b.
        length_m: correlation length [m].
        fields: the points of each series, by its index.
    """

    def __init__(self, max_pairs: float = MAX_PAIRS, is_local: bool = False) -> None:
        """Make an empty field.

        Args:
            max_pairs: points squared, over all series; of more, points are too many.
            is_local: whether these are all kept and the nearest ones count, or they are merged.
        """
        self.max_pairs, self.is_local = max_pairs, is_local
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
        """Return a field of the same correlation with other points, given as in `fit`."""
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        field = type(self)(self.max_pairs, self.is_local)
        field.share, field.kind_share, field.length_m = self.share, self.kind_share, self.length_m
        field._store(series, position_m, residual, kind)
        field._factor()
        return field

    def _store(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray,
               kind: np.ndarray) -> dict[int, np.ndarray]:
        """Store the points, given as in `fit`; return the rows of each series."""
        rows_of_series = _rows_by_series(series)
        limit = self._limit(len(rows_of_series))
        self.fields = {}
        for number, rows in rows_of_series.items():
            points = position_m[rows], residual[rows], kind[rows]
            field = _merged(*points, SAME_POINT_M)
            if len(field.residual) > limit and not self.is_local:
                field = _coarsened(*points, limit)
            self.fields[number] = field
        return rows_of_series

    def _limit(self, series: int) -> int:
        """Return how many points each of so many series may have."""
        return int(np.clip(np.sqrt(self.max_pairs / max(series, 1)), MIN_POINTS, MAX_POINTS))

    def predict(self, series: np.ndarray, position_m: np.ndarray,
                kind: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (n,) of the residual at points, given as in `fit`.

        Far from points that are stored, and in unknown series, they are 0 and 1. Memory does not
        grow with n.
        """
        mean, sd = np.zeros(len(series)), np.ones(len(series))
        for (factor, weights), rows, cross in self._crossing(series, position_m, kind):
            mean[rows] = weights @ cross
            whitened = solve_triangular(factor, cross, lower=True, overwrite_b=True)
            sd[rows] = np.sqrt(np.maximum(1.0 - np.square(whitened).sum(axis=0), 0.0))
        return mean, sd

    def mean(self, series: np.ndarray, position_m: np.ndarray,
             kind: np.ndarray | None = None) -> np.ndarray:
        """Return the mean that `predict` returns, of the same arguments, in less time."""
        mean = np.zeros(len(series))
        for (_, weights), rows, cross in self._crossing(series, position_m, kind):
            mean[rows] = weights @ cross
        return mean

    def _crossing(self, series: np.ndarray, position_m: np.ndarray, kind: np.ndarray | None,
                  ) -> Iterator[tuple[_Solved, np.ndarray, np.ndarray]]:
        """Give solved points, rows that they predict, and how both correlate; in batches."""
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        for number, own in _rows_by_series(series).items():
            if number not in self.fields:
                continue
            for field, solved, asked in self._solved_for(number, position_m, own):
                for start in range(0, len(asked), BATCH):
                    rows = asked[start : start + BATCH]
                    distance_m = cdist(field.position_m, position_m[rows])
                    yield solved, rows, self._correlation(distance_m, field.kind, kind[rows])

    def _solved_for(self, number: int, position_m: np.ndarray, rows: np.ndarray
                    ) -> Iterator[tuple[_Field, _Solved, np.ndarray]]:
        """Give points of a series, solved, and those of some rows that they predict."""
        field = self.fields[number]
        if number in self._solved or len(field.residual) <= LOCAL_POINTS:
            yield field, self._solved.get(number) or self._solve(field), rows
            return
        tree = cKDTree(field.position_m)
        waiting = [rows]
        while waiting:
            own = waiting.pop()
            low_m, high_m = position_m[own].min(axis=0), position_m[own].max(axis=0)
            reach_m, near = tree.query((low_m + high_m) / 2, LOCAL_POINTS)
            wide_m = np.linalg.norm(high_m - low_m) / 2
            if len(own) > 1 and wide_m > 0 and (
                    len(own) > LOCAL_ROWS or wide_m > LOCAL_SPREAD * reach_m[-1]):
                order = own[np.argsort(position_m[own, (high_m - low_m).argmax()], kind="stable")]
                waiting += [order[:len(own) // 2], order[len(own) // 2:]]
                continue
            part = _Field(field.position_m[near], field.residual[near], field.kind[near],
                          field.count[near])
            yield part, self._solve(part), own

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
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any],
                   is_local: bool = False) -> Self:
        """Return the field that `state` described; `is_local` as in `__init__`."""
        field = cls(is_local=is_local)
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
        points = [len(each.residual) for number, each in field.fields.items()
                  if not field._has_too_many(number)]
        FIELD_PAIRS.check(sum(count**2 for count in points), "the interpolated residual")
        field._factor()
        return field

    def _correlation(self, distance_m: np.ndarray, kind: np.ndarray,
                     other: np.ndarray) -> np.ndarray:
        correlation = distance_m / -self.length_m
        np.exp(correlation, out=correlation)
        correlation *= self.share
        if self.kind_share:
            return correlation + self.kind_share * (kind[:, None] == other[None])
        return correlation

    def _covariance(self, field: _Field, distance_m: np.ndarray) -> np.ndarray:
        covariance = self._correlation(distance_m, field.kind, field.kind)
        nugget = (1 - self.share - self.kind_share) / field.count
        covariance.ravel()[::len(covariance) + 1] += nugget + 1e-8  # keeps it positive definite
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
                # It is symmetric: transposed it needs no copy
                factor = cholesky(self._covariance(field, distance_m).T, lower=True,
                                  overwrite_a=True, check_finite=False)
                whitened = solve_triangular(factor, field.residual, lower=True, check_finite=False)
                value += 0.5 * whitened @ whitened + np.log(np.diag(factor)).sum()
            return value

        number = 2 + kinds
        bounds = [(-4.0, 6.0), (np.log(1.0), np.log(max(2.0, 2.0 * max_m))), (-6.0, 4.0)][:number]
        starts = [np.array([0.0, np.log(part * max_m), -1.0])[:number] for part in (0.02, 0.2)]
        start = min((np.clip(start, *np.transpose(bounds)) for start in starts), key=objective)
        simplex = np.vstack([start, start + np.diag([1.0, 0.7, 1.0])[:number, :number]])
        options = {"initial_simplex": simplex, "maxfev": 30 * number, "xatol": 0.05, "fatol": 0.1}
        assign(minimize(objective, start, method="Nelder-Mead", bounds=bounds, options=options).x)

    def _has_too_many(self, number: int) -> bool:
        """Return whether the nearest points of a series count."""
        most = self._limit(len(self.fields))
        return self.is_local and len(self.fields[number].residual) > most

    def _factor(self) -> None:
        """Solve every series whose points all count."""
        self._solved = {number: self._solve(field) for number, field in self.fields.items()
                        if not self._has_too_many(number)}

    def _solve(self, field: _Field) -> _Solved:
        """Return the Cholesky factor (p, p) of the covariance, and the weights (p,)."""
        covariance = self._covariance(field, cdist(field.position_m, field.position_m))
        factor = cholesky(covariance, lower=True, overwrite_a=True)
        return factor, cho_solve((factor, True), field.residual)


def _rows_by_series(series: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rows of each series, in order."""
    order = np.argsort(series, kind="stable")
    numbers, first = np.unique(series[order], return_index=True)
    return {int(number): order[start:start + count] for number, start, count in
            zip(numbers, first, np.diff([*first, len(order)]), strict=True)}


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


def _fixed_receivers_m(links: LinkGeometry) -> np.ndarray:
    """Return places (k, 3) of receivers that stand still while devices move [m]; else none."""
    cells, place = np.unique(np.round(links.receiver_m / SAME_PLACE_M), axis=0,
                             return_inverse=True)
    place = place.ravel()
    pairs = np.unique(np.column_stack([place, links.device]), axis=0)
    devices, places = np.bincount(pairs[:, 0]), np.bincount(pairs[:, 1])
    if np.median(devices[place]) <= np.median(places[links.device]):
        return np.zeros((0, 3))
    return cells[devices >= MIN_POINTS] * SAME_PLACE_M


class RegressionKriging(ChannelModel):
    """The law as trend, and for each device a Gaussian process over the receiver's position.

    The process is fitted to the residual in units of its class's standard deviation. Far from all
    measurements, and for a device without any, mean and standard deviation are the law's.

    A link that was not detected enters with its conditional mean below the limit: left out, the map
    would fill a shadow with the detected levels around it.

    A device is its index in `LinkGeometry.device`: use the same indices to fit and to predict.
    Where most links are of a place of receivers that heard more devices than there are places that
    heard their device, each of these places has a process over the device's position, and all
    other receivers have one together.
    """

    name = "regression_kriging"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.field = ResidualField(is_local=True)
        self.fixed_m = np.zeros((0, 3))  # receivers, where devices move

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        self.fixed_m = _fixed_receivers_m(links)
        self.field.fit(*self._residual(links, level_db, limit_db), seed)
        return self

    def refit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit) -> Self:
        """Return a model of the same correlation that is fitted to other links, see `fit`."""
        model = type(self)()
        model.fixed_m = self.fixed_m
        model.field = self.field.with_points(*model._residual(links, level_db, limit_db))
        return model

    def _residual(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the law; return series, positions and residual of the links that a fit can use."""
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        mean_db, sd_db = self.law.predict(links)
        return *self._ends(links), standardised(level_db, mean_db, sd_db, limit_db)

    def _ends(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return series (n,) and positions (n, 3) [m]; receivers elsewhere share a series."""
        if not len(self.fixed_m):
            return links.device, links.receiver_m
        away_m, nearest = cKDTree(self.fixed_m).query(links.receiver_m)
        return np.where(away_m <= SAME_PLACE_M, nearest, len(self.fixed_m)), links.device_m

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        mean_db, sd_db = self.law.predict(links)
        mean, sd = self.field.predict(*self._ends(links))
        return mean_db + sd_db * mean, sd_db * sd

    @property
    @override
    def trend(self) -> SegmentedLogDistance:
        return self.law

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, settings = self.law.state()
        field_arrays, field_settings = self.field.state()
        if len(self.fixed_m):
            arrays = arrays | {"fixed_m": self.fixed_m}
        return arrays | field_arrays, settings | field_settings

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        model = cls()
        law = {"lines": arrays["lines"]}
        model.law = SegmentedLogDistance.from_state(law, {"borrowed": settings["borrowed"]})
        if "fixed_m" in arrays:
            model.fixed_m = require_array(arrays, "fixed_m", (None, 3), -MAX_POSITION_M,
                                          MAX_POSITION_M)
        model.field = ResidualField.from_state(
            {name: array for name, array in arrays.items() if name not in (*law, "fixed_m")},
            {name: value for name, value in settings.items() if name != "borrowed"}, True)
        return model
