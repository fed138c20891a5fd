"""Exploration, replay memory of whole flights, and packed batches for training."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from marl.checkpoint import Within, require
from marl.environment import ACTION_COUNT, Frame, empty_frame
from marl.flights import Flights
from marl.mission import MAX_SNR_DB, Mission


class Exploration:
    """Temporally extended ε-greedy exploration: random actions that are repeated for some slots.

    Independent random moves hardly ever take a UAV across the city (Dabney, Ostrovski and Barreto,
    ICLR 2021; here with a geometric distribution of lengths). Each UAV explores independently.

    `epsilon` is the share of the slots in which UAVs explore. An excursion takes `mean_slots` in
    the mean, at least 1, and ends early if its action is not feasible.
    """

    def __init__(self, epsilon: float, mean_slots: float, rng: np.random.Generator) -> None:
        self._mean_slots, self._rng = mean_slots, rng
        # Probability that an excursion begins in a slot without one.
        self._begin = epsilon / (mean_slots - epsilon * (mean_slots - 1))

    def start(self, flights: int, uavs: int) -> None:
        """Reset the excursions for new flights."""
        self._kept = np.zeros((flights, uavs), dtype=np.int64)
        self._left = np.zeros((flights, uavs), dtype=np.int64)

    def change(self, action: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Replace some of a policy's actions (E, U) by random ones that `mask` (E, U, 6) allows.

        A random action is repeated for some slots, and ends early if it becomes infeasible.
        """
        begins = (self._rng.random(action.shape) < self._begin) & (self._left == 0)
        drawn = np.where(mask, self._rng.random(mask.shape), -1.0).argmax(axis=-1)
        self._kept[begins] = drawn[begins]
        lengths = np.ones(action.shape, dtype=np.int64) if self._mean_slots == 1 else \
            self._rng.geometric(1 / self._mean_slots, action.shape)
        self._left[begins] = lengths[begins]
        feasible = np.take_along_axis(mask, self._kept[..., None], axis=-1)[..., 0]
        explores = (self._left > 0) & feasible
        self._left = np.where(explores, self._left - 1, 0)
        return np.where(explores, self._kept, action)


class Replay:
    """Replay memory of the last `capacity` flights, now `size`, allocated once.

    It stores frames, from which features are computed when they are sampled. Frames take a fifth of
    the memory, and features of flights in an earlier twin use today's known positions.
    """

    def __init__(self, capacity: int, mission: Mission) -> None:
        self.capacity, self.size, self._next = capacity, 0, 0
        shape = (capacity, mission.longest)
        self._flights = Flights(
            empty_frame(shape, mission), np.zeros((*shape, mission.uavs), np.int8),
            np.zeros((*shape, mission.uavs), np.float32), np.zeros(capacity, np.int32))
        waiting = mission.data_units.astype(np.float32)
        # Ranges of values that are accepted from a checkpoint.
        self._ranges = {
            "cell": (0, np.array(mission.steps_home.shape[1:]) - 1),
            "battery": (0, mission.battery), "snr_db": (-np.inf, MAX_SNR_DB),
            "data_units": (0, waiting), "assigned": (-1, mission.devices - 1),
            "action": (0, ACTION_COUNT - 1), "collected": (0, waiting.max()),
            "length": (1, mission.longest)}

    def add(self, flights: Flights) -> None:
        """Store new flights in place of the oldest ones."""
        rows = (self._next + np.arange(len(flights.length))) % self.capacity
        for kept, new in zip(_arrays(self._flights).values(), _arrays(flights).values()):
            kept[rows] = new
        self._next = int((self._next + len(rows)) % self.capacity)
        self.size = min(self.size + len(rows), self.capacity)

    def sample(self, count: int, rng: np.random.Generator) -> Flights:
        """Draw `count` different flights uniformly, cut to the longest of them."""
        rows, kept = rng.choice(self.size, count, replace=False), self._flights
        slots = kept.length[rows].max()
        return Flights(Frame(*(array[rows, :slots] for array in kept.frames)),
                       kept.action[rows, :slots], kept.collected[rows, :slots], kept.length[rows])

    def state(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {"next": self._next, "size": self.size,
                **{name: array[:self.size] for name, array in _arrays(self._flights).items()}}

    def load_state(self, state: dict) -> None:
        """Restore the memory from a checkpoint's state."""
        size = require(state["size"], range(self.capacity + 1), "size")
        arrays = {name: array[:size] for name, array in _arrays(self._flights).items()}
        require(state, {"next": range(self.capacity), "size": ...} | {
            name: Within(array, *self._ranges[name]) for name, array in arrays.items()})
        for name, array in arrays.items():
            array[:] = state[name]
        self._next, self.size = state["next"], size


def _arrays(flights: Flights) -> dict[str, np.ndarray]:
    """Return all arrays of a record by name."""
    return flights.frames._asdict() | {"action": flights.action, "collected": flights.collected,
                                       "length": flights.length}


@dataclass(frozen=True, eq=False)
class Batch:
    """E flights to learn from, packed as by `torch.nn.utils.rnn.PackedSequence`.

    Rows are all flights in slot 0, the longest first, then those still flying in slot 1, and so on.
    N is the sum of their lengths, T the longest, U the number of UAVs.

    Attributes:
        observation: (N, U, observation_size)
        mask: (N, U, 6) bool feasible actions.
        state: (N, state_size)
        action: (N, U) int64.
        last_action: (N, U) int64, of the slot before; -1 in the first one.
        reward: (T, E, 1), not packed.
        valid: (T, E, 1), 0 behind the end of a flight.
        slot: (N,) slot of each row.
        flight: (N,) flight of each row, an index of `reward` and `valid`: the longest flight is 0.
        sizes: (T,) int64 flights that reach each slot, on the CPU.
    """

    observation: Tensor
    mask: Tensor
    state: Tensor
    action: Tensor
    last_action: Tensor
    reward: Tensor
    valid: Tensor
    slot: Tensor
    flight: Tensor
    sizes: np.ndarray

    def unpacked(self, values: Tensor) -> Tensor:
        """Unpack values (N, …) to (T, E, …), with 0 after the end of a flight."""
        padded = values.new_zeros(*self.valid.shape[:2], *values.shape[1:])
        padded[self.slot, self.flight] = values
        return padded
