"""How far a whole 3D map is shifted against what was measured over it."""

from __future__ import annotations

import numpy as np
from scipy.stats import ttest_1samp

from radiotwin.channel.class_fit import LinkFit
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.map_sizes import estimate_sizes
from radiotwin.channel.path_levels import moved, paths_db
from radiotwin.inference.gaussian import Limit, limits_of
from radiotwin.links import LinkGeometry
from radiotwin.progress import progress

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
