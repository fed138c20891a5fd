"""How wrong a 3D map seems to be, from what measured levels leave of the paths over it.

The whole map may be shifted, its surfaces may reflect and diffract otherwise than declared, and
each wall and each roof may be off. A wrong wall or roof shows where a small shift of it changes the
paths: next to the border of a shadow, hardly in the open. So the paths are followed over maps with
errors of known sizes, and the sizes are sought whose changes go with the residuals' (maximum
likelihood): the variance of a link is that of its class plus what errors of the map would do to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from radiotwin.channel.class_fit import LinkFit, links_as_one
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.map_shift import NO_SHIFT, Shift, estimate_shift
from radiotwin.channel.path_levels import (
    MAX_OFFSET_DB,
    Offsets,
    fit_offsets,
    moved,
    over,
    paths_db,
)
from radiotwin.channel.stored import require_names, require_number
from radiotwin.links import LinkGeometry
from radiotwin.progress import progress
from radiotwin.scene.perturbation import perturbed_map

LINKS = 400  # that are looked at
MIN_LINKS = 60  # fewer say nothing of a map
MEMBERS = 3  # maps of each size of error
WALL_SIZES_M = (0.0, 1.0, 2.0, 4.0)
HEIGHT_SIZES_M = (0.0, 1.5, 3.0, 6.0)
STEPS = 4  # tried sizes between two followed ones
SEEN_WALL_M, SEEN_HEIGHT_M = 0.5, 1.0  # smaller errors change less than the paths' own error
WARN_WALL_M, WARN_HEIGHT_M = 1.0, 2.0  # errors above which the user is told
WARN_OFFSET_DB = 3.0
INTERVAL_NATS = 1.353  # drop of the profile likelihood at the ends of a 90 % interval (Wilks 1938)


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

    wall_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
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
        """What a user is told of a map that is worse than usual; empty where it is not."""
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


def estimate_map_error(links: LinkGeometry, level_db: np.ndarray, limit_db: float | None,
                       seed: int) -> tuple[MapError, tuple[float, float]]:
    """Estimate the errors of the map that links lie over.

    Args:
        links: n links over a map, to devices whose positions are known.
        level_db: (n,) [dB]; NaN: not detected.
        limit_db: below which levels are not detected [dB]; None: unknown.
        seed: of the choice of links, and of the maps' errors.

    Returns:
        the errors, zeros where there are too few links to tell; and the power beside the paths, see
        `ImagePaths`.
    """
    error = MapError(shift_m=estimate_shift(links, level_db, limit_db, seed))
    links = error.on_map(links)
    diffuse = ImagePaths().fit_diffuse(links, level_db, limit_db).diffuse
    known = np.flatnonzero(np.isfinite(level_db) | (limit_db is not None))
    if len(known) < MIN_LINKS:
        return error, diffuse
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(known, min(LINKS, len(known)), replace=False))
    links, level_db = links.select(rows), level_db[rows]
    error = replace(error, offsets_db=fit_offsets(links, level_db, limit_db, diffuse))
    spread = _Spread(links, diffuse, error.offsets_db, seed)
    fit = LinkFit(level_db, limit_db)
    reached = [1, 1]
    while True:  # larger errors are followed only where they may be
        profile = _profile(spread, reached, fit)
        at_end = [places[-1] == STEPS * last and last < len(WALL_SIZES_M) - 1
                  for places, last in zip(profile.likely(links), reached, strict=True)]
        if not any(at_end):
            wall_m, height_m = profile.sizes_m(links)
            return replace(error, wall_m=wall_m, height_m=height_m), diffuse
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
                    changes.append(paths_db(over(self.links, wrong), *self._power) - self.base_db)
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

    def sizes_m(self, links: LinkGeometry) -> list[tuple[float, float, float]]:
        """Return estimate and interval of walls and of heights [m]."""
        sizes = []
        for best, places, scale_m in zip(self.best, self.likely(links),
                                         (WALL_SIZES_M, HEIGHT_SIZES_M), strict=True):
            three = np.array([best, places[0], places[-1]]) / STEPS
            sizes.append(tuple(np.interp(three, np.arange(len(scale_m)), scale_m).tolist()))
        return sizes


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
