"""The map as the place of the search: where devices may be, and how well each place is_cause the data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.localize.estimate import LocalizeSettings
from radiotwin.localize.likelihood import Likelihood
from radiotwin.localize.link_table import Channel, DirectChannel, tabulate
from radiotwin.localize.observations import Observations

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

Bounds = tuple[float, float, float, float]
DIRECT_SAVING = 8  # predicting a link takes some ten times longer than looking it up
# Where in a cell a device might stand if not at its centre, in cell widths.
ELSEWHERE = np.array([[0, 0], [0.35, 0], [-0.35, 0], [0, 0.35], [0, -0.35],
                      [0.35, 0.35], [-0.35, 0.35], [0.35, -0.35], [-0.35, -0.35]])  # fmt: skip


@dataclass(frozen=True)
class Scan:
    """Log-likelihoods over a grid of square cells, which covers the bounds.

    centre_m: (c, 2) of the cells; width_m: of each; point_m: (c, 2) where in the cell it was evaluated: a place
    where a device may be; value: one (c,) array for each of the search's devices. Cells without such a place are
    not in it.
    """

    centre_m: np.ndarray
    width_m: float
    point_m: np.ndarray
    value: np.ndarray


class Search:
    """Devices of one height, with their data, in a map."""

    def __init__(
        self,
        observations: Observations,
        channel: Channel,
        devices: np.ndarray,
        z_m: float,
        bounds: Bounds,
        city: CityMap | None,
        limit_db: float | None,
        settings: LocalizeSettings,
        rng: np.random.Generator,
    ):
        """devices: (k,) positions in observations.devices of those at z_m [m], by which the methods know
        them. Draws from rng."""
        self.devices, self.z_m = devices, z_m
        self._bounds, self._city, self._settings = bounds, city, settings
        known_as = np.array([observations.devices[k].device for k in devices])
        links = tabulate(channel, observations.receiver_m, z_m, bounds, known_as, rng)
        self._direct = isinstance(links, DirectChannel)
        self.likelihood = Likelihood(observations, links, devices, z_m, city, limit_db, settings.chunk_links)

    def allowed(self, xy_m: np.ndarray) -> np.ndarray:
        """(p,) bool: whether a device may be at positions (p, 2)."""
        x_min, x_max, y_min, y_max = self._bounds
        x, y = xy_m.T
        allowed = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        if self._city is not None and not self._settings.allow_indoor and allowed.any():
            at = np.column_stack([xy_m[allowed], np.full(allowed.sum(), self.z_m)])
            allowed[allowed] = ~self._city.inside(at)
        return allowed

    def log_likelihood(self, k: int, xy_m: np.ndarray) -> np.ndarray:
        """(p,) [nats] of one device's data at positions (p, 2); -inf where it may not be."""
        value = np.full(len(xy_m), -np.inf)
        allowed = self.allowed(xy_m)
        value[allowed] = self.likelihood.of_device(k, xy_m[allowed])
        return value

    def scan(self, coarser: float = 1.0) -> Scan:
        """Every device's log-likelihood over the whole map, in cells as small as the settings' number of links
        allows, times `coarser`.

        Raises BadInput where buildings leave no place for a device.
        """
        x_min, x_max, y_min, y_max = self._bounds
        links = self._settings.scan_links // (DIRECT_SAVING if self._direct else 1)
        area = (x_max - x_min) * (y_max - y_min)
        width = (
            max(self._settings.scan_step_m, np.sqrt(area * len(self.likelihood.receiver_m) / links)) * coarser
        )
        centre = np.stack(
            np.meshgrid(_centres(x_min, x_max, width), _centres(y_min, y_max, width)), axis=-1
        ).reshape(-1, 2)
        point, placed = centre.copy(), np.zeros(len(centre), bool)
        for offset in ELSEWHERE * width:
            todo = np.flatnonzero(~placed)
            tried = centre[todo] + offset
            good = self.allowed(tried)
            point[todo[good]], placed[todo[good]] = tried[good], True
        if not placed.any():
            raise BadInput(
                f"no place for a device at height {self.z_m} m within x {x_min} … {x_max} and y {y_min} … {y_max} "
                "m: all of it is inside buildings; widen the bounds, check the heights, or set allow_indoor"
            )
        centre, point = centre[placed], point[placed]
        return Scan(centre, width, point, self.likelihood.of_all(point))


def _centres(low: float, high: float, width: float) -> np.ndarray:
    """Centres of the cells that cover an interval, overhanging both ends alike: each is inside it."""
    n = max(1, int(np.ceil((high - low) / width - 1e-9)))
    return (low + high) / 2 + (np.arange(n) - (n - 1) / 2) * width
