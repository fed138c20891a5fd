"""Search space: where devices may be, and the likelihood of their data over the whole map."""

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

Bounds = tuple[float, float, float, float]  # x_min, x_max, y_min, y_max [m]
DIRECT_SAVING = 8  # times fewer links where predicting one takes ten times longer than a look-up
# Points of a cell that are tried for one where a device may be, from its centre, in cell widths.
POINTS_OF_CELL = np.array([[0, 0], [0.35, 0], [-0.35, 0], [0, 0.35], [0, -0.35],
                           [0.35, 0.35], [-0.35, 0.35], [0.35, -0.35], [-0.35, -0.35]])


@dataclass(frozen=True)
class Scan:
    """Log-likelihoods over a grid of square cells, which covers the bounds.

    Cells without a point where a device may be are left out.

    Attributes:
        centre_m: (c, 2) centres of the cells [m].
        width_m: of every cell [m].
        point_m: (c, 2) point of each cell where a device may be, at which it was evaluated [m].
        value: (k, c) log-likelihood of each of the search's devices [nats].
    """

    centre_m: np.ndarray
    width_m: float
    point_m: np.ndarray
    value: np.ndarray


class Search:
    """Devices of one height, with their data, on a map.

    Attributes:
        devices: (k,) indices in `Observations.devices`, by which the methods identify them.
        z_m: height of the devices [m].
        likelihood: of their data.
    """

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
    ) -> None:
        """Prepare the search for some devices.

        Args:
            observations: of all devices.
            channel: fitted.
            devices: (k,) indices in `observations.devices` of those at `z_m`.
            z_m: their height [m].
            bounds: within which they are.
            city: 3D map; None: every link has line of sight.
            limit_db: limit of detection [dB]; None: unknown.
            settings: of the search.
            rng: random state, which is drawn from.
        """
        self.devices, self.z_m = devices, z_m
        self._bounds, self._city, self._settings = bounds, city, settings
        index = np.array([observations.devices[k].device for k in devices])
        links = tabulate(channel, observations.receiver_m, z_m, bounds, index, rng)
        self._direct = isinstance(links, DirectChannel)
        self.likelihood = Likelihood(observations, links, devices, z_m, city, limit_db,
                                     settings.chunk_links)

    def allowed(self, xy_m: np.ndarray) -> np.ndarray:
        """Return whether (p,) a device may be at positions (p, 2) [m]."""
        x_min, x_max, y_min, y_max = self._bounds
        x, y = xy_m.T
        allowed = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        if self._city is not None and not self._settings.allow_indoor and allowed.any():
            at = np.column_stack([xy_m[allowed], np.full(allowed.sum(), self.z_m)])
            allowed[allowed] = ~self._city.inside(at)
        return allowed

    def log_likelihood(self, k: int, xy_m: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of one device's data at positions.

        Args:
            k: index in `Observations.devices`.
            xy_m: (p, 2) [m].

        Returns:
            (p,) [nats]; -inf where the device may not be.
        """
        value = np.full(len(xy_m), -np.inf)
        allowed = self.allowed(xy_m)
        value[allowed] = self.likelihood.of_device(k, xy_m[allowed])
        return value

    def scan(self, coarser: float = 1.0) -> Scan:
        """Evaluate every device's log-likelihood over the whole map.

        The cells are as small as the settings' number of links allows.

        Args:
            coarser: factor on the width of the cells.

        Returns:
            log-likelihoods

        Raises:
            BadInput: there is no point outside buildings.
        """
        x_min, x_max, y_min, y_max = self._bounds
        links = self._settings.scan_links // (DIRECT_SAVING if self._direct else 1)
        area = (x_max - x_min) * (y_max - y_min)
        width = max(self._settings.scan_step_m,
                    np.sqrt(area * len(self.likelihood.receiver_m) / links)) * coarser
        axes = _centres(x_min, x_max, width), _centres(y_min, y_max, width)
        centre = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        point, placed = centre.copy(), np.zeros(len(centre), bool)
        for offset in POINTS_OF_CELL * width:
            todo = np.flatnonzero(~placed)
            tried = centre[todo] + offset
            good = self.allowed(tried)
            point[todo[good]], placed[todo[good]] = tried[good], True
        if not placed.any():
            raise BadInput(
                f"no position for a device at height {self.z_m} m within x {x_min} … {x_max} and y "
                f"{y_min} … {y_max} m: all of it is inside buildings; widen the bounds, check the "
                "heights, or set allow_indoor")
        centre, point = centre[placed], point[placed]
        return Scan(centre, width, point, self.likelihood.of_all(point))


def _centres(low: float, high: float, width: float) -> np.ndarray:
    """Return centres, all inside, of cells that cover an interval and overhang both ends alike."""
    n = max(1, int(np.ceil((high - low) / width - 1e-9)))
    return (low + high) / 2 + (np.arange(n) - (n - 1) / 2) * width
