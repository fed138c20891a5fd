"""Corrected positions of devices that lie inside a building or below the ground of the map.

Roofs, walls and ground of a map have errors. A mast on a roof that is mapped too high is inside the
building in the map, and so is a lamp at a wall that is mapped too far out. Such a device is moved
just above the roof or the ground, or just outside the wall: whichever needs the smallest error of
the map, in standard deviations.
"""

from dataclasses import dataclass

import numpy as np

from radiotwin.scene.citymap import DOWN, HEIGHT_SD_M, CityMap

CLEARANCE_M = 0.5  # distance of a moved device from the roof, ground or wall
WALL_SD_M = 2.0
"""Standard deviation of a wall's position, across the wall. Outlines of OpenStreetMap lie 4 m from
surveyed ones on average, mostly by a shift that neighbours share, and surveyed ones are off by
decimetres (Fan, Zipf, Fu and Neis 2014, 'Quality assessment for building footprints data on
OpenStreetMap', IJGIS 28)."""
GROUND_SD_M = 2.4  # Copernicus DEM: within 4 m at 90 %
MAX_SDS = 3.0  # a larger error is not attributed to the map
STEP_M, DIRECTIONS = 0.1, 72  # of the search for the nearest wall


@dataclass(frozen=True, eq=False)
class Footing:
    """A corrected position outdoors.

    Attributes:
        point_m: (3,) x, y, z [m].
        sds: error of the map that would explain the device's position, in standard deviations.
        move: description of the correction, for a message.
    """

    point_m: np.ndarray
    sds: float
    move: str


def footing(city: CityMap, point_m: np.ndarray) -> Footing | None:
    """Find the likeliest position outdoors for a device (3,) [m] that the map shows indoors.

    Candidates are just above the ground, on the roof, and beside the nearest wall. The one is
    returned that needs the smallest error of the map, in standard deviations of that height or
    wall; None if all need more than `MAX_SDS`.
    """
    candidates = (_above_surface(city, point_m, to_ground=True),
                  _above_surface(city, point_m, to_ground=False), _beside_wall(city, point_m))
    plausible = [one for one in candidates if one is not None and one.sds <= MAX_SDS]
    return min(plausible, key=lambda one: one.sds, default=None)


def moved_outdoors(city: CityMap, points_m: np.ndarray) -> np.ndarray:
    """Return positions (n, 3) [m] of devices, the misplaced ones moved outdoors by `footing`."""
    corrected_m = points_m.copy()
    for row in np.flatnonzero(city.misplaced(points_m) != ""):
        found = footing(city, points_m[row])
        if found is not None:
            corrected_m[row] = found.point_m
    return corrected_m


def _above_surface(city: CityMap, point_m: np.ndarray, to_ground: bool) -> Footing | None:
    """Return the position above the ground (or roof); None if under the device, or indoors."""
    x_m, y_m, z_m = point_m.tolist()
    ground_m = float(city.ground_height_m(x_m, y_m))
    surface_m, sd_m, what = ground_m, GROUND_SD_M, "the ground"
    if not to_ground:
        surface_m, sd_m, what = *_roof_m(city, x_m, y_m), "the roof"
    above_m = np.array([x_m, y_m, surface_m + CLEARANCE_M])
    if surface_m < z_m or (not to_ground and surface_m <= ground_m) or city.inside(above_m)[0]:
        return None
    return Footing(above_m, (surface_m - z_m) / sd_m,
                   f"{above_m[2] - z_m:.1f} m up, to {CLEARANCE_M:g} m above {what}, which the map "
                   f"has {surface_m - z_m:.1f} m too high (standard deviation {sd_m:.1f} m)")


def _roof_m(city: CityMap, x_m: float, y_m: float) -> tuple[float, float]:
    """Return the height of the highest surface (-inf: none) and its standard deviation [m]."""
    above_m = np.array([[x_m, y_m, city.vertices[:, 2].max() + 1.0]])
    distance_m, face, _ = city.first_hits_towards(above_m, DOWN)
    if face[0] < 0:
        return -np.inf, HEIGHT_SD_M
    sd_m = np.nan if city.height_sd_m is None else float(city.height_sd_m[face[0]])
    return float(above_m[0, 2] - distance_m[0]), HEIGHT_SD_M if np.isnan(sd_m) else sd_m


def _beside_wall(city: CityMap, point_m: np.ndarray) -> Footing | None:
    """Return the position just outside the nearest wall; None if that is too far.

    The limit is `MAX_SDS` standard deviations of a wall's position, `WALL_SD_M`.
    """
    steps_m = np.arange(0.0, MAX_SDS * WALL_SD_M, STEP_M) + STEP_M
    angle_rad = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    towards = np.column_stack([np.sin(angle_rad), np.cos(angle_rad), np.zeros(DIRECTIONS)])
    free = np.ones((len(steps_m), DIRECTIONS), dtype=bool)
    for beyond_m in (0.0, CLEARANCE_M):  # the next building may be close
        points_m = point_m + (steps_m + beyond_m)[:, None, None] * towards
        free &= ~city.inside(points_m.reshape(-1, 3)).reshape(free.shape)
    if not free.any():
        return None
    nearest = int(free.any(axis=1).argmax())
    wall_m, outward = float(steps_m[nearest]), towards[free[nearest]]
    across = outward.sum(axis=0) / max(np.linalg.norm(outward.sum(axis=0)), 1e-9)
    for direction in (across, outward[0]):  # between two walls their mean may point along both
        outside_m = point_m + (wall_m + CLEARANCE_M) * direction
        if not city.inside(outside_m)[0]:
            break
    return Footing(outside_m, wall_m / WALL_SD_M,
                   f"{wall_m + CLEARANCE_M:.1f} m sideways, to {CLEARANCE_M:g} m outside the wall, "
                   f"which the map has {wall_m:.1f} m too far out (standard deviation "
                   f"{WALL_SD_M:g} m)")
