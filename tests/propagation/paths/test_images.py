"""Points of interaction of paths against plane geometry."""

import numpy as np
import pytest

from radiotwin.propagation.paths.candidates import CandidateSearch
from radiotwin.propagation.paths.fields import buffer_gains
from radiotwin.propagation.paths.images import Candidates, PathBuffer, find_paths
from radiotwin.propagation.paths.interactions import slabs_of
from radiotwin.propagation.paths.surfaces import ALONG, NORMAL, OFFSET, ORIGIN, START
from radiotwin.scene.citymap import CONCRETE

WAVE_NUMBER = 2 * np.pi * 2.4e9 / 299_792_458.0
SLABS = slabs_of([CONCRETE, CONCRETE], 2.4e9)


@pytest.fixture(scope="module")
def inner_corner(city_of):
    """Walls x = 0 and y = 0 that face the quarter x, y > 0, and their rows."""
    search = CandidateSearch(city_of((-5, -5, 0, 60, 20), (0, -5, 60, 0, 20)), depth=2)
    planes = search.surfaces.planes
    return search, *(int(np.argmax((planes[:, NORMAL + axis] > 0.9) & np.isclose(planes[:, OFFSET], 0))) for axis in (0, 1))


def solve(search, before, edge, after, device_m, receiver_m):
    candidates = Candidates(np.array([before]), np.array([edge]), np.array([after]))
    buffer = PathBuffer.allocate(5)
    found, _ = find_paths(search.surfaces, candidates, np.array(device_m), np.array([receiver_m]), 0, buffer)
    gain = buffer_gains(search.surfaces, candidates, WAVE_NUMBER, SLABS, buffer, np.arange(found))
    return [buffer.points_m[i, :buffer.count[i]] for i in range(found)], gain


def test_two_walls_of_a_corner(inner_corner, line_of_slab):
    """In the plane of both walls' normals a vertical field lies across both planes of incidence."""
    search, wall_x, wall_y = inner_corner
    device_m, receiver_m = [20.0, 4.0, 5.0], [3.0, 30.0, 5.0]
    paths, gain = solve(search, [wall_y, wall_x], -1, [-1], device_m, receiver_m)
    offset_m = np.array([23.0, 34.0])
    length_m = np.hypot(*offset_m)
    te_x, te_y = (line_of_slab(along / length_m)[0] for along in offset_m)
    assert len(paths) == 1
    assert np.linalg.norm(np.diff(paths[0], axis=0), axis=1).sum() == pytest.approx(length_m)
    assert np.isclose(paths[0][1, 1], 0) and np.isclose(paths[0][2, 0], 0)
    assert gain[0] == pytest.approx(abs(te_x * te_y) ** 2 / (2 * WAVE_NUMBER * length_m) ** 2, rel=1e-9)


def test_diffraction_and_reflection_after_the_edge(city_of):
    """Over a roof edge to a higher wall and back: angles to the edge are equal, and so are those to the wall."""
    search = CandidateSearch(city_of((0, -50, 5, 50, 10), (60, -50, 70, 50, 40)), depth=3)
    planes, _, edges = search.surfaces
    roof = int(np.flatnonzero(np.isclose(edges[:, [START, START + 2]], [0, 10]).all(axis=1)
                              & (np.abs(edges[:, ALONG + 1]) > 0.9))[0])
    wall = int(np.flatnonzero((planes[:, NORMAL] < -0.9) & (planes[:, ORIGIN] > 50))[0])
    paths, gain = solve(search, [-1], roof, [wall], [-10.0, -5.0, 2.0], [20.0, 12.0, 45.0])
    assert len(paths) == 1 and gain[0] > 0
    legs = np.diff(paths[0], axis=0)
    legs /= np.linalg.norm(legs, axis=1)[:, None]
    assert legs[0, 1] == pytest.approx(legs[1, 1]) and np.isclose(paths[0][1, [0, 2]], [0, 10]).all()
    assert np.isclose(paths[0][2, 0], 60) and np.allclose(legs[1] * [-1, 1, 1], legs[2])
