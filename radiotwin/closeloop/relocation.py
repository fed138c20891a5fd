"""Unknown devices where the paths over the map put them, looked for around where a law of distance does.

A law with two classes of links takes one just behind an edge, a few decibels below line of sight, for one with it, and
moves a device in a narrow street to where it would have line of sight. Paths tell the two apart. To follow them takes
long, so the law says where it is worth it: the likelihood of each place is that of some of the device's links, by the
law in all cells around, by paths in the best of these and on the way down from there.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.bases import FittedBase
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Problem, Solution, expect, nll, residual_db
from radiotwin.effects.base import View
from radiotwin.paths import path_powers
from radiotwin.progress import progress
from radiotwin.scene.citymap import CityMap
from radiotwin.twin import TwinDevice

LINKS = 150  # of a device, about
LEAST_HEARD = 30  # of these; what is not heard tells little, and fits many places
MOST_DEVICES = 30  # of unknown position; each takes some ten seconds
CELL_M, CELLS_APART_M = 7.0, 9.0
MOST_CELLS = 4000  # or wider ones
LEAST_REACH_M, REACH_RADII = 70.0, 1.5  # of the law's circle
FOLLOWED_SHARE, LEAST_FOLLOWED, MOST_FOLLOWED = 0.12, 16, 40  # of the cells
DESCENTS, DESCENTS_APART_M = 2, 15.0
STEPS_M = (4.0, 2.0, 1.0)
AROUND_M = (14.0, 7.0)  # where a descent has ended it is looked around, in case it was a dent
DOF = 4.0
MOST_MISFIT = 4.0  # square of how many times the errors of other devices
CREDIBLE = 0.9

LevelOf = Callable[[np.ndarray, Records], np.ndarray]
"""Powers of paths (n,) of links -> their levels (n,) [dB]."""


@dataclass(eq=False)
class Relocation:
    """What was followed is remembered for other parts of the same links.

    Attributes:
        bounds: west, east, south and north end of where devices may be [m].
        most_radius_m: of the circle by the law; a device with a wider one stays.
        least: of each device: the least number of a link's place to take part, in all parts of the links.
        places: where each device was found before, which is worth a look with other links, too.
        powers: city, device's place -> power by the number of the other end.
    """

    bounds: tuple[float, float, float, float]
    most_radius_m: float
    least: dict[str, np.uint64] = field(default_factory=dict)
    places: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    powers: dict[tuple, dict[int, float]] = field(default_factory=dict)

    def devices(self, records: Records, law: FittedBase, base: FittedBase, level_db: LevelOf) -> list[TwinDevice]:
        """The devices of a law, unknown ones where paths put them if these explain their links better than the law.

        Where they are too many, all stay.

        Args:
            records: n links over a map.
            law: has found them.
            base: follows paths.
            level_db: of the base.
        """
        unknown = sum(device.role == "unknown" for device in law.found)
        if unknown > MOST_DEVICES:
            return list(law.found)
        everything = np.ones(len(records), dtype=bool)
        sides = [Side.make(records, everything, each, DOF) for each in (law, base)]
        fits = [side.fit() for side in sides]
        found = list(law.found)
        with progress("looking for devices along paths", total=unknown) as advance:
            for number, device in enumerate(law.found):
                if device.role != "unknown":
                    continue
                rows = self._rows(records, number)
                heard = np.isfinite(records.level_db[rows]).sum()
                if device.credible_radius_m <= self.most_radius_m and heard >= LEAST_HEARD:
                    by_law, by_paths = (_Likelihood(side, fit, rows, number) for side, fit in zip(sides, fits))
                    places = self.places.setdefault(device.device, [])
                    search = _Search(by_law, by_paths, level_db, self._follow, self.bounds)
                    found[number] = search.from_law(device, places)
                    places.append((found[number].x_m, found[number].y_m))
                advance()
        return found

    def _rows(self, records: Records, device: int) -> np.ndarray:
        """Some links of a device: the same ones in each part of them."""
        rows = np.flatnonzero(records.device == device)
        numbers = _numbers(records.receiver_m[rows])
        name = records.device_names[device]
        if name not in self.least:
            self.least[name] = np.sort(numbers)[-LINKS] if len(rows) > LINKS else np.uint64(0)
        return rows[numbers >= self.least[name]]

    def _follow(self, city: CityMap, place_m: tuple[float, float, float], ends_m: np.ndarray,
                frequency_hz: float) -> np.ndarray:
        """(n,) power from a place to ends (n, 3)."""
        known = self.powers.setdefault((id(city), place_m), {})
        numbers = _numbers(ends_m).tolist()
        missing = {number: row for row, number in enumerate(numbers) if number not in known}
        if missing:
            new_m = ends_m[list(missing.values())]
            followed = path_powers(city, np.array([place_m]), new_m, np.zeros(len(new_m), int), frequency_hz,
                                   "vertical")
            known.update(zip(missing, followed.total.tolist()))
        return np.array([known[number] for number in numbers])


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Of some links of a device, wherever it stands.

    Attributes:
        side, solution: of all links.
        rows: links of the device that take part.
        device: its row.
    """

    side: Side
    solution: Solution
    rows: np.ndarray
    device: int

    def at(self, place_m: np.ndarray) -> Records:
        """The links, the device at a place (2,)."""
        device_m = self.side.records.device_m.copy()
        device_m[self.device, :2] = place_m
        return replace(self.side.records.select(self.rows), device_m=device_m)

    def problem(self, records: Records, mean_db: np.ndarray) -> Problem:
        """The regression on the links, of which the base expects (n,)."""
        everything, base = np.ones(len(records), dtype=bool), self.side.base
        return replace(self.side, records=records, train=everything, usable=everything, base_db=mean_db,
                       base_columns=base.columns(records)[0], group=base.group(records)).problem(slice(None))

    def nll(self, records: Records, mean_db: np.ndarray) -> float:
        """Negative log-likelihood [nats]."""
        return float(nll(self.problem(records, mean_db), self.solution).sum())


@dataclass(eq=False)
class _Search:
    """Of one device.

    Attributes:
        by_law, by_paths: its links' likelihood.
        level_db, follow, bounds: see `Relocation`.
        tried: place -> negative log-likelihood by paths [nats].
    """

    by_law: _Likelihood
    by_paths: _Likelihood
    level_db: LevelOf
    follow: Callable[..., np.ndarray]
    bounds: tuple[float, float, float, float]
    tried: dict[tuple[float, float], float] = field(default_factory=dict)

    def from_law(self, device: TwinDevice, known: list[tuple[float, float]]) -> TwinDevice:
        """The device where paths put it: around where the law does, or near places `known` from other links; or where
        it is, if paths explain its links nowhere better than the law there, or not as they explain those of others."""
        start_m = np.array([device.x_m, device.y_m])
        known_m = self._free(np.array(known).reshape(-1, 2))
        worth_m = known_m if len(known_m) else self._likely_cells(device)
        for place_m in (*self._free(np.round(start_m)[None]), *worth_m):
            self._try(place_m)
        if not self.tried:
            return device
        ranked_m = np.array(sorted(self.tried, key=self.tried.__getitem__))
        for place_m in _apart(ranked_m, DESCENTS_APART_M, 1 if len(known_m) else DESCENTS):
            self._descend(place_m)
        if not len(known_m):
            self._look_around()
        best = min(self.tried, key=self.tried.__getitem__)
        view = self._view(best)
        # Of errors that are scattered as those of other devices the median is 1.
        misfit = np.median((view.residual_db / view.scale_db) ** 2) / float(t.ppf(0.75, DOF)) ** 2
        if self.tried[best] >= self._law_nll(start_m) or misfit > MOST_MISFIT:
            return device
        radius_m = self._radius_m(best, view.design_effect * max(misfit, 1.0))
        return replace(device, x_m=best[0], y_m=best[1], credible_radius_m=radius_m, located=True, second_mode=None)

    def _likely_cells(self, device: TwinDevice) -> list[np.ndarray]:
        """Centres of cells around a device that are worth following paths from."""
        start_m = np.array([device.x_m, device.y_m])
        reach_m = max(REACH_RADII * device.credible_radius_m, LEAST_REACH_M)
        cells_m = self._free(_cells(start_m, reach_m, self.bounds))
        order = np.argsort([self._law_nll(cell_m) for cell_m in cells_m])
        most = int(np.clip(FOLLOWED_SHARE * len(cells_m), LEAST_FOLLOWED, MOST_FOLLOWED))
        return _apart(cells_m[order], CELLS_APART_M, most)

    def _descend(self, from_m: np.ndarray) -> None:
        """Look at the four neighbours of a place, go to the best, and again, with shorter and shorter steps."""
        best, value = from_m, self._try(from_m)
        for step_m in STEPS_M:
            better = True
            while better:
                around_m = self._free(best + step_m * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]))
                values = [self._try(place_m) for place_m in around_m]
                better = min(values, default=np.inf) < value
                if better:
                    best, value = around_m[np.argmin(values)], min(values)

    def _look_around(self) -> None:
        """From the best place, as long as there is a better one near by."""
        better = True
        while better:
            best = min(self.tried, key=self.tried.__getitem__)
            angles = np.arange(8) * np.pi / 4
            ring = np.column_stack([np.cos(angles), np.sin(angles)])
            around_m = self._free(np.round(np.vstack([best + away_m * ring for away_m in AROUND_M])))
            values = [self._try(place_m) for place_m in around_m]
            better = min(values, default=np.inf) < self.tried[best]
            if better:
                self._descend(around_m[np.argmin(values)])

    def _free(self, places_m: np.ndarray) -> np.ndarray:
        """Those of places (c, 2) that are within bounds and not within a building."""
        west, east, south, north = self.bounds
        x_m, y_m = places_m.T
        places_m = places_m[(x_m >= west) & (x_m <= east) & (y_m >= south) & (y_m <= north)]
        records = self.by_law.side.records
        assert records.city is not None
        height_m = np.full(len(places_m), records.device_m[self.by_law.device, 2])
        return places_m[~records.city.inside(np.column_stack([places_m, height_m]))]

    def _law_nll(self, place_m: np.ndarray) -> float:
        records = self.by_law.at(place_m)
        return self.by_law.nll(records, self.by_law.side.base.mean_db(records))

    def _paths_db(self, records: Records) -> np.ndarray:
        x_m, y_m, z_m = map(float, records.device_m[self.by_paths.device])
        power = self.follow(records.city, (x_m, y_m, z_m), records.receiver_m, records.frequency_hz)
        return self.level_db(power, records)

    def _try(self, place_m: np.ndarray) -> float:
        place = float(place_m[0]), float(place_m[1])
        if place not in self.tried:
            records = self.by_paths.at(place_m)
            self.tried[place] = self.by_paths.nll(records, self._paths_db(records))
        return self.tried[place]

    def _view(self, best: tuple[float, float]) -> View:
        """The links, the device where it is found."""
        likelihood, records = self.by_paths, self.by_paths.at(np.array(best))
        problem = likelihood.problem(records, self._paths_db(records))
        expected = expect(problem, likelihood.solution)
        return View(records, residual_db(problem, likelihood.solution), expected.scale_db, expected.mean_db,
                    likelihood.side.base.shifted_db)

    def _radius_m(self, best: tuple[float, float], links_as_one: float) -> float:
        """Of a circle that holds nine tenths of the probability of what was tried, each place standing for the ground
        that is nearer to it than to others."""
        places_m, values = np.array(list(self.tried)), np.array(list(self.tried.values()))
        apart_m = np.linalg.norm(places_m[:, None] - places_m, axis=2)
        area = np.where(apart_m > 0, apart_m, np.inf).min(axis=1) ** 2
        share = area * np.exp((values.min() - values) / links_as_one)
        from_best_m = np.linalg.norm(places_m - best, axis=1)
        order = np.argsort(from_best_m)
        held = np.searchsorted(np.cumsum(share[order]) / share.sum(), CREDIBLE)
        return float(from_best_m[order][min(held, len(order) - 1)] + STEPS_M[-1])


def _apart(places_m: np.ndarray, apart_m: float, most: int) -> list[np.ndarray]:
    """The first of places (c, 2) that are so far apart."""
    chosen: list[np.ndarray] = []
    for place_m in places_m:
        if len(chosen) < most and all(np.hypot(*(place_m - other_m)) >= apart_m for other_m in chosen):
            chosen.append(place_m)
    return chosen


def _cells(around_m: np.ndarray, reach_m: float, bounds: tuple[float, float, float, float]) -> np.ndarray:
    """(c, 2) whole metres near the centres of cells within reach and about the bounds, of a grid that is the same
    wherever it is looked at, as long as its cells need not be wider."""
    low, high = np.array(bounds[::2]), np.array(bounds[1::2])
    low, high = np.maximum(around_m - reach_m, low), np.minimum(around_m + reach_m, high)
    cell_m = max(CELL_M, float(np.sqrt(np.prod(np.maximum(high - low, 0)) / MOST_CELLS)))
    first, last = np.floor(low / cell_m).astype(int), np.ceil(high / cell_m).astype(int)
    axes = [(np.arange(start, end) + 0.5) * cell_m for start, end in zip(first, last)]
    cells_m = np.round(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
    return cells_m[np.linalg.norm(cells_m - around_m, axis=1) <= reach_m]


def _numbers(places_m: np.ndarray) -> np.ndarray:
    """(n,) a number for each place (n, 3), as if drawn at random, and always the same."""
    keys = np.round(places_m * 100).astype(np.int64).astype(np.uint64)
    number = np.zeros(len(places_m), dtype=np.uint64)
    for axis in range(3):
        number = (number ^ keys[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        number ^= number >> np.uint64(29)
    return number
