"""Worlds: where devices stand and what UAVs fly in a city, before anything is hidden. All of it follows from a seed.

A world belongs to a group and a seed. Groups share no world, so that what is learnt about one group's cities, devices
and flights says nothing of another's; the families of one group share a world, and with it the costly trace.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from tests.undeclared.cities import CITIES, SIDE_M, Building, buildings
from tests.undeclared.shapes import corners_of, distance_m, fits, turned

GROUPS = ("receivers", "devices", "obstacles", "pairs")
DEVICES, ANCHORS, UAVS, FLIGHTS, SLOTS = 10, 6, 3, 6, 60
HEIGHT_M = 1.5
TO_WALL_M, TO_BORDER_M, APART_M = 3.0, 15.0, 55.0
STEPS = 4  # of the flight mechanics in a slot of 1 s
TURN_RAD_S = np.radians(12)
REACHED_M = 50.0  # a waypoint counts as reached, which keeps the tightest turn from circling it
GRAVITY_M_S2 = 9.81


@dataclass(frozen=True, eq=False)
class World:
    """Devices, flights and towers, k = 10 devices, p = 1080 points (flight, then UAV, then slot).

    Attributes:
        group, seed, city: names of the world.
        device_m: (k, 3) where the devices stand [m].
        is_anchor: (k,) bool
        towers: that stand in the city's gaps and that flights avoid; only some families make them real.
        points_m: (p, 3) positions of the receivers [m].
        time_s: (p,) since the first slot.
        flight, receiver: (p,) numbers.
        heading_deg: (p,) clockwise from north, where the nose points.
        pitch_deg, roll_deg: (p,) nose up and right side down are positive.
    """

    group: str
    seed: int
    city: str
    device_m: np.ndarray
    is_anchor: np.ndarray
    towers: tuple[Building, ...]
    points_m: np.ndarray
    time_s: np.ndarray
    flight: np.ndarray
    receiver: np.ndarray
    heading_deg: np.ndarray
    pitch_deg: np.ndarray
    roll_deg: np.ndarray

    @property
    def names(self) -> list[str]:
        return [f"d{number}" for number in range(DEVICES)]


@cache
def world(group: str, seed: int) -> World:
    """The world of a group and seed; even seeds are in the first city, odd ones in the second."""
    city = CITIES[seed % len(CITIES)]
    places, roles, gaps, air = np.random.default_rng([seed, GROUPS.index(group)]).spawn(4)
    device_m = np.array(_devices(city, places))
    is_anchor = roles.permutation(np.arange(DEVICES) < ANCHORS)
    towers = _towers(city, device_m, gaps)
    return World(group, seed, city, device_m, is_anchor, towers, **_flights(towers, air))


def free(city: str, point_m: np.ndarray, room_m: float) -> bool:
    """Whether a point (2,) lies in the extent and `room_m` from all buildings."""
    if not TO_BORDER_M <= min(point_m) <= max(point_m) <= SIDE_M - TO_BORDER_M:
        return False
    near = [b.footprint_m for b in buildings(city) if np.hypot(*(b.footprint_m - point_m).T).min() < 80]
    return all(distance_m(point_m[None], footprint)[0] >= room_m for footprint in near)


def _devices(city: str, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    found: list[tuple[float, float, float]] = []
    while len(found) < DEVICES:
        point = rng.uniform(0, SIDE_M, 2).round(1)
        if all(np.hypot(*(point - other[:2])) >= APART_M for other in found) and free(city, point, TO_WALL_M):
            found.append((*point, HEIGHT_M))
    return found


def _towers(city: str, device_m: np.ndarray, rng: np.random.Generator) -> tuple[Building, ...]:
    """One or two, near a device each: there they stand between it and a good part of the sky."""
    number = int(rng.integers(1, 3))
    found: list[Building] = []
    standing = [b.footprint_m for b in buildings(city)]
    while len(found) < number:
        centre = rng.uniform(40, SIDE_M - 40, 2)
        box = corners_of("box", rng.uniform(15, 28), rng.uniform(15, 28), rng)
        corners = (turned(box, rng.uniform(0, np.pi)) + centre).round(2)
        height_m = round(float(rng.uniform(60, 100)), 1)
        away = distance_m(device_m[:, :2], corners)
        apart = all(np.hypot(*(centre - other.footprint_m.mean(axis=0))) > 120 for other in found)
        if apart and 8 < away.min() < 40 and fits(corners, standing, 3.0):
            found.append(Building(corners, height_m, "concrete"))
    return tuple(found)


def _flights(towers: tuple[Building, ...], rng: np.random.Generator) -> dict[str, np.ndarray]:
    level_m = (rng.uniform(50, 57), rng.uniform(60, 67), rng.uniform(71, 78))
    parts, start_s = [], 0.0
    for flight in range(FLIGHTS):
        blows, comes_from = rng.uniform(0.5, 2.5), rng.uniform(0, 2 * np.pi)
        wind = blows * np.array([np.cos(comes_from), np.sin(comes_from)])
        for uav in range(UAVS):
            track = _track(towers, rng)
            sway = rng.uniform(0.5, 1.5) * np.sin(2 * np.pi * (np.arange(SLOTS) / rng.uniform(30, 60) + rng.random()))
            part = _attitude(track, wind, rng)
            part["points_m"] = np.column_stack([track[:, :2], level_m[uav] + sway]).round(2)
            part["time_s"] = start_s + np.arange(SLOTS, dtype=float)
            part["flight"], part["receiver"] = np.full(SLOTS, flight), np.full(SLOTS, uav)
            parts.append(part)
        start_s += SLOTS + float(rng.integers(150, 500))  # batteries are changed
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _track(towers: tuple[Building, ...], rng: np.random.Generator) -> np.ndarray:
    """(slots, 4) x, y [m], course [rad, counter-clockwise from east] and its rate [rad/s]: a flight from one random
    waypoint towards the next that stays over the city and clear of the towers."""
    while True:
        track = _fly(rng)
        over_city = track[:, :2].min() > 5 and track[:, :2].max() < SIDE_M - 5
        if over_city and all(distance_m(track[:, :2], tower.footprint_m).min() > 8 for tower in towers):
            return track


def _fly(rng: np.random.Generator) -> np.ndarray:
    place, goal = rng.uniform(30, SIDE_M - 30, 2), rng.uniform(40, SIDE_M - 40, 2)
    course = np.arctan2(*(goal - place)[::-1])
    speed_m_s, gusts = rng.uniform(8.7, 11.3), rng.uniform(0, 2 * np.pi)
    rows, dt = [], 1 / STEPS
    for step in range(SLOTS * STEPS):
        while np.hypot(*(goal - place)) < REACHED_M:
            goal = rng.uniform(40, SIDE_M - 40, 2)
        bearing = np.arctan2(*(goal - place)[::-1])
        off = (bearing - course + np.pi) % (2 * np.pi) - np.pi
        rate = np.clip(0.5 * off, -TURN_RAD_S, TURN_RAD_S)
        if step % STEPS == 0:
            rows.append((*place, course, rate))
        speed = speed_m_s + 0.6 * np.sin(gusts + 2 * np.pi * step * dt / 17)
        course += rate * dt
        place = place + speed * dt * np.array([np.cos(course), np.sin(course)])
    return np.array(rows)


def _attitude(track: np.ndarray, wind: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The nose points into the wind a little, the rotors' plane leans into motion and turns."""
    velocity = np.gradient(track[:, :2], axis=0)
    air = velocity - wind
    airspeed = np.hypot(*air.T)
    roll = np.degrees(np.arctan(-airspeed * track[:, 3] / GRAVITY_M_S2))
    return {"heading_deg": ((90 - np.degrees(np.arctan2(air[:, 1], air[:, 0]))) % 360).round(1) % 360,
            "pitch_deg": (-0.04 * airspeed**2 + rng.normal(0, 0.6, SLOTS)).round(1),
            "roll_deg": (roll + rng.normal(0, 0.6, SLOTS)).round(1)}
