"""Where a UAV may be, and how many moves it takes to get from one place to another.

The model of Chen et al. 2023 (Sec. II): one lattice step north, west, south or east costs 1 battery unit, a hover
costs 0.5, the UAV stays on the map and must be able to reach its terminal with what is left.
"""

import numpy as np

MOVES = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])  # north, west, south, east as (row, column)
MOVE_COST = 1.0
HOVER_COST = 0.5
UNREACHABLE = np.iinfo(np.int64).max // 4


class FlightGrid:
    """The cells of one altitude.

    Args:
        allowed: (ny, nx) bool; False inside buildings.
        terminal: (row, column) where a flight must end.
    """

    def __init__(self, allowed: np.ndarray, terminal: tuple[int, int]):
        self.allowed = allowed
        self.terminal = terminal
        self._steps: dict[tuple[int, int], np.ndarray] = {}

    def steps_to(self, cell: tuple[int, int]) -> np.ndarray:
        """(ny, nx) moves from every cell to `cell`; UNREACHABLE where there is no way."""
        cell = (int(cell[0]), int(cell[1]))
        if cell not in self._steps:
            steps = np.full(self.allowed.shape, UNREACHABLE)
            front, distance = np.zeros_like(self.allowed), 0
            front[cell] = self.allowed[cell]
            while front.any():
                steps[front] = distance
                spread = np.zeros_like(front)
                spread[1:] |= front[:-1]
                spread[:-1] |= front[1:]
                spread[:, 1:] |= front[:, :-1]
                spread[:, :-1] |= front[:, 1:]
                front, distance = spread & self.allowed & (steps == UNREACHABLE), distance + 1
            self._steps[cell] = steps
        return self._steps[cell]

    def steps_home(self, cell: tuple[int, int]) -> int:
        return int(self.steps_to(self.terminal)[tuple(cell)])

    def neighbours(self, cell: tuple[int, int]) -> list[tuple[int, int]]:
        """Cells one move away."""
        inside = [tuple(c) for c in np.asarray(cell) + MOVES
                  if 0 <= c[0] < self.allowed.shape[0] and 0 <= c[1] < self.allowed.shape[1]]
        return [(int(r), int(c)) for r, c in inside if self.allowed[r, c]]

    def path(self, start: tuple[int, int], end: tuple[int, int], rng: np.random.Generator) -> list[tuple[int, int]]:
        """A shortest path, drawn at random among the shortest; without `start`, with `end`."""
        steps, cells, cell = self.steps_to(end), [], start
        while steps[tuple(cell)] > 0:
            nearer = [n for n in self.neighbours(cell) if steps[n] < steps[tuple(cell)]]
            cell = nearer[rng.integers(len(nearer))]
            cells.append(cell)
        return cells
