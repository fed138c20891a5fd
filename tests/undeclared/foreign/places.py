"""Effects of what is written down: a map of another year, devices and receivers that are elsewhere."""

import numpy as np

from tests.undeclared.foreign.draws import between, device
from tests.undeclared.foreign.grounds import Grounds
from tests.undeclared.foreign.layouts import Building
from tests.undeclared.foreign.scenario import Hidden, Scenario
from tests.undeclared.shapes import blocked_alone, corners_of, distance_m, fits, inside, turned


def missing_obstacle(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A building that stands and that the map lacks, one of those that alone block the most links."""
    plan = at.where.city.buildings
    some = np.arange(0, at.links, 7)
    a_m, b_m = at.where.device_m[at.device[some]], at.where.campaign.points_m[at.point[some]]
    able = [(index, one) for index, one in enumerate(at.where.true) if one is not None and at.where.mapped[index]
            and not inside(at.where.device_m[:, :2], plan[index].footprint_m).any()]
    alone = blocked_alone([one for _, one in able], a_m, b_m)
    index, one = able[int(rng.choice(np.argsort(-alone, kind="stable")[:6]))]
    return Hidden("missing_obstacle", True, _building(one), map_lacks=(index,))


def removed_obstacle(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A building that was pulled down and that the map still shows: that of the plan, or one where there is room."""
    one = at.where.city.buildings[at.where.reserve] if rng.random() < 0.5 else _in_a_gap(at, rng)
    return Hidden("removed_obstacle", True, _building(one), map_shows=(one,))


def _in_a_gap(at: Scenario, rng: np.random.Generator) -> Building:
    """Draw a building that stands on nobody's way."""
    ends_m = np.concatenate([at.where.device_m, at.where.campaign.points_m])
    low_m = ends_m[ends_m[:, 2] < 40, :2]
    standing = [one.footprint_m for one in at.where.city.buildings]
    for side_m in np.linspace(26, 7, 60):
        centre = rng.uniform(20, at.where.city.side_m - 20, 2)
        corners = turned(corners_of("box", side_m * rng.uniform(0.7, 1.4), side_m, rng), rng.uniform(0, np.pi)) + centre
        if fits(corners, standing, 3.0) and distance_m(low_m, corners).min() > 4:
            break
    else:
        return at.where.city.buildings[at.where.reserve]
    return Building(corners.round(2), round(float(rng.uniform(10, 30)), 1), "brick")


def _building(one: Building) -> dict:
    return {"corners_m": one.footprint_m.tolist(), "height_m": one.height_m,
            "centre_m": (0.5 * (one.footprint_m.min(axis=0) + one.footprint_m.max(axis=0))).round(2).tolist()}


def device_position_error(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device that stands elsewhere than its owner wrote down."""
    number, name = device(at, rng)
    true_m, ground = at.where.device_m[number], Grounds(at.where.city)
    while True:
        away_m, angle = between(rng, 4, 45), rng.uniform(0, 2 * np.pi)
        wrong_m = true_m + np.array([np.cos(angle), np.sin(angle), 0]) * away_m
        if ground.room_m(wrong_m[None, :2], wrong_m[2])[0] > 3.5:
            break
    device_m = at.where.device_m[:-1].copy()
    device_m[number] = wrong_m.round(2)
    return Hidden("device_position_error", True, {"device": name, "true_m": true_m.tolist(), "away_m": round(away_m, 1)},
                  device_m=device_m)


def receiver_clock_offset(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver's levels and positions come from two clocks."""
    campaign = at.where.campaign
    moving = [number for number in range(campaign.receiver.max() + 1) if _moves(at, number)]
    number = int(rng.choice(moving or [0]))
    late_s = float(rng.choice([-1, 1])) * between(rng, 1, 12)
    written_m = campaign.points_m.copy()
    for flight in np.unique(campaign.flight):
        rows = np.flatnonzero((campaign.flight == flight) & (campaign.receiver == number))
        for axis in range(3) if len(rows) else ():
            written_m[rows, axis] = np.interp(campaign.time_s[rows] - late_s, campaign.time_s[rows],
                                              campaign.points_m[rows, axis])
    return Hidden("receiver_clock_offset", True, {"receiver": f"r{number + 1}", "late_s": round(late_s, 2)},
                  written_m=written_m.round(2))


def _moves(at: Scenario, number: int) -> bool:
    flights = at.where.campaign.flight[at.where.campaign.receiver == number]
    return any(at.where.campaign.kind[flight] in ("drive", "fly") for flight in flights)
