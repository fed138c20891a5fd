"""Heights from another zero than the scene's: the note names the likely one."""

from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.links.heights import height_notes
from radiotwin.tables import Origin

FLIGHT_M = np.column_stack([np.linspace(-100, 100, 50), np.zeros(50), np.linspace(30, 80, 50)])


def scene(altitude_m=0.0, ground_m=0.0):
    """A plane at a height above the datum, which has an altitude."""
    city = SimpleNamespace(ground_height_m=lambda x_m, y_m: np.full(np.shape(x_m), ground_m))
    return SimpleNamespace(city=city, config=SimpleNamespace(
        origin=Origin(latitude_deg=48, longitude_deg=11, altitude_m=altitude_m)))


def raised(by_m):
    return FLIGHT_M + [0, 0, by_m]


@pytest.mark.parametrize(("world", "points_m", "parts"), [
    (scene(520), raised(-520), ["30 to 80 m would be plausible", "import them as height, not as altitude"]),
    (scene(0, 90), FLIGHT_M, ["30 to 80 m would be plausible", "z counts from its datum"]),
    (scene(520), raised(-900), ["below the ground, by up to 870 m", "the ellipsoid"]),
    (scene(520), raised(520), ["m and more above the ground", "altitudes above the sea"])])
def test_another_zero_is_named(world, points_m, parts):
    (note,) = height_notes(points_m, world)
    assert all(part in note for part in parts), note


@pytest.mark.parametrize("points_m", [FLIGHT_M, FLIGHT_M * [1, 1, np.nan], raised(100), np.vstack([FLIGHT_M, raised(-60)[:10]])])
def test_plausible_or_unknown_heights_are_not_mentioned(points_m):
    assert height_notes(points_m, scene(520)) == []
