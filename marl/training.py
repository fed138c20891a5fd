"""What training needs besides networks: exploration, memory of whole flights, and batches of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from marl.checkpoint import Within, require
from marl.environment import ACTION_COUNT, Frame, empty_frame
from marl.flights import Flights
from marl.mission import MAX_SNR_DB, Mission


class Exploration:
    """Random actions in place of the best ones, each kept for a while.

    Steps of one slot each take a UAV back and forth, and hardly ever across the city. Kept for
    longer they do: temporally extended ε-greedy exploration (Dabney, Ostrovski and Barreto, ICLR
    2021), with a geometric distribution in place of their zeta distribution. Each UAV of each
    flight explores by itself.

    Args:
        epsilon: share of the slots that UAVs spend on excursions.
        mean_slots: mean length of an excursion, 1 or more; it ends early where its action is not
            feasible.
        rng: of begin, length and action.
    """

    def __init__(self, epsilon: float, mean_slots: float, rng: np.random.Generator) -> None:
        self._mean_slots, self._rng = mean_slots, rng
        # Probability that an excursion begins in a slot in which none is under way.
        self._begin = epsilon / (mean_slots - epsilon * (mean_slots - 1))

    def start(self, flights: int, uavs: int) -> None:
        """Forget the flights before."""
        self._kept = np.zeros((flights, uavs), dtype=np.int64)
        self._left = np.zeros((flights, uavs), dtype=np.int64)

    def change(self, action: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return the actions (E, U) to be flown in this slot, instead of those of the policy.

        The mask (E, U, 6) has the feasible ones.
        """
        begins = (self._rng.random(action.shape) < self._begin) & (self._left == 0)
        lots = np.where(mask, self._rng.random(mask.shape), -1.0).argmax(axis=-1)
        self._kept[begins] = lots[begins]
        self._left[begins] = self._lengths(action.shape)[begins]
        feasible = np.take_along_axis(mask, self._kept[..., None], axis=-1)[..., 0]
        explores = (self._left > 0) & feasible
        self._left = np.where(explores, self._left - 1, 0)
        return np.where(explores, self._kept, action)

    def _lengths(self, shape: tuple[int, ...]) -> np.ndarray:
        if self._mean_slots == 1:
            return np.ones(shape, dtype=np.int64)
        return self._rng.geometric(1 / self._mean_slots, shape)


class Replay:
    """The last `capacity` flights, in memory allocated once.

    Frames are kept, and features are made of them when they are sampled: frames take a fifth of
    the memory, and a flight in an earlier twin is seen with the positions that are known now.

    Attributes:
        capacity: of flights.
        size: flights that are in it.
    """

    def __init__(self, capacity: int, mission: Mission) -> None:
        self.capacity, self.size, self._next = capacity, 0, 0
        shape = (capacity, mission.longest)
        self._flights = Flights(
            empty_frame(shape, mission), np.zeros((*shape, mission.uavs), np.int8),
            np.zeros((*shape, mission.uavs), np.float32), np.zeros(capacity, np.int32))
        waiting = mission.data_units.astype(np.float32)
        # Of what may be read from a checkpoint.
        self._ranges = {
            "cell": (0, np.array(mission.steps_home.shape[1:]) - 1),
            "battery": (0, mission.battery), "snr_db": (-np.inf, MAX_SNR_DB),
            "data_units": (0, waiting), "assigned": (-1, mission.devices - 1),
            "action": (0, ACTION_COUNT - 1), "collected": (0, waiting.max()),
            "length": (1, mission.longest)}

    def add(self, flights: Flights) -> None:
        """Replace the oldest flights by new ones."""
        rows = (self._next + np.arange(len(flights.length))) % self.capacity
        for kept, new in zip(_arrays(self._flights).values(), _arrays(flights).values()):
            kept[rows] = new
        self._next = int((self._next + len(rows)) % self.capacity)
        self.size = min(self.size + len(rows), self.capacity)

    def sample(self, count: int, rng: np.random.Generator) -> Flights:
        """Draw different flights uniformly; cut to the longest of them."""
        rows, kept = rng.choice(self.size, count, replace=False), self._flights
        slots = kept.length[rows].max()
        return Flights(Frame(*(array[rows, :slots] for array in kept.frames)),
                       kept.action[rows, :slots], kept.collected[rows, :slots], kept.length[rows])

    @property
    def bytes(self) -> int:
        """Memory in use."""
        return sum(array.nbytes for array in _arrays(self._flights).values())

    def state(self) -> dict[str, Any]:
        """Return a checkpoint."""
        return {"next": self._next, "size": self.size,
                **{name: array[:self.size] for name, array in _arrays(self._flights).items()}}

    def load_state(self, state: dict) -> None:
        """Go on from a checkpoint."""
        size = require(state["size"], range(self.capacity + 1), "size")
        arrays = {name: array[:size] for name, array in _arrays(self._flights).items()}
        require(state, {"next": range(self.capacity), "size": ...} | {
            name: Within(array, *self._ranges[name]) for name, array in arrays.items()})
        for name, array in arrays.items():
            array[:] = state[name]
        self._next, self.size = state["next"], size


def _arrays(flights: Flights) -> dict[str, np.ndarray]:
    return flights.frames._asdict() | {"action": flights.action, "collected": flights.collected,
                                       "length": flights.length}


@dataclass(frozen=True, eq=False)
class Batch:
    """E flights to learn from, without padding: packed as by `torch.nn.utils.rnn.PackedSequence`.

    First all flights in their first slot, then those that still fly in the second, and so on; the
    longest come first. N is the sum of their lengths, T the longest, U the number of UAVs.

    Attributes:
        observation: (N, U, observation_size)
        mask: (N, U, 6) bool feasible actions.
        state: (N, state_size)
        action: (N, U) int64.
        last_action: (N, U) int64, of the slot before; -1 in the first one.
        reward: (T, E, 1), not packed.
        valid: (T, E, 1), 0 behind the end of a flight.
        slot: (N,) of each row.
        flight: (N,) likewise.
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
        """Return (N, …) values as (T, E, …), 0 behind the end of a flight."""
        padded = values.new_zeros(*self.valid.shape[:2], *values.shape[1:])
        padded[self.slot, self.flight] = values
        return padded
