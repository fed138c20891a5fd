"""Paths of links: power, directions at both ends and legs, from Sionna RT; kept so that effects need no trace.

A second search, two interactions deep and with few rays, follows what rough walls scatter. Scattered
paths are many and weak: those that leave in one eighth of the horizon are kept as one.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from radiotwin.trace.solver import candidate_search, import_sionna, load_city
from tests.undeclared.foreign.worlds import Settings

MOST_PATHS, WEAKEST_DB = 8, -25.0  # of a link, below its strongest
SECTORS = 8
SCATTERED_RAYS = 1_000
RECEIVERS = 140  # of a call
TABLE_SIZE, DIFFRACTION_SHARE = 3_000_017, 0.4
LIGHT_M_S = 299_792_458.0


@dataclass(frozen=True, eq=False)
class Paths:
    """q paths of links; those of one link stand together, the strongest first.

    Attributes:
        link: (q,) index of the link.
        power_db: (q,) received over transmitted power [dB].
        leaves_rad, arrives_rad: (q, 2) elevation and azimuth (counter-clockwise from east) of the
            directions from the device and from the receiver into the path [rad].
        first_m, last_m: (q,) lengths of the first and the last leg [m].
        bounces: (q,) number of interactions; a path without one is direct.
    """

    link: np.ndarray
    power_db: np.ndarray
    leaves_rad: np.ndarray
    arrives_rad: np.ndarray
    first_m: np.ndarray
    last_m: np.ndarray
    bounces: np.ndarray


class Tracer:
    """Sionna RT on one city as it stands."""

    def __init__(self, xml_path: Path, frequency_hz: float, settings: Settings):
        self._city = load_city(xml_path, frequency_hz)
        rt = import_sionna()
        self._solver = rt.PathSolver(deterministic=True)
        self._device = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._receivers = [rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0]) for i in range(RECEIVERS)]
        for end in (self._device, *self._receivers):
            self._city.add(end)
        self._frequency_hz = frequency_hz
        common = {"refraction": False, "max_num_paths_per_src": 600_000}
        self._specular = common | {"max_depth": settings.max_depth, "samples_per_src": settings.rays,
                                   "diffraction": True, "seed": 4242}
        self._scattered = common | {"max_depth": 2, "samples_per_src": SCATTERED_RAYS, "los": False,
                                    "specular_reflection": False, "diffuse_reflection": True,
                                    "diffraction": False, "seed": 99}
        self._scatters = settings.scattering > 0

    def paths(self, device_m: np.ndarray, points_m: np.ndarray) -> Paths:
        """Trace the links from a device (3,) to points (n, 3) [m]."""
        import drjit

        parts = []
        for start in range(0, len(points_m), RECEIVERS):
            some_m = points_m[start:start + RECEIVERS]
            found = self._call(device_m, some_m, self._specular)
            if self._scatters:
                found = [np.concatenate(pair) for pair in
                         zip(found, _gather(self._call(device_m, some_m, self._scattered)))]
            found = _strongest(found)
            found[0] = found[0] + start
            parts.append(found)
        drjit.flush_malloc_cache()
        return Paths(*(np.concatenate(column) for column in zip(*parts)))

    def _call(self, device_m: np.ndarray, points_m: np.ndarray, settings: dict) -> list[np.ndarray]:
        """Columns of `Paths` of one call."""
        self._device.position = [float(value) for value in device_m]
        last = len(points_m) - 1
        for number, receiver in enumerate(self._receivers):  # a call that is not full repeats its last point
            receiver.position = [float(value) for value in points_m[min(number, last)]]
        with candidate_search(TABLE_SIZE, DIFFRACTION_SHARE):
            paths = self._solver(self._city, **settings)
        length_m = LIGHT_M_S * np.array(paths.tau, dtype=float).reshape(RECEIVERS, -1)
        real, imaginary = (np.array(part, dtype=float).reshape(RECEIVERS, -1) for part in paths.a)
        power = real**2 + imaginary**2
        kinds = np.array(paths.interactions)
        kinds = kinds.reshape(len(kinds), RECEIVERS, -1)
        corners_m = np.array(paths.vertices).reshape(*kinds.shape, 3)
        del paths
        link, path = np.nonzero((length_m[:len(points_m)] > 0) & (power[:len(points_m)] > 0))
        kinds, corners_m = kinds[:, link, path], corners_m[:, link, path].astype(float)
        bounces = (kinds > 0).sum(axis=0)
        a_m, b_m = np.broadcast_to(device_m, (len(link), 3)), points_m[link]
        pick = np.arange(len(link))
        direct = bounces == 0
        first_m = np.where(direct[:, None], b_m, corners_m[0] if len(corners_m) else b_m)
        last_m = np.where(direct[:, None], a_m, corners_m[np.maximum(bounces - 1, 0), pick] if len(corners_m) else a_m)
        columns = [link, power[link, path], _angles(first_m - a_m), _angles(last_m - b_m),
                   np.linalg.norm(first_m - a_m, axis=1), np.linalg.norm(last_m - b_m, axis=1), bounces]
        # Sionna RT may return a direct path many times over, with a power or a length that is not its own.
        space = (LIGHT_M_S / (4 * np.pi * self._frequency_hz * np.linalg.norm(a_m - b_m, axis=1)))**2
        true = ~direct | (np.abs(10 * np.log10(columns[1] / space)) < 0.2)
        keys = np.column_stack([link, bounces, (length_m[link, path] * 100).round(), kinds.T.astype(float),
                                (columns[2] * 500).round(), (columns[3] * 500).round()])
        keys[direct, 2:] = 0
        once = np.zeros(len(link), dtype=bool)
        chosen = np.flatnonzero(true)
        if len(chosen):
            once[chosen[np.unique(keys[chosen], axis=0, return_index=True)[1]]] = True
        return [column[once] for column in columns]


def _angles(ways_m: np.ndarray) -> np.ndarray:
    """(q, 2) elevation and azimuth of vectors (q, 3) [rad]."""
    return np.column_stack([np.arctan2(ways_m[:, 2], np.hypot(ways_m[:, 0], ways_m[:, 1])),
                            np.arctan2(ways_m[:, 1], ways_m[:, 0])])


def _gather(found: list[np.ndarray]) -> list[np.ndarray]:
    """Make one path of all that leave in one sector: the sum of their powers along the strongest of them."""
    link, power, leaves = found[:3]
    if not len(link):
        return found
    sector = ((leaves[:, 1] + np.pi) / (2 * np.pi) * SECTORS).astype(int).clip(0, SECTORS - 1)
    order = np.lexsort((-power, sector, link))
    _, first, group = np.unique((link * SECTORS + sector)[order], return_index=True, return_inverse=True)
    gathered = [column[order][first] for column in found]
    gathered[1] = np.bincount(group.reshape(-1), power[order])
    return gathered


def _strongest(found: list[np.ndarray]) -> list[np.ndarray]:
    """Keep the strongest paths of each link, raised so that they carry the power of all; powers become decibels."""
    order = np.lexsort((-found[1], found[0]))
    link, power, *others = (column[order] for column in found)
    if not len(link):
        return [link, power, *others]
    _, first, group = np.unique(link, return_index=True, return_inverse=True)
    group = group.reshape(-1)
    keep = (np.arange(len(link)) - first[group] < MOST_PATHS) & (power >= power[first][group] * 10**(WEAKEST_DB / 10))
    raised = np.bincount(group, power) / np.bincount(group, power * keep)
    return [link[keep], 10 * np.log10(power * raised[group])[keep], *(column[keep] for column in others)]
