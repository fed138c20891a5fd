"""How wrong a 3D map seems to be, from what measured levels leave of the paths over it.

A wrong wall or roof shows where a small shift of it changes the paths: next to the border of a
shadow, hardly in the open. So the paths are followed over maps with errors of known sizes, and the
sizes are sought whose changes go with the residuals' (maximum likelihood): the variance of a link
is that of its class plus what errors of the map would do to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize

from radiotwin.channel.followed_paths import path_gains
from radiotwin.channel.image_paths import with_diffuse_db
from radiotwin.channel.stored import require_names, require_number
from radiotwin.inference import student
from radiotwin.links import LinkGeometry, design_effect
from radiotwin.progress import progress
from radiotwin.scene.perturbation import perturbed_map

LINKS = 400  # that are looked at
MIN_LINKS = 60  # fewer say nothing of a map
MEMBERS = 3  # maps of each size of error
WALL_SIZES_M = (0.0, 1.0, 2.0, 4.0)
HEIGHT_SIZES_M = (0.0, 1.5, 3.0, 6.0)
STEPS = 4  # tried sizes between two followed ones
DOF = 4.0  # of the errors
BLOCK_M = 100.0  # side of the ground within which the links of a device err alike
SEEN_WALL_M, SEEN_HEIGHT_M = 0.5, 1.0  # smaller errors change less than the paths' own error
INTERVAL_NATS = 1.353  # drop of the profile likelihood at the ends of a 90 % interval (Wilks 1938)


@dataclass(frozen=True)
class MapError:
    """Standard deviations of a map's errors, with 90 % intervals.

    Attributes:
        wall_m: position of a wall, across it: estimate, low and high end [m].
        height_m: height of a building, likewise [m].
    """

    wall_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def is_seen(self) -> bool:
        """Whether the map is so wrong that predictions should allow for it."""
        return self.wall_m[0] >= SEEN_WALL_M or self.height_m[0] >= SEEN_HEIGHT_M

    def __str__(self) -> str:
        parts = [f"{what} by {size:.1f} m (90 %: {low:.1f}-{high:.1f})"
                 for what, (size, low, high) in (("walls", self.wall_m),
                                                 ("heights", self.height_m))]
        return " and ".join(parts)

    def state(self) -> dict[str, list[float]]:
        """Return what JSON can hold, for `from_state`."""
        return {"wall_m": list(self.wall_m), "height_m": list(self.height_m)}

    @classmethod
    def from_state(cls, state: Any) -> Self:
        """Return what `state` described; raises ValueError where it is none."""
        if not isinstance(state, dict):
            raise ValueError("the map's error is none")
        require_names("map error", state, ["wall_m", "height_m"])
        found = []
        for name in ("wall_m", "height_m"):
            if not isinstance(state[name], list) or len(state[name]) != 3:
                raise ValueError(f"{name} is not an estimate with its interval")
            named = dict(zip(("size", "low", "high"), state[name], strict=True))
            found.append(tuple(require_number(named, key, 0, 100) for key in named))
        return cls(*found)  # type: ignore[arg-type]  # three numbers each


def estimate_map_error(links: LinkGeometry, level_db: np.ndarray, limit_db: float | None,
                       diffuse: tuple[float, float], seed: int) -> MapError:
    """Estimate the errors of the map that links lie over.

    Args:
        links: n links over a map, to devices whose positions are known.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB]; None: unknown.
        diffuse: power beside the paths, see `ImagePaths`.
        seed: of the choice of links, and of the maps' errors.

    Returns:
        zeros where there are too few links to tell.
    """
    detected = np.flatnonzero(np.isfinite(level_db) | (limit_db is not None))
    if len(detected) < MIN_LINKS:
        return MapError()
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(detected, min(LINKS, len(detected)), replace=False))
    spread = _Spread(links.select(rows), diffuse, seed)
    level_db = level_db[rows]
    limits_db = np.full(len(rows), -np.inf if limit_db is None else limit_db)
    reached = [1, 1]
    while True:  # larger errors are followed only where they may be
        found = _profile(spread, reached, level_db, limits_db)
        at_end = [places[-1] == STEPS * last and last < len(WALL_SIZES_M) - 1
                  for places, last in zip(found.likely(spread.links), reached, strict=True)]
        if not any(at_end):
            return found.error(spread.links)
        reached = [last + wider for last, wider in zip(reached, at_end, strict=True)]


class _Spread:
    """Mean square of what errors of a map do to links, by the size of the errors."""

    def __init__(self, links: LinkGeometry, diffuse: tuple[float, float], seed: int) -> None:
        self.links, self._diffuse, self._seed = links, diffuse, seed
        self.base_db = paths_db(links, diffuse)
        nothing = np.zeros(len(links))
        self._known: dict[tuple[float, float], np.ndarray] = {(0.0, 0.0): nothing}

    def square_db(self, wall: float, height: float) -> np.ndarray:
        """Return the mean square (n,) [dB²] at places on the scales of sizes, such as 1.5."""
        walls, heights = ([(size, 0.0) for size in WALL_SIZES_M],
                          [(0.0, size) for size in HEIGHT_SIZES_M])
        return self._between(walls, wall) + self._between(heights, height)

    def _between(self, sizes: list[tuple[float, float]], at: float) -> np.ndarray:
        low = min(int(at), len(sizes) - 2)
        share = at - low
        if not share:
            return self._at(sizes[low])
        return (1 - share) * self._at(sizes[low]) + share * self._at(sizes[low + 1])

    def _at(self, size: tuple[float, float]) -> np.ndarray:
        if size not in self._known:
            city = self.links.city
            assert city is not None
            changes = []
            with progress("following paths over wrong maps", total=MEMBERS) as advance:
                for member in range(MEMBERS):
                    wrong = perturbed_map(city, *size, self._seed + member)
                    changes.append(paths_db(over(self.links, wrong), self._diffuse) - self.base_db)
                    advance(1)
            self._known[size] = np.mean(np.square(changes), axis=0)
        return self._known[size]


@dataclass(frozen=True, eq=False)
class _Profile:
    """Likelihood of sizes of errors.

    Attributes:
        nll: (walls, heights) on the scales of sizes, `STEPS` to a followed one [nats].
        best: row and column of the least.
        z: (n,) residuals over their scale at the best.
    """

    nll: np.ndarray
    best: tuple[int, int]
    z: np.ndarray

    def likely(self, links: LinkGeometry) -> list[np.ndarray]:
        """Return the places within the 90 % interval on both scales."""
        block = np.column_stack([links.device, np.floor(links.receiver_m[:, :2] / BLOCK_M)])
        label = np.unique(block, axis=0, return_inverse=True)[1].reshape(-1)
        enough = INTERVAL_NATS * design_effect(label, self.z)
        return [np.flatnonzero(self.nll.min(axis=1 - axis) - self.nll.min() <= enough)
                for axis in range(2)]

    def error(self, links: LinkGeometry) -> MapError:
        """Return estimate and interval of both sizes [m]."""
        sizes = []
        for best, places, scale_m in zip(self.best, self.likely(links),
                                         (WALL_SIZES_M, HEIGHT_SIZES_M), strict=True):
            three = np.array([best, places[0], places[-1]]) / STEPS
            sizes.append(tuple(np.interp(three, np.arange(len(scale_m)), scale_m).tolist()))
        return MapError(*sizes)


def _profile(spread: _Spread, reached: list[int], level_db: np.ndarray, limits_db: np.ndarray
             ) -> _Profile:
    """Try all sizes up to the places `reached` on both scales."""
    walls, heights = (range(STEPS * last + 1) for last in reached)
    nll, best, best_z = np.full((len(walls), len(heights)), np.inf), np.inf, level_db
    start: dict[bool, np.ndarray] = {}
    for wall in walls:
        for height in heights:
            square_db = spread.square_db(wall / STEPS, height / STEPS)
            nll[wall, height], z = _fit_classes(spread, square_db, level_db, limits_db, start)
            if nll[wall, height] < best:
                best, best_z = nll[wall, height], z
    row, column = np.unravel_index(nll.argmin(), nll.shape)
    return _Profile(nll, (int(row), int(column)), best_z)


def _fit_classes(spread: _Spread, square_db: np.ndarray, level_db: np.ndarray,
                 limits_db: np.ndarray, start: dict[bool, np.ndarray]) -> tuple[float, np.ndarray]:
    """Fit level and scale of each class of line of sight; return nats and residuals (n,)."""
    total, z = 0.0, np.zeros(len(level_db))
    for los in (False, True):
        mine = spread.links.los == los
        if not np.isfinite(level_db[mine]).any():
            continue
        fit = fit_class(level_db[mine], limits_db[mine], spread.base_db[mine], square_db[mine],
                        start.get(los))
        start[los] = fit.numbers
        total += fit.nll
        error_db = level_db[mine] - spread.base_db[mine] - fit.level_db
        z[mine] = np.nan_to_num(error_db / fit.scale_db(square_db[mine]))
    return total, z


@dataclass(frozen=True, eq=False)
class ClassFit:
    """Level and error scale of links of one class.

    Attributes:
        numbers: level [dB], and logarithm of the scale where the map's errors do nothing.
        nll: at these [nats].
    """

    numbers: np.ndarray
    nll: float

    @property
    def level_db(self) -> float:
        """What measured levels lie above the paths'."""
        return float(self.numbers[0])

    def scale_db(self, square_db: np.ndarray) -> np.ndarray:
        """Return the scale (n,) [dB] of links that errors of the map change so much (n,) [dB²]."""
        return scale_db(float(np.exp(self.numbers[1])), square_db)


def scale_db(own_db: float, square_db: np.ndarray) -> np.ndarray:
    """Return the Student-t scale (n,) [dB] of a class's own scale and the map's errors (n,)."""
    return np.sqrt(own_db**2 + square_db * (DOF - 2) / DOF)


def fit_class(level_db: np.ndarray, limits_db: np.ndarray, paths: np.ndarray,
              square_db: np.ndarray, start: np.ndarray | None = None) -> ClassFit:
    """Fit level and scale to links of one class.

    Args:
        level_db: (n,) [dB]; NaN: not detected.
        limits_db: (n,) below which levels are not detected [dB].
        paths: (n,) levels of the followed paths [dB].
        square_db: (n,) mean square of what the map's errors do [dB²].
        start: of an earlier fit.
    """
    if start is None:
        seen = np.isfinite(level_db)
        start = np.array([np.median((level_db - paths)[seen]), 0.5])

    def nll(numbers: np.ndarray) -> float:
        own_db = float(np.exp(np.clip(numbers[1], -3, 4)))
        return float(student.censored_nll(level_db, limits_db, paths + numbers[0],
                                          scale_db(own_db, square_db), DOF).sum())

    found = minimize(nll, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
    return ClassFit(np.array([found.x[0], np.clip(found.x[1], -3, 4)]), float(found.fun))


def paths_db(links: LinkGeometry, diffuse: tuple[float, float]) -> np.ndarray:
    """Return the level (n,) [dB] of followed paths and diffuse power."""
    return with_diffuse_db(path_gains(links), links.distance_m, *diffuse)


def over(links: LinkGeometry, city: Any) -> LinkGeometry:
    """Return links over another map, with the line of sight that they have over their own."""
    return LinkGeometry(links.device_m, links.receiver_m, links.los, links.device, city,
                        links.frequency_hz, links.estimated)
