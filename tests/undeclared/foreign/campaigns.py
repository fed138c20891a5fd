"""Campaigns: who measured where and when. UAVs fly at many heights or hover, cars and walkers move in the streets."""

from dataclasses import dataclass

import numpy as np

from tests.undeclared.foreign.grounds import Grounds

POINTS, STATION_POINTS = 560, 1260  # of a campaign, about; two or three stations need more for as many links
STREET_ROOM_M, AIR_ROOM_M = 4.2, 6.0
LEG_M = (35.0, 190.0)


@dataclass(frozen=True, eq=False)
class Campaign:
    """p points of flights of receivers.

    Attributes:
        stations: cars that listen to stations on roofs.
        points_m: (p, 3) where the receivers truly are [m].
        time_s: (p,) since the campaign began.
        flight, receiver: (p,) numbers.
        heading_deg, pitch_deg, roll_deg: (p,) attitude; heading clockwise from north.
        kind: of each flight: `drive`, `walk`, `fly`, `hover`.
    """

    stations: bool
    points_m: np.ndarray
    time_s: np.ndarray
    flight: np.ndarray
    receiver: np.ndarray
    heading_deg: np.ndarray
    pitch_deg: np.ndarray
    roll_deg: np.ndarray
    kind: tuple[str, ...]


def draw_campaign(ground: Grounds, stations: bool, rng: np.random.Generator) -> Campaign:
    """Draw a campaign of 2 to 10 flights by 1 to 4 receivers; `stations`: cars and walkers only."""
    flights = int(rng.integers(2, 11))
    receivers = int(rng.choice([1, 2, 3, 4], p=[0.12, 0.53, 0.25, 0.1]))
    together = rng.random() < 0.5 or flights < 2 * receivers  # all receivers in each flight, or one each
    crews = [list(range(receivers))] * flights if together else [[n % receivers] for n in range(flights)]
    tracks = sum(len(crew) for crew in crews)
    each = (STATION_POINTS if stations else POINTS) // tracks
    mix = ["drive", "walk"] if stations else list(rng.choice(["drive", "fly", "hover", "fly", "walk"], 3, replace=False))
    levels_m = rng.uniform(20, 110, 4)
    parts, kinds, start_s = [], [], 0.0
    for flight, crew in enumerate(crews):
        kind = str(rng.choice(mix))
        kinds.append(kind)
        ends = []
        for receiver in crew:
            height_m = float({"drive": 1.8, "walk": 1.5}.get(kind, rng.choice(levels_m) + rng.normal(0, 2)))
            part = _track(ground, kind, height_m, each, rng)
            part["time_s"] = part["time_s"] + start_s
            ends.append(part["time_s"][-1])
            part["flight"], part["receiver"] = np.full(each, flight), np.full(each, receiver)
            parts.append(part)
        start_s = max(ends) + float(rng.integers(60, 900))
    return Campaign(stations, kind=tuple(kinds), **{name: np.concatenate([part[name] for part in parts])
                                                    for name in parts[0]})


def _track(ground: Grounds, kind: str, height_m: float, number: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Sample a track of `number` points of one receiver."""
    flies = kind in ("fly", "hover")
    room_m = AIR_ROOM_M if flies else STREET_ROOM_M
    speed_m_s = {"drive": rng.uniform(4, 12), "walk": rng.uniform(1.0, 1.7), "fly": rng.uniform(3, 14),
                 "hover": rng.uniform(3, 8)}[kind]
    spacing_m = rng.uniform(3, 9)
    rest = int(rng.integers(8, 25)) if kind == "hover" else 1  # readings at each place
    route = _route(ground, height_m if flies else 0.0, room_m, spacing_m * number / rest * (6 if rest > 1 else 1), rng)
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    places = int(np.ceil(number / rest))
    at = np.linspace(0, along[-1], places) if rest > 1 else np.arange(number) * spacing_m
    xy = np.column_stack([np.interp(at, along, route[:, axis]) for axis in (0, 1)])
    course = np.array([route[min(np.searchsorted(along, s, side="right"), len(route) - 1)]
                       - route[min(np.searchsorted(along, s, side="right"), len(route) - 1) - 1] for s in at])
    heading = np.degrees(np.arctan2(course[:, 0], course[:, 1]))
    time_s = at / speed_m_s
    if rest > 1:
        xy = np.repeat(xy, rest, axis=0)[:number]
        heading = np.repeat(heading, rest)[:number] + np.linspace(0, rng.choice([0, 360.0]) * places, number)
        time_s = np.repeat(time_s, rest)[:number] + np.arange(number) * 1.0
    sway = np.cumsum(rng.normal(0, 0.15, number)) if flies else np.zeros(number)
    tilt = rng.normal(0, 1.5 if flies else 0.4, (2, number)) + ([[-3.0 if kind == "fly" else 0.0], [0.0]])
    return {"points_m": np.column_stack([xy, height_m + np.clip(sway, -1.5, 1.5)]).round(2),
            "time_s": time_s.round(2), "heading_deg": ((heading + rng.normal(0, 2, number)) % 360).round(1) % 360,
            "pitch_deg": tilt[0].round(1), "roll_deg": tilt[1].round(1)}


def _route(ground: Grounds, height_m: float, room_m: float, length_m: float, rng: np.random.Generator) -> np.ndarray:
    """(m, 2) corners of a random walk of straight legs that keep room from all buildings, at least `length_m` long."""
    route, total_m, least_m = [ground.free_point(rng, room_m, height_m)], 0.0, LEG_M[0]
    while total_m < length_m:
        for _ in range(200):
            leg_m = rng.uniform(least_m, LEG_M[1])
            angle = rng.uniform(0, 2 * np.pi)
            steps = np.arange(1.0, leg_m + 1.0)[:, None]
            leg = route[-1] + steps * (np.cos(angle), np.sin(angle))
            if ground.room_m(leg, height_m).min() >= room_m:
                route.append(leg[-1])
                total_m += float(steps[-1, 0])
                least_m = LEG_M[0]
                break
        else:
            least_m /= 2  # a narrow yard: shorter legs, then another start
            if least_m < 4:
                route, total_m, least_m = [ground.free_point(rng, room_m, height_m)], 0.0, LEG_M[0]
    return np.array(route)
