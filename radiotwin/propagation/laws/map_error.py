"""Estimate errors of a 3D map from measured links: shift, wall and roof errors, materials.

The whole map may be shifted, its surfaces may reflect and diffract otherwise than declared, and
each wall and roof may be off. An error of a wall or roof changes the levels of links next to the
border of a radio shadow, hardly those in the open. So paths are traced over maps with random errors
of known sizes, and the sizes of greatest likelihood are found: the error variance of a link is that
of its class, LoS or NLoS, plus the mean square change of its level over these maps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np
from scipy.stats import ttest_1samp

from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.links import LinkGeometry, design_effect
from radiotwin.propagation.laws.base import ground_blocks, require_names, require_number
from radiotwin.propagation.laws.image_paths import (
    MAX_OFFSET_DB,
    ImagePaths,
    LinkFit,
    Offsets,
    fit_offsets,
    moved,
    paths_db,
)
from radiotwin.runtime.console import progress
from radiotwin.scene.citymap import perturbed_map

MEMBERS = 3  # random maps for each size of error
WALL_SIZES_M = (0.0, 1.0, 2.0, 4.0)  # standard deviations of walls over which paths are traced
HEIGHT_SIZES_M = (0.0, 1.5, 3.0, 6.0)  # and of heights of buildings
STEPS = 4  # steps by which sizes between two traced ones are interpolated
INTERVAL_NATS = 2.303  # drop of log-likelihood at the 90 % region of two parameters (Wilks 1938)
Size = tuple[float, float, float]
"""A standard deviation: estimate, low and high end of its 90 % interval [m]."""
SHIFT_LINKS, LINKS = 300, 400  # random links from which the shift, and other errors, are estimated
MIN_LINKS = 60  # fewer links do not determine errors of a map
RINGS_M = (2.5, 5.0)  # radii of the first shifts, eight on each
STEPS_M = (2.0, 1.0, 0.5)  # steps of the descent that follows
MAX_SHIFT_M = 12.0
SEEN_SHIFT_M = 1.0  # smaller shifts cannot be told from errors of single walls
MIN_DEVICES = 2  # around a single device, errors of a few walls look like a shift
SURE = 0.1  # p-value (t test) of the likelihood gains of left-out devices
SURE_NATS = 4.6  # log-likelihood a shift must gain beyond wall errors: 99 % (Wilks 1938)
RADIUS_SDS = 2.146  # radius of the 90 % circle of a normal distribution over its sd
Shift = tuple[float, float, float]
"""Displacement of the map to the east and to the north, and radius of its 90 % circle [m]."""
NO_SHIFT: Shift = (0.0, 0.0, 0.0)
SEEN_WALL_M, SEEN_HEIGHT_M = 0.5, 1.0  # smaller errors matter less than errors of path tracing
WARN_WALL_M, WARN_HEIGHT_M = 1.0, 2.0  # the user is warned of larger errors
WARN_OFFSET_DB = 3.0


@dataclass(frozen=True)
class _Sizes:
    """Estimated errors of walls and roofs.

    Attributes:
        wall_m, height_m: standard deviations with 90 % intervals.
        nll: negative log-likelihood of the links at the estimate [nats].
        design_effect: number of correlated links that carry the information of one.
    """

    wall_m: Size
    height_m: Size
    nll: float
    design_effect: float


def _estimate_sizes(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                    diffuse: tuple[float, float], offsets_db: Offsets, seed: int) -> _Sizes:
    """Estimate standard deviations of wall positions and roof heights by maximum likelihood.

    Each tried pair adds to the error variance of a link its mean square change over random maps.
    """
    power, fit = (diffuse, offsets_db), LinkFit(level_db, limit_db)
    base_db = paths_db(links, *power)

    @cache
    def square_db(wall_m: float, height_m: float) -> np.ndarray:
        return _mean_square_db(links, base_db, power, (wall_m, height_m), seed)

    def interpolated(sizes: list[tuple[float, float]], position: float) -> np.ndarray:
        """Interpolate the mean square (n,) [dB²] at a fractional position in a list of sizes."""
        low = min(int(position), len(sizes) - 2)
        share = position - low
        if not share:
            return square_db(*sizes[low])
        return (1 - share) * square_db(*sizes[low]) + share * square_db(*sizes[low + 1])

    last_traced = [1, 1]  # index of the largest traced size of walls, of heights
    while True:
        nll, residual = np.full([STEPS * last + 1 for last in last_traced], np.inf), level_db
        for wall, height in np.ndindex(*nll.shape):
            wall_db2 = interpolated([(size, 0.0) for size in WALL_SIZES_M], wall / STEPS)
            height_db2 = interpolated([(0.0, size) for size in HEIGHT_SIZES_M], height / STEPS)
            link_nll, link_residual = fit.fit(links.los, base_db, wall_db2 + height_db2)
            if link_nll.sum() < nll.min():
                residual = link_residual
            nll[wall, height] = link_nll.sum()
        variance_factor = design_effect(ground_blocks(links), residual)
        drop = INTERVAL_NATS * variance_factor
        likely = [np.flatnonzero(nll.min(axis=1 - axis) - nll.min() <= drop) for axis in range(2)]
        # Trace paths over maps with larger errors only if these may be likely.
        at_end = [steps[-1] == STEPS * last and last < len(WALL_SIZES_M) - 1
                  for steps, last in zip(likely, last_traced, strict=True)]
        if not any(at_end):
            best = np.unravel_index(nll.argmin(), nll.shape)
            wall_m, height_m = (_size(*args) for args in zip(
                best, likely, (WALL_SIZES_M, HEIGHT_SIZES_M), strict=True))
            return _Sizes(wall_m, height_m, float(nll.min()), variance_factor)
        last_traced = [last + wider for last, wider in zip(last_traced, at_end, strict=True)]


def _mean_square_db(links: LinkGeometry, base_db: np.ndarray,
                    power: tuple[tuple[float, float], Offsets], size_m: tuple[float, float],
                    seed: int) -> np.ndarray:
    """Return the mean square level change (n,) [dB²] from a map to copies with random errors.

    `base_db` (n,) are the levels over the given map, `power` the arguments of `paths_db`, `size_m`
    the standard deviations of walls and of heights in the copies. Zeros without a map.
    """
    city = links.city
    if city is None or not any(size_m):
        return np.zeros(len(links))
    changes = []
    with progress("following paths over wrong maps", total=MEMBERS) as advance:
        for member in range(MEMBERS):
            wrong = replace(links, city=perturbed_map(city, *size_m, seed + member))
            changes.append(paths_db(wrong, *power) - base_db)  # line of sight of the given map
            advance(1)
    return np.mean(np.square(changes), axis=0)


def _size(best: np.intp, likely: np.ndarray, scale_m: tuple[float, ...]) -> Size:
    """Convert best and `likely` steps to an estimate and 90 % interval [m], widened by a step."""
    steps = np.array([best, likely[0] - 1, likely[-1] + 1]) / STEPS
    size_m, low_m, high_m = np.interp(steps, np.arange(len(scale_m)), scale_m).tolist()
    return size_m, low_m, high_m


def estimate_shift(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit, seed: int
                   ) -> Shift:
    """Estimate the shift of a map from links between declared positions (maximum likelihood).

    Returns shift east and north and 90 % radius [m]; zeros with fewer than MIN_LINKS links or
    MIN_DEVICES devices, below SEEN_SHIFT_M, or if not significant: wrong walls look like a
    different shift around each device, so the shift found without a device must raise that device's
    likelihood, tested over all devices, and explain more than errors of walls do.
    """
    limits_db = limits_of(limit_db, len(links))
    known = np.isfinite(level_db) | np.isfinite(limits_db)
    if links.estimated is not None:
        known &= ~links.estimated
    if not np.isfinite(level_db[known]).any():
        return NO_SHIFT
    rows = _random_rows(known, SHIFT_LINKS, seed)
    if not len(rows):
        return NO_SHIFT
    links, level_db, limits_db = links.select(rows), level_db[rows], limits_db[rows]
    device = np.unique(links.device, return_inverse=True)[1]
    if device.max() + 1 < MIN_DEVICES:
        return NO_SHIFT
    diffuse = ImagePaths().fit_diffuse(links, level_db, limits_db).diffuse
    with progress("looking for a shift of the map", total=None):
        tried = _try_shifts(links, LinkFit(level_db, limits_db), diffuse)
    best, shifts = _likeliest(tried), np.array(list(tried))
    by_device = np.array([np.bincount(device, nll) for nll in tried.values()])
    # Leave-one-out: the best shift of the other devices, and its likelihood gain for this device
    left_out = (by_device.sum(axis=1)[:, None] - by_device).argmin(axis=0)
    gain_nats = by_device[0] - by_device[left_out, np.arange(len(left_out))]
    # The signed root of twice a likelihood ratio is nearly normal; the ratio itself is skewed.
    roots = np.sign(gain_nats) * np.sqrt(2 * np.abs(gain_nats))
    chance = ttest_1samp(roots, 0, alternative="greater").pvalue
    if np.hypot(*best) < SEEN_SHIFT_M or not chance < SURE:
        return NO_SHIFT
    unshifted, shifted = (_estimate_sizes(placed, level_db, limits_db, diffuse, (0.0, 0.0), seed)
                          for placed in (links, moved(links, *best)))
    if unshifted.nll - shifted.nll < SURE_NATS * shifted.design_effect:  # walls explain as much
        return NO_SHIFT
    # The jackknife (Tukey 1958), both axes taken together.
    square_m2 = ((shifts[left_out] - best)**2).sum() * (len(left_out) - 1) / len(left_out)
    radius_m = RADIUS_SDS * float(np.sqrt(square_m2 / 2))
    return best[0], best[1], max(radius_m, STEPS_M[-1])


def _random_rows(known: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Draw at most `count` rows where `known` (n,) is True; none if less than MIN_LINKS are."""
    rows = np.flatnonzero(known)
    if len(rows) < MIN_LINKS:
        return rows[:0]
    return np.sort(np.random.default_rng(seed).choice(rows, min(count, len(rows)), replace=False))


def _try_shifts(links: LinkGeometry, fit: LinkFit, diffuse: tuple[float, float]
                ) -> dict[tuple[float, float], np.ndarray]:
    """Try shifts up to MAX_SHIFT_M on rings, then descend; return the links' (n,) nll by shift."""
    tried: dict[tuple[float, float], np.ndarray] = {}

    def try_shift(east_m: float, north_m: float) -> None:
        shift = round(float(east_m), 3), round(float(north_m), 3)
        if shift not in tried and np.hypot(*shift) <= MAX_SHIFT_M:
            shifted = moved(links, *shift)
            tried[shift], _ = fit.fit(shifted.los, paths_db(shifted, diffuse))

    try_shift(0.0, 0.0)
    for radius_m in RINGS_M:
        for angle_rad in np.arange(8) * np.pi / 4:
            try_shift(radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad))
    for step_m in STEPS_M:
        best = None
        while best != (better := _likeliest(tried)):
            best = better
            for east, north in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                try_shift(best[0] + step_m * east, best[1] + step_m * north)
    return tried


def _likeliest(tried: dict[tuple[float, float], np.ndarray]) -> tuple[float, float]:
    """Return the shift of greatest likelihood among those of `_try_shifts`."""
    return min(tried, key=lambda shift: tried[shift].sum())


@dataclass(frozen=True)
class MapError:
    """Estimated errors of a map.

    Attributes:
        wall_m: standard deviation of a wall's position across it, low and high end of its 90 %
            interval [m].
        height_m: standard deviation of a building's height, low and high end likewise [m].
        shift_m: displacement of the map to the east and north, and radius of its 90 % circle [m].
        offsets_db: measured minus computed level of reflected, and of diffracted, paths [dB].
    """

    wall_m: Size = (0.0, 0.0, 0.0)
    height_m: Size = (0.0, 0.0, 0.0)
    shift_m: Shift = NO_SHIFT
    offsets_db: Offsets = (0.0, 0.0)

    @property
    def is_seen(self) -> bool:
        """Return True if walls or heights are so wrong that predictions should allow for it."""
        return self.wall_m[0] >= SEEN_WALL_M or self.height_m[0] >= SEEN_HEIGHT_M

    @property
    def is_shifted(self) -> bool:
        """Return True if the whole map is shifted."""
        return self.shift_m != NO_SHIFT

    @property
    def warning(self) -> str:
        """Return a message about map errors above the WARN_ limits; empty if there are none."""
        east_m, north_m, radius_m = self.shift_m
        reflected_db, diffracted_db = self.offsets_db
        parts = [f"it lies {east_m:+.1f} m east and {north_m:+.1f} m north of where it should "
                 f"(90 %: within {radius_m:.1f} m)"] * self.is_shifted
        sizes = ("walls", self.wall_m, WARN_WALL_M), ("heights", self.height_m, WARN_HEIGHT_M)
        parts += [f"{what} are off by {size:.1f} m (90 %: {low:.1f}-{high:.1f})"
                  for what, (size, low, high), warn_m in sizes if size > warn_m]
        parts += [f"{what} are {abs(offset_db):.1f} dB {'stronger' if offset_db > 0 else 'weaker'} "
                  "than its materials make them"
                  for what, offset_db in (("reflections", reflected_db),
                                          ("diffractions", diffracted_db))
                  if abs(offset_db) > WARN_OFFSET_DB]
        return "; ".join(parts)

    def on_map(self, links: LinkGeometry) -> LinkGeometry:
        """Return links moved to their positions on the shifted map."""
        if not self.is_shifted:
            return links
        return moved(links, self.shift_m[0], self.shift_m[1])

    def state(self) -> dict[str, list[float]]:
        """Return the errors as lists for JSON, for `from_state`."""
        return {name: list(getattr(self, name)) for name in _BOUNDS}

    @classmethod
    def from_state(cls, state: Any) -> Self:
        """Restore the errors from their `state`; raise ValueError if it is damaged."""
        if not isinstance(state, dict):
            raise ValueError("map error is no object")
        require_names("map error", state, list(_BOUNDS))
        found = {}
        for name, bounds in _BOUNDS.items():
            if not isinstance(state[name], list) or len(state[name]) != len(bounds):
                raise ValueError(f"{name} is not {len(bounds)} numbers")
            named = {f"{name}[{place}]": value for place, value in enumerate(state[name])}
            found[name] = tuple(require_number(named, key, *ends)
                                for key, ends in zip(named, bounds, strict=True))
        return cls(**found)  # type: ignore[arg-type]  # lengths were checked above


_BOUNDS = {"wall_m": [(0.0, 100.0)] * 3, "height_m": [(0.0, 100.0)] * 3,
           "shift_m": [(-100.0, 100.0)] * 2 + [(0.0, 200.0)],
           "offsets_db": [(-MAX_OFFSET_DB, MAX_OFFSET_DB)] * 2}


Found = tuple[MapError, tuple[float, float]]
"""Errors of a map, and the diffuse power, see `ImagePaths`."""


def estimate_map_error(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                       seed: int) -> Found:
    """Estimate the errors of a map from measured links, by maximum likelihood.

    Levels are (n,) [dB], NaN: not detected; `seed` is of the random links and maps. Returns the
    errors, zeros with fewer than MIN_LINKS links, and the diffuse power. Only for the shift, links
    to devices of estimated positions are left out.
    """
    shift_m = estimate_shift(links, level_db, limit_db, seed)
    links = MapError(shift_m=shift_m).on_map(links)
    error, diffuse = estimate_other_errors(links, level_db, limit_db, seed)
    return replace(error, shift_m=shift_m), diffuse


def estimate_other_errors(links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                          seed: int) -> Found:
    """Estimate errors of walls, heights and materials of a map that is not shifted.

    Arguments and result are those of `estimate_map_error`.
    """
    diffuse = ImagePaths().fit_diffuse(links, level_db, limit_db).diffuse
    limits_db = limits_of(limit_db, len(links))
    rows = _random_rows(np.isfinite(level_db) | np.isfinite(limits_db), LINKS, seed)
    if not len(rows):
        return MapError(), diffuse
    links, level_db, limits_db = links.select(rows), level_db[rows], limits_db[rows]
    offsets_db = fit_offsets(links, level_db, limits_db, diffuse)
    sizes = _estimate_sizes(links, level_db, limits_db, diffuse, offsets_db, seed)
    return MapError(sizes.wall_m, sizes.height_m, offsets_db=offsets_db), diffuse
