"""Flying whole flights with a policy, and what is recorded of them."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd
import torch

from marl.environment import Environment, Frame, empty_frame
from marl.exploration import Exploration
from marl.features import observe
from marl.heuristics import greedy_actions, random_actions
from marl.mission import Mission
from marl.networks import Agent
from radiotwin.scene import Scene


@dataclass(frozen=True, eq=False)
class Flights:
    """A record of E flights, slot by slot.

    Attributes:
        frames: `Frame` of arrays (E, T, …): what there was before each action.
        action: (E, T, U) int8.
        collected: (E, T, U) float32 data units.
        length: (E,) int32 slots until all batteries were empty; what lies behind is padding.
    """

    frames: Frame
    action: np.ndarray
    collected: np.ndarray
    length: np.ndarray

    def ratio(self, mission: Mission) -> np.ndarray:
        """(E,) collected data of all the data that waited."""
        return self.collected.sum(axis=(1, 2), dtype=float) / self.frames.data_units[:, 0].sum(axis=1, dtype=float)


def track_table(scene: Scene, mission: Mission, flights: Flights, flight: int) -> pd.DataFrame:
    """One flight as a table: flight, uav, time_s, x_m, y_m, z_m, the device that served the UAV there (empty for none),
    and collected [data units]; a row for every slot until the UAV's battery is empty."""
    parts, frames = [], flights.frames
    names = np.array([device.device for device in scene.config.devices] + [""])
    for u, uav in enumerate(scene.config.uavs):
        slots = np.arange(max(int((frames.battery[flight, :flights.length[flight], u] > 0).sum()), 1))
        cell = frames.cell[flight, slots, u].astype(int)
        parts.append(pd.DataFrame({
            "flight": f"f{flight}", "uav": uav.uav, "time_s": scene.config.mission.slot_s * slots,
            "x_m": scene.lattice.x_m[cell[:, 1]], "y_m": scene.lattice.y_m[cell[:, 0]], "z_m": mission.altitude_m[u],
            "device": names[frames.assigned[flight, slots, u]], "collected": flights.collected[flight, slots, u]}))
    return pd.concat(parts, ignore_index=True)


class Policy(Protocol):
    """Decides the actions of E flights, slot by slot."""

    def start(self, mission: Mission, flights: int) -> None:
        """Forget the flights before."""

    def act(self, frame: Frame) -> np.ndarray:
        """(E, U) feasible actions."""


class HeuristicPolicy:
    """`random` or `greedy`."""

    def __init__(self, name: str, rng: np.random.Generator):
        self._decide = {"random": random_actions, "greedy": greedy_actions}[name]
        self._rng = rng

    def start(self, mission: Mission, flights: int) -> None:
        self._mission = mission

    def act(self, frame: Frame) -> np.ndarray:
        return self._decide(self._mission, frame, self._rng)


class AgentPolicy:
    """The best action by the agents' values.

    Args:
        agent: its weights are read at every slot.
        device: the torch device that the agent is on.
        exploration: changes some actions; None: none.
        guide: actions (T, U) of a plan, and (E,) slots that each flight follows it before the agents take over.
    """

    def __init__(self, agent: Agent, device: str = "cpu", exploration: Exploration | None = None,
                 guide: tuple[np.ndarray, np.ndarray] | None = None):
        self._agent, self._device, self._exploration, self._guide = agent, device, exploration, guide

    def start(self, mission: Mission, flights: int) -> None:
        self._mission = mission
        self._memory = None
        self._last = np.full((flights, mission.uavs), -1, dtype=np.int64)
        self._slot = 0
        if self._exploration is not None:
            self._exploration.start(flights, mission.uavs)

    @torch.inference_mode()
    def act(self, frame: Frame) -> np.ndarray:
        observation, mask = observe(self._mission, frame)
        values, self._memory = self._agent(torch.from_numpy(observation).to(self._device)[None],
                                           torch.from_numpy(self._last).to(self._device)[None], self._memory)
        action = np.where(mask, values[0].cpu().numpy(), -np.inf).argmax(axis=-1)
        if self._exploration is not None:
            action = self._exploration.change(action, mask)
        if self._guide is not None:
            plan, slots = self._guide
            wanted = plan[self._slot]
            # A UAV that was lost cannot follow.
            following = (slots > self._slot)[:, None] & mask[:, np.arange(len(wanted)), wanted]
            action = np.where(following, wanted, action)
        self._last, self._slot = action, self._slot + 1
        return action


class Replayed:
    """The actions of earlier flights, flight by flight; only for as many, and where they are feasible.

    Args:
        action: (E, T, U).
    """

    def __init__(self, action: np.ndarray):
        self._action = action

    def start(self, mission: Mission, flights: int) -> None:
        self._slot = 0

    def act(self, frame: Frame) -> np.ndarray:
        self._slot += 1
        return self._action[:, self._slot - 1]


def fly(environment: Environment, policy: Policy) -> Flights:
    """Fly from take-off until all batteries are empty, and record everything."""
    mission, frame = environment.mission, environment.reset()
    count = len(frame.battery)
    policy.start(mission, count)
    record = Flights(empty_frame((count, mission.longest), mission),
                     np.zeros((count, mission.longest, mission.uavs), np.int8),
                     np.zeros((count, mission.longest, mission.uavs), np.float32), np.zeros(count, np.int32))
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
        kept[:, slot:] = now[:, None]  # padding that is a place where a UAV can be
    return record
