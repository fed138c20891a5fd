"""Campaigns over open ground, without a map and without a ray tracer, with something hidden in them or not.

    open_case(7).measurements   # what a user would have
    open_case(7).answer         # what is hidden

A law of distance of its own, shadowing of each device from random plane waves, noise, steps and gaps; then effects by
formulas of this module. From quiet to rough, from hardly visible to obvious. All is drawn from the number of the case.
"""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from radiotwin.links.measurements import Measurements

CASES = 60
WAVES = 300  # of a field of shadowing
CRUISE_M_S, EVERY_S = 10.0, 1.0


@dataclass(frozen=True, eq=False)
class OpenCase:
    """A campaign, and what is in it.

    `answer["effects"]` is a list of what is hidden, each with `name` and `in_catalogue`; `answer["besides"]` names what
    is true of every campaign: devices are about a decibel off.
    """

    measurements: Measurements
    answer: dict
    scene: None = None


@dataclass(eq=False)
class _World:
    """n readings in the making, which effects change."""

    rng: np.random.Generator
    side_m: float
    device_m: np.ndarray
    flight: np.ndarray
    receiver: np.ndarray
    device: np.ndarray
    slot: np.ndarray
    time_s: np.ndarray
    place_m: np.ndarray
    level_db: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def away_m(self) -> np.ndarray:
        return self.place_m - self.device_m[self.device]

    def pick(self, label: np.ndarray) -> np.ndarray:
        """Return the mask of the readings of one of the labels (n,)."""
        return label == self.rng.choice(np.unique(label))

    def size_db(self, low: float = 1.0, high: float = 9.0) -> float:
        return float(self.rng.choice([-1, 1]) * np.exp(self.rng.uniform(np.log(low), np.log(high))))


def _campaign(rng: np.random.Generator) -> _World:
    side_m, devices, receivers = rng.uniform(300, 900), rng.integers(4, 9), rng.integers(1, 4)
    flights, slots = rng.integers(3, 9), rng.integers(50, 121)
    rows = []
    for flight in range(flights):
        for receiver in range(receivers):
            if flights > 3 and rng.random() < 0.15:
                continue
            place, heading, height = rng.uniform(0.2, 0.8, 2) * side_m, rng.uniform(0, 2 * np.pi), rng.uniform(20, 90)
            for slot in range(slots):
                heading += rng.normal(0, 0.2)
                if np.abs(place - side_m / 2).max() > 0.48 * side_m:
                    heading = np.arctan2(*(side_m / 2 - place))
                place = place + CRUISE_M_S * EVERY_S * np.array([np.sin(heading), np.cos(heading)])
                rows += [(flight, receiver, device, slot, slots * 1.5 * flight + slot * EVERY_S, *place, height)
                         for device in range(devices)]
    flight, receiver, device, slot, time_s, *place_m = np.array(rows).T
    device_m = np.column_stack([rng.uniform(0, side_m, (devices, 2)), rng.uniform(1, 10, devices)])
    flight, receiver, device, slot = (each.astype(int) for each in (flight, receiver, device, slot))
    return _World(rng, side_m, device_m, flight, receiver, device, slot, time_s, np.column_stack(place_m))


def _shadowing_db(at: _World) -> np.ndarray:
    """Return a field (n,) for each device whose correlation falls exponentially with the distance."""
    sd_db, length_m = at.rng.choice([0.0, 1.0, 2.5, 5.0, 8.0]), np.exp(at.rng.uniform(np.log(6), np.log(80)))
    result = np.zeros(len(at.device))
    for device in range(len(at.device_m)):
        mine = at.device == device
        # The spectrum of exp(-d / length) in the plane is a Cauchy density: normal over the root of a gamma variable.
        waves = at.rng.normal(size=(WAVES, 2)) / np.sqrt(at.rng.chisquare(1, (WAVES, 1))) / length_m
        phase = at.place_m[mine, :2] @ waves.T + at.rng.uniform(0, 2 * np.pi, WAVES)
        result[mine] = sd_db * np.sqrt(2 / WAVES) * np.cos(phase).sum(axis=1)
    return result


def _receiver_gain_offset(at: _World) -> None:
    at.level_db[at.pick(at.receiver)] += at.size_db()


def _device_gain_offset(at: _World) -> None:
    at.level_db[at.pick(at.device)] += at.size_db()


def _receiver_drift(at: _World) -> None:
    mine, lasts_s = at.pick(at.receiver), at.rng.uniform(0.1, 0.4) * np.ptp(at.time_s)
    at.level_db[mine] += at.size_db(2.0, 10.0) * np.exp(-(at.time_s[mine] - at.time_s.min()) / lasts_s)


def _device_drift(at: _World) -> None:
    when_s = at.rng.uniform(0.3, 0.7) * np.ptp(at.time_s)
    at.level_db[at.pick(at.device) & (at.time_s > when_s)] += at.size_db()


def _antenna_pattern(at: _World) -> None:
    mine, turned = at.pick(at.device), at.rng.uniform(0, 2 * np.pi)
    east, north, _ = at.away_m[mine].T
    forward = 0.5 + 0.5 * np.cos(np.arctan2(east, north) - turned)
    at.level_db[mine] -= abs(at.size_db(4.0, 25.0)) * (1 - forward ** at.rng.uniform(0.7, 3.0))


def _episode(at: _World) -> None:
    mine, length_s = at.pick(at.receiver), at.rng.uniform(0.08, 0.25) * np.ptp(at.time_s)
    start_s = at.rng.uniform(0.1, 0.9 - length_s / np.ptp(at.time_s)) * np.ptp(at.time_s)
    at.level_db[mine & (at.time_s > start_s) & (at.time_s < start_s + length_s)] -= abs(at.size_db(3.0, 15.0))


def _faulty_flight(at: _World) -> None:
    flown = np.unique(np.column_stack([at.receiver, at.flight]), axis=0)
    receivers, counts = np.unique(flown[:, 0], return_counts=True)
    mine = at.receiver == at.rng.choice(receivers[counts >= min(3, counts.max())])
    mine &= at.flight == at.rng.choice(np.unique(at.flight[mine])[1:-1])
    if at.rng.random() < 0.5:
        at.level_db[mine] += at.size_db(4.0, 12.0)
    else:
        at.level_db[mine] += at.rng.normal(0, at.rng.uniform(4, 10), mine.sum())


def _interference(at: _World) -> None:
    place_m = np.r_[at.rng.uniform(0, at.side_m, 2), 10.0]
    away_m = np.maximum(np.linalg.norm(at.place_m - place_m, axis=1), 5.0)
    noise_db = np.quantile(at.level_db, at.rng.uniform(0.3, 0.8)) - 20 * np.log10(away_m / (0.2 * at.side_m))
    at.level_db[:] = 10 * np.log10(10 ** (at.level_db / 10) + 10 ** (noise_db / 10))


def _receiver_saturation(at: _World) -> None:
    mine = at.pick(at.receiver)
    most_db = np.quantile(at.level_db[mine], at.rng.uniform(0.4, 0.85))
    over_db = np.maximum(at.level_db[mine] - most_db, 0)
    at.level_db[mine] -= over_db - 3 * np.log1p(over_db / 3) * 0.5


def _wander(at: _World) -> None:
    mine = at.pick(at.receiver)
    at.level_db[mine] += at.size_db(2.0, 8.0) * np.sin(2 * np.pi * at.time_s[mine] / at.rng.uniform(60, 300))


def _lobes(at: _World) -> None:
    mine = at.pick(at.device)
    up = np.arctan2(at.away_m[mine, 2], np.linalg.norm(at.away_m[mine, :2], axis=1))
    at.level_db[mine] += abs(at.size_db(3.0, 9.0)) * np.sin(at.rng.uniform(10, 40) * up + at.rng.uniform(0, 6))


def _lorry(at: _World) -> None:
    mine, towards = at.pick(at.device), at.rng.uniform(0, 2 * np.pi)
    hidden = np.cos(np.arctan2(at.away_m[:, 0], at.away_m[:, 1]) - towards) > np.cos(at.rng.uniform(0.2, 0.6))
    when_s = at.rng.uniform(0.3, 0.6) * np.ptp(at.time_s)
    at.level_db[mine & hidden & (at.time_s > when_s)] -= abs(at.size_db(5.0, 20.0))


KNOWN = {"receiver_gain_offset": _receiver_gain_offset, "device_gain_offset": _device_gain_offset,
         "receiver_drift": _receiver_drift, "device_drift": _device_drift, "antenna_pattern": _antenna_pattern,
         "episode": _episode, "faulty_flight": _faulty_flight, "interference": _interference,
         "receiver_saturation": _receiver_saturation}
WRITTEN = ("device_position_error", "receiver_clock_offset")  # the levels are right, the positions beside them are not
OUTSIDE = {"wander": _wander, "lobes": _lobes, "lorry": _lorry}


def open_case(number: int) -> OpenCase:
    """A campaign by its number, from 0: nothing hidden in a fifth, something that no catalogue has in a fifth."""
    rng = np.random.default_rng([2024, number])
    at = _campaign(rng)
    shadowing_db = _shadowing_db(at)
    away_m = np.linalg.norm(at.away_m, axis=1)
    at.level_db = (-rng.uniform(30, 45) - 10 * rng.uniform(2.0, 3.5) * np.log10(away_m) + shadowing_db
                   + rng.normal(0, 1, len(at.device_m))[at.device])
    kind = ("nothing", "outside", "known", "known", "known")[number % 5]
    drawn = {"nothing": [], "outside": list(OUTSIDE), "known": [*KNOWN, *WRITTEN]}[kind]
    if len(np.unique(at.receiver)) == 1:  # alone, a receiver's constant is everybody's
        drawn = [name for name in drawn if name != "receiver_gain_offset"]
    name = str(rng.choice(drawn)) if drawn else None
    if name in KNOWN or name in OUTSIDE:
        (KNOWN | OUTSIDE)[name](at)
    at.level_db += rng.uniform(0.5, 3.0) * rng.normal(size=len(at.level_db))
    written_m, declared_m, keep = at.place_m.copy(), at.device_m.copy(), rng.random(len(at.level_db)) < 0.95
    if name == "device_position_error":
        angle, moved_m = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(8), np.log(90)))
        declared_m[rng.integers(len(declared_m)), :2] += moved_m * np.array([np.sin(angle), np.cos(angle)])
    elif name == "receiver_clock_offset":
        mine, late = at.pick(at.receiver), int(rng.integers(1, 5))
        there = np.flatnonzero(mine & (at.slot >= late))
        written_m[there] = at.place_m[there - late * len(at.device_m)]
        keep &= ~mine | (at.slot >= late)
    return OpenCase(_measured(at, written_m, declared_m, keep, rng),
                    {"effects": [{"name": name, "in_catalogue": name not in OUTSIDE}] if name else [],
                     "besides": ["device_gain_offset"]})


def _measured(at: _World, written_m: np.ndarray, declared_m: np.ndarray, keep: np.ndarray,
              rng: np.random.Generator) -> Measurements:
    step_db = rng.choice([0.1, 0.25, 1.0])
    level_db = np.round(at.level_db / step_db) * step_db
    limit_db = np.quantile(level_db, rng.choice([0.0, 0.05, 0.2]))
    table = pd.DataFrame({
        "time_s": at.time_s, "flight": [f"f{i + 1}" for i in at.flight], "receiver": [f"r{i + 1}" for i in at.receiver],
        **{f"receiver_{axis}_m": written_m[:, i].round(2) for i, axis in enumerate("xyz")},
        "device": [f"d{i + 1}" for i in at.device], "gain_db": np.where(level_db < limit_db, np.nan, level_db)})
    devices = pd.DataFrame({"device": [f"d{i + 1}" for i in range(len(declared_m))],
                            **{f"{axis}_m": declared_m[:, i] for i, axis in enumerate("xyz")}, "role": "anchor",
                            "frequency_hz": rng.choice([0.868e9, 2.4e9, 5.8e9])})
    return Measurements(table[keep].reset_index(drop=True), devices)
