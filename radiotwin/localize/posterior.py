"""From log-likelihoods over the map to an estimate, its credible radius, and a second mode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

CREDIBLE_MASS = 0.9
SPLIT = 5  # a cell becomes SPLIT x SPLIT cells
MAX_SPLIT_CELLS = 80
FINEST_M = 0.3
MODE_FLOOR = 1e-3
MODE_WEIGHT = 0.05
MODE_SEPARATION_M = 20.0


@dataclass(frozen=True)
class Posterior:
    """Square cells that tile the part of the map where a device may be, small where the likelihood is high.

    xy_m: (c, 2) a point of each where a device may be; cell_m: (c, 2) centre of the cell of the scan that it is in
    or is; width_m: (c,); log_likelihood: (c,) [nats]; mass: (c,) posterior probability under a uniform prior, with
    the likelihood tempered; sums to 1.
    """

    xy_m: np.ndarray
    cell_m: np.ndarray
    width_m: np.ndarray
    log_likelihood: np.ndarray
    mass: np.ndarray

    def radius(self, xy_m: np.ndarray) -> float:
        """Radius [m] about a position (2,) that holds CREDIBLE_MASS."""
        distance = np.linalg.norm(self.xy_m - xy_m, axis=1)
        # The mass of a cell is spread over it: half of it is nearer than its centre, half farther.
        spread = np.concatenate([distance - self.width_m / 4, distance + self.width_m / 4])
        order = np.argsort(spread)
        enough = np.searchsorted(np.cumsum(np.tile(self.mass, 2)[order] / 2), CREDIBLE_MASS * (1 - 1e-9))
        return float(spread[order][enough])

    def region_share(self) -> float:
        """Share of the area that the smallest region with CREDIBLE_MASS covers: 0.9 for a flat posterior."""
        area = self.width_m**2
        order = np.argsort(-self.mass / area)
        inside = np.searchsorted(np.cumsum(self.mass[order]), CREDIBLE_MASS * (1 - 1e-9)) + 1
        return float(area[order][:inside].sum() / area.sum())

    def modes(self, allowed: Callable[[np.ndarray], np.ndarray]) -> list[tuple[np.ndarray, float]]:
        """Position (2,) and weight of each separate mode, heaviest first.

        A mode is a connected patch of the scan's grid whose cells hold at least MODE_FLOOR of what the heaviest
        holds. Its position is the mean over it under the likelihood as it is: tempering widens a posterior, it does
        not move a composite likelihood's estimate. Where a device may not be at the mean (`allowed`: (p, 2) to (p,)
        bool), or a crescent's mean falls beside it, it is the patch's most likely point.
        """
        column, row = np.round((self.cell_m - self.cell_m.min(axis=0)) / self.width_m.max()).astype(int).T
        grid = np.zeros((row.max() + 1, column.max() + 1))
        np.add.at(grid, (row, column), self.mass)
        patches, _ = label(grid >= MODE_FLOOR * grid.max(), structure=np.ones((3, 3)))
        patch = patches[row, column]
        weights = np.bincount(patch, self.mass)
        weights[0] = 0.0
        found = []
        for k in np.argsort(-weights)[: np.count_nonzero(weights)]:
            mine = patch == k
            height = self.log_likelihood[mine]
            share = self.width_m[mine] ** 2 * np.exp(height - height.max())
            mean = share @ self.xy_m[mine] / share.sum()
            beside = np.abs(self.cell_m[mine] - mean).max(axis=1).min() > self.width_m.max() / 2
            if beside or not allowed(mean[None])[0]:
                mean = self.xy_m[mine][height.argmax()]
            found.append((mean, float(weights[k])))
        return found


def second_mode(modes: list[tuple[np.ndarray, float]]) -> tuple[float, float, float] | None:
    """(x_m, y_m, weight) of the heaviest other mode at least MODE_SEPARATION_M away, if it has MODE_WEIGHT."""
    first = modes[0][0]
    for xy_m, weight in modes[1:]:
        if weight >= MODE_WEIGHT and np.linalg.norm(xy_m - first) >= MODE_SEPARATION_M:
            return float(xy_m[0]), float(xy_m[1]), weight
    return None


def refine(
    log_likelihood: Callable[[np.ndarray], np.ndarray],
    centre_m: np.ndarray,
    point_m: np.ndarray,
    value: np.ndarray,
    width_m: float,
    peaks_m: np.ndarray,
    likelihood_power: float,
) -> Posterior:
    """Splits the cells of a scan that matter until they are below FINEST_M, and weighs all.

    log_likelihood: of positions (p, 2), -inf where a device may not be; centre_m: (c, 2) centres of the scan's cells
    of width_m, point_m: (c, 2) and value: (c,) where in each the log-likelihood was evaluated and what it is there;
    peaks_m: (s, 2) positions whose cells are split whatever their value, because a peak may be narrower than a cell;
    likelihood_power: power of the likelihood, at most 1.
    """
    cell_m = centre_m
    done = []
    while True:
        split = np.zeros(len(value), bool)
        if width_m > FINEST_M:
            split[np.argsort(-value)[:MAX_SPLIT_CELLS]] = True
            for peak in peaks_m:
                split |= np.abs(centre_m - peak).max(axis=1) <= width_m / 2 * (1 + 1e-6)
        done.append((point_m[~split], cell_m[~split], np.full((~split).sum(), width_m), value[~split]))
        if not split.any():
            break
        offset = ((np.arange(SPLIT) + 0.5) / SPLIT - 0.5) * width_m
        offsets = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
        centre_m = point_m = (centre_m[split][:, None] + offsets).reshape(-1, 2)
        cell_m = np.repeat(cell_m[split], SPLIT**2, axis=0)
        width_m /= SPLIT
        value = log_likelihood(point_m)
        allowed = np.isfinite(value)
        centre_m, point_m, cell_m, value = (
            centre_m[allowed],
            point_m[allowed],
            cell_m[allowed],
            value[allowed],
        )
    xy_m, cell_m, widths_m, value = (np.concatenate(each) for each in zip(*done, strict=True))
    mass = widths_m**2 * np.exp(likelihood_power * (value - value.max()))
    return Posterior(xy_m, cell_m, widths_m, value, mass / mass.sum())
