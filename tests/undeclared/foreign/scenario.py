"""A campaign's links before anything is hidden, and what a hidden effect may change."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tests.undeclared.foreign.layouts import Building
from tests.undeclared.foreign.paths import LIGHT_M_S, Paths
from tests.undeclared.foreign.store import load
from tests.undeclared.foreign.worlds import World, world
from tests.undeclared.shapes import blocked


@dataclass(frozen=True, eq=False)
class Hidden:
    """One hidden effect: its entry in the answer, and what it changes; n links, q paths, p points, k devices.

    Attributes:
        name: of the catalogue, or one of its own.
        in_catalogue: whether the catalogue has that name.
        truth: true parameters, their units in their names.
        path_db: (q,) added to each path [dB].
        air_db: (n,) added to what arrives [dB].
        adds_db: (n,) power that adds to what arrives, as a gain [dB].
        reads: what a receiver makes of the levels that arrive (n,) [dB].
        lost: (n,) bool, links that come out blank.
        written_m: (p, 3) positions of the receivers as they are written down [m].
        device_m: (k, 3) positions of the devices as they are declared [m].
        map_lacks: indices of buildings of the plan that the map lacks.
        map_shows: buildings that the map shows although they are gone.
    """

    name: str
    in_catalogue: bool
    truth: dict
    path_db: np.ndarray | None = None
    air_db: np.ndarray | None = None
    adds_db: np.ndarray | None = None
    reads: Callable[[np.ndarray], np.ndarray] | None = None
    lost: np.ndarray | None = None
    written_m: np.ndarray | None = None
    device_m: np.ndarray | None = None
    map_lacks: tuple[int, ...] = ()
    map_shows: tuple[Building, ...] = ()


@dataclass(frozen=True, eq=False)
class Scenario:
    """Links of a world: k declared devices, p points, n = k p links (device by device), q paths.

    Attributes:
        where: the world.
        paths: of the declared devices' links.
        spare_db: (p,) gain from the device that nobody declares; -inf where there is no path [dB].
    """

    where: World
    paths: Paths
    spare_db: np.ndarray

    @classmethod
    def of(cls, name: str) -> "Scenario":
        """Read a traced world."""
        where, paths = world(name), load(name)
        points, devices = len(where.campaign.points_m), len(where.device_m) - 1
        is_spare = paths.link >= devices * points
        columns = {key: getattr(paths, key) for key in Paths.__dataclass_fields__}
        spare_db = _sums_db(columns["link"][is_spare] - devices * points, columns["power_db"][is_spare], points)
        return cls(where, Paths(**{key: column[~is_spare] for key, column in columns.items()}), spare_db)

    @property
    def points(self) -> int:
        return len(self.where.campaign.points_m)

    @property
    def devices(self) -> int:
        return len(self.where.device_m) - 1

    @property
    def links(self) -> int:
        return self.points * self.devices

    @cached_property
    def device(self) -> np.ndarray:
        """(n,) number of each link's device."""
        return np.repeat(np.arange(self.devices), self.points)

    @cached_property
    def point(self) -> np.ndarray:
        """(n,) number of each link's point."""
        return np.tile(np.arange(self.points), self.devices)

    def of_links(self, name: str) -> np.ndarray:
        """(n,) a column of the campaign, for links."""
        return getattr(self.where.campaign, name)[self.point]

    @cached_property
    def plain_db(self) -> np.ndarray:
        """(n,) gain with nothing hidden, -inf where there is no path [dB]."""
        return self.arriving_db([])

    def arriving_db(self, hidden: list[Hidden]) -> np.ndarray:
        """(n,) level at the receivers' antennas' outputs, as a gain [dB]."""
        power_db = self.paths.power_db + sum(one.path_db for one in hidden if one.path_db is not None)
        level_db = _sums_db(self.paths.link, power_db, self.links)
        level_db = level_db + sum(one.air_db for one in hidden if one.air_db is not None)
        for one in hidden:
            if one.adds_db is not None:
                with np.errstate(divide="ignore"):
                    level_db = 10 * np.log10(10**(level_db / 10) + 10**(one.adds_db / 10))
        return level_db

    @cached_property
    def standing(self) -> list[Building]:
        """Buildings as they stand."""
        return [one for one in self.where.true if one is not None]

    def rough_db(self, device_m: np.ndarray, points_m: np.ndarray, buildings: list[Building]) -> np.ndarray:
        """(n,) free space, less the median excess loss of shadowed links where a building is in between [dB].

        It says how much a wrong map or position matters, which no trace tells.
        """
        a_m, b_m = np.repeat(device_m, len(points_m), axis=0), np.tile(points_m, (len(device_m), 1))
        distance_m = np.linalg.norm(a_m - b_m, axis=1)
        space_db = 20 * np.log10(LIGHT_M_S / (4 * np.pi * self.where.frequency_hz * np.maximum(distance_m, 1)))
        return space_db - self._shadow_db * blocked(buildings, a_m, b_m)

    @cached_property
    def direct(self) -> np.ndarray:
        """(n,) bool, whether a direct path arrives."""
        found = np.zeros(self.links, dtype=bool)
        found[self.paths.link[self.paths.bounces == 0]] = True
        return found

    @cached_property
    def _shadow_db(self) -> float:
        way_m = self.where.device_m[self.device] - self.where.campaign.points_m[self.point]
        space_db = 20 * np.log10(LIGHT_M_S / (4 * np.pi * self.where.frequency_hz * np.linalg.norm(way_m, axis=1)))
        shadowed = ~self.direct & np.isfinite(self.plain_db)
        return float(np.median((space_db - self.plain_db)[shadowed])) if shadowed.any() else 20.0


def _sums_db(link: np.ndarray, power_db: np.ndarray, links: int) -> np.ndarray:
    """(links,) sums of powers [dB]; -inf where there is no path."""
    with np.errstate(divide="ignore"):
        return 10 * np.log10(np.bincount(link, 10**(power_db / 10), links))
