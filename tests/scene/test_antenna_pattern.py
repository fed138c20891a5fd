import numpy as np
import pytest

from radiotwin.scene.antennas import Antenna, Pattern

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


def sparse(azimuth_deg, gain_dbi):
    return Pattern(np.array(azimuth_deg, dtype=float), np.array([-90.0, 90.0]), np.tile(gain_dbi, (2, 1)))


@pytest.mark.parametrize(("azimuth_deg", "gain_dbi"), [
    ([0, 1, 2, 3, 180], [10.0, 10, 10, 10, -20]), ([10, 50, 200, 210], [3.0, 3, -4, 12]), ([7, 300], [0.0, 0]),
    (np.r_[0:90, 90:355:5], beam(np.r_[0:90, 90:355:5], 5))])
def test_mean_over_headings_that_are_not_even(azimuth_deg, gain_dbi):
    """Azimuths that lie close together do not count more: the mean is that of the interpolated pattern."""
    pattern = sparse(azimuth_deg, gain_dbi)
    headings = np.arange(0.005, 360, 0.01)
    assert pattern.heading_mean().at(0, 0) == pytest.approx(10 * np.log10(np.mean(10 ** (pattern.at(headings, 0) / 10))),
                                                            abs=1e-3)


def test_even_headings_are_even_when_a_file_rounds_them():
    azimuth_deg, gain_dbi = np.arange(7) * 360 / 7, np.array([12.0, 3, -9, -30, -9, 3, 6])
    even, rounded = sparse(azimuth_deg, gain_dbi), sparse(azimuth_deg.round(1), gain_dbi)
    mean_dbi = 10 * np.log10(np.mean(10 ** (gain_dbi / 10)))
    assert even.heading_mean().at(0, 0) == pytest.approx(mean_dbi, abs=1e-9)
    assert rounded.heading_mean().at(0, 0) == pytest.approx(mean_dbi, abs=0.01)


@pytest.mark.parametrize(("azimuth_deg", "tilt_deg", "ray", "seen"), [
    (0, 0, (0, 1, 0), (0, 0)), (0, 0, (1, 0, 0), (90, 0)), (90, 0, (1, 0, 0), (0, 0)), (90, 0, (0, 1, 0), (-90, 0)),
    (0, 0, (0, 1, 1), (0, 45)), (0, -10, (0, 1, 0), (0, 10)), (0, -10, (0, -1, 0), (180, -10)),
    (180, 20, (0, -np.cos(np.radians(20)), np.sin(np.radians(20))), (0, 0)), (37, 25, (np.cos(np.radians(37)),
     -np.sin(np.radians(37)), 0), (90, 0))])
def test_directions_as_the_antenna_sees_them(azimuth_deg, tilt_deg, ray, seen):
    gain = Antenna(GRID, azimuth_deg, tilt_deg).gain_dbi(7 * np.array(ray, dtype=float))
    assert gain == pytest.approx(beam(*map(float, seen)), abs=0.05)


@pytest.mark.parametrize(("azimuth_deg", "east_north", "gain_dbi"), [
    (0, (1, 0), 5), (0, (-1, 0), -5), (90, (0, -1), 5), (90, (0, 1), -5), (225, (-1, 1), 5)])
def test_azimuths_of_a_pattern_are_clockwise(azimuth_deg, east_north, gain_dbi):
    """Of one that is stronger on its right: east of north, south of east."""
    at_deg = np.arange(0.0, 360.0, 10.0)
    lopsided = Pattern(at_deg, np.array([-90.0, 90.0]), np.tile(5 * np.sin(np.radians(at_deg)), (2, 1)))
    assert Antenna(lopsided, azimuth_deg).gain_dbi(np.array([*east_north, 0.0])) == pytest.approx(gain_dbi)
