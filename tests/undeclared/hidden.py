"""What is hidden in the traced world: towers, a building that is gone, an anchor elsewhere, antennas.

Each function draws one effect and returns it as an entry of the answer, plain enough for JSON.
"""

import numpy as np

from tests.undeclared.cities import buildings, declared_scene
from tests.undeclared.shapes import blocked_alone, distance_m
from tests.undeclared.worlds import UAVS, World, free

TRACED = ("missing_obstacle", "removed_obstacle", "device_position_error", "antenna_pattern")


def missing_obstacle(world: World, rng: np.random.Generator) -> dict:
    """The world's one or two towers, which the declared map lacks."""
    return {"name": "missing_obstacle", "obstacles": [
        {"centre_m": tower.footprint_m.mean(axis=0).round(2).tolist(), "corners_m": tower.footprint_m.tolist(),
         "height_m": tower.height_m} for tower in world.towers]}


def removed_obstacle(world: World, rng: np.random.Generator) -> dict:
    """One of the eight buildings that alone block the most links: the map has it, the world has not."""
    points_m = world.points_m[::5]
    a_m = np.repeat(world.device_m, len(points_m), axis=0)
    b_m = np.tile(points_m, (len(world.device_m), 1))
    blocked = np.flatnonzero(~declared_scene(world.city).city.line_of_sight(a_m, b_m))
    a_m, b_m = a_m[blocked], b_m[blocked]
    alone = blocked_alone(buildings(world.city), a_m, b_m)
    index = int(rng.choice(np.argsort(-alone, kind="stable")[:8]))
    building = buildings(world.city)[index]
    return {"name": "removed_obstacle", "building": index, "shape": f"b{index:03d}",
            "centre_m": building.footprint_m.mean(axis=0).round(2).tolist(),
            "corners_m": building.footprint_m.tolist(), "height_m": building.height_m}


def device_position_error(world: World, rng: np.random.Generator) -> dict:
    """An anchor that stands 20 to 60 m from where it is declared."""
    device = int(rng.choice(np.flatnonzero(world.is_anchor)))
    declared_m = world.device_m[device]
    while True:
        away_m, turn = rng.uniform(20, 60), rng.uniform(0, 2 * np.pi)
        true_m = (declared_m[:2] + away_m * np.array([np.cos(turn), np.sin(turn)])).round(1)
        in_tower = any(distance_m(true_m[None], tower.footprint_m)[0] < 3 for tower in world.towers)
        if free(world.city, true_m, 2.0) and not in_tower:
            break
    return {"name": "device_position_error", "device": world.names[device], "declared_m": declared_m.tolist(),
            "true_m": [*true_m.tolist(), float(declared_m[2])],
            "error_m": round(float(np.hypot(*(true_m - declared_m[:2]))), 2)}


def sector_antenna(world: World, rng: np.random.Generator, but: str | None = None) -> dict:
    """A sector antenna (3GPP TR 38.901) on an anchor, other than that named `but`."""
    choice = [number for number in np.flatnonzero(world.is_anchor) if world.names[number] != but]
    return {"name": "antenna_pattern", "kind": "sector", "device": world.names[int(rng.choice(choice))],
            "pattern": "tr38901", "azimuth_deg": round(float(rng.uniform(0, 360)), 1),
            "downtilt_deg": round(float(rng.uniform(0, 12)), 1)}


def tilted_dipole(world: World, rng: np.random.Generator) -> dict:
    """A half-wave dipole on a UAV that leans from the body's upward axis, towards a side of the body."""
    return {"name": "antenna_pattern", "kind": "dipole", "receiver": f"uav{rng.integers(UAVS)}",
            "pattern": "hw_dipole", "tilt_deg": round(float(rng.uniform(15, 35)), 1),
            "tilt_towards_deg": round(float(rng.uniform(0, 360)), 1)}


def dipole_turns_rad(world: World, points: np.ndarray, tilt_deg: float, tilt_towards_deg: float) -> np.ndarray:
    """(n, 3) angles of the dipole's frame about z, y, x at some points, following the UAV's heading, pitch and roll [rad].

    It leans by `tilt_deg` from the body's upward axis to a side, clockwise from above: 0 the nose, 90 the right side.
    """
    yaw = np.radians(90 - world.heading_deg[points])
    # Turned about the left side, the nose goes down; about the nose, the right side goes down.
    body = about_z(yaw) @ about_y(-np.radians(world.pitch_deg[points])) @ about_x(np.radians(world.roll_deg[points]))
    side = np.radians(np.array([-tilt_towards_deg]))
    turn = body @ about_z(side) @ about_y(np.radians(np.array([tilt_deg])))
    return np.column_stack([np.arctan2(turn[:, 1, 0], turn[:, 0, 0]), -np.arcsin(np.clip(turn[:, 2, 0], -1, 1)),
                            np.arctan2(turn[:, 2, 1], turn[:, 2, 2])])


def about_z(angle: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations, counter-clockwise seen from the axis' tip."""
    return _about(angle, 0, 1)


def about_y(angle: np.ndarray) -> np.ndarray:
    """(n, 3, 3); a small positive angle turns x downwards."""
    return _about(angle, 2, 0)


def about_x(angle: np.ndarray) -> np.ndarray:
    """(n, 3, 3)"""
    return _about(angle, 1, 2)


def _about(angle: np.ndarray, first: int, second: int) -> np.ndarray:
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    matrix[:, first, first] = matrix[:, second, second] = np.cos(angle)
    matrix[:, second, first], matrix[:, first, second] = np.sin(angle), -np.sin(angle)
    return matrix
