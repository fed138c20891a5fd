import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import Extent, LatticeConfig
from radiotwin.scene.placement import (
    BuiltGrid,
    choose_altitudes,
    choose_extent,
    choose_step,
    place_devices,
    place_uavs,
)
from tests.scene.conftest import city_of

EXTENT = Extent(x_min_m=-100, x_max_m=100, y_min_m=0, y_max_m=300)
HOUSES = [(-80, 40, -40, 120, 30.0), (0, 40, 60, 80, 20.0), (-20, 130, 20, 170, 80.0)]  # x0, y0, x1, y1, height


@pytest.fixture(scope="module")
def buildings():
    return city_of(HOUSES)


def gap(device, house):
    x0, y0, x1, y1, _ = house
    return np.hypot(max(x0 - device.x_m, 0, device.x_m - x1), max(y0 - device.y_m, 0, device.y_m - y1))


@pytest.mark.parametrize("tops, lowest", [([], 30), ([12.0] * 10, 30), ([20.1] * 10, 35), ([10.0] * 99 + [300], 30)])
def test_altitudes(tops, lowest):
    assert choose_altitudes(np.array(tops)) == [lowest, lowest + 5, lowest + 10]


@pytest.mark.parametrize("side_m, step_m", [(1000, 20), (100, 20), (99, 10), (12, 2), (0.8, 0.1)])
def test_step(side_m, step_m):
    assert choose_step((0, 5 * side_m, 0, side_m)) == step_m
    assert choose_extent((-755.2, 655.1, -648, 480)).bounds == (-760, 660, -660, 480)


def placed(buildings, count, bounds, at):
    """Place devices, or UAVs at altitudes, on a part (x_min, x_max, y_min, y_max)."""
    extent = Extent(**dict(zip(("x_min_m", "x_max_m", "y_min_m", "y_max_m"), bounds)))
    if at:
        return place_uavs(count, extent, LatticeConfig(step_m=10, altitudes_m=at), buildings)
    return place_devices(count, BuiltGrid.over(extent, buildings), None, np.random.default_rng(0))


@pytest.mark.parametrize(("count", "bounds", "at", "message"), [
    (4, (-80, -40, 40, 120), [], "4 devices.*not enough ground"),
    (1, (-75, -45, 45, 115), [20], "20 m every lattice position"),
    (1, (0, 1e5, 0, 1e-3), [], "an extent of 100000 x 0.001 m is but a line")])
def test_no_room(buildings, count, bounds, at, message):
    with pytest.raises(BadInput, match=message):
        placed(buildings, count, bounds, at)


@pytest.mark.parametrize("seed", range(3))
def test_devices_are_clear_of_buildings_and_apart(buildings, seed):
    grid = BuiltGrid.over(EXTENT, buildings)
    devices = place_devices(10, grid, None, np.random.default_rng(seed))
    assert len(devices) == 10 and {device.z_m for device in devices} == {1.5}
    assert grid.fraction == pytest.approx((40 * 80 + 60 * 40 + 40 * 40) / 60_000, abs=0.002)
    assert {device.role for device in place_devices(2, grid, None, np.random.default_rng(seed))} == {"anchor"}
    assert sum(device.role == "anchor" for device in devices) == 3
    for device in devices:
        assert min(gap(device, house) for house in HOUSES) >= 9.0
        assert abs(device.x_m) <= 91 and 9 <= device.y_m <= 291
    points = np.array([(device.x_m, device.y_m) for device in devices])
    distance = np.linalg.norm(points[:, None] - points, axis=2) + 1e9 * np.eye(10)
    assert distance.min() > 20
    again = place_devices(10, grid, None, np.random.default_rng(seed))
    assert again == devices


def test_devices_stand_on_the_ground_that_there_is(buildings):
    slope = CityMap([[-100, 0, 10], [100, 0, 10], [100, 300, 40], [-100, 300, 40.0]], [[0, 1, 2], [0, 2, 3]])
    for device in place_devices(5, BuiltGrid.over(EXTENT, buildings), slope, np.random.default_rng(0)):
        assert device.z_m == pytest.approx(10 + device.y_m / 10 + 1.5, abs=0.02)


def test_uavs_start_beside_the_tower(buildings):
    lattice = LatticeConfig(step_m=20, altitudes_m=[50, 90])
    low, high, again = place_uavs(3, EXTENT, lattice, buildings)
    assert (high.start_x_m, high.start_y_m) == (0, 140)  # above the tower: the lattice position nearest to (0, 150)
    assert not (abs(low.start_x_m) <= 20 and 130 <= low.start_y_m <= 170)
    assert (again.altitude_m, again.uav) == (50, "uav3")
    assert (low.start_x_m, low.start_y_m) == (low.terminal_x_m, low.terminal_y_m)


def test_thousands_of_devices_and_uavs_are_placed():
    extent = Extent(x_min_m=0, x_max_m=3000, y_min_m=0, y_max_m=3000)
    grid = BuiltGrid.over(extent, None)
    devices = place_devices(2_000, grid, None, np.random.default_rng(0))
    uavs = place_uavs(2_000, extent, LatticeConfig(altitudes_m=[50.0, 60.0]), None)
    assert len({(device.x_m, device.y_m) for device in devices}) == 2_000 and len(uavs) == 2_000
    for options in (BuildOptions(devices=10**9), BuildOptions(uavs=10**9)):
        with pytest.raises(BadInput, match="1,000,000,000 .* at most"):
            options.check()
