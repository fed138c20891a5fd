"""Memory of whole flights, allocated once."""

import numpy as np

from marl.environment import Environment, Frame, empty_frame
from marl.flights import Flights, Replayed, fly
from marl.mission import Mission

SIDE_BY_SIDE = 200  # flights that are flown again at once; bounds the memory


class Replay:
    """The last `capacity` flights as frames; features are made of them when they are sampled.

    Frames are a fifth of the size of observations, and a flight remembered from an earlier twin is seen with the
    positions that are known now.

    Attributes:
        size: flights that are in it.
    """

    def __init__(self, capacity: int, mission: Mission):
        self.capacity, self.size, self._next = capacity, 0, 0
        shape = (capacity, mission.longest)
        self._flights = Flights(empty_frame(shape, mission), np.zeros((*shape, mission.uavs), np.int8),
                                np.zeros((*shape, mission.uavs), np.float32), np.zeros(capacity, np.int32))

    def add(self, flights: Flights) -> None:
        """Put flights in the place of the oldest ones."""
        rows = (self._next + np.arange(len(flights.length))) % self.capacity
        for kept, new in zip(_arrays(self._flights), _arrays(flights)):
            kept[rows] = new
        self._next = int((self._next + len(rows)) % self.capacity)
        self.size = min(self.size + len(rows), self.capacity)

    def fly_again(self, mission: Mission, rng: np.random.Generator) -> None:
        """Fly all that is remembered again in another map: the same actions, but what is received and collected there.

        Args:
            mission: differs in the map and the known positions only, so that the actions stay feasible.
            rng: draws the shadowing.
        """
        for start in range(0, self.size, SIDE_BY_SIDE):
            rows = slice(start, min(start + SIDE_BY_SIDE, self.size))
            flights = fly(Environment(mission, rows.stop - start, rng), Replayed(self._flights.action[rows]))
            for kept, new in zip(_arrays(self._flights), _arrays(flights)):
                kept[rows] = new

    def sample(self, count: int, rng: np.random.Generator) -> Flights:
        """Draw different flights, all with the same chance; cut to the longest of them."""
        rows = rng.choice(self.size, count, replace=False)
        slots = self._flights.length[rows].max()
        frames, (action, collected) = (
            Frame(*(array[rows, :slots] for array in self._flights.frames)),
            (array[rows, :slots] for array in (self._flights.action, self._flights.collected)))
        return Flights(frames, action, collected, self._flights.length[rows])

    @property
    def bytes(self) -> int:
        return sum(array.nbytes for array in _arrays(self._flights))

    def state(self) -> dict[str, np.ndarray | int]:
        """What is in it, for a checkpoint."""
        names = (*Frame._fields, "action", "collected", "length")
        return {"next": self._next, "size": self.size,
                **{name: array[:self.size] for name, array in zip(names, _arrays(self._flights))}}

    def load_state(self, state: dict) -> None:
        self._next, self.size = int(state["next"]), int(state["size"])
        for name, array in zip((*Frame._fields, "action", "collected", "length"), _arrays(self._flights)):
            array[:self.size] = state[name]


def _arrays(flights: Flights) -> tuple[np.ndarray, ...]:
    return *flights.frames, flights.action, flights.collected, flights.length
