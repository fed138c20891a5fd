"""Missions in generated cities, in the statistical truth, for tuning and for judging planners.

`python -m studies.generated SEED FOLDER` writes the scene of one such city, to be traced.
"""

import sys

import numpy as np

from marl.mission import Mission
from radiotwin.maps.survey import LOS_LAW, NLOS_LAW
from radiotwin.runtime.compiled import njit
from radiotwin.scene.presets import (
    PRESETS,
    CityParameters,
    Preset,
    build_preset,
    draw_buildings,
)

STEP_M = 20.0
TX_LESS_NOISE_DB = 103.0  # transmit power less noise, of the paper


def generated_mission(seed: int, uavs: int = 3, devices: int = 10, battery: float = 60.0,
                      data_units: float = 16_000.0, side_m: tuple[float, float] | None = None,
                      altitudes_m: tuple[float, ...] = (55.0, 60.0, 65.0)) -> Mission:
    """Draw a city of blocks, devices, starts and terminals.

    Args:
        seed: of all of it.
        uavs: that fly at the altitudes in turn.
        devices: anywhere between the buildings.
        battery: of each UAV, in battery units.
        data_units: of each device on average; they differ by a factor of two.
        side_m: of the map; None to draw it, 600 to 1000 m.
        altitudes_m: above all roofs.
    """
    rng = np.random.default_rng([seed, uavs, devices])
    width_m, depth_m = side_m or 20.0 * rng.integers(30, 51, 2)
    device_m = np.column_stack([rng.uniform(0, (width_m, depth_m), (devices, 2)),
                                np.full(devices, 1.5)])
    parameters = _drawn_parameters(float(width_m), float(depth_m), rng)
    boxes = draw_buildings(parameters, device_m[:, :2], int(rng.integers(2**31)))
    columns, rows = int(width_m // STEP_M) + 1, int(depth_m // STEP_M) + 1
    x_m, y_m = np.meshgrid(STEP_M * np.arange(columns), STEP_M * np.arange(rows))
    shape = (len(altitudes_m), devices, rows, columns)
    snr_db, sigma_db = np.empty((2, *shape), np.float32)
    cells_m = np.column_stack([x_m.ravel(), y_m.ravel()])
    for k in range(devices):
        lowest_m = _lowest_sight_m(boxes, cells_m, device_m[k])
        for level, altitude_m in enumerate(altitudes_m):
            seen = altitude_m > lowest_m
            cells_3d_m = np.column_stack([cells_m, np.full(len(cells_m), altitude_m)])
            log_distance = np.log10(np.linalg.norm(cells_3d_m - device_m[k], axis=1))
            gain_db = np.where(seen, LOS_LAW.mean_db(log_distance), NLOS_LAW.mean_db(log_distance))
            snr_db[level, k] = (gain_db + TX_LESS_NOISE_DB).reshape(rows, columns)
            sigma_db[level, k] = np.where(seen, LOS_LAW.sd_db, NLOS_LAW.sd_db
                                          ).reshape(rows, columns)
    start, home = _drawn_ends((rows, columns), rng)
    hovers = max(int(2 * battery), 4 * int(home[tuple(start)]))
    return Mission(
        snr_db, sigma_db, np.tile(home, (uavs, 1, 1)), np.tile(start, (uavs, 1)),
        np.full(uavs, hovers), np.arange(uavs) % len(altitudes_m),
        np.array([altitudes_m[u % len(altitudes_m)] for u in range(uavs)]),
        data_units * rng.uniform(2 / 3, 4 / 3, devices), device_m[:, :2].copy(), STEP_M, 100.0,
        10.0, -np.inf, np.array([TX_LESS_NOISE_DB + LOS_LAW.intercept_db, -10 * LOS_LAW.exponent]),
        False)


def _drawn_parameters(width_m: float, depth_m: float, rng: np.random.Generator) -> CityParameters:
    avenue_m = rng.uniform(160, 300)
    return CityParameters(
        width_m, depth_m, avenue_width_m=rng.uniform(40, 90),
        avenue_spacing_m=avenue_m, street_width_m=rng.uniform(15, 30),
        block_mean_m=avenue_m / 2, block_min_m=avenue_m / 2.5, side_min_m=rng.uniform(40, 75),
        mean_height_m=rng.uniform(10, 30), first_block_m=tuple(-rng.uniform(0, avenue_m, 2)))


def build_generated_scene(seed: int, folder: str) -> None:
    """Write the scene folder of a generated city of 700 x 700 m with ten devices and three UAVs."""
    rng = np.random.default_rng(seed)
    parameters = _drawn_parameters(700.0, 700.0, rng)
    places_m = [(float(x_m), float(y_m)) for x_m, y_m in STEP_M * rng.integers(1, 35, (12, 2))]
    PRESETS["town"] = Preset(
        parameters, tuple(places_m[:10]), anchors=(0, 1, 2), start_m=places_m[10],
        terminal_m=places_m[11], battery=65.0, data_units=16_000.0,
        altitudes_m=(55.0, 60.0, 65.0), seed=seed)
    build_preset("town", folder)


def redrawn(mission: Mission, rng: np.random.Generator) -> Mission:
    """Draw another mission in the city of a generated one.

    1 to 5 UAVs, some of the devices (at least 6) with 8,000 to 20,000 data units on average,
    batteries of 40 to 80, another base and another end; the map is turned and mirrored.
    """
    uavs, (levels, devices) = int(rng.integers(1, 6)), mission.snr_db.shape[:2]
    chosen = rng.permutation(devices)[:rng.integers(6, devices + 1)]
    known_m = mission.known_m[chosen]
    maps = [mission.snr_db[:, chosen], mission.sigma_db[:, chosen]]
    for axis in (3, 2):  # x, y
        if rng.random() < 0.5:
            maps = [np.flip(each, axis) for each in maps]
            far_m = (maps[0].shape[axis] - 1) * mission.step_m
            known_m[:, 3 - axis] = far_m - known_m[:, 3 - axis]
    if rng.random() < 0.5:
        maps, known_m = [each.swapaxes(2, 3) for each in maps], known_m[:, ::-1].copy()
    snr_db, sigma_db = (np.ascontiguousarray(each) for each in maps)
    ends, level = _drawn_ends(snr_db.shape[2:], rng), np.arange(uavs) % levels
    battery = max(int(2 * rng.uniform(40, 80)), 4 * int(ends[1][tuple(ends[0])]))
    return mission._replace(
        snr_db=snr_db, sigma_db=sigma_db, steps_home=np.tile(ends[1], (uavs, 1, 1)),
        start=np.tile(ends[0], (uavs, 1)), battery=np.full(uavs, battery), level=level,
        altitude_m=mission.altitude_m[level], known_m=known_m,
        data_units=rng.uniform(8000, 20_000) * rng.uniform(2 / 3, 4 / 3, len(chosen)))


def _drawn_ends(shape: tuple[int, ...], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw the cell where UAVs start, and where they land: (rows, columns) moves to that cell."""
    start, terminal = rng.integers(0, shape, (2, 2))
    row, column = np.indices(shape)
    return start, abs(row - terminal[0]) + abs(column - terminal[1])


@njit(cache=True)
def _lowest_sight_m(boxes: np.ndarray, cells_m: np.ndarray, device_m: np.ndarray) -> np.ndarray:
    """Return the altitude above which each cell (n, 2) sees a device (x, y, z), over boxes."""
    lowest_m = np.full(len(cells_m), -np.inf)
    for i in range(len(cells_m)):
        for b in range(len(boxes)):
            enters, leaves = 0.0, 1.0  # of the way from the device to the cell
            for axis in range(2):
                from_m, way_m = device_m[axis], cells_m[i, axis] - device_m[axis]
                low_m, high_m = boxes[b, axis] - from_m, boxes[b, 2 + axis] - from_m
                if way_m == 0.0:
                    if low_m > 0.0 or high_m < 0.0:
                        leaves = -1.0
                    continue
                one, other = low_m / way_m, high_m / way_m
                enters, leaves = max(enters, min(one, other)), min(leaves, max(one, other))
            if enters <= leaves:  # the line rises, so it passes over the box if it enters above it
                needed_m = device_m[2] + (boxes[b, 4] - device_m[2]) / max(enters, 1e-9)
                lowest_m[i] = max(lowest_m[i], needed_m)
    return lowest_m



if __name__ == "__main__":
    build_generated_scene(int(sys.argv[1]), sys.argv[2])
