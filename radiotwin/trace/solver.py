"""Gains of links by the paths that Sionna RT finds.

Paths of a link that Sionna RT returns more than once.

Sionna RT 2.2.0 does so in two ways. Its repeatable search sends the rays twice, to count candidate
paths and to store them. Some rays take another way the second time (in RBM, in one call of two in
fifteen, single ones of 100,000, from their third interaction on), so that their candidates are
counted but never written. Such a blank candidate is a direct path to the first receiver of the
call. It appeared up to 400 times, 26 dB too much, and has no direction of departure. And where the
meshes of two buildings share an edge, each of them diffracts the same ray at the same point.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.scene.antennas import Antenna
from radiotwin.trace.settings import DIFFRACTION_PROBABILITY, TABLE_SIZE, SolverSettings
from radiotwin.trace.sionna_scene import City, candidate_search, import_sionna, load_city

# Delays are single precision, with a unit roundoff of 6e-8, and sums of up to five segments.
_LENGTH_TOLERANCE = 1e-6  # relative
_SAME_POINT_M = 0.01  # as close as two surfaces must be to count as one
# Dr.Jit keeps freed memory for the next call, which needs the same sizes again but for the paths.
# Freed after every call, 40 % of the time goes into allocating it again; never, it may pile up.
_CALLS_BETWEEN_FLUSHES = 10
# A path is no stronger than free space over its own length; this much is left to rounding.
_BOUND_TOLERANCE_DB = 0.1
IMPOSSIBLE_DB = np.inf
"""Gain of a link that stays above what its own paths can carry."""
Antennas = tuple[Antenna | None, Antenna | None]


def distinct_paths(interactions: np.ndarray, vertices_m: np.ndarray, length_m: np.ndarray,
                   strength: np.ndarray, cos_turn: np.ndarray) -> np.ndarray:
    """Mark each path of each link once.

    Two paths are one if they have the same interactions in the same order at the same points, and
    the same length; of these the strongest is kept. Paths of one length over different points stay,
    as from two walls at equal distances. A link has one direct path.

    Args:
        interactions: (depth, n, k) types of interactions of k paths of n links, 0: none.
        vertices_m: (depth, n, k, 3) points of interaction [m].
        length_m: (n, k) length [m]; not positive where there is no path.
        strength: (n, k) magnitude of the field.
        cos_turn: (n, k) cosine of the angle between the directions of departure and of arrival,
            -1 for a straight line. A blank candidate has no direction of departure.

    Returns:
        (n, k) bool.
    """
    exists = length_m > 0
    used = interactions > 0
    direct = exists & ~used.any(axis=0)
    keep = exists & ~direct
    straightest = np.where(direct, cos_turn, np.inf).argmin(axis=1) if direct.any() else 0
    links = np.flatnonzero(direct.any(axis=1))
    keep[links, np.broadcast_to(straightest, len(direct))[links]] = True

    link, path = np.nonzero(exists & ~direct)
    types = np.ascontiguousarray(interactions[:, link, path].T)
    kind = np.unique(types, axis=0, return_inverse=True)[1].reshape(-1)
    length = length_m[link, path]
    order = np.lexsort((-strength[link, path], length, kind, link))
    link, path, kind, length = link[order], path[order], kind[order], length[order]
    point_m = np.where(used[..., None], vertices_m, 0.0)
    for shift in range(1, len(link)):
        near = ((link[shift:] == link[:-shift]) & (kind[shift:] == kind[:-shift])
                & (length[shift:] - length[:-shift] <= _LENGTH_TOLERANCE * length[shift:]))
        if not near.any():  # nor at a larger shift, as lengths rise within a link and kind
            break
        first = np.flatnonzero(near)
        second = first + shift
        apart_m = np.abs(point_m[:, link[first], path[first]]
                         - point_m[:, link[second], path[second]])
        same = apart_m.max(axis=(0, 2)) <= _SAME_POINT_M
        first, second = first[same], second[same]
        stronger = strength[link[first], path[first]] >= strength[link[second], path[second]]
        weaker = np.where(stronger, second, first)
        keep[link[weaker], path[weaker]] = False
    return keep


class PathGains:
    """Gains from one device to many points, found by shooting rays and the image method.

    Each call of Sionna RT has one device and a fixed number of points. So a gain does not depend on
    the other devices, nor, but for rare collisions in a hash table, on the other points; kernels
    are compiled once; and memory is bounded.

    Args:
        city: `city.xml` of a scene folder, or what `read_city` returns; None for free space.
        frequency_hz: Frequency [Hz].
        settings: Settings with solver `paths`.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: No usable libLLVM.
    """

    def __init__(self, city: City, frequency_hz: float, settings: SolverSettings) -> None:
        self.settings = settings
        self._calls = 0
        self._city = load_city(city, frequency_hz, settings.compute_device)
        rt = import_sionna(settings.compute_device)
        self._solver = rt.PathSolver(deterministic=True)
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._receivers = [rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0])
                           for i in range(settings.batch_receivers)]
        for radio_device in (self._transmitter, *self._receivers):
            self._city.add(radio_device)

    def batches(self, n: int) -> list[slice]:
        """Return the slices that `n` points are solved in."""
        step = self.settings.batch_receivers
        return [slice(start, min(start + step, n)) for start in range(0, n, step)]

    def solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None)
              ) -> np.ndarray:
        """Solve one batch.

        Rays are launched all around whatever the antennas. Each path then gets their gains in the
        directions in which it leaves and arrives, and stays vertically polarised, as a pattern of
        levels says nothing else.

        A path counts once (`radiotwin.trace.solver`), and carries no more than free space does
        over its own length between the peaks of the antennas. A link whose gain exceeds what all
        its paths can carry is solved again alone, with the next seed.

        Args:
            device_m: (3,) position [m].
            points_m: (n, 3) positions [m], n at most `settings.batch_receivers`.
            antennas: Antennas of the device and of the receivers; None: isotropic.

        Returns:
            (n,) gain [dB]; NaN where there is no path, `IMPOSSIBLE_DB` where the second solution
            exceeds its bound, too.
        """
        seed = self.settings.seed
        gain_db = self._solve(device_m, points_m, antennas, seed)
        for row in np.flatnonzero(gain_db == IMPOSSIBLE_DB):
            alone_m, other_seed = points_m[row:row + 1], (seed + 1) % 2**31
            gain_db[row] = self._solve(device_m, alone_m, antennas, other_seed)[0]
        return gain_db

    def _solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas, seed: int
               ) -> np.ndarray:
        """Solve once; `IMPOSSIBLE_DB` where a gain exceeds its bound."""
        import drjit

        settings = self.settings
        # A short batch is filled up with its last point: the same shapes run the same kernels
        padded_m = points_m[np.minimum(np.arange(settings.batch_receivers), len(points_m) - 1)]
        self._transmitter.position = [float(value) for value in device_m]
        for receiver, point_m in zip(self._receivers, padded_m):
            receiver.position = [float(value) for value in point_m]
        with candidate_search(TABLE_SIZE, DIFFRACTION_PROBABILITY):
            paths = self._solver(
                self._city, max_depth=settings.max_depth, samples_per_src=settings.samples_per_src,
                max_num_paths_per_src=settings.max_num_paths_per_src,
                refraction=settings.refraction, diffraction=settings.diffraction, seed=seed)
        power, bound = (sums[:len(points_m)] for sums in self._combine(paths, antennas))
        del paths
        self._calls += 1
        if self._calls % _CALLS_BETWEEN_FLUSHES == 0:
            drjit.flush_malloc_cache()
        possible = power <= bound * 10 ** (_BOUND_TOLERANCE_DB / 10)
        return np.where(possible, power_to_db(power), IMPOSSIBLE_DB)

    def gains(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None),
              advance: Callable[[int], None] = lambda n: None) -> np.ndarray:
        """Solve any number of points, batch by batch.

        Args:
            device_m: (3,) position [m].
            points_m: (n, 3) positions [m].
            antennas: As in `solve`.
            advance: Called with the number of points after each batch.

        Returns:
            (n,) gain [dB] as in `solve`.
        """
        gain_db = np.full(len(points_m), np.nan)
        for part in self.batches(len(points_m)):
            gain_db[part] = self.solve(device_m, points_m[part], antennas)
            advance(part.stop - part.start)
        return gain_db

    def _combine(self, paths: Any, antennas: Antennas) -> tuple[np.ndarray, np.ndarray]:
        """Return the (batch_receivers,) received over transmitted power, and its highest value."""
        n = self.settings.batch_receivers

        def by_link(values: Any) -> np.ndarray:
            return np.array(values, dtype=float).reshape(n, -1)

        field = by_link(paths.a[0]) + 1j * by_link(paths.a[1])
        leaving, arriving = (_directions(by_link(zenith), by_link(azimuth)) for zenith, azimuth in
                             ((paths.theta_t, paths.phi_t), (paths.theta_r, paths.phi_r)))
        counted = self._counted(paths, np.abs(field), np.sum(leaving * arriving, axis=-1))
        # Sionna's coefficients lack the phase of the delay, which is -1 where there is no path
        delay_s = by_link(paths.tau)
        field *= counted
        frequency_hz = float(self._city.frequency[0])
        limit = counted / (4 * np.pi * frequency_hz * np.where(counted, delay_s, 1.0))
        for antenna, direction in zip(antennas, (leaving, arriving)):
            if antenna is not None:
                field *= 10 ** (antenna.gain_dbi(direction) / 20)
                limit *= 10 ** (antenna.pattern.peak_dbi / 20)
        if self.settings.combining == "power":
            return _exact_sums(np.abs(field) ** 2), _exact_sums(limit**2)
        field *= np.exp(-2j * np.pi * frequency_hz * delay_s)
        return (_exact_sums(field.real) ** 2 + _exact_sums(field.imag) ** 2,
                _exact_sums(limit) ** 2)

    def _counted(self, paths: Any, strength: np.ndarray, cos_turn: np.ndarray) -> np.ndarray:
        """Return (n, k) whether a path counts; arguments as of `distinct_paths`."""
        interactions = np.array(paths.interactions)
        interactions = interactions.reshape(len(interactions), *strength.shape)
        vertices_m = np.array(paths.vertices).reshape(*interactions.shape, 3)
        length_m = speed_of_light * np.array(paths.tau, dtype=float).reshape(strength.shape)
        return distinct_paths(interactions, vertices_m, length_m, strength, cos_turn)


def power_to_db(power: np.ndarray) -> np.ndarray:
    """Return a power ratio in dB, NaN where it is zero."""
    with np.errstate(divide="ignore"):
        return np.where(power > 0, 10 * np.log10(power), np.nan)


def _directions(zenith_rad: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return (..., 3) unit vectors of Sionna's angles; the azimuth counts from x to y."""
    return np.stack([np.sin(zenith_rad) * np.cos(azimuth_rad),
                     np.sin(zenith_rad) * np.sin(azimuth_rad), np.cos(zenith_rad)], axis=-1)


def _exact_sums(values: np.ndarray) -> np.ndarray:
    """Sum each row exactly: the order in which Sionna RT returns paths depends on threads."""
    return np.array([math.fsum(row[row != 0]) for row in values])
