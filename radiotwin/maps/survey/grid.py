"""The grid that a UAV flies on: allowed cells, and numbers of moves between them.

The model of Chen et al. 2023 (Sec. II): one lattice step north, west, south or east costs 1 battery
unit, a hover costs 0.5, the UAV stays on the map and must be able to reach its terminal with the
rest of its battery.
"""

import numpy as np

MOVES = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])  # north, west, south, east as (row, column)
MOVE_COST = 1.0  # battery units
HOVER_COST = 0.5  # battery units
UNREACHABLE = np.iinfo(np.int64).max // 4  # a number of moves; sums of a few do not overflow

Cell = tuple[int, int]


class FlightGrid:
    """The cells of one altitude.

    Args:
        allowed: (ny, nx) bool; False inside buildings.
        terminal: (row, column) where a flight must end.
    """

    def __init__(self, allowed: np.ndarray, terminal: Cell) -> None:
        self.allowed = allowed
        self.terminal = terminal
        self._steps: dict[Cell, np.ndarray] = {}

    def steps_to(self, cell: Cell) -> np.ndarray:
        """Return the (ny, nx) moves from every cell to `cell`; UNREACHABLE where there is no way.

        Args:
            cell: (row, column).
        """
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

    def steps_home(self, cell: Cell) -> int:
        """Return the number of moves from a cell to the terminal."""
        return int(self.steps_to(self.terminal)[tuple(cell)])

    def neighbours(self, cell: Cell) -> list[Cell]:
        """Return the allowed cells one move away."""
        rows, columns = self.allowed.shape
        cells = [(int(row), int(column)) for row, column in np.asarray(cell) + MOVES]
        return [(row, column) for row, column in cells
                if 0 <= row < rows and 0 <= column < columns and self.allowed[row, column]]

    def path(self, start: Cell, end: Cell, rng: np.random.Generator) -> list[Cell]:
        """Draw one of the shortest paths.

        Args:
            start: First cell, which is not part of the result.
            end: Last cell, which is.
            rng: Source of the choice.

        Returns:
            Cells (row, column) in order; none where there is no way to go.
        """
        steps, cells, cell = self.steps_to(end), [], start
        while steps[tuple(cell)] > 0:
            nearer = [n for n in self.neighbours(cell) if steps[n] < steps[tuple(cell)]]
            cell = nearer[rng.integers(len(nearer))]
            cells.append(cell)
        return cells
