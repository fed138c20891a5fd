"""Environment with disturbances: other data volumes than assumed, and a UAV that fails."""

from typing import NamedTuple

import numpy as np
from typing_extensions import override

from marl.environment import Environment, Frame
from marl.mission import Mission


class Disturbance(NamedTuple):
    """Distribution of the surprises.

    Attributes:
        volume_spread: each device's data is drawn uniformly from (1 ± this) times the mission's
            value, for every flight.
        loss: probability that one of the UAVs, all equally likely, fails in a flight: from a slot
            of the first half of the longest flight on it stays where it is with an empty battery.
    """

    volume_spread: float = 0.0
    loss: float = 0.0


class DisturbedEnvironment(Environment):
    """`Environment` with a disturbance, drawn anew for every flight."""

    def __init__(self, mission: Mission, flights: int, rng: np.random.Generator,
                 disturbance: Disturbance) -> None:
        super().__init__(mission, flights, rng)
        self._disturbance = disturbance
        self._slot, self._failed, self._failed_in = np.zeros((3, flights), dtype=np.int64)

    @override
    def reset(self, which: np.ndarray | None = None) -> Frame:
        frame, mission, rng = super().reset(which), self.mission, self._rng
        new = np.arange(len(frame.cell)) if which is None else np.flatnonzero(which)
        flights, (volume_spread, loss) = len(new), self._disturbance
        frame.data_units[new] = mission.data_units * rng.uniform(
            1 - volume_spread, 1 + volume_spread, (flights, frame.data_units.shape[1]))
        self._slot[new], self._failed[new] = 0, rng.integers(0, mission.uavs, flights)
        self._failed_in[new] = np.where(rng.random(flights) < loss,
                                        rng.integers(1, max(mission.longest // 2, 1) + 1, flights),
                                        -1)
        return frame

    @override
    def step(self, action: np.ndarray) -> np.ndarray:
        collected = super().step(action)
        self._slot += 1
        flights = np.flatnonzero(self._failed_in == self._slot)
        self.frame.battery[flights, self._failed[flights]] = 0
        # Its device waits for a slot: the others were assigned before the failure was known.
        self.frame.assigned[flights, self._failed[flights]] = -1
        return collected
