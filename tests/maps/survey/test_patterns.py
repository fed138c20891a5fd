"""Flights obey the UAV model, whatever the pattern."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radiotwin.maps.survey import PATTERNS, FlightGrid


def cost(cells: np.ndarray) -> float:
    moved = np.abs(np.diff(cells, axis=0)).sum(axis=1)
    assert moved.max(initial=0) <= 1, "one lattice step a slot"
    return float(np.where(moved == 1, 1.0, 0.5).sum())


@st.composite
def missions(draw):
    rows, columns = draw(st.integers(2, 12)), draw(st.integers(2, 12))
    start, terminal = ((draw(st.integers(0, rows - 1)), draw(st.integers(0, columns - 1))) for _ in range(2))
    needed = abs(start[0] - terminal[0]) + abs(start[1] - terminal[1])
    return (rows, columns), start, terminal, needed + draw(st.integers(0, 80)) / 2, draw(st.integers(0, 99))


@pytest.mark.parametrize("pattern", PATTERNS)
@settings(max_examples=60, deadline=None)
@given(mission=missions())
def test_a_flight_stays_on_the_map_and_comes_home_on_its_battery(pattern, mission):
    shape, start, terminal, battery, seed = mission
    grid = FlightGrid(np.ones(shape, dtype=bool), terminal)
    cells = np.array(PATTERNS[pattern](grid, start, battery, np.random.default_rng(seed)))
    assert tuple(cells[0]) == start and tuple(cells[-1]) == terminal
    assert (cells >= 0).all() and (cells < shape).all()
    assert cost(cells) <= battery


@pytest.mark.parametrize("pattern", PATTERNS)
def test_no_flight_goes_through_a_building(pattern):
    allowed = np.ones((9, 9), dtype=bool)
    allowed[4, 1:] = False  # a wall with one gap in the west
    grid = FlightGrid(allowed, (8, 8))
    cells = np.array(PATTERNS[pattern](grid, (0, 8), 60, np.random.default_rng(0)))
    assert allowed[tuple(cells.T)].all() and tuple(cells[-1]) == (8, 8)
    assert (4, 0) in [tuple(cell) for cell in cells]


@pytest.mark.parametrize("pattern", ["random-waypoint", "lawnmower"])
def test_the_battery_is_used(pattern):
    """A pattern that went home at once would pass every other test: these two fly at least four fifths of it."""
    grid = FlightGrid(np.ones((41, 31), dtype=bool), (23, 16))
    for seed in range(10):
        cells = np.array(PATTERNS[pattern](grid, (23, 16), 60, np.random.default_rng(seed)))
        assert cost(cells) >= 48


def test_a_lawnmower_with_enough_battery_sees_every_cell():
    grid = FlightGrid(np.ones((6, 5), dtype=bool), (0, 0))
    cells = PATTERNS["lawnmower"](grid, (0, 0), 200, np.random.default_rng(1))
    assert len(set(cells)) == 30


def test_paths_are_shortest_and_unreachable_cells_are_known():
    allowed = np.ones((3, 5), dtype=bool)
    allowed[:, 3] = False
    grid = FlightGrid(allowed, (0, 0))
    assert len(grid.path((2, 2), (0, 0), np.random.default_rng(0))) == 4 == grid.steps_home((2, 2))
    assert grid.steps_home((0, 4)) > 10**6
