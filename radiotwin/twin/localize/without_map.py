"""Locate devices by a fitted model with effects, with or without a 3D map.

Each device has a posterior over the ground: the likelihood of its links, with the effects of their
receivers. The device's own unknown level (hand, pocket, battery) is integrated out by Gauss-Hermite
quadrature. The prior is uniform over the area. Cells are first coarse, then fine where the
probability is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from radiotwin.links import Links
from radiotwin.twin.localize.estimate import CREDIBLE, TwinDevice
from radiotwin.twin.model.model import Fit, FittedModel

COARSE_CELLS, MAX_FINE_CELLS, MAX_SPLIT = 1500, 640, 4  # the last: fine cells along a coarse one
HELD = 0.999  # probability of the coarse cells that are split
NODES = 7  # quadrature nodes over the device's own level
MIN_LINKS = 3  # links needed to locate a device
MARGIN_M = 300.0  # of the area around all known positions
LINKS_AT_ONCE = 400_000  # links in all cells predicted at a time: 260 bytes each without a map

Area = tuple[float, float, float, float]
"""West, east, south and north end of where devices may be [m]."""


@dataclass(frozen=True, eq=False)
class PositionPosterior:
    """Log-likelihood of one device's links over the cells that hold nearly all probability.

    Attributes:
        device: name of the device.
        cells_m: (c, 2) centres of the cells [m].
        width_m: width of the cells [m].
        log_likelihood: (c,) log-likelihood of the device's links in each cell [nats].
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
    def of(cls, model: FittedModel, device_links: Links, area_m: Area, power: float
           ) -> PositionPosterior:
        """Compute the log-likelihood of a device's position, on coarse cells, then on fine ones.

        Fine cells are chosen by that power of the likelihood.
        """
        coarse_m, width_m = _grid(area_m)
        coarse = position_log_likelihood(model, device_links, coarse_m)
        cells_m, width_m = _finer(coarse, power, coarse_m, width_m)
        device = int(device_links.device[0])
        return cls(device_links.device_names[device], cells_m, width_m,
                   position_log_likelihood(model, device_links, cells_m), cdist(cells_m, cells_m),
                   float(device_links.device_m[device, 2]))

    def estimate(self, power: float) -> TwinDevice:
        """Return the device at the position of least expected distance, with a 90 % radius.

        The likelihood is raised to `power`, at most 1, for the radius only: lower powers widen it.
        """
        best = int((self.apart_m @ _normalised(self.log_likelihood)).argmin())
        order = np.argsort(self.apart_m[best])
        cumulated = np.cumsum(_normalised(power * self.log_likelihood)[order])
        reached = int(np.searchsorted(cumulated, CREDIBLE))
        radius_m = self.apart_m[best][order[min(reached, len(order) - 1)]] + self.width_m / 2
        x_m, y_m = self.cells_m[best].tolist()
        return TwinDevice(self.device, x_m, y_m, self.z_m, "unknown", True, float(radius_m), None)


def locate(model: FittedModel, links: Links, area_m: Area,
           on_progress: Callable[[], None] = lambda: None) -> Iterator[TwinDevice]:
    """Locate each device of the links with at least `MIN_LINKS` links; its height is declared.

    The model's receiver indices are those of the links. `on_progress` is called after each device.
    """
    for device in np.unique(links.device):
        device_links = links.select(links.device == device)
        if len(device_links) >= MIN_LINKS:
            power = model.likelihood_power
            found = PositionPosterior.of(model, device_links, area_m, power).estimate(power)
            yield replace(found, credible_radius_m=model.radius_factor * found.credible_radius_m)
        on_progress()


def whole_area(model: FittedModel, links: Links) -> Area:
    """Return the bounds of all receivers and known devices, plus MARGIN_M."""
    known = np.vstack([links.receiver_m[:, :2], model.device_m[:, :2]])
    (west, south), (east, north) = known.min(axis=0) - MARGIN_M, known.max(axis=0) + MARGIN_M
    return west, east, south, north


def position_log_likelihood(model: FittedModel, device_links: Links,
                            positions_m: np.ndarray) -> np.ndarray:
    """Return the log-likelihood (c,) [nats] of one device's links by position (c, 2) [m]."""
    cells = max(LINKS_AT_ONCE // len(device_links), 1)
    return np.concatenate([
        _log_likelihood_at(model, device_links, positions_m[first:first + cells])
        for first in range(0, len(positions_m), cells)])


def _log_likelihood_at(model: FittedModel, device_links: Links, positions_m: np.ndarray
                       ) -> np.ndarray:
    """Compute `position_log_likelihood`, integrated over the device's unknown level."""
    n, cells, sd_db = len(device_links), len(positions_m), model.device_sd_db
    fit = fit_elsewhere(model, device_links, positions_m)
    problem = fit.model.regression()
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES if sd_db > 0 else 1)
    values = []
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        moved = replace(problem, gain_db=problem.gain_db + node * sd_db)
        values.append(np.log(weight) - moved.nll(fit).reshape(cells, n).sum(axis=1))
    return np.logaddexp.reduce(values, axis=0)


def fit_elsewhere(model: FittedModel, device_links: Links, positions_m: np.ndarray) -> Fit:
    """Apply a model to one device's n links, at each of its candidate positions (c, 2) [m].

    The device keeps its height. The result has c * n links, positions slowest.
    """
    n, cells, known = len(device_links), len(positions_m), len(model.device_m)
    height_m = np.full(cells, device_links.device_m[device_links.device[0], 2])
    candidates_m = np.column_stack([positions_m, height_m])
    # Effects refer to devices by their rows in the model, so candidates are appended to these.
    repeated = device_links.select(np.tile(np.arange(n), cells)).of_devices(
        known + np.repeat(np.arange(cells), n), np.vstack([model.device_m, candidates_m]),
        [f"device {i}" for i in range(known + cells)], frozenset())
    repeated = repeated.with_ends(flown=replace(repeated.ends.flown, first_s=model.first_s))
    return model.on_links(repeated)


def _finer(log_likelihood: np.ndarray, power: float, coarse_m: np.ndarray,
           width_m: float) -> tuple[np.ndarray, float]:
    """Split the coarse cells that hold the probability HELD; return fine ones (c, 2), width [m]."""
    probability = _normalised(power * log_likelihood)
    order = np.argsort(-probability)
    held = order[:int(np.searchsorted(np.cumsum(probability[order]), HELD)) + 1]
    split = int(np.clip(np.sqrt(MAX_FINE_CELLS / len(held)), 1, MAX_SPLIT))
    steps_m = (np.arange(split) + 0.5) * width_m / split - width_m / 2
    around_m = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)
    return (coarse_m[held, None] + around_m).reshape(-1, 2), width_m / split


def _normalised(log_likelihood: np.ndarray) -> np.ndarray:
    """Normalise log-likelihoods (c,) [nats] to probabilities."""
    share = np.exp(log_likelihood - log_likelihood.max())
    return share / share.sum()


def _grid(area_m: Area) -> tuple[np.ndarray, float]:
    """Cover an area (west, east, south, north) by COARSE_CELLS cells: centres (c, 2), width [m]."""
    west, east, south, north = area_m
    width_m = max(np.sqrt((east - west) * (north - south) / COARSE_CELLS), 1.0)
    x, y = (np.arange(low + width_m / 2, high + width_m / 2, width_m)
            for low, high in ((west, east), (south, north)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), width_m
