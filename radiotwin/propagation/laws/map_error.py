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
from functools import cache
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
class _Sizes:
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


def _estimate_sizes(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                    diffuse: tuple[float, float], offsets_db: Offsets, seed: int) -> _Sizes:
    """Estimate the errors of walls and roofs from links to devices of known position."""
    power, fit = (diffuse, offsets_db), LinkFit(level_db, limit_db)
    base_db = paths_db(links, *power)

    @cache
    def square_db(wall_m: float, height_m: float) -> np.ndarray:
        return _mean_square_db(links, base_db, power, (wall_m, height_m), seed)

    def between(sizes: list[tuple[float, float]], at: float) -> np.ndarray:
        low = min(int(at), len(sizes) - 2)
        share = at - low
        if not share:
            return square_db(*sizes[low])
        return (1 - share) * square_db(*sizes[low]) + share * square_db(*sizes[low + 1])

    reached = [1, 1]  # places on both scales
    while True:
        nll, z = np.full([STEPS * last + 1 for last in reached], np.inf), level_db
        for wall, height in np.ndindex(*nll.shape):
            of_walls = between([(size, 0.0) for size in WALL_SIZES_M], wall / STEPS)
            of_heights = between([(0.0, size) for size in HEIGHT_SIZES_M], height / STEPS)
            each, its_z = fit.fit(links.los, base_db, of_walls + of_heights)
            if each.sum() < nll.min():
                z = its_z
            nll[wall, height] = each.sum()
        as_one = links_as_one(links, z)
        likely = [np.flatnonzero(nll.min(axis=1 - axis) - nll.min() <= INTERVAL_NATS * as_one)
                  for axis in range(2)]
        # Larger errors are followed only where they may be.
        at_end = [places[-1] == STEPS * last and last < len(WALL_SIZES_M) - 1
                  for places, last in zip(likely, reached, strict=True)]
        if not any(at_end):
            best = np.unravel_index(nll.argmin(), nll.shape)
            wall_m, height_m = (_size(*each) for each in zip(
                best, likely, (WALL_SIZES_M, HEIGHT_SIZES_M), strict=True))
            return _Sizes(wall_m, height_m, float(nll.min()), as_one)
        reached = [last + wider for last, wider in zip(reached, at_end, strict=True)]


def _mean_square_db(links: LinkGeometry, base_db: np.ndarray,
                    power: tuple[tuple[float, float], Offsets], size_m: tuple[float, float],
                    seed: int) -> np.ndarray:
    """Return the mean square (n,) [dB²] of what errors of walls and heights do to levels (n,)."""
    city = links.city
    if city is None or not any(size_m):
        return np.zeros(len(links))
    changes = []
    with progress("following paths over wrong maps", total=MEMBERS) as advance:
        for member in range(MEMBERS):
            wrong = replace(links, city=perturbed_map(city, *size_m, seed + member))
            changes.append(paths_db(wrong, *power) - base_db)  # with the map's line of sight
            advance(1)
    return np.mean(np.square(changes), axis=0)


def _size(best: np.intp, places: np.ndarray, scale_m: tuple[float, ...]) -> Size:
    """Return estimate and interval [m]; the ends are within a step of the last likely place."""
    three = np.array([best, places[0] - 1, places[-1] + 1]) / STEPS
    size, low, high = np.interp(three, np.arange(len(scale_m)), scale_m).tolist()
    return size, low, high


def estimate_shift(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit, seed: int
                   ) -> Shift:
    """Estimate the shift of a map from links between declared positions (maximum likelihood).

    Arguments are those of `estimate_map_error`.

    Returns:
        zeros if there are too few links, or no shift. Independent errors of single walls look like
        a different shift about each device. So a shift must also explain the links of a device
        that was left out, and must explain more than errors of single walls do.
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
    diffuse = ImagePaths().fit_diffuse(links, level_db, limits_db).diffuse
    with progress("looking for a shift of the map", total=None):
        tried = _try_shifts(links, LinkFit(level_db, limits_db), diffuse)
    best, shifts = _likeliest(tried), np.array(list(tried))
    by_device = np.array([np.bincount(device, nll) for nll in tried.values()])
    # Leave one device out: the best shift for the others, and what that gains for this device
    left_out = (by_device.sum(axis=1)[:, None] - by_device).argmin(axis=0)
    gain_nats = by_device[0] - by_device[left_out, np.arange(len(left_out))]
    # The signed root of twice a likelihood ratio is near to normal, the ratio itself is skewed
    roots = np.sign(gain_nats) * np.sqrt(2 * np.abs(gain_nats))
    chance = ttest_1samp(roots, 0, alternative="greater").pvalue
    if np.hypot(*best) < SEEN_SHIFT_M or not chance < SURE:
        return NO_SHIFT
    unshifted, shifted = (_estimate_sizes(each, level_db, limits_db, diffuse, (0.0, 0.0), seed)
                          for each in (links, moved(links, *best)))
    if unshifted.nll - shifted.nll < SURE_NATS * shifted.as_one:  # wrong walls explain as much
        return NO_SHIFT
    # The jackknife (Tukey 1958), both axes taken together.
    square_m2 = ((shifts[left_out] - best)**2).sum() * (len(left_out) - 1) / len(left_out)
    radius_m = RADIUS_SDS * float(np.sqrt(square_m2 / 2))
    return best[0], best[1], max(radius_m, STEPS_M[-1])


def _try_shifts(links: LinkGeometry, fit: LinkFit, diffuse: tuple[float, float]
                ) -> dict[tuple[float, float], np.ndarray]:
    """Return the negative log-likelihood of each link (n,) [nats] for each shift, (0, 0) first.

    Tried are shifts on rings, then a descent from the best one in steps.
    """
    tried: dict[tuple[float, float], np.ndarray] = {}

    def look(east_m: float, north_m: float) -> None:
        shift = round(float(east_m), 3), round(float(north_m), 3)
        if shift not in tried and np.hypot(*shift) <= MAX_SHIFT_M:
            over = moved(links, *shift)
            tried[shift], _ = fit.fit(over.los, paths_db(over, diffuse))

    look(0.0, 0.0)
    for radius_m in RINGS_M:
        for angle_rad in np.arange(8) * np.pi / 4:
            look(radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad))
    for step_m in STEPS_M:
        best = None
        while best != (better := _likeliest(tried)):
            best = better
            for east, north in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                look(best[0] + step_m * east, best[1] + step_m * north)
    return tried


def _likeliest(tried: dict[tuple[float, float], np.ndarray]) -> tuple[float, float]:
    return min(tried, key=lambda shift: tried[shift].sum())


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
    """Estimate errors of walls, roofs and materials of a map that is not shifted.

    Arguments and result are those of `estimate_map_error`.
    """
    diffuse = ImagePaths().fit_diffuse(links, level_db, limit_db).diffuse
    limits_db = limits_of(limit_db, len(links))
    known = np.flatnonzero(np.isfinite(level_db) | np.isfinite(limits_db))
    if len(known) < MIN_LINKS:
        return MapError(), diffuse
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(known, min(LINKS, len(known)), replace=False))
    links, level_db, limits_db = links.select(rows), level_db[rows], limits_db[rows]
    offsets_db = fit_offsets(links, level_db, limits_db, diffuse)
    sizes = _estimate_sizes(links, level_db, limits_db, diffuse, offsets_db, seed)
    return MapError(sizes.wall_m, sizes.height_m, offsets_db=offsets_db), diffuse
