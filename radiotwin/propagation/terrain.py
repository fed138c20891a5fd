"""Diffraction loss over terrain and the curved Earth: delta-Bullington of ITU-R P.526-15 [1].

It is for links that the ground blocks and no path over the map reaches, and for links so long that
the Earth's curvature matters. All obstacles of the profile, ground and roofs, are replaced by one
knife edge where the horizons of both ends meet (Bullington), with an empirical correction for
multiple or rounded obstacles; the excess loss over a smooth Earth is added.

[1] Recommendation ITU-R P.526-15, "Propagation by diffraction", 2019.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.scene.citymap import EARTH_RADIUS_M, FAR_M, CityMap

STEP_M = 2.5  # between the points of a profile, up to 5 km
POINTS = (64, 128, 256, 512, 1024, 2048)  # allowed numbers of points of a profile
CHUNK_POINTS = 500_000  # points of profiles at a time: about 100 MB
MIN_HEIGHT_M = 0.1  # least antenna height above the smooth Earth
PERMITTIVITY, CONDUCTIVITY_S_M = 22.0, 0.003  # of land ([1], section 3.1.1.1)


class Profiles(NamedTuple):
    """Terrain profiles of n links; heights are above the datum.

    Attributes:
        length_m: (n,) horizontal distance between the ends [m].
        at_m: (n, p) horizontal distances of the points from the first end [m].
        ground_m: (n, p + 2) heights of the ground at the points and at both ends [m].
        surface_m: (n, p) heights of ground or roofs at the points [m].
        end_m: (n, 2) heights of the antennas [m].
    """

    length_m: np.ndarray
    at_m: np.ndarray
    ground_m: np.ndarray
    surface_m: np.ndarray
    end_m: np.ndarray


class TerrainPaths(NamedTuple):
    """Power that reaches n receivers over the terrain profile.

    Attributes:
        gain: (n,) power gain between isotropic antennas, linear.
        edge_m: (n, 3) where the horizons of both ends meet, or the middle of a line of sight [m].
    """

    gain: np.ndarray
    edge_m: np.ndarray


def is_far(device_m: np.ndarray, receiver_m: np.ndarray) -> np.ndarray:
    """Return (n,) bool: the receiver is more than FAR_M from the device (3,) [m], horizontally."""
    return np.hypot(*(receiver_m - device_m)[:, :2].T) > FAR_M


def terrain_paths(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray,
                  frequency_hz: float) -> TerrainPaths:
    """Compute the power gain over terrain from a device (3,) to receivers (n, 3) [m]."""
    found = TerrainPaths(np.zeros(len(receiver_m)), (device_m + receiver_m) / 2)
    for rows, profiles in _profiles(city, device_m, receiver_m):
        way_m = receiver_m[rows] - device_m
        free = (speed_of_light / (4 * np.pi * frequency_hz * np.linalg.norm(way_m, axis=1))) ** 2
        found.gain[rows] = free * 10 ** (-delta_bullington_db(profiles, frequency_hz) / 10)
        blocked, cross_m, height_m = _edges(profiles, profiles.surface_m, profiles.end_m)
        fraction = (cross_m / profiles.length_m[blocked])[:, None]
        found.edge_m[rows[blocked]] = np.column_stack([
            device_m[:2] + fraction * way_m[blocked, :2], height_m])
    return found


def _profiles(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray
              ) -> Iterator[tuple[np.ndarray, Profiles]]:
    """Yield chunks of terrain profiles from a device (3,) to receivers (n, 3) [m], with their rows.

    The number of points depends on the length only, so that exchanged ends have the same profile.
    """
    length_m = np.maximum(np.hypot(*(receiver_m - device_m)[:, :2].T), STEP_M / 10)
    points = np.array(POINTS)[np.searchsorted(POINTS[:-1], length_m / STEP_M)]
    for count in np.unique(points).tolist():
        links, chunk = np.flatnonzero(points == count), CHUNK_POINTS // count
        share, inner = np.linspace(0, 1, count + 2), slice(1, -1)
        for rows in (links[first:first + chunk] for first in range(0, len(links), chunk)):
            x_m, y_m = (device_m[axis] + share * (receiver_m[rows, axis, None] - device_m[axis])
                        for axis in (0, 1))
            ground_m = city.ground_height_m(x_m, y_m)
            yield rows, Profiles(
                length_m[rows], share[inner] * length_m[rows, None], ground_m,
                np.maximum(ground_m[:, inner], city.height_at(x_m[:, inner], y_m[:, inner])),
                np.column_stack([np.full(len(rows), device_m[2]), receiver_m[rows, 2]]))


def delta_bullington_db(profiles: Profiles, frequency_hz: float) -> np.ndarray:
    """Return the delta-Bullington loss (n,) over free space [dB] (ITU-R P.526-15, 4.5.2)."""
    wavelength_m = speed_of_light / frequency_hz
    above_m = np.maximum(profiles.end_m - _smooth_m(profiles), MIN_HEIGHT_M)
    flat_db = _bullington_db(profiles, np.zeros_like(profiles.surface_m), above_m, wavelength_m)
    round_db = spherical_earth_db(profiles.length_m, above_m, frequency_hz)
    return (_bullington_db(profiles, profiles.surface_m, profiles.end_m, wavelength_m)
            + np.maximum(round_db - flat_db, 0.0))


def knife_edge_db(nu: np.ndarray) -> np.ndarray:
    """Return the knife-edge loss J(ν) [dB] ([1], Eq. 31); 0 for ν <= -0.78."""
    shifted = np.maximum(nu, -0.78) - 0.1
    return np.where(nu > -0.78, 6.9 + 20 * np.log10(np.sqrt(shifted**2 + 1) + shifted), 0.0)


def _edges(profiles: Profiles, height_m: np.ndarray,
           end_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which links (n,) are blocked, and where the horizons of their two ends meet.

    That point, Bullington's single knife edge, is given by its distances (m,) from the first end
    and heights (m,) [m]. `height_m` (n, p) are the heights of the profiles, `end_m` (n, 2) of
    antennas [m].
    """
    at_m, back_m = profiles.at_m, profiles.length_m[:, None] - profiles.at_m
    curved_m = height_m + at_m * back_m / (2 * EARTH_RADIUS_M)
    up, down = (((curved_m - antenna_m[:, None]) / way_m).max(axis=1)
                for antenna_m, way_m in zip(end_m.T, (at_m, back_m)))
    rise_m = end_m[:, 1] - end_m[:, 0]
    blocked = up >= rise_m / profiles.length_m
    cross_m = (rise_m + down * profiles.length_m)[blocked] / (up + down)[blocked]
    return blocked, cross_m, end_m[blocked, 0] + up[blocked] * cross_m


def _bullington_db(profiles: Profiles, height_m: np.ndarray, end_m: np.ndarray,
                   wavelength_m: float) -> np.ndarray:
    """Return the Bullington loss (n,) by one knife edge [dB] (4.5.1); arguments as in `_edges`."""
    length_m = profiles.length_m[:, None]

    def parameter(rows: np.ndarray, at_m: np.ndarray, over_datum_m: np.ndarray) -> np.ndarray:
        """Return the knife-edge parameter ν of points at a distance and height [m]."""
        back_m = length_m[rows] - at_m
        line_m = (end_m[rows, :1] * back_m + end_m[rows, 1:] * at_m) / length_m[rows]
        return (over_datum_m - line_m) * np.sqrt(
            2 * length_m[rows] / (wavelength_m * at_m * back_m))

    # With line of sight, the edge is the most obstructed point; else where the horizons cross.
    bulge_m = profiles.at_m * (length_m - profiles.at_m) / (2 * EARTH_RADIUS_M)
    nu = parameter(np.ones(len(end_m), bool), profiles.at_m, height_m + bulge_m).max(axis=1)
    blocked, cross_m, top_m = _edges(profiles, height_m, end_m)
    nu[blocked] = parameter(blocked, cross_m[:, None], top_m[:, None])[:, 0]
    edge_db = knife_edge_db(nu)
    return edge_db + (1 - np.exp(-edge_db / 6)) * (10 + 0.02 * profiles.length_m / 1e3)


def _smooth_m(profiles: Profiles) -> np.ndarray:
    """Fit a smooth surface to the ground; return its heights (n, 2) at both ends [m] (4.5.2)."""
    length_m, end_m, ground_m = profiles.length_m[:, None], profiles.end_m, profiles.ground_m
    at_m = np.column_stack([np.zeros(len(length_m)), profiles.at_m, length_m])
    step_m, low_m, high_m = np.diff(at_m), ground_m[:, :-1], ground_m[:, 1:]
    v1 = (step_m * (high_m + low_m)).sum(axis=1)
    v2 = (step_m * (high_m * (2 * at_m[:, 1:] + at_m[:, :-1])
                    + low_m * (at_m[:, 1:] + 2 * at_m[:, :-1]))).sum(axis=1)
    length_m = profiles.length_m
    smooth_m = np.column_stack([(2 * v1 * length_m - v2), v2 - v1 * length_m]) \
        / length_m[:, None] ** 2
    back_m = length_m[:, None] - profiles.at_m
    over_m = ground_m[:, 1:-1] - (end_m[:, :1] * back_m
                                  + end_m[:, 1:] * profiles.at_m) / length_m[:, None]
    slope = np.column_stack([(over_m / way_m).max(axis=1) for way_m in (profiles.at_m, back_m)])
    highest_m = np.maximum(over_m.max(axis=1), 0.0)  # lower the smooth Earth if the ground blocks
    slope = np.where(highest_m[:, None] > 0, slope, 1.0)
    smooth_m -= highest_m[:, None] * slope / slope.sum(axis=1, keepdims=True)
    return np.minimum(smooth_m, ground_m[:, [0, -1]])


def spherical_earth_db(distance_m: np.ndarray, height_m: np.ndarray,
                       frequency_hz: float) -> np.ndarray:
    """Return the diffraction loss (n,) over a smooth 4/3 Earth [dB] (ITU-R P.526-15, 3.2).

    Horizontal distances (n,), heights of both antennas (n, 2) above ground; vertical polarisation.
    """
    first, second = height_m.T
    root_m = np.sqrt(height_m).sum(axis=1)
    is_beyond = distance_m >= np.sqrt(2 * EARTH_RADIUS_M) * root_m
    # Within the horizon: least clearance over the clearance of zero loss
    c = (first - second) / (first + second)
    m = distance_m**2 / (4 * EARTH_RADIUS_M * (first + second))
    b = 2 * np.sqrt((m + 1) / (3 * m)) * np.cos(
        np.pi / 3 + np.arccos(np.clip(1.5 * c * np.sqrt(3 * m / (m + 1) ** 3), -1, 1)) / 3)
    d1 = distance_m / 2 * (1 + b)
    d2 = distance_m - d1
    clear_m = ((first - d1**2 / (2 * EARTH_RADIUS_M)) * d2
               + (second - d2**2 / (2 * EARTH_RADIUS_M)) * d1) / distance_m
    needed_m = 0.552 * np.sqrt(d1 * d2 * speed_of_light / frequency_hz / distance_m)
    share = np.clip(1 - clear_m / needed_m, 0.0, 1.0)
    radius_m = np.where(is_beyond, EARTH_RADIUS_M, 0.5 * (distance_m / root_m) ** 2)
    loss_db = _first_term_db(distance_m, height_m, frequency_hz, radius_m)
    return np.where(is_beyond, loss_db, share * np.maximum(loss_db, 0.0))


def _first_term_db(distance_m: np.ndarray, height_m: np.ndarray, frequency_hz: float,
                   radius_m: np.ndarray) -> np.ndarray:
    """Return the loss (n,) over a smooth Earth by the first residue term [dB] (P.526-15, 3.1)."""
    wavelength_m = speed_of_light / frequency_hz
    imaginary = CONDUCTIVITY_S_M * 18e9 / frequency_hz
    admittance = (0.36 * (radius_m / 1e3 * frequency_hz / 1e6) ** (-1 / 3)
                  * ((PERMITTIVITY - 1) ** 2 + imaginary**2) ** -0.25
                  * np.sqrt(PERMITTIVITY**2 + imaginary**2))
    beta = (1 + 1.6 * admittance**2 + 0.67 * admittance**4) \
        / (1 + 4.5 * admittance**2 + 1.53 * admittance**4)
    x = beta * (np.pi / (wavelength_m * radius_m**2)) ** (1 / 3) * distance_m
    far_db = np.where(x >= 1.6, 11 + 10 * np.log10(x) - 17.6 * x,
                      -20 * np.log10(x) - 5.6488 * x**1.425)
    y = (beta**2 * 2 * (np.pi**2 / (wavelength_m**2 * radius_m)) ** (1 / 3))[:, None] * height_m
    over = np.maximum(y - 1.1, 0.1)
    gain_db = np.where(y > 2, 17.6 * np.sqrt(over) - 5 * np.log10(over) - 8,
                       20 * np.log10(y + 0.1 * y**3))
    gain_db = np.maximum(gain_db, 2 + 20 * np.log10(admittance)[:, None])
    return -far_db - gain_db.sum(axis=1)
