"""Flight patterns. Each gives the cells of one flight, slot by slot, from the start to the terminal."""

import numpy as np

from radiotwin.survey.grid import HOVER_COST, MOVE_COST, UNREACHABLE, FlightGrid

Cell = tuple[int, int]


def random_waypoint(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator) -> list[Cell]:
    """Straight to a random cell that can still be flown to and home from, then to another, until none is left."""
    cells = [start]
    while True:
        left = battery - MOVE_COST * (len(cells) - 1)
        reachable = grid.steps_to(cells[-1]) + grid.steps_to(grid.terminal) <= left / MOVE_COST
        reachable[cells[-1]] = False
        if not reachable.any():
            return cells + grid.path(cells[-1], grid.terminal, rng)
        waypoint = rng.choice(np.argwhere(reachable))
        cells += grid.path(cells[-1], (int(waypoint[0]), int(waypoint[1])), rng)


def lawnmower(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator) -> list[Cell]:
    """Parallel lanes over the map, as narrow as the battery allows, in a random direction and from a random side."""
    corners = _lanes(grid.allowed.shape, battery, rng)
    cells = [start]
    for corner in corners:
        if grid.steps_home(corner) == UNREACHABLE:
            continue
        for cell in grid.path(cells[-1], corner, rng):
            if MOVE_COST * (len(cells) + grid.steps_home(cell)) > battery:
                return cells + grid.path(cells[-1], grid.terminal, rng)
            cells.append(cell)
    return cells + grid.path(cells[-1], grid.terminal, rng)


def _lanes(shape: tuple[int, int], battery: float, rng: np.random.Generator) -> list[Cell]:
    """Ends of the lanes in the order that they are flown."""
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


def random_walk(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator) -> list[Cell]:
    """In every slot any move or hover, with equal chances, after which the terminal is still in reach."""
    cells, left = [start], battery
    while True:
        options = [(cell, MOVE_COST) for cell in grid.neighbours(cells[-1])] + [(cells[-1], HOVER_COST)]
        safe = [(cell, cost) for cell, cost in options if grid.steps_home(cell) * MOVE_COST <= left - cost]
        if not safe:
            return cells
        cell, cost = safe[rng.integers(len(safe))]
        cells.append(cell)
        left -= cost


PATTERNS = {"random-waypoint": random_waypoint, "lawnmower": lawnmower, "random-walk": random_walk}
