import numpy as np
import pytest

from radiotwin.antennas import Antenna, Pattern

ROUND = Pattern(np.array([0.0]), np.array([-90.0, 0.0, 90.0]), np.array([[-20.0], [2.0], [-10.0]]))


def beam(azimuth_deg, elevation_deg):
    """A smooth pattern with a closed form."""
    return -((azimuth_deg + 180) % 360 - 180) ** 2 / 500 - (elevation_deg - 5) ** 2 / 100


GRID = Pattern(np.arange(0.0, 360, 2), np.arange(-90.0, 91, 2),
               beam(np.arange(0.0, 360, 2)[None], np.arange(-90.0, 91, 2)[:, None]))


def test_between_the_directions_of_the_grid():
    azimuth, elevation = np.array([0.0, 359.0, -1.0, 45.5, 181.3]), np.array([5.0, 0.0, 0.0, -33.3, 89.9])
    assert GRID.at(azimuth, elevation) == pytest.approx(beam(azimuth, elevation), abs=0.05)
    assert GRID.at(359.0, 7.0) == GRID.at(1.0, 7.0) == pytest.approx(GRID.at(-361.0, 7.0))


def test_mean_over_headings_is_of_power():
    half = Pattern(np.array([0.0, 180.0]), np.array([-90.0, 90.0]), np.array([[10.0, -40.0], [10.0, -40.0]]))
    assert half.heading_mean().at(77.0, 3.0) == pytest.approx(10 * np.log10((10 + 1e-4) / 2), abs=1e-9)
    assert ROUND.heading_mean().at(12.0, 45.0) == ROUND.at(200.0, 45.0) == pytest.approx(-4.0)


@pytest.mark.parametrize(("azimuth_deg", "tilt_deg", "ray", "seen"), [
    (0, 0, (0, 1, 0), (0, 0)), (0, 0, (1, 0, 0), (90, 0)), (90, 0, (1, 0, 0), (0, 0)), (90, 0, (0, 1, 0), (-90, 0)),
    (0, 0, (0, 1, 1), (0, 45)), (0, -10, (0, 1, 0), (0, 10)), (0, -10, (0, -1, 0), (180, -10)),
    (180, 20, (0, -np.cos(np.radians(20)), np.sin(np.radians(20))), (0, 0)), (37, 25, (np.cos(np.radians(37)),
     -np.sin(np.radians(37)), 0), (90, 0))])
def test_directions_as_the_antenna_sees_them(azimuth_deg, tilt_deg, ray, seen):
    gain = Antenna(GRID, azimuth_deg, tilt_deg).gain_dbi(7 * np.array(ray, dtype=float))
    assert gain == pytest.approx(beam(*map(float, seen)), abs=0.05)


def test_any_shape_of_rays():
    rays = np.random.default_rng(0).normal(size=(4, 5, 3))
    assert Antenna(GRID, 12, 3).gain_dbi(rays).shape == (4, 5)
