"""Flight patterns: functions that draw the cells of one flight, from the start to the terminal.

Each takes the grid of its altitude, the start (row, column), the battery [units] and a source of
random numbers, and returns one cell (row, column) per slot. The terminal is reached in time.
"""

import numpy as np

from radiotwin.survey.grid import HOVER_COST, MOVE_COST, UNREACHABLE, Cell, FlightGrid


def random_waypoint(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator
                    ) -> list[Cell]:
    """Fly straight to random cells, as long as there is battery for one and home again.

    Args:
        grid: Cells of the altitude.
        start: First cell.
        battery: Battery units.
        rng: Source of the waypoints.
    """
    cells = [start]
    while True:
        left = battery - MOVE_COST * (len(cells) - 1)
        steps = grid.steps_to(cells[-1]) + grid.steps_to(grid.terminal)
        reachable = steps <= left / MOVE_COST
        reachable[cells[-1]] = False
        if not reachable.any():
            return cells + grid.path(cells[-1], grid.terminal, rng)
        row, column = rng.choice(np.argwhere(reachable))
        cells += grid.path(cells[-1], (int(row), int(column)), rng)


def lawnmower(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator
              ) -> list[Cell]:
    """Fly parallel lanes, as narrow as the battery allows, in a random direction and order.

    Args:
        grid: Cells of the altitude.
        start: First cell.
        battery: Battery units.
        rng: Source of direction, offset and order.
    """
    cells = [start]
    for corner in _lane_ends(grid.allowed.shape, battery, rng):
        if grid.steps_home(corner) == UNREACHABLE:
            continue
        for cell in grid.path(cells[-1], corner, rng):
            if MOVE_COST * (len(cells) + grid.steps_home(cell)) > battery:
                return cells + grid.path(cells[-1], grid.terminal, rng)
            cells.append(cell)
    return cells + grid.path(cells[-1], grid.terminal, rng)


def _lane_ends(shape: tuple[int, ...], battery: float, rng: np.random.Generator) -> list[Cell]:
    """Return the ends of the lanes in the order in which they are flown."""
    along = int(rng.integers(2))  # axis that lanes run along
    lane_length, width = shape[along], shape[1 - along]
    lanes_affordable = max(int(battery / MOVE_COST // lane_length), 2)
    spacing = max(int(np.ceil(width / lanes_affordable)), 1)
    lanes = np.arange(rng.integers(spacing), width, spacing)
    if rng.integers(2):
        lanes = lanes[::-1]
    ends = []
    for number, lane in enumerate(lanes):
        far, near = (lane_length - 1, 0) if number % 2 else (0, lane_length - 1)
        ends += [(far, lane), (near, lane)]
    return [(int(a), int(b)) if along == 0 else (int(b), int(a)) for a, b in ends]


def random_walk(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator
                ) -> list[Cell]:
    """Move or hover with equal chances in every slot, as long as the terminal stays in reach.

    Args:
        grid: Cells of the altitude.
        start: First cell.
        battery: Battery units.
        rng: Source of the moves.
    """
    cells, left = [start], battery
    while True:
        options = [(cell, MOVE_COST) for cell in grid.neighbours(cells[-1])]
        options.append((cells[-1], HOVER_COST))
        safe = [(cell, cost) for cell, cost in options
                if grid.steps_home(cell) * MOVE_COST <= left - cost]
        if not safe:
            return cells
        cell, cost = safe[rng.integers(len(safe))]
        cells.append(cell)
        left -= cost


PATTERNS = {"random-waypoint": random_waypoint, "lawnmower": lawnmower, "random-walk": random_walk}
