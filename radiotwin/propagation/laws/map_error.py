"""How wrong a 3D map seems to be: the shift of the whole, and errors of walls and roofs.

The whole map may be shifted, its surfaces may reflect and diffract otherwise than declared, and
each wall and each roof may be off. A wrong wall or roof shows where a small shift of it changes the
paths: next to the border of a shadow, hardly in the open. So the paths are followed over maps with
errors of known sizes, and the sizes are sought whose changes agree with the residuals (maximum
likelihood): the variance of a link is that of its class plus what errors of the map would do to
it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.stats import ttest_1samp

from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.base import require_names, require_number
from radiotwin.propagation.laws.image_paths import (
    MAX_OFFSET_DB,
    ImagePaths,
    LinkFit,
    Offsets,
    fit_offsets,
    links_as_one,
    moved,
    paths_db,
)
from radiotwin.runtime.console import progress
from radiotwin.scene.citymap import perturbed_map

MEMBERS = 3  # maps of each size of error
WALL_SIZES_M = (0.0, 1.0, 2.0, 4.0)
HEIGHT_SIZES_M = (0.0, 1.5, 3.0, 6.0)
STEPS = 4  # tried sizes between two followed ones
INTERVAL_NATS = 2.303  # drop of the likelihood at the ends of the 90 % region of both (Wilks 1938)
Size = tuple[float, float, float]
"""A standard deviation: estimate, low and high end of its 90 % interval [m]."""
SHIFT_LINKS = 300  # that are looked at
MIN_SHIFT_LINKS = 60  # fewer say nothing of a map
RINGS_M = (2.5, 5.0)  # eight shifts each, to begin with
STEPS_M = (2.0, 1.0, 0.5)
MAX_SHIFT_M = 12.0
SEEN_SHIFT_M = 1.0  # below, errors of single walls look alike
MIN_DEVICES = 2  # about one alone a few walls that are off look like a shift
SURE = 0.1  # probability that devices which were left out gain so much by chance (t test)
SURE_NATS = 4.6  # that a shift must explain beyond errors of single walls: 99 % (Wilks 1938)
RADIUS_SDS = 2.146  # of the 90 % circle of a normal distribution, in its standard deviations
Shift = tuple[float, float, float]
"""How far the map lies too far east and north, and the radius that holds it to 90 % [m]."""
NO_SHIFT: Shift = (0.0, 0.0, 0.0)
LINKS = 400  # that are looked at
MIN_LINKS = 60  # fewer say nothing of a map
SEEN_WALL_M, SEEN_HEIGHT_M = 0.5, 1.0  # smaller errors change less than the paths' own error
WARN_WALL_M, WARN_HEIGHT_M = 1.0, 2.0  # errors above which the user is told
WARN_OFFSET_DB = 3.0


@dataclass(frozen=True)
class Sizes:
    """Errors of walls and roofs.

    Attributes:
        wall_m, height_m: standard deviations.
        nll: negative log-likelihood of the links at these [nats].
        as_one: number of links that count as one.
    """

    wall_m: Size
    height_m: Size
    nll: float
    as_one: float


def estimate_sizes(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                   diffuse: tuple[float, float], offsets_db: Offsets, seed: int) -> Sizes:
    """Estimate the errors of walls and roofs.

    Args:
        links: n links over a map, to devices whose positions are known.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB], one for all or (n,); None: unknown.
        diffuse: power beside the paths, see `ImagePaths`.
        offsets_db: see `Offsets`.
        seed: of the maps' errors.
    """
    spread = _Spread(links, diffuse, offsets_db, seed)
    fit = LinkFit(level_db, limit_db)
    reached = [1, 1]
    while True:  # larger errors are followed only where they may be
        profile = _profile(spread, reached, fit)
        at_end = [places[-1] == STEPS * last and last < len(WALL_SIZES_M) - 1
                  for places, last in zip(profile.likely(links), reached, strict=True)]
        if not any(at_end):
            return profile.sizes(links)
        reached = [last + wider for last, wider in zip(reached, at_end, strict=True)]


class _Spread:
    """Mean square of what errors of a map do to links, by the size of the errors."""

    def __init__(self, links: LinkGeometry, diffuse: tuple[float, float], offsets_db: Offsets,
                 seed: int) -> None:
        self.links, self._seed = links, seed
        self._power = diffuse, offsets_db
        self.base_db = paths_db(links, *self._power)
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
                    there = replace(self.links, city=wrong)  # line of sight stays the map's
                    changes.append(paths_db(there, *self._power) - self.base_db)
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
        enough = INTERVAL_NATS * links_as_one(links, self.z)
        return [np.flatnonzero(self.nll.min(axis=1 - axis) - self.nll.min() <= enough)
                for axis in range(2)]

    def sizes(self, links: LinkGeometry) -> Sizes:
        """Return the most likely sizes with their intervals."""
        wall_m, height_m = (self._size(*each) for each in zip(
            self.best, self.likely(links), (WALL_SIZES_M, HEIGHT_SIZES_M), strict=True))
        return Sizes(wall_m, height_m, float(self.nll.min()), links_as_one(links, self.z))

    @staticmethod
    def _size(best: int, places: np.ndarray, scale_m: tuple[float, ...]) -> Size:
        """Return estimate and interval [m]; the ends are within a step of the last likely place."""
        three = np.array([best, places[0] - 1, places[-1] + 1]) / STEPS
        size, low, high = np.interp(three, np.arange(len(scale_m)), scale_m).tolist()
        return size, low, high


def _profile(spread: _Spread, reached: list[int], fit: LinkFit) -> _Profile:
    """Try all sizes up to the places `reached` on both scales."""
    walls, heights = (range(STEPS * last + 1) for last in reached)
    nll, best, best_z = np.full((len(walls), len(heights)), np.inf), np.inf, fit.level_db
    for wall in walls:
        for height in heights:
            square_db = spread.square_db(wall / STEPS, height / STEPS)
            each, z = fit.fit(spread.links.los, spread.base_db, square_db)
            nll[wall, height] = each.sum()
            if nll[wall, height] < best:
                best, best_z = nll[wall, height], z
    row, column = np.unravel_index(nll.argmin(), nll.shape)
    return _Profile(nll, (int(row), int(column)), best_z)


def estimate_shift(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit, seed: int
                   ) -> Shift:
    """Estimate the shift of a map from links between declared positions (maximum likelihood).

    Args:
        links: n links over a map; those to devices of estimated position are not looked at.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB], one for all or (n,); None: unknown.
        seed: of the choice of links, and of the maps' errors.

    Returns:
        zeros where there are too few links, or no shift. Walls that are off each in their own way
        look like another shift about each device; so one that is found without a device must
        explain the links of that device, and more than errors of single walls do.
    """
    limits_db = limits_of(limit_db, len(links))
    known = np.isfinite(level_db) | np.isfinite(limits_db)
    if links.estimated is not None:
        known &= ~links.estimated
    rows = np.flatnonzero(known)
    if len(rows) < MIN_SHIFT_LINKS or not np.isfinite(level_db[rows]).any():
        return NO_SHIFT
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(rows, min(SHIFT_LINKS, len(rows)), replace=False))
    links, level_db, limits_db = links.select(rows), level_db[rows], limits_db[rows]
    device = np.unique(links.device, return_inverse=True)[1]
    if device.max() + 1 < MIN_DEVICES:
        return NO_SHIFT
    search = _Search(links, level_db, limits_db)
    with progress("looking for a shift of the map", total=None):
        best = search.best()
    shifts = np.array(list(search.nll))
    by_device = np.array([np.bincount(device, nll) for nll in search.nll.values()])
    # Of each device: the best shift for the others, and what it gains by that.
    without = (by_device.sum(axis=1)[:, None] - by_device).argmin(axis=0)
    gains = by_device[0] - by_device[without, np.arange(len(without))]
    # The signed root of twice a likelihood ratio is near to normal, the ratio itself is skewed.
    roots = np.sign(gains) * np.sqrt(2 * np.abs(gains))
    chance = ttest_1samp(roots, 0, alternative="greater").pvalue
    if np.hypot(*best) < SEEN_SHIFT_M or not chance < SURE:
        return NO_SHIFT
    diffuse, offsets_db = search.diffuse, (0.0, 0.0)
    here, there = (estimate_sizes(each, level_db, limits_db, diffuse, offsets_db, seed)
                   for each in (links, moved(links, *best)))
    if here.nll - there.nll < SURE_NATS * there.as_one:  # walls that are off explain as much
        return NO_SHIFT
    # The jackknife (Tukey 1958), both axes taken together.
    square_m2 = ((shifts[without] - best)**2).sum() * (len(without) - 1) / len(without)
    radius_m = RADIUS_SDS * float(np.sqrt(square_m2 / 2))
    return best[0], best[1], max(radius_m, STEPS_M[-1])


class _Search:
    """Shifts that were tried.

    Attributes:
        diffuse: power beside the paths.
        nll: shift -> negative log-likelihood of each link (n,) [nats]; the first is no shift.
    """

    def __init__(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit) -> None:
        self._links, self._fit = links, LinkFit(level_db, limit_db)
        self.diffuse = ImagePaths().fit_diffuse(links, level_db, limit_db).diffuse
        self.nll: dict[tuple[float, float], np.ndarray] = {}

    def best(self) -> tuple[float, float]:
        """Return the best of the rings, or what is better in steps from there."""
        self._try(0.0, 0.0)
        for radius_m in RINGS_M:
            for angle_rad in np.arange(8) * np.pi / 4:
                self._try(radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad))
        best = self._least()
        for step_m in STEPS_M:
            while True:
                for east, north in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    self._try(best[0] + step_m * east, best[1] + step_m * north)
                better = self._least()
                if better == best:
                    break
                best = better
        return best

    def _least(self) -> tuple[float, float]:
        return min(self.nll, key=lambda shift: self.nll[shift].sum())

    def _try(self, east_m: float, north_m: float) -> None:
        shift = round(float(east_m), 3), round(float(north_m), 3)
        if shift in self.nll or np.hypot(*shift) > MAX_SHIFT_M:
            return
        over = moved(self._links, *shift)
        self.nll[shift], _ = self._fit.fit(over.los, paths_db(over, self.diffuse))


@dataclass(frozen=True)
class MapError:
    """Errors of a map: standard deviations with 90 % intervals, and what all of it is off by.

    Attributes:
        wall_m: position of a wall, across it: estimate, low and high end [m].
        height_m: height of a building, likewise [m].
        shift_m: how far the map lies too far east and north, and the radius that holds it to
            90 % [m].
        offsets_db: what reflected, and diffracted, paths carry beside those over the map [dB].
    """

    wall_m: Size = (0.0, 0.0, 0.0)
    height_m: Size = (0.0, 0.0, 0.0)
    shift_m: Shift = NO_SHIFT
    offsets_db: Offsets = (0.0, 0.0)

    @property
    def is_seen(self) -> bool:
        """Whether walls or roofs are so wrong that predictions should allow for it."""
        return self.wall_m[0] >= SEEN_WALL_M or self.height_m[0] >= SEEN_HEIGHT_M

    @property
    def is_shifted(self) -> bool:
        """Whether the whole map is shifted."""
        return self.shift_m != NO_SHIFT

    @property
    def warning(self) -> str:
        """Message about a map that is worse than usual; empty where it is not."""
        east_m, north_m, radius_m = self.shift_m
        reflected_db, diffracted_db = self.offsets_db
        parts = [f"it lies {east_m:+.1f} m east and {north_m:+.1f} m north of where it should "
                 f"(90 %: within {radius_m:.1f} m)"] * self.is_shifted
        sizes = ("walls", self.wall_m, WARN_WALL_M), ("heights", self.height_m, WARN_HEIGHT_M)
        parts += [f"{what} are off by {size:.1f} m (90 %: {low:.1f}-{high:.1f})"
                  for what, (size, low, high), limit_m in sizes if size > limit_m]
        parts += [f"{what} are {abs(offset_db):.1f} dB {'stronger' if offset_db > 0 else 'weaker'} "
                  "than its materials make them"
                  for what, offset_db in (("reflections", reflected_db),
                                          ("diffractions", diffracted_db))
                  if abs(offset_db) > WARN_OFFSET_DB]
        return "; ".join(parts)

    def on_map(self, links: LinkGeometry) -> LinkGeometry:
        """Return links where they are on the map, which may be shifted."""
        if not self.is_shifted:
            return links
        return moved(links, self.shift_m[0], self.shift_m[1])

    def state(self) -> dict[str, list[float]]:
        """Return what JSON can hold, for `from_state`."""
        return {name: list(getattr(self, name)) for name in _BOUNDS}

    @classmethod
    def from_state(cls, state: Any) -> Self:
        """Return what `state` described; raises ValueError where it is none."""
        if not isinstance(state, dict):
            raise ValueError("the map's error is none")
        require_names("map error", state, list(_BOUNDS))
        found = {}
        for name, bounds in _BOUNDS.items():
            if not isinstance(state[name], list) or len(state[name]) != len(bounds):
                raise ValueError(f"{name} is not {len(bounds)} numbers")
            named = {f"{name}[{place}]": value for place, value in enumerate(state[name])}
            found[name] = tuple(require_number(named, key, *ends)
                                for key, ends in zip(named, bounds, strict=True))
        return cls(**found)  # type: ignore[arg-type]  # as many numbers as each has


_BOUNDS = {"wall_m": [(0.0, 100.0)] * 3, "height_m": [(0.0, 100.0)] * 3,
           "shift_m": [(-100.0, 100.0)] * 2 + [(0.0, 200.0)],
           "offsets_db": [(-MAX_OFFSET_DB, MAX_OFFSET_DB)] * 2}


Found = tuple[MapError, tuple[float, float]]
"""Errors of a map, and the power beside its paths, see `ImagePaths`."""


def estimate_map_error(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                       seed: int) -> Found:
    """Estimate the errors of the map that links lie over.

    Args:
        links: n links over a map, to devices whose positions are known.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB], one for all or (n,); None: unknown.
        seed: of the choice of links, and of the maps' errors.

    Returns:
        the errors, zeros where there are too few links to tell, and the diffuse power.
    """
    shift_m = estimate_shift(links, level_db, limit_db, seed)
    links = MapError(shift_m=shift_m).on_map(links)
    error, diffuse = estimate_other_errors(links, level_db, limit_db, seed)
    return replace(error, shift_m=shift_m), diffuse


def estimate_other_errors(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                          seed: int) -> Found:
    """Do as `estimate_map_error` for a map that is not shifted."""
    diffuse = ImagePaths().fit_diffuse(links, level_db, limit_db).diffuse
    limits_db = limits_of(limit_db, len(links))
    known = np.flatnonzero(np.isfinite(level_db) | np.isfinite(limits_db))
    if len(known) < MIN_LINKS:
        return MapError(), diffuse
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(known, min(LINKS, len(known)), replace=False))
    links, level_db, limits_db = links.select(rows), level_db[rows], limits_db[rows]
    offsets_db = fit_offsets(links, level_db, limits_db, diffuse)
    sizes = estimate_sizes(links, level_db, limits_db, diffuse, offsets_db, seed)
    return MapError(sizes.wall_m, sizes.height_m, offsets_db=offsets_db), diffuse
