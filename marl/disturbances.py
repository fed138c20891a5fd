"""Flights that do not go as was thought before take-off: data volumes that nobody knew, and a UAV that is lost."""

from typing import NamedTuple

import numpy as np

from marl.environment import Environment, Frame
from marl.mission import Mission


class Disturbance(NamedTuple):
    """What happens.

    Attributes:
        volume_spread: each device's data is drawn evenly from (1 ± this) times what the mission says, for every flight.
        loss: chance that one of the UAVs, each as likely, is lost in a flight: from a slot of the first half of the
            longest flight on it stands still, collects nothing, and has no battery.
    """

    volume_spread: float = 0.0
    loss: float = 0.0


class DisturbedEnvironment(Environment):
    """`Environment` with a disturbance, drawn anew for every flight."""

    def __init__(self, mission: Mission, flights: int, rng: np.random.Generator, disturbance: Disturbance):
        super().__init__(mission, flights, rng)
        self._disturbance = disturbance
        self._slot, self._lost, self._lost_in = np.zeros((3, flights), dtype=np.int64)

    def reset(self, which: np.ndarray | None = None) -> Frame:
        """See `Environment.reset`; with these flights' data volumes."""
        frame, mission, rng = super().reset(which), self.mission, self._rng
        new = np.arange(len(frame.cell)) if which is None else np.flatnonzero(which)
        flights, (volume_spread, loss) = len(new), self._disturbance
        frame.data_units[new] = mission.data_units * rng.uniform(1 - volume_spread, 1 + volume_spread,
                                                                 (flights, frame.data_units.shape[1]))
        self._slot[new], self._lost[new] = 0, rng.integers(0, mission.uavs, flights)
        self._lost_in[new] = np.where(rng.random(flights) < loss, rng.integers(1, mission.longest // 2 + 1, flights),
                                      -1)
        return frame

    def step(self, action: np.ndarray) -> np.ndarray:
        """See `Environment.step`."""
        collected = super().step(action)
        self._slot += 1
        flights = np.flatnonzero(self._lost_in == self._slot)
        self.frame.battery[flights, self._lost[flights]] = 0
        # The device that it would have served waits for a slot: the others were assigned before anybody knew.
        self.frame.assigned[flights, self._lost[flights]] = -1
        return collected
