"""Worlds: what stands in a city, what its map says, its radio, devices and campaign. All of it follows from a seed."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from tests.undeclared.foreign.campaigns import Campaign, draw_campaign
from tests.undeclared.foreign.grounds import Grounds
from tests.undeclared.foreign.layouts import CITIES, Building, City, city
from tests.undeclared.shapes import blocked_alone, inside

WORLDS = 3  # of each city
DEVICES = 7  # declared ones; one more is traced, which nobody declares
FREQUENCIES_HZ = (0.45e9, 0.8e9, 0.9e9, 1.8e9, 2.1e9, 2.4e9, 2.6e9, 3.5e9, 3.7e9, 5.8e9, 10e9, 24e9, 26e9, 28e9)
APART_M = 30.0
MOST_OFF_M = 1.6  # of a wall by a building's shift, and as much again by its size
MOST_HIGH_M = 4.5  # of a roof
GAP_M = 4.5  # from plan to device: no wall that a survey misplaced reaches it


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings of the tracer, other for every world.

    Attributes:
        max_depth: of paths that are not scattered.
        rays: of one device.
        scattering: coefficient of the walls; the ground has half of it.
    """

    max_depth: int
    rays: int
    scattering: float


@dataclass(frozen=True, eq=False)
class World:
    """A world; k = 8 traced devices, the last of them undeclared; p points of the campaign.

    Attributes:
        city: its plan.
        number: 0 to 2 within the city.
        frequency_hz: of all devices.
        settings: of the tracer.
        true: buildings as they stand, one for each of the plan; None: not there.
        mapped: bool for each building of the plan: a good surveyor's map has it.
        reserve: index of a building of the plan that is gone, and that an old map would still show.
        gaps_m: errors of the survey, root mean square: walls and heights [m].
        device_m: (k, 3) [m].
        campaign: who measured where and when.
    """

    city: City
    number: int
    frequency_hz: float
    settings: Settings
    true: tuple[Building | None, ...]
    mapped: tuple[bool, ...]
    reserve: int
    gaps_m: tuple[float, float]
    device_m: np.ndarray
    campaign: Campaign

    @property
    def name(self) -> str:
        """`cityNN-wN`"""
        return world_name(self.city.number, self.number)


def world_name(city_number: int, number: int) -> str:
    """Return the name of a world."""
    return f"city{city_number:02d}-w{number}"


def city_of(name: str) -> City:
    """Return the city of a world, or of a case in it, by its name."""
    return city(int(name[4:6]))


def all_names() -> list[str]:
    """Return the names of all worlds, calibrate and judge in turn."""
    by_split = [[n for n in range(CITIES) if city(n).split == split] for split in ("calibrate", "judge")]
    return [world_name(number, w) for w in range(WORLDS) for pair in zip(*by_split) for number in pair]


@cache
def world(name: str) -> World:
    """Draw a world by its name; the same for the same name."""
    where, number = city_of(name), int(name[8:])
    seeds = np.random.default_rng([where.number, number, 5]).spawn(5)
    frequency_hz = float(seeds[0].choice(FREQUENCIES_HZ))
    settings = Settings(int(seeds[0].integers(3, 7)), int(seeds[0].integers(20, 36)) * 1000,
                        float(seeds[0].choice([0.0, seeds[0].uniform(0.1, 0.5)], p=[0.2, 0.8])))
    ground = Grounds(where)
    campaign = draw_campaign(ground, (where.number + number) % 5 == 4, seeds[1])
    device_m = _devices(ground, campaign, seeds[2])
    reserve, blocks = _influence(where, device_m, campaign.points_m)
    gaps_m = float(np.exp(seeds[3].uniform(np.log(0.3), np.log(2)))), float(np.exp(seeds[3].uniform(0, np.log(4))))
    true: list[Building | None] = [_as_built(one, gaps_m, seeds[3]) for one in where.buildings]
    lost, unmapped = _changes(blocks, reserve, seeds[4])
    for index in (*lost, reserve):
        true[index] = None
    mapped = tuple(index not in (*unmapped, reserve) for index in range(len(true)))
    return World(where, number, frequency_hz, settings, tuple(true), mapped, reserve, gaps_m, device_m, campaign)


def _as_built(one: Building, gaps_m: tuple[float, float], rng: np.random.Generator) -> Building:
    """Move and grow a building, so that each wall is off by about `gaps_m[0]`."""
    off = np.clip(rng.normal(0, gaps_m[0] / np.sqrt(2), 4), -MOST_OFF_M, MOST_OFF_M)
    middle = 0.5 * (one.footprint_m.min(axis=0) + one.footprint_m.max(axis=0))
    reach = np.ptp(one.footprint_m, axis=0) / 2
    footprint = (one.footprint_m - middle) * (1 + off[2:] / reach) + middle + off[:2]
    height_m = max(3.0, one.height_m + float(np.clip(rng.normal(0, gaps_m[1]), -MOST_HIGH_M, MOST_HIGH_M)))
    return replace(one, footprint_m=footprint.round(2), height_m=round(height_m, 1))


def _devices(ground: Grounds, campaign: Campaign, rng: np.random.Generator) -> np.ndarray:
    """At street level, at roof edges, and in worlds of stations two or three on roofs; the last one is nobody's."""
    found: list[np.ndarray] = []
    stations = int(rng.integers(2, 4)) if campaign.stations else 0
    roofs = 0.0 if campaign.stations else rng.uniform(0, 0.5)
    number = stations or DEVICES
    while len(found) < number + 1:
        if (stations or rng.random() < roofs) and len(found) < number:
            point = ground.roof_edge(rng, tallest=bool(stations))
        else:
            point = np.array([*ground.free_point(rng, GAP_M), rng.choice([1.5, 1.5, 2.0, 3.0, 6.0])])
        apart_m = np.hypot(*(np.array(found).reshape(-1, 3)[:, :2] - point[:2]).T)
        if (apart_m > APART_M).all() and np.linalg.norm(campaign.points_m - point, axis=1).min() > 3:
            found.append(point)
    return np.array(found).round(2)


def _influence(where: City, device_m: np.ndarray, points_m: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the building to take away, and how many links each building of the plan blocks alone."""
    some_m = points_m[::4]
    a_m, b_m = np.repeat(device_m[:-1], len(some_m), axis=0), np.tile(some_m, (len(device_m) - 1, 1))
    alone = blocked_alone(where.buildings, a_m, b_m)
    own_roof = [inside(device_m[:, :2], one.footprint_m).any() for one in where.buildings]
    order = [index for index in np.argsort(-alone, kind="stable") if not own_roof[index]]
    return int(order[2]), np.where(own_roof, 10**6, alone)


def _changes(alone: np.ndarray, reserve: int, rng: np.random.Generator) -> tuple[list[int], list[int]]:
    """Draw 0 to 10 % of buildings that are gone or unmapped, of those that matter least to the links."""
    number = int(round(rng.uniform(0, 0.1) * len(alone)))
    little = [index for index in np.argsort(alone, kind="stable")[:len(alone) // 2] if index != reserve]
    chosen = rng.permutation(little)[:number]
    return [int(index) for index in chosen[::2]], [int(index) for index in chosen[1::2]]
