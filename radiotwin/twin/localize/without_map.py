"""Devices of unknown position, by a channel with effects: for networks without a 3D map, too.

The posterior over the ground of each device by itself: the likelihood of its links, with everything
that was found of their receivers, and a level of the device's own that nobody knows (hand, pocket,
battery), which is integrated out (Gauss-Hermite). The prior is flat over the area; a coarse grid
first, then a finer one where the probability is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from radiotwin.links import Links
from radiotwin.twin.localize.estimate import TwinDevice
from radiotwin.twin.model.model import Fit, FittedModel

COARSE_CELLS, MAX_FINE_CELLS, MAX_SPLIT = 1500, 640, 4
HELD = 0.999  # of the probability, by the coarse cells that are split
NODES = 7  # of the quadrature over the device's own level
CREDIBLE = 0.9
MIN_LINKS = 3
MARGIN_M = 300.0  # of the area around all ends that are known
LINKS_AT_ONCE = 400_000  # of all cells together: bounds memory, 260 bytes each without a map

Area = tuple[float, float, float, float]
"""West, east, south and north end of where devices may be [m]."""


@dataclass(frozen=True, eq=False)
class PositionPosterior:
    """Likelihood of the links of one device over the cells where nearly all probability is.

    Attributes:
        device: its name.
        cells_m: (c, 2) their centres [m].
        width_m: their width [m].
        log_likelihood: (c,) of the links.
        apart_m: (c, c) distance between cells [m].
        z_m: height of the device [m].
    """

    device: str
    cells_m: np.ndarray
    width_m: float
    log_likelihood: np.ndarray
    apart_m: np.ndarray
    z_m: float

    @classmethod
    def of(cls, model: FittedModel, own: Links, area_m: Area, power: float
           ) -> PositionPosterior:
        """Return that of the links of one device; the cells hold the likelihood to a power."""
        coarse_m, width_m = _grid(area_m)
        coarse = position_log_likelihood(model, own, coarse_m)
        cells_m, width_m = _finer(coarse, power, coarse_m, width_m)
        device = int(own.device[0])
        return cls(own.device_names[device], cells_m, width_m,
                   position_log_likelihood(model, own, cells_m), cdist(cells_m, cells_m),
                   float(own.device_m[device, 2]))

    def estimate(self, power: float) -> TwinDevice:
        """Return the position by the likelihood as it is, and the radius by its power."""
        best = int((self.apart_m @ _share(self.log_likelihood)).argmin())
        order = np.argsort(self.apart_m[best])
        cumulated = np.cumsum(_share(power * self.log_likelihood)[order])
        reached = int(np.searchsorted(cumulated, CREDIBLE))
        radius_m = self.apart_m[best][order[min(reached, len(order) - 1)]] + self.width_m / 2
        x_m, y_m = self.cells_m[best].tolist()
        return TwinDevice(self.device, x_m, y_m, self.z_m, "unknown", True, float(radius_m), None)


def locate(model: FittedModel, links: Links, area_m: Area,
           on_progress: Callable[[], None] = lambda: None) -> Iterator[TwinDevice]:
    """Locate the devices of some links, whatever position the links have them at but for height.

    Args:
        model: counts receivers as `links` do.
        links: of the devices.
        area_m: where they may be.
        on_progress: called after each device.

    Yields:
        an estimate of each device with at least `MIN_LINKS` links.
    """
    for device in np.unique(links.device):
        own = links.select(links.device == device)
        if len(own) >= MIN_LINKS:
            power = model.likelihood_power
            found = PositionPosterior.of(model, own, area_m, power).estimate(power)
            yield replace(found, credible_radius_m=model.radius_factor * found.credible_radius_m)
        on_progress()


def whole_area(model: FittedModel, links: Links) -> Area:
    """Return the area around all ends that are known."""
    known = np.vstack([links.receiver_m[:, :2], model.device_m[:, :2]])
    (west, south), (east, north) = known.min(axis=0) - MARGIN_M, known.max(axis=0) + MARGIN_M
    return west, east, south, north


def position_log_likelihood(model: FittedModel, own: Links,
                            positions_m: np.ndarray) -> np.ndarray:
    """Return the log-likelihood (c,) of the links of one device, if it were elsewhere.

    Args:
        model: counts receivers as the links do.
        own: links of one device.
        positions_m: (c, 2) where it might be, at the height that the links have it [m].
    """
    cells = max(LINKS_AT_ONCE // len(own), 1)
    return np.concatenate([_log_likelihood_at(model, own, positions_m[first:first + cells])
                           for first in range(0, len(positions_m), cells)])


def _log_likelihood_at(model: FittedModel, own: Links, positions_m: np.ndarray) -> np.ndarray:
    """Return the same for few enough positions, all at once."""
    n, cells, sd_db = len(own), len(positions_m), model.device_sd_db
    fit = fit_elsewhere(model, own, positions_m)
    problem = fit.model.regression()
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES if sd_db > 0 else 1)
    values = []
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        moved = replace(problem, gain_db=problem.gain_db + node * sd_db)
        values.append(np.log(weight) - moved.nll(fit).reshape(cells, n).sum(axis=1))
    return np.logaddexp.reduce(values, axis=0)


def fit_elsewhere(model: FittedModel, own: Links, positions_m: np.ndarray) -> Fit:
    """Return a model on the links of one device, again for each position (c, 2) that it may have.

    Args:
        model: counts receivers as the links do.
        own: n links of one device.
        positions_m: where it might be, at the height that the links have it [m].

    Returns:
        of c * n links, positions slowest.
    """
    n, cells, known = len(own), len(positions_m), len(model.device_m)
    height_m = np.full(cells, own.device_m[own.device[0], 2])
    candidates_m = np.column_stack([positions_m, height_m])
    # Effects count devices as the model does, so the candidates come after those that it knows.
    every = own.select(np.tile(np.arange(n), cells)).of_devices(
        known + np.repeat(np.arange(cells), n), np.vstack([model.device_m, candidates_m]),
        [f"device {i}" for i in range(known + cells)], frozenset()).with_first_time(model.first_s)
    return model.on_links(every)


def _finer(log_likelihood: np.ndarray, power: float, coarse_m: np.ndarray,
           width_m: float) -> tuple[np.ndarray, float]:
    """Return centres (c, 2) of finer cells where nearly all probability is, and their width [m].

    The fewer coarse cells (k,) hold it, the finer.
    """
    share = _share(power * log_likelihood)
    order = np.argsort(-share)
    held = order[:int(np.searchsorted(np.cumsum(share[order]), HELD)) + 1]
    times = int(np.clip(np.sqrt(MAX_FINE_CELLS / len(held)), 1, MAX_SPLIT))
    steps_m = (np.arange(times) + 0.5) * width_m / times - width_m / 2
    around_m = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)
    return (coarse_m[held, None] + around_m).reshape(-1, 2), width_m / times


def _share(log_likelihood: np.ndarray) -> np.ndarray:
    share = np.exp(log_likelihood - log_likelihood.max())
    return share / share.sum()


def _grid(area_m: Area) -> tuple[np.ndarray, float]:
    """Return centres (c, 2) of the coarse cells, and their width [m]."""
    west, east, south, north = area_m
    width_m = max(np.sqrt((east - west) * (north - south) / COARSE_CELLS), 1.0)
    x, y = (np.arange(low + width_m / 2, high + width_m / 2, width_m)
            for low, high in ((west, east), (south, north)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), width_m
