"""Simulate whole flights with a policy, and record them."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd

from marl.environment import Environment, Frame, empty_frame
from marl.mission import Mission
from radiotwin.scene import Scene


@dataclass(frozen=True, eq=False)
class Flights:
    """A record of E flights, slot by slot.

    Attributes:
        frames: `Frame` of arrays (E, T, …): the state before each action.
        action: (E, T, U) int8.
        collected: (E, T, U) float32 data units.
        length: (E,) int32 slots until all batteries were empty; later slots are padding.
    """

    frames: Frame
    action: np.ndarray
    collected: np.ndarray
    length: np.ndarray

    def ratio(self, mission: Mission) -> np.ndarray:
        """Return the (E,) share of all data that each flight collected."""
        initial = self.frames.data_units[:, 0].sum(axis=1, dtype=float)
        return self.collected.sum(axis=(1, 2), dtype=float) / initial


class Policy(Protocol):
    """Decides the actions of E flights, slot by slot."""

    def start(self, mission: Mission, flights: int) -> None:
        """Reset the policy for E = `flights` new flights of a mission."""

    def act(self, frame: Frame) -> np.ndarray:
        """Return feasible actions (E, U) for the present slot."""


def fly(environment: Environment, policy: Policy) -> Flights:
    """Fly a policy from take-off until all batteries are empty, and record every slot."""
    mission, frame = environment.mission, environment.reset()
    count = len(frame.battery)
    policy.start(mission, count)
    shape = (count, mission.longest)
    record = Flights(empty_frame(shape, mission), np.zeros((*shape, mission.uavs), np.int8),
                     np.zeros((*shape, mission.uavs), np.float32), np.zeros(count, np.int32))
    slot, flying = 0, np.ones(count, dtype=bool)
    while flying.any():
        for kept, now in zip(record.frames, frame):
            kept[:, slot] = now
        action = policy.act(frame)
        record.action[:, slot] = action
        record.collected[:, slot] = environment.step(action)
        record.length[flying] += 1
        flying = ~environment.done
        slot += 1
    for kept, now in zip(record.frames, frame):
        kept[:, slot:] = now[:, None]  # padded with a valid state, so that features can be computed
    return record


def evaluate(mission: Mission, policy: Policy, flights: int, rng: np.random.Generator) -> Flights:
    """Fly a policy for E = `flights` flights of a mission; `rng` draws the shadowing."""
    return fly(Environment(mission, flights, rng), policy)


def track_table(scene: Scene, mission: Mission, flights: Flights, flight: int) -> pd.DataFrame:
    """Return one flight as a table with a row for each UAV and slot until its battery is empty.

    The column device is the one assigned to the UAV, empty for none.
    """
    parts, frames = [], flights.frames
    names = np.array([device.device for device in scene.config.devices] + [""])
    for u, uav in enumerate(scene.config.uavs):
        flying = frames.battery[flight, :flights.length[flight], u] > 0
        slots = np.arange(max(int(flying.sum()), 1))
        cell = frames.cell[flight, slots, u].astype(int)
        parts.append(pd.DataFrame({
            "flight": f"f{flight}", "uav": uav.uav, "time_s": scene.config.mission.slot_s * slots,
            "x_m": scene.lattice.x_m[cell[:, 1]], "y_m": scene.lattice.y_m[cell[:, 0]],
            "z_m": mission.altitude_m[u], "device": names[frames.assigned[flight, slots, u]],
            "collected": flights.collected[flight, slots, u]}))
    return pd.concat(parts, ignore_index=True)
