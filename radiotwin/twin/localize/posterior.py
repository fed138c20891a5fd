"""Posterior of a device's position: refine cells, find modes and the credible radius."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from radiotwin.twin.localize.estimate import CREDIBLE

SPLIT = 5  # a cell becomes SPLIT x SPLIT cells
MAX_SPLIT_CELLS = 80  # cells of highest likelihood that are split in a step
FINEST_M = 0.3  # narrower cells are not split
MODE_FLOOR = 1e-3  # a cell with less mass, over the heaviest cell's, belongs to no mode
MIN_MODE_WEIGHT = 0.05  # least posterior probability of a reported second mode
MODE_SEPARATION_M = 20.0  # its least distance from the first mode


@dataclass(frozen=True)
class Posterior:
    """Posterior over square cells that tile the allowed area, finer where a device is likely.

    Attributes:
        xy_m: (c, 2) allowed point of each cell [m].
        cell_m: (c, 2) centre of the scan's cell that contains it [m].
        width_m: (c,) width of each cell [m].
        log_likelihood: (c,) log-likelihood at the point [nats].
        mass: (c,) posterior probability under a uniform prior and a power of the likelihood; sums
            to 1.
    """

    xy_m: np.ndarray
    cell_m: np.ndarray
    width_m: np.ndarray
    log_likelihood: np.ndarray
    mass: np.ndarray

    def radius(self, xy_m: np.ndarray) -> float:
        """Return the radius [m] around a position (2,) that holds the probability CREDIBLE."""
        distance = np.linalg.norm(self.xy_m - xy_m, axis=1)
        # The mass of a cell is spread over it: half is nearer than its centre, half farther.
        halves = np.concatenate([distance - self.width_m / 4, distance + self.width_m / 4])
        order = np.argsort(halves)
        within = np.cumsum(np.tile(self.mass, 2)[order] / 2)
        return float(halves[order][np.searchsorted(within, CREDIBLE * (1 - 1e-9))])

    def region_share(self) -> float:
        """Return the area of the smallest region with probability CREDIBLE over that of all cells.

        It is 0.9 for a flat posterior.
        """
        area = self.width_m**2
        order = np.argsort(-self.mass / area)
        inside = np.searchsorted(np.cumsum(self.mass[order]), CREDIBLE * (1 - 1e-9)) + 1
        return float(area[order][:inside].sum() / area.sum())

    def modes(self, allowed: Callable[[np.ndarray], np.ndarray]) -> list[tuple[np.ndarray, float]]:
        """Return position (2,) [m] and weight of each separate mode, heaviest first.

        A mode is a connected patch of the scan's grid whose cells have at least MODE_FLOOR of the
        heaviest cell's mass. Its position is the mean over the patch under the likelihood itself,
        since the power that widens `mass` must not move it; if that mean is outside the patch (a
        crescent) or not allowed, it is the patch's likeliest point.

        Args:
            allowed: function from positions (p, 2) [m] to (p,) bool, a device may be there.
        """
        offset = (self.cell_m - self.cell_m.min(axis=0)) / self.width_m.max()
        column, row = np.round(offset).astype(int).T
        grid = np.zeros((row.max() + 1, column.max() + 1))
        np.add.at(grid, (row, column), self.mass)
        patches, _ = label(grid >= MODE_FLOOR * grid.max(), structure=np.ones((3, 3)))
        patch = patches[row, column]
        weights = np.bincount(patch, self.mass)
        weights[0] = 0.0
        found = []
        for k in np.argsort(-weights)[: np.count_nonzero(weights)]:
            cells = patch == k
            nats = self.log_likelihood[cells]
            mass = self.width_m[cells] ** 2 * np.exp(nats - nats.max())
            mean = mass @ self.xy_m[cells] / mass.sum()
            outside = np.abs(self.cell_m[cells] - mean).max(axis=1).min() > self.width_m.max() / 2
            if outside or not allowed(mean[None])[0]:
                mean = self.xy_m[cells][nats.argmax()]
            found.append((mean, float(weights[k])))
        return found


def second_mode(modes: list[tuple[np.ndarray, float]]) -> tuple[float, float, float] | None:
    """Return the heaviest mode far enough from the first, (x_m, y_m, weight), or None.

    It is at least MODE_SEPARATION_M away and of MIN_MODE_WEIGHT.
    """
    first = modes[0][0]
    for xy_m, weight in modes[1:]:
        if weight >= MIN_MODE_WEIGHT and np.linalg.norm(xy_m - first) >= MODE_SEPARATION_M:
            return float(xy_m[0]), float(xy_m[1]), weight
    return None


def refine(log_likelihood: Callable[[np.ndarray], np.ndarray], centre_m: np.ndarray,
           point_m: np.ndarray, value: np.ndarray, width_m: float, peaks_m: np.ndarray,
           likelihood_power: float) -> Posterior:
    """Split the likeliest cells of a scan until they are below FINEST_M, and normalise all.

    Cells have centres (c, 2), points at which they were evaluated (c, 2), and values (c,); those
    around `peaks_m` (s, 2) are always split, as a peak may be narrower than a cell. Split cells at
    -inf, where no device may be, are dropped. The power of the likelihood is at most 1.
    """
    cell_m = centre_m
    done = []
    while True:
        split = np.zeros(len(value), bool)
        if width_m > FINEST_M:
            split[np.argsort(-value)[:MAX_SPLIT_CELLS]] = True
            for peak in peaks_m:
                split |= np.abs(centre_m - peak).max(axis=1) <= width_m / 2 * (1 + 1e-6)
        done.append((point_m[~split], cell_m[~split], np.full((~split).sum(), width_m),
                     value[~split]))
        if not split.any():
            break
        offset = ((np.arange(SPLIT) + 0.5) / SPLIT - 0.5) * width_m
        offsets = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
        centre_m = point_m = (centre_m[split][:, None] + offsets).reshape(-1, 2)
        cell_m = np.repeat(cell_m[split], SPLIT**2, axis=0)
        width_m /= SPLIT
        value = log_likelihood(point_m)
        allowed = np.isfinite(value)
        centre_m, point_m = centre_m[allowed], point_m[allowed]
        cell_m, value = cell_m[allowed], value[allowed]
    xy_m, cell_m, widths_m, value = (np.concatenate(parts) for parts in zip(*done, strict=True))
    mass = widths_m**2 * np.exp(likelihood_power * (value - value.max()))
    return Posterior(xy_m, cell_m, widths_m, value, mass / mass.sum())
