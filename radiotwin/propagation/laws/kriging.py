"""Regression kriging: segmented log-distance law plus the interpolated residual of each device.

The interpolation is a Gaussian process over positions, one field for each series of links.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Self

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

MIN_LENGTH_M = 1e-3  # shortest correlation length in a file
MAX_PAIRS = 36e6  # sum over series of squared number of points: matrices take 8 bytes a pair
MAX_POINTS, MIN_POINTS = 2500, 30  # bounds of the number of points to which a series is reduced
MAX_POINTS_TO_FIT, MAX_SERIES_TO_FIT = 300, 400  # for the correlation; at most MAX_PAIRS again
SAME_PLACE_M = 1.0  # a receiver that stays within it is fixed
SAME_POINT_M = 0.1  # width of the cells in which points are merged
LOCAL_POINTS = 400  # nearest points used in a series with too many, see `ResidualField`
LOCAL_ROWS = 200  # most predicted positions that share the same nearest points
LOCAL_SPREAD = 0.5  # largest radius of these positions over that of the nearest points
COARSER = 1.5  # growth of the cell width while points are merged
BATCH = 2000  # points predicted at a time: bounds memory


_Solved = tuple[np.ndarray, np.ndarray]
"""Cholesky factor (p, p) of the covariance, and kriging weights (p,)."""


class _Field(NamedTuple):
    """Residuals of one series at p points.

    Attributes:
        position_m: (p, 3) position [m].
        residual: (p,) mean residual in standard deviations of the law.
        kind: (p,) index of the kind of measurement, see `ResidualField`.
        count: (p,) number of measurements in the mean.
    """

    position_m: np.ndarray
    residual: np.ndarray
    kind: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides an unused method of tuples

    def select(self, rows: np.ndarray) -> _Field:
        """Return the points of given indices."""
        return _Field(*(values[rows] for values in self))


class ResidualField:
    """Interpolate residuals by a Gaussian process of unit variance for each series.

    A series is, for example, all receivers of one device. The covariance has three parts:
    a * exp(-r / length), the exponential model of shadowing (Gudmundson 1991, Electronics Letters
    27); b between measurements of one kind at any distance, such as those by one phone; and a
    nugget 1 - a - b. The parameters maximise the marginal likelihood of at most MAX_SERIES_TO_FIT
    series of at most MAX_POINTS_TO_FIT points. If a series has too many points, neighbours are
    merged; or, in a local field, each position is predicted from its LOCAL_POINTS nearest points
    (moving neighbourhood: Chiles and Delfiner 2012, Geostatistics, section 3.6).

    Attributes:
        share: a, the same for all series.
        kind_share: b, the same for all series.
        length_m: correlation length [m].
        fields: points of each series, by its index.
    """

    def __init__(self, max_pairs: float = MAX_PAIRS, is_local: bool = False) -> None:
        """Make an empty field of at most `max_pairs`, the sum of the series' squared sizes.

        `is_local`: beyond it, keep all points and use the nearest ones; False: merge points.
        """
        self.max_pairs, self.is_local = max_pairs, is_local
        self.share, self.kind_share, self.length_m = 0.5, 0.0, 50.0
        self.fields: dict[int, _Field] = {}

    def fit(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray, seed: int,
            kind: np.ndarray | None = None) -> Self:
        """Fit the correlation over distance, store the points, and return the field itself.

        Residuals (n,), of unit variance, are at positions (n, 3) [m]; `series` (n,) is the index of
        the field of each, `kind` (n,) the index of, e.g., the phone (None: all the same). `seed`
        draws the points to which the correlation is fitted.
        """
        rng = np.random.default_rng(seed)
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        rows_of_series = self._store(series, position_m, residual, kind)
        numbers = list(rows_of_series)
        if len(numbers) > MAX_SERIES_TO_FIT:
            numbers = np.sort(rng.choice(numbers, MAX_SERIES_TO_FIT, replace=False)).tolist()
        merged = (_merged(position_m[rows], residual[rows], kind[rows], SAME_POINT_M)
                  for rows in (rows_of_series[number] for number in numbers))
        samples = [_random_points(field, rng) for field in merged]
        self._fit_correlation(samples, len(np.unique(kind)) > 1)
        self._factor()
        return self

    def with_points(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray,
                    kind: np.ndarray | None = None) -> Self:
        """Return a field of the same correlation with other points; arguments as in `fit`."""
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        field = type(self)(self.max_pairs, self.is_local)
        field.share, field.kind_share, field.length_m = self.share, self.kind_share, self.length_m
        field._store(series, position_m, residual, kind)
        field._factor()
        return field

    def _store(self, series: np.ndarray, position_m: np.ndarray, residual: np.ndarray,
               kind: np.ndarray) -> dict[int, np.ndarray]:
        """Merge and store points, given as in `fit`, in `fields`; return the rows of each series.

        In a field that is not local, the cells grow until no series has too many points.
        """
        rows_of_series = _rows_by_series(series)
        max_points = self._max_points(len(rows_of_series))
        self.fields = {}
        for number, rows in rows_of_series.items():
            points = position_m[rows], residual[rows], kind[rows]
            field, width_m = _merged(*points, SAME_POINT_M), SAME_POINT_M
            extent_m = np.ptp(position_m[rows], axis=0).max()
            while len(field.residual) > max_points and width_m <= extent_m and not self.is_local:
                width_m *= COARSER
                field = _merged(*points, width_m)
            self.fields[number] = field
        return rows_of_series

    def _max_points(self, series_count: int) -> int:
        """Return the largest number of points of a series, given the number of series."""
        return int(np.clip(np.sqrt(self.max_pairs / max(series_count, 1)), MIN_POINTS, MAX_POINTS))

    def predict(self, series: np.ndarray, position_m: np.ndarray,
                kind: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return posterior mean and standard deviation (n,) of residuals of unit variance.

        They are 0 and 1 far from stored points, and in unknown series; arguments as in `fit`.
        """
        mean, sd = np.zeros(len(series)), np.ones(len(series))
        for (factor, weights), rows, cross in self._batches(series, position_m, kind):
            mean[rows] = weights @ cross
            whitened = solve_triangular(factor, cross, lower=True, overwrite_b=True)
            sd[rows] = np.sqrt(np.maximum(1.0 - np.square(whitened).sum(axis=0), 0.0))
        return mean, sd

    def mean(self, series: np.ndarray, position_m: np.ndarray,
             kind: np.ndarray | None = None) -> np.ndarray:
        """Return only the posterior mean (n,) of `predict`, which takes less time."""
        mean = np.zeros(len(series))
        for (_, weights), rows, cross in self._batches(series, position_m, kind):
            mean[rows] = weights @ cross
        return mean

    def _batches(self, series: np.ndarray, position_m: np.ndarray, kind: np.ndarray | None,
                 ) -> Iterator[tuple[_Solved, np.ndarray, np.ndarray]]:
        """Split points to predict, given as in `fit`, into batches; unknown series are left out.

        Yields the solution of p stored points, rows (b,) to predict, and the correlation (p, b).
        """
        kind = np.zeros(len(series), dtype=int) if kind is None else kind
        for number, series_rows in _rows_by_series(series).items():
            if number not in self.fields:
                continue
            for field, solved, near_rows in self._neighbourhoods(number, position_m, series_rows):
                for start in range(0, len(near_rows), BATCH):
                    rows = near_rows[start : start + BATCH]
                    distance_m = cdist(field.position_m, position_m[rows])
                    yield solved, rows, self._correlation(distance_m, field.kind, kind[rows])

    def _neighbourhoods(self, number: int, position_m: np.ndarray, rows: np.ndarray
                        ) -> Iterator[tuple[_Field, _Solved, np.ndarray]]:
        """Yield groups of rows to predict in a series, with the stored points that predict them.

        If there are too many points, groups of neighbouring rows use their nearest ones.
        """
        field = self.fields[number]
        if number in self._solved or len(field.residual) <= LOCAL_POINTS:
            yield field, self._solved.get(number) or self._solve(field), rows
            return
        tree = cKDTree(field.position_m)
        groups = [rows]
        while groups:
            group = groups.pop()
            least_m, greatest_m = position_m[group].min(axis=0), position_m[group].max(axis=0)
            distance_m, nearest_rows = tree.query((least_m + greatest_m) / 2, LOCAL_POINTS)
            radius_m = np.linalg.norm(greatest_m - least_m) / 2
            if len(group) > 1 and radius_m > 0 and (
                    len(group) > LOCAL_ROWS or radius_m > LOCAL_SPREAD * distance_m[-1]):
                longest = (greatest_m - least_m).argmax()
                order = group[np.argsort(position_m[group, longest], kind="stable")]
                groups += [order[:len(group) // 2], order[len(group) // 2:]]
                continue
            nearest = field.select(nearest_rows)
            yield nearest, self._solve(nearest), group

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return arrays by name, and settings that JSON can hold, for `from_state`."""
        arrays = {f"{name}/{number}": values for number, field in self.fields.items()
                  for name, values in field._asdict().items()}
        return arrays, {"devices": list(self.fields), "share": self.share,
                        "kind_share": self.kind_share, "length_m": self.length_m}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any],
                   is_local: bool = False) -> Self:
        """Restore a field from its `state`, after checking it; `is_local` as in `__init__`."""
        field = cls(is_local=is_local)
        require_names("settings", settings, ["devices", "share", "kind_share", "length_m"])
        numbers = settings["devices"]
        if not isinstance(numbers, list) or len(set(numbers)) < len(numbers) or any(
                type(number) is not int or number < 0 for number in numbers):
            raise ValueError("devices are not distinct whole numbers")
        require_names("arrays", arrays, [f"{name}/{number}" for number in numbers
                                         for name in _Field._fields])
        field.share = require_number(settings, "share", 0, 1)
        field.kind_share = require_number(settings, "kind_share", 0, 1 - field.share + 1e-9)
        field.length_m = require_number(settings, "length_m", MIN_LENGTH_M, MAX_POSITION_M)
        field.fields = {number: _stored(arrays, number) for number in numbers}
        pairs = sum(len(points.residual)**2 for number, points in field.fields.items()
                    if not field._has_too_many(number))
        FIELD_PAIRS.check(pairs, "the interpolated residual")
        field._factor()
        return field

    def _correlation(self, distance_m: np.ndarray, kind: np.ndarray,
                     other_kind: np.ndarray) -> np.ndarray:
        """Return the correlation (n, m) at distances (n, m) [m] of points of kinds (n,), (m,)."""
        correlation = distance_m / -self.length_m
        np.exp(correlation, out=correlation)
        correlation *= self.share
        if self.kind_share:
            return correlation + self.kind_share * (kind[:, None] == other_kind[None])
        return correlation

    def _covariance(self, field: _Field, distance_m: np.ndarray) -> np.ndarray:
        """Return the covariance (p, p) of stored points; means of several have less nugget."""
        covariance = self._correlation(distance_m, field.kind, field.kind)
        nugget = (1 - self.share - self.kind_share) / field.count
        covariance.ravel()[::len(covariance) + 1] += nugget + 1e-8  # keeps it positive definite
        return covariance

    def _fit_correlation(self, fields: list[_Field], has_kinds: bool) -> None:
        """Fit shares and length by marginal likelihood (Rasmussen and Williams 2006, eq. 5.8).

        They stay as they are if no series has points at two places.
        """
        distances_m = [cdist(field.position_m, field.position_m) for field in fields]
        max_m = max(float(distance_m.max()) for distance_m in distances_m)
        if max_m == 0.0:
            return

        def assign(theta: np.ndarray) -> None:
            """Set share, length and kind_share from log(a/nugget), log(length), log(b/nugget)."""
            position, kind = np.exp(theta[0]), np.exp(theta[2]) if has_kinds else 0.0
            total = 1.0 + position + kind
            self.share, self.kind_share = float(position / total), float(kind / total)
            self.length_m = float(np.exp(theta[1]))

        def objective(theta: np.ndarray) -> float:
            assign(theta)
            value = 0.0
            for field, distance_m in zip(fields, distances_m, strict=True):
                # Transposing the symmetric matrix spares LAPACK a copy.
                factor = cholesky(self._covariance(field, distance_m).T, lower=True,
                                  overwrite_a=True, check_finite=False)
                whitened = solve_triangular(factor, field.residual, lower=True, check_finite=False)
                value += 0.5 * whitened @ whitened + np.log(np.diag(factor)).sum()
            return value

        count = 2 + has_kinds
        bounds = [(-4.0, 6.0), (np.log(1.0), np.log(max(2.0, 2.0 * max_m))), (-6.0, 4.0)][:count]
        starts = [np.array([0.0, np.log(part * max_m), -1.0])[:count] for part in (0.02, 0.2)]
        start = min((np.clip(start, *np.transpose(bounds)) for start in starts), key=objective)
        simplex = np.vstack([start, start + np.diag([1.0, 0.7, 1.0])[:count, :count]])
        options = {"initial_simplex": simplex, "maxfev": 30 * count, "xatol": 0.05, "fatol": 0.1}
        assign(minimize(objective, start, method="Nelder-Mead", bounds=bounds, options=options).x)

    def _has_too_many(self, number: int) -> bool:
        """Return True if a series of a local field is predicted from its nearest points only."""
        max_points = self._max_points(len(self.fields))
        return self.is_local and len(self.fields[number].residual) > max_points

    def _factor(self) -> None:
        """Factor the covariance of every series without too many points."""
        self._solved = {number: self._solve(field) for number, field in self.fields.items()
                        if not self._has_too_many(number)}

    def _solve(self, field: _Field) -> _Solved:
        """Return the Cholesky factor (p, p) of the covariance, and the kriging weights (p,)."""
        covariance = self._covariance(field, cdist(field.position_m, field.position_m))
        factor = cholesky(covariance, lower=True, overwrite_a=True)
        return factor, cho_solve((factor, True), field.residual)


def _rows_by_series(series: np.ndarray) -> dict[int, np.ndarray]:
    """Return a dict from each series, such as a device, to its ascending rows."""
    order = np.argsort(series, kind="stable")
    numbers, first = np.unique(series[order], return_index=True)
    return {int(number): order[start:start + count] for number, start, count in
            zip(numbers, first, np.diff([*first, len(order)]), strict=True)}


def _stored(arrays: dict[str, np.ndarray], number: int) -> _Field:
    """Return the points of one series of a file after checking them."""
    residual = require_array(arrays, f"residual/{number}", (None,), -MAX_DB, MAX_DB)
    points, max_rows = len(residual), float(ROWS.limit)
    return _Field(
        require_array(arrays, f"position_m/{number}", (points, 3), -MAX_POSITION_M,
                      MAX_POSITION_M),
        residual, require_array(arrays, f"kind/{number}", (points,), 0, max_rows),
        require_array(arrays, f"count/{number}", (points,), 1, max_rows))


def _merged(position_m: np.ndarray, residual: np.ndarray, kind: np.ndarray,
            width_m: float) -> _Field:
    """Average measurements of one kind within cubic cells of a width [m]."""
    cells = np.column_stack([np.round(position_m / width_m), kind])
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    means = [np.bincount(cell, values) / count for values in (*position_m.T, residual, kind)]
    return _Field(np.column_stack(means[:3]), means[3], means[4].round().astype(int), count)


def _random_points(field: _Field, rng: np.random.Generator) -> _Field:
    """Draw at most MAX_POINTS_TO_FIT points at random."""
    if len(field.residual) <= MAX_POINTS_TO_FIT:
        return field
    return field.select(np.sort(rng.choice(len(field.residual), MAX_POINTS_TO_FIT, replace=False)))


def _fixed_receivers_m(links: LinkGeometry) -> np.ndarray:
    """Return positions (k, 3) of fixed receivers [m] if devices move; (0, 3) if receivers move.

    Devices move if, in the median, a link's receiver has links to more devices than its device to
    receiver positions. Receivers with links to fewer than MIN_POINTS devices are left out.
    """
    cells, place = np.unique(np.round(links.receiver_m / SAME_PLACE_M), axis=0,
                             return_inverse=True)
    place = place.ravel()
    pairs = np.unique(np.column_stack([place, links.device]), axis=0)
    devices, places = np.bincount(pairs[:, 0]), np.bincount(pairs[:, 1])
    if np.median(devices[place]) <= np.median(places[links.device]):
        return np.zeros((0, 3))
    return cells[devices >= MIN_POINTS] * SAME_PLACE_M


class RegressionKriging(ChannelModel):
    """Segmented log-distance law as trend, plus kriging of each device's residuals over receivers.

    Residuals are in standard deviations of their class, LoS or NLoS. Far from all measurements, and
    for a device without any, mean and standard deviation are the law's.

    A link that was not detected enters with its conditional mean below the limit of detection:
    without it, the levels detected around a radio shadow would fill it.

    A device is its index in `LinkGeometry.device`: use the same indices to fit and to predict.
    If receivers are fixed and devices move, each fixed receiver has a process over the device's
    position, and all other receivers share one.
    """

    name = "kriging"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.field = ResidualField(is_local=True)
        self.fixed_m = np.zeros((0, 3))  # fixed receivers, if devices move

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        self.fixed_m = _fixed_receivers_m(links)
        self.field.fit(*self._residual(links, level_db, limit_db), seed)
        return self

    def refit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit) -> Self:
        """Fit a new model to other links, keeping the correlation; arguments as in `fit`."""
        model = type(self)()
        model.fixed_m = self.fixed_m
        model.field = self.field.with_points(*model._residual(links, level_db, limit_db))
        return model

    def _residual(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the law; return series (m,), positions (m, 3) [m] and standardised residuals (m,)."""
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        mean_db, sd_db = self.law.predict(links)
        return *self._ends(links), standardised(level_db, mean_db, sd_db, limit_db)

    def _ends(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return series (n,) and positions (n, 3) [m] of links, where residuals are interpolated.

        Device and receiver position or, if devices move, fixed receiver and the device's position.
        """
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
        """Return arrays and settings of law and residual field together, for `from_state`."""
        arrays, settings = self.law.state()
        field_arrays, field_settings = self.field.state()
        if len(self.fixed_m):
            arrays = arrays | {"fixed_m": self.fixed_m}
        return arrays | field_arrays, settings | field_settings

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Restore law and residual field from their `state`, after checking them."""
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
