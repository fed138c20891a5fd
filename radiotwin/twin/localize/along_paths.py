"""Relocation: locate unknown devices by tracing paths, around the position of a log-distance law.

A law with LoS and NLoS takes a link just behind an edge, a few decibels weaker, for one with line
of sight, and moves a device in a narrow street to a position with line of sight. Paths distinguish
both, but take long. So the search goes from coarse to fine: the law in all cells around; short
paths of a few links in the best cells; all paths of more links in the best of these; and a descent
from there. A step of the descent tries only the reflections and diffractions that are strong a few
metres away. Path powers are cached for other subsets of the same links.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from scipy.special import stdtrit

from radiotwin.effects.arrays import subsample
from radiotwin.effects.base import ResidualView
from radiotwin.inference.censored_regression import CensoredRegression
from radiotwin.inference.student import DOF
from radiotwin.links import Links
from radiotwin.links.declared import Declared
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.paths.images import Candidates
from radiotwin.propagation.paths.powers import PathPowers, path_powers
from radiotwin.runtime.console import progress
from radiotwin.runtime.execution import Executor, Job, Resources
from radiotwin.runtime.pieces import Piece, ResultCache, cached_with_name, keeps
from radiotwin.runtime.processes import in_threads
from radiotwin.scene.citymap import CityMap
from radiotwin.twin.localize.estimate import CREDIBLE, TwinDevice
from radiotwin.twin.localize.on_map import distinct_modes
from radiotwin.twin.model.model import Fit, Model

_Place = tuple[float, float]  # x and y of a device [m]
Followed = dict[tuple[float, ...], dict[int, float]]
"""Cache of path powers: device position -> hash of receiver position and antenna -> power."""
LINKS = 150  # links of a device in the likelihood, about
FIT_LINKS = 1000  # links to which levels and error scales are fitted
MIN_HEARD = 30  # detected links needed: undetected ones fit many positions
MAX_DEVICES = 30  # unknown devices; each takes some ten seconds
CELL_M, CELLS_APART_M = 7.0, 9.0  # width of cells, and least distance of those that are traced
MAX_CELLS = 4000  # cells of the search area; beyond it they are wider
MIN_REACH_M, REACH_RADII = 70.0, 1.5  # radius of the search area [m], or in radii by the law
FOLLOWED_SHARE, MIN_FOLLOWED, MAX_FOLLOWED = 0.12, 16, 40  # share and number of traced cells
DESCENTS, DESCENTS_APART_M = 2, 15.0  # number, and least distance of their starts
STEPS_M = (4.0, 2.0, 1.0, 0.5)  # of a descent
AROUND_M = (14.0, 7.0)  # radii of rings around the end of a descent, against local minima
COARSE_LINKS, COARSE_DEPTH = 50, 3  # links, and interactions of paths, in the coarse likelihood
SECOND_LOOKS = 8  # positions that are then tried with all links and paths
NEAR_M = 4.0  # within this distance the same reflections and diffractions are strong
RAYS = 10_000  # from each position, 2 degrees apart: ten times as many find the same positions
MAX_MISFIT = 4.0  # largest median squared residual, over that of other devices
WORKER_BYTES = 2 * 2**30  # memory of a process that searches


def followed_since(known: dict[tuple[float, ...], int], followed: Followed
                   ) -> dict[str, np.ndarray]:
    """Return path powers cached since each position had `known` links, as arrays for a file."""
    new = {position_m: list(powers.items())[known.get(position_m, 0):]
           for position_m, powers in followed.items() if len(powers) > known.get(position_m, 0)}
    entries = [entry for powers in new.values() for entry in powers]
    return {"position_m": np.array(list(new)).reshape(-1, 3),
            "count": np.array([len(powers) for powers in new.values()], dtype=int),
            "hash": np.array([key for key, _ in entries], dtype=np.uint64),
            "power": np.array([power for _, power in entries], dtype=float)}


def add_followed(arrays: dict[str, np.ndarray], followed: Followed) -> None:
    """Add path powers from `followed_since` to a cache in place; ValueError if damaged."""
    entries = list(zip(arrays["hash"].tolist(), arrays["power"].tolist(), strict=True))
    if arrays["count"].sum() != len(entries):
        raise ValueError("counts do not match the entries")
    last = np.cumsum(arrays["count"]).tolist()
    for position_m, end, count in zip(arrays["position_m"].tolist(), last,
                                      arrays["count"].tolist(), strict=True):
        if count:
            followed.setdefault(tuple(position_m), {}).update(entries[end - count:end])


@dataclass(eq=False)
class Relocation:
    """Search for devices along paths, with a cache of path powers for subsets of the same links.

    Attributes:
        bounds: west, east, south and north bound of devices' positions [m].
        max_radius_m: devices with a larger radius by the law are not searched [m].
        thresholds: for each device the least hash of a receiver position that takes part, so that
            all subsets of the links use the same receivers.
        positions: earlier results for each device, tried with other links, too.
        history: hash of all searches so far, on which the cache depends.
        powers: cache of path powers for each map.
        executor: runs several searches in parallel, inside `keep_pieces`.
    """

    bounds: tuple[float, float, float, float]
    max_radius_m: float
    thresholds: dict[str, np.uint64] = field(default_factory=dict)
    positions: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    history: str = ""
    powers: WeakKeyDictionary[CityMap, Followed] = field(default_factory=WeakKeyDictionary)
    executor: Executor = field(default_factory=Executor)

    def relocate(self, links: Links, devices: list[TwinDevice],
                 channel: ImagePaths) -> list[TwinDevice]:
        """Move unknown devices to the positions of greatest likelihood along paths.

        A device keeps its position by the law unless paths explain its links better, its radius is
        within `max_radius_m`, `MIN_HEARD` links are detected, and `MAX_DEVICES` at most are sought.
        """
        unknown = sum(device.role == "unknown" for device in devices)
        if unknown > MAX_DEVICES:
            return list(devices)
        device_m = np.array([device.position_m for device in devices])
        placed = np.isfinite(device_m).all(axis=1)
        sample = links.select(subsample(np.flatnonzero(placed[links.device]), FIT_LINKS))
        fits = [Model.build(sample, model, DOF, device_m=device_m).fit()
                for model in (channel.law, channel)]
        links = links.with_devices(np.where(placed[:, None], device_m, 0.0))
        searches: dict[int, _Question] = {}
        for number, device in enumerate(devices):
            if device.role != "unknown":
                continue
            rows = self._rows(links, number)
            detected = np.isfinite(links.level_db[rows]).sum()
            if device.credible_radius_m <= self.max_radius_m and detected >= MIN_HEARD:
                by_law, by_paths = (_Likelihood(fit, links, rows, number) for fit in fits)
                before = self.positions.setdefault(device.device, [])
                searches[number] = _Search(by_law, by_paths, self), device, before
        self._search_ahead(list(searches.values()))
        found = list(devices)
        with progress("looking for devices along paths", total=len(searches)) as advance:
            for number, (search, device, before) in searches.items():
                found[number] = self._search(search, device, before)
                search.strongest.clear()  # megabytes that no other search uses
                before.append((found[number].x_m, found[number].y_m))
                advance()
        return found

    def _search_ahead(self, searches: list[_Question]) -> None:
        """Run the searches in parallel; `_search` then finds their results in the cache on disk."""
        if not self.executor.is_worth_it or not keeps() or len(searches) < 2:
            return
        inputs: list[tuple] = []
        parts: ResultCache[int, Piece] = ResultCache("position", inputs.__getitem__,
                                                     lambda found: found, lambda *piece: piece)
        history = self.history
        for search, device, before in searches:
            inputs.append((history, self.bounds, search.by_law, search.by_paths, device, before))
            history = parts.name(len(inputs) - 1)
        job = Job("looking for devices along paths", partial(_search_alone, searches),
                  Resources(WORKER_BYTES, False))
        self.executor.run_ahead(job, range(len(searches)), parts)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without cache and executor: another process traces the paths that it needs."""
        return type(self), (self.bounds, self.max_radius_m, self.thresholds, self.positions,
                            self.history)

    def _search(self, search: _Search, device: TwinDevice,
                before: list[tuple[float, float]]) -> TwinDevice:
        """Search the position of one device, or load it; add its path powers to the cache."""
        city = search.by_law.links.city
        assert city is not None
        followed = self.powers.setdefault(city, {})
        known = {position_m: len(powers) for position_m, powers in followed.items()}

        def write(found: TwinDevice) -> Piece:
            return followed_since(known, followed), found.record

        def read(arrays: dict[str, np.ndarray], content: Any) -> TwinDevice:
            found = TwinDevice.from_record(content)
            add_followed(arrays, followed)
            return found

        inputs = self.history, self.bounds, search.by_law, search.by_paths, device, before
        found, self.history = cached_with_name(
            "position", inputs, partial(search.from_law, device, before), write, read)
        return found

    def _rows(self, links: Links, device: int) -> np.ndarray:
        """Choose about LINKS links of a device, by a hash of the receiver position.

        So every subset of links, such as a fold, uses the same receivers, whose powers are cached.
        """
        rows = np.flatnonzero(links.device == device)
        hashes = _hashes(links.receiver_m[rows])
        name = links.device_names[device]
        if name not in self.thresholds:
            least = np.sort(hashes)[-LINKS] if len(rows) > LINKS else np.uint64(0)
            self.thresholds[name] = least
        return rows[hashes >= self.thresholds[name]]

    def follow(self, links: Links, device: int, candidates: Candidates | None = None
               ) -> tuple[np.ndarray, Candidates | None]:
        """Return the path power (n,) of a device's links, cached or newly traced, linear.

        It is through the declared antennas. If all paths were traced (no `candidates` given), the
        strongest candidates at this position are returned, too.
        """
        assert links.city is not None
        position_m = tuple(map(float, links.device_m[device]))
        known = self.powers.setdefault(links.city, {}).setdefault(position_m, {})
        keys = _keys(links, device)
        missing = {key: row for row, key in enumerate(keys) if key not in known}
        strongest = None
        if missing:
            followed = path_powers(
                links.city, links.device_m[device], links.receiver_m[list(missing.values())],
                links.frequency_hz, rays=RAYS, candidates=candidates)
            known.update(zip(missing, _through_antennas(followed, links.declared, device).tolist(),
                             strict=True))
            if candidates is None and len(missing) == len(keys):
                strongest = followed.strongest
        return np.array([known[key] for key in keys]), strongest

    def is_followed(self, links: Links, device: int) -> bool:
        """Return True if the cache has the path power of all these links of a device."""
        assert links.city is not None
        known = self.powers.get(links.city, {}).get(tuple(map(float, links.device_m[device])), {})
        return all(key in known for key in _keys(links, device))


def _keys(links: Links, device: int) -> list[int]:
    """Return cache keys (n,) of links: hash of the receiver position plus the antenna's number."""
    declared = links.declared
    antenna = declared.radios[device].antenna if declared.radios else None
    # Several devices, with other antennas, may be tried at one position.
    number = [None, *(known for known, _ in declared.antennas)].index(antenna)
    return (_hashes(links.receiver_m) + np.uint64(number)).tolist()


def _through_antennas(followed: PathPowers, declared: Declared, device: int) -> np.ndarray:
    """Return the path power (n,) of a device's links through the declared antennas, linear."""
    if not declared.has_antennas:
        return followed.total
    antenna_db = followed.directions.antenna_gain_db(
        len(followed.direct), declared.radios[device].antenna, declared.receiver_antenna)
    return followed.total * np.nan_to_num(10 ** (antenna_db / 10))


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Likelihood of one device's links as a function of its position.

    Attributes:
        fit: fitted levels and error scales, from links of all devices.
        links: links of all devices, at their positions by the law.
        rows: links of the device that take part.
        device: row of the device.
    """

    fit: Fit
    links: Links
    rows: np.ndarray
    device: int

    def at(self, position_m: np.ndarray) -> Links:
        """Return the device's links with the device at a position (2,) [m]."""
        device_m = self.links.device_m.copy()
        device_m[self.device, :2] = position_m
        return self.links.select(self.rows).with_devices(device_m)

    def problem(self, links: Links, mean_db: np.ndarray) -> CensoredRegression:
        """Return the regression on links whose channel mean (n,) [dB] is known."""
        return Model.build(links, self.fit.channel, DOF, channel_db=mean_db).regression()

    def nll(self, links: Links, mean_db: np.ndarray) -> float:
        """Return the negative log-likelihood of links with channel mean (n,) [dB], in nats."""
        return float(self.problem(links, mean_db).nll(self.fit).sum())


@dataclass(eq=False)
class _Search:
    """Search for the position of one device along paths.

    Attributes:
        by_law, by_paths: likelihood of its links by the log-distance law, and by paths.
        relocation: bounds, and cache of path powers.
        tried: position -> negative log-likelihood by paths [nats].
        strongest: position -> strongest candidates, where all paths were traced.
    """

    by_law: _Likelihood
    by_paths: _Likelihood
    relocation: Relocation
    tried: dict[_Place, float] = field(default_factory=dict)
    strongest: dict[_Place, Candidates] = field(default_factory=dict)

    def from_law(self, device: TwinDevice, known: list[tuple[float, float]]) -> TwinDevice:
        """Return a device at its likeliest position by traced paths, or unchanged.

        It is unchanged if the law explains its links as well, or its residuals by paths are much
        larger than those of other devices (MAX_MISFIT). With positions `known` from other subsets
        of links, only their surroundings and the law's position are tried.
        """
        start_m = np.array([device.x_m, device.y_m])
        known_m = self._free(np.array(known).reshape(-1, 2))
        first_m = known_m if len(known_m) else self._second_looks(self._likely_cells(device))
        self._try([*self._free(np.round(start_m)[None]), *first_m])
        if not self.tried:
            return device
        ranked_m = np.array(sorted(self.tried, key=self.tried.__getitem__))
        for position_m in distinct_modes(ranked_m, -np.arange(len(ranked_m)),
                                         1 if len(known_m) else DESCENTS, DESCENTS_APART_M):
            self._descend(position_m)
        if not len(known_m):
            self._look_around()
        best = min(self.tried, key=self.tried.__getitem__)
        view = self._view(best)
        # The median of squared residuals, over that of a Student-t distribution
        z = view.residual_db / view.scale_db
        misfit = np.median(z**2) / float(stdtrit(DOF, 0.75)) ** 2
        if self.tried[best] >= self._law_nll(start_m) or misfit > MAX_MISFIT:
            return device
        radius_m = self._radius_m(best, view.design_effect * max(misfit, 1.0))
        return replace(device, x_m=best[0], y_m=best[1], credible_radius_m=radius_m, located=True,
                       second_mode=None)

    def _likely_cells(self, device: TwinDevice) -> list[np.ndarray]:
        """Return the cell centres (2,) [m] around a device that the law makes likeliest, apart."""
        start_m = np.array([device.x_m, device.y_m])
        reach_m = max(REACH_RADII * device.credible_radius_m, MIN_REACH_M)
        cells_m = self._free(_cells(start_m, reach_m, self.relocation.bounds))
        order = np.argsort([self._law_nll(cell_m) for cell_m in cells_m])
        count = int(np.clip(FOLLOWED_SHARE * len(cells_m), MIN_FOLLOWED, MAX_FOLLOWED))
        return [*distinct_modes(cells_m[order], -np.arange(len(order)), count, CELLS_APART_M)]

    def _descend(self, from_m: np.ndarray) -> None:
        """Descend from a position to lower negative log-likelihood by paths, in smaller steps."""
        best, (value,) = from_m, self._try([from_m])
        for step_m in STEPS_M:
            better = True
            while better:
                cross = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
                around_m = self._free(best + step_m * cross)
                if not all(self._is_cheap(position_m) for position_m in around_m):
                    self._find_strongest(best)
                values = self._try(around_m)
                better = min(values, default=np.inf) < value
                if better:
                    best, value = around_m[np.argmin(values)], min(values)

    def _look_around(self) -> None:
        """Try rings around the best position and descend from a better one, while there is any."""
        better = True
        while better:
            best = min(self.tried, key=self.tried.__getitem__)
            angles = np.arange(8) * np.pi / 4
            ring = np.column_stack([np.cos(angles), np.sin(angles)])
            rings = np.vstack([best + away_m * ring for away_m in AROUND_M])
            around_m = self._second_looks([*self._free(np.round(rings))])
            values = self._try(around_m)
            better = min(values, default=np.inf) < self.tried[best]
            if better:
                self._descend(around_m[np.argmin(values)])

    def _free(self, positions_m: np.ndarray) -> np.ndarray:
        """Select positions (c, 2) [m] within the bounds and outside buildings."""
        west, east, south, north = self.relocation.bounds
        x_m, y_m = positions_m.T
        inside = (x_m >= west) & (x_m <= east) & (y_m >= south) & (y_m <= north)
        positions_m = positions_m[inside]
        links = self.by_law.links
        assert links.city is not None
        height_m = np.full(len(positions_m), links.device_m[self.by_law.device, 2])
        return positions_m[~links.city.inside(np.column_stack([positions_m, height_m]))]

    def _law_nll(self, position_m: np.ndarray) -> float:
        """Return the negative log-likelihood by the law at a position (2,) [nats]."""
        links = self.by_law.at(position_m)
        return self.by_law.nll(links, self.by_law.fit.model.level_at(links))

    def _second_looks(self, positions_m: list[np.ndarray]) -> list[np.ndarray]:
        """Keep the SECOND_LOOKS positions (2,) that short paths of a few links make likeliest."""
        if len(positions_m) <= SECOND_LOOKS:
            return positions_m
        order = np.argsort(in_threads(self._coarse_nll, positions_m), kind="stable")
        return [positions_m[place] for place in order[:SECOND_LOOKS]]

    def _coarse_nll(self, position_m: np.ndarray) -> float:
        """Return the negative log-likelihood of a position [nats] by short paths of a few links."""
        rows = self.by_paths.rows[::max(len(self.by_paths.rows) // COARSE_LINKS, 1)]
        likelihood = replace(self.by_paths, rows=rows)
        links, device = likelihood.at(position_m), likelihood.device
        assert links.city is not None
        followed = path_powers(links.city, links.device_m[device], links.receiver_m,
                               links.frequency_hz, depth=COARSE_DEPTH, rays=RAYS)
        power = _through_antennas(followed, links.declared, device)
        return likelihood.nll(links, self._level_db(links, power))

    def _level_db(self, links: Links, power: np.ndarray) -> np.ndarray:
        """Return the level (n,) [dB] of links from path power (n,), linear, and declared power."""
        channel, declared = self.by_paths.fit.channel, links.declared
        assert isinstance(channel, ImagePaths)
        feed_db = 0.0 if declared.adds_nothing else declared.fed_db[self.by_paths.device]
        return channel.level_db(power, links.geometry) + feed_db

    def _try(self, positions_m: Iterable[np.ndarray]) -> list[float]:
        """Return the negative log-likelihood by paths of each position (2,) [nats]; cached."""
        keys = [(float(x_m), float(y_m)) for x_m, y_m in positions_m]
        new = [key for key in dict.fromkeys(keys) if key not in self.tried]
        # Results do not depend on the number of threads: a call uses candidates found before it.
        asked = [(key, self._nearby(key)) for key in new]
        for key, (nll, strongest) in zip(new, in_threads(self._paths_nll, asked), strict=True):
            self.tried[key] = nll
            if strongest is not None:
                self.strongest[key] = strongest
        return [self.tried[key] for key in keys]

    def _paths_nll(self, asked: tuple[_Place, Candidates | None]
                   ) -> tuple[float, Candidates | None]:
        """Return the negative log-likelihood of a position [nats], and its strongest candidates.

        Tried are the given candidates, None: all; only then are there strongest ones.
        """
        position_m, candidates = asked
        links = self.by_paths.at(np.array(position_m))
        power, strongest = self.relocation.follow(links, self.by_paths.device, candidates)
        return self.by_paths.nll(links, self._level_db(links, power)), strongest

    def _nearby(self, position_m: _Place) -> Candidates | None:
        """Return the strongest candidates at the nearest fully traced place, if within `NEAR_M`."""
        away_m = {place: np.hypot(place[0] - position_m[0], place[1] - position_m[1])
                  for place in self.strongest}
        nearest = min(away_m, key=away_m.__getitem__, default=None)
        return None if nearest is None or away_m[nearest] > NEAR_M else self.strongest[nearest]

    def _is_cheap(self, position_m: np.ndarray) -> bool:
        """Return True if a position (2,) is cached, or near a fully traced one."""
        place = float(position_m[0]), float(position_m[1])
        return self._nearby(place) is not None or self.relocation.is_followed(
            self.by_paths.at(position_m), self.by_paths.device)

    def _find_strongest(self, position_m: np.ndarray) -> None:
        """Trace all paths from a position (2,); store its strongest interactions in `strongest`."""
        place, links = (float(position_m[0]), float(position_m[1])), self.by_paths.at(position_m)
        if place not in self.strongest:
            assert links.city is not None
            self.strongest[place] = path_powers(
                links.city, links.device_m[self.by_paths.device], links.receiver_m,
                links.frequency_hz, rays=RAYS).strongest

    def _view(self, best: _Place) -> ResidualView:
        """Return the residuals by paths of the device's links, at the best position."""
        likelihood, links = self.by_paths, self.by_paths.at(np.array(best))
        power, _ = self.relocation.follow(links, likelihood.device)
        problem = likelihood.problem(links, self._level_db(links, power))
        reading = problem.predict(likelihood.fit)
        return ResidualView(links, problem.residual_db(likelihood.fit), reading.scale_db,
                            reading.mean_db, likelihood.fit.model.level_at)

    def _radius_m(self, best: _Place, design_effect: float) -> float:
        """Return the radius [m] with 90 % of the tried positions' probability, plus a step."""
        positions_m, values = np.array(list(self.tried)), np.array(list(self.tried.values()))
        apart_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
        area = np.where(apart_m > 0, apart_m, np.inf).min(axis=1) ** 2
        mass = area * np.exp((values.min() - values) / design_effect)
        from_best_m = np.linalg.norm(positions_m - best, axis=1)
        order = np.argsort(from_best_m)
        held = np.searchsorted(np.cumsum(mass[order]) / mass.sum(), CREDIBLE)
        return float(from_best_m[order][min(held, len(order) - 1)] + STEPS_M[-1])


_Question = tuple[_Search, TwinDevice, list[tuple[float, float]]]  # search, device, known positions


def _search_alone(searches: list[_Question], number: int) -> Piece:
    """Run one search in a worker with an empty cache; return the traced paths and the device."""
    search, device, before = searches[number]
    relocation = replace(search.relocation, powers=WeakKeyDictionary())
    found = replace(search, relocation=relocation, tried={}, strongest={}).from_law(device, before)
    city = search.by_law.links.city
    assert city is not None
    return followed_since({}, relocation.powers.get(city, {})), found.record


def _cells(around_m: np.ndarray, reach_m: float,
           bounds: tuple[float, float, float, float]) -> np.ndarray:
    """Return centres (c, 2) of grid cells within bounds and reach of a position, whole metres."""
    low, high = np.array(bounds[::2]), np.array(bounds[1::2])
    low, high = np.maximum(around_m - reach_m, low), np.minimum(around_m + reach_m, high)
    cell_m = max(CELL_M, float(np.sqrt(np.prod(np.maximum(high - low, 0)) / MAX_CELLS)))
    first, last = np.floor(low / cell_m).astype(int), np.ceil(high / cell_m).astype(int)
    axes = [(np.arange(start, end) + 0.5) * cell_m for start, end in zip(first, last, strict=True)]
    cells_m = np.round(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
    return cells_m[np.linalg.norm(cells_m - around_m, axis=1) <= reach_m]


def _hashes(positions_m: np.ndarray) -> np.ndarray:
    """Hash positions (n, 3) [m], rounded to the centimetre; return (n,) uint64."""
    keys = np.round(positions_m * 100).astype(np.int64).astype(np.uint64)
    number = np.zeros(len(positions_m), dtype=np.uint64)
    for axis in range(3):
        number = (number ^ keys[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        number ^= number >> np.uint64(29)
    return number
