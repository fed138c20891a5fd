"""Sizes of the errors of a map's walls and roofs, from what paths over it leave of measured levels.

A wrong wall or roof shows where a small shift of it changes the paths: next to the border of a
shadow, hardly in the open. So the paths are followed over maps with errors of known sizes, and the
sizes are sought whose changes go with the residuals' (maximum likelihood): the variance of a link
is that of its class plus what errors of the map would do to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from radiotwin.channel.class_fit import LinkFit, links_as_one
from radiotwin.channel.path_levels import Offsets, paths_db
from radiotwin.inference.gaussian import Limit
from radiotwin.links import LinkGeometry
from radiotwin.progress import progress
from radiotwin.scene.perturbation import perturbed_map

MEMBERS = 3  # maps of each size of error
WALL_SIZES_M = (0.0, 1.0, 2.0, 4.0)
HEIGHT_SIZES_M = (0.0, 1.5, 3.0, 6.0)
STEPS = 4  # tried sizes between two followed ones
INTERVAL_NATS = 2.303  # drop of the likelihood at the ends of the 90 % region of both (Wilks 1938)

Size = tuple[float, float, float]
"""A standard deviation: estimate, low and high end of its 90 % interval [m]."""


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
