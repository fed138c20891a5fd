"""Missions in generated cities, in the statistical truth, for tuning and for judging planners.

`python -m studies.generated SEED FOLDER` writes the scene of one such city, to be traced.
"""

import sys

import numpy as np
import trimesh

from marl.mission import Mission
from radiotwin.maps.survey import LOS_LAW, NLOS_LAW
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.presets import (
    PRESETS,
    CityParameters,
    Preset,
    build_preset,
    building_meshes,
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
    solid = trimesh.util.concatenate(building_meshes(boxes))
    assert isinstance(solid, trimesh.Trimesh)
    city = CityMap(solid.vertices, solid.faces)
    columns, rows = int(width_m // STEP_M) + 1, int(depth_m // STEP_M) + 1
    x_m, y_m = np.meshgrid(STEP_M * np.arange(columns), STEP_M * np.arange(rows))
    shape = (len(altitudes_m), devices, rows, columns)
    snr_db, sigma_db = np.empty((2, *shape), np.float32)
    for level, altitude_m in enumerate(altitudes_m):
        cells_m = np.column_stack([x_m.ravel(), y_m.ravel(), np.full(x_m.size, altitude_m)])
        for k in range(devices):
            seen = city.line_of_sight(cells_m, device_m[k][None])
            log_distance = np.log10(np.linalg.norm(cells_m - device_m[k], axis=1))
            gain_db = np.where(seen, LOS_LAW.mean_db(log_distance), NLOS_LAW.mean_db(log_distance))
            snr_db[level, k] = (gain_db + TX_LESS_NOISE_DB).reshape(rows, columns)
            sigma_db[level, k] = np.where(seen, LOS_LAW.sd_db, NLOS_LAW.sd_db
                                          ).reshape(rows, columns)
    start, terminal = rng.integers(0, (rows, columns), (2, 2))
    row, column = np.indices((rows, columns))
    home = abs(row - terminal[0]) + abs(column - terminal[1])
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
    places_m = STEP_M * rng.integers(1, 35, (12, 2))
    PRESETS["town"] = Preset(
        parameters, [(float(x_m), float(y_m), number < 3)
                     for number, (x_m, y_m) in enumerate(places_m[:10])],
        tuple(map(float, places_m[10])), tuple(map(float, places_m[11])), battery=65.0,
        data_units=16_000.0, altitudes_m=(55.0, 60.0, 65.0), seed=seed)
    build_preset("town", folder)


if __name__ == "__main__":
    build_generated_scene(int(sys.argv[1]), sys.argv[2])
