"""Antennas along each path: two rays over a metal plane, added by hand."""

import numpy as np
import pytest
from scipy.constants import epsilon_0, speed_of_light

from radiotwin.coverage.sources import source_over
from radiotwin.coverage.transmitters import Transmitter
from radiotwin.links.declared import Declared, Radio
from radiotwin.links.links import Columns, Ends, Links, World
from radiotwin.propagation.laws.followed_paths import declared_antenna_db
from radiotwin.scene.antennas import Antenna, Pattern
from radiotwin.twin.localize.along_paths import Relocation

FREQUENCY_HZ = 2e9
MAST_M = np.array([5.0, -3.0, 10.0])
BORESIGHT_DEG = 30.0
METAL_S_M = 1e7  # ITU-R P.2040-4, Table 3
POINTS = 200


def isotropic_dbi(azimuth_deg, elevation_deg):
    return np.full(np.broadcast(azimuth_deg, elevation_deg).shape, 12.0)


def downtilted_sector_dbi(azimuth_deg, elevation_deg):
    """15 dBi, 65° wide and 7° high, 6° below the horizon, lobes 30 dB down."""
    off_deg = (np.asarray(azimuth_deg) + 180) % 360 - 180
    main_db = -12 * (off_deg / 65) ** 2 - 12 * ((np.asarray(elevation_deg) + 6) / 7) ** 2
    return 15 + 10 * np.log10(10 ** (main_db / 10) + 1e-3)


def dipole_dbi(azimuth_deg, elevation_deg):
    """An upright half-wave dipole (Balanis, Antenna Theory, eq. 4-84)."""
    elevation = np.radians(np.clip(elevation_deg, -89.5, 89.5)) + 0 * np.asarray(azimuth_deg)
    return 2.15 + 20 * np.log10(np.cos(np.pi / 2 * np.sin(elevation)) / np.cos(elevation))


def antenna_of(gain_dbi):
    azimuth_deg, elevation_deg = np.arange(0.0, 360.0), np.arange(-90.0, 90.1, 0.25)
    return Antenna(Pattern(azimuth_deg, elevation_deg, gain_dbi(azimuth_deg, elevation_deg[:, None])), BORESIGHT_DEG)


def rays_by_hand(receiver_m):
    """Azimuth at the mast, and of both paths the elevation at the mast and at the receiver [deg], and the power.

    The bounce seems to come from the mast's image; its reflection is Fresnel's of parallel polarisation on a half space.
    """
    east, north = (receiver_m[:, axis] - MAST_M[axis] for axis in (0, 1))
    ground_m = np.hypot(east, north)
    wavelength_m = speed_of_light / FREQUENCY_HZ
    permittivity = 1 - 1j * METAL_S_M / (2 * np.pi * FREQUENCY_HZ * epsilon_0)
    grazing = np.arctan2(receiver_m[:, 2] + MAST_M[2], ground_m)
    root = np.sqrt(permittivity - np.cos(grazing) ** 2)
    reflection = (permittivity * np.sin(grazing) - root) / (permittivity * np.sin(grazing) + root)
    up_deg = np.degrees(np.arctan2(receiver_m[:, 2] - MAST_M[2], ground_m))
    down_deg = -np.degrees(grazing)
    free = [(wavelength_m / (4 * np.pi * np.hypot(ground_m, receiver_m[:, 2] + sign * MAST_M[2]))) ** 2 for sign in (-1, 1)]
    return np.degrees(np.arctan2(east, north)), ((up_deg, -up_deg, free[0]),
                                                 (down_deg, down_deg, free[1] * np.abs(reflection) ** 2))


def points(height_m):
    rng = np.random.default_rng(int(height_m))
    azimuth, distance_m = rng.uniform(-np.pi, np.pi, POINTS), rng.uniform(15, 500, POINTS)
    around_m = [MAST_M[0] + distance_m * np.sin(azimuth), MAST_M[1] + distance_m * np.cos(azimuth)]
    return np.column_stack([*around_m, np.full(POINTS, height_m)])


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    from tests.coverage.conftest import write_scene

    return write_scene(tmp_path_factory.mktemp("scene") / "plain", ground="metal")


@pytest.mark.parametrize("height_m", [1.5, 60.0])
@pytest.mark.parametrize("gain_dbi", [isotropic_dbi, downtilted_sector_dbi, dipole_dbi])
def test_coverage_is_the_sum_of_both_paths_through_the_antenna(plain, gain_dbi, height_m):
    receiver_m = points(height_m)
    azimuth_deg, paths = rays_by_hand(receiver_m)
    expected = sum(power * 10 ** (gain_dbi(azimuth_deg - BORESIGHT_DEG, leaving_deg) / 10) for leaving_deg, _, power in paths)
    mast = Transmitter("mast", MAST_M, 0.0, antenna_of(gain_dbi), frequency_hz=FREQUENCY_HZ)
    gain_db, _ = source_over("paths", plain, [mast]).predict(0, receiver_m, np.arange(POINTS))
    np.testing.assert_allclose(gain_db, 10 * np.log10(expected), atol=0.02)


@pytest.mark.parametrize("has_map", [True, False])
def test_antennas_at_both_ends_act_on_each_path(plain, has_map):
    """A sector at the mast, a dipole at the receivers; a second device is isotropic. Without a map only the direct path."""
    receiver_m = points(60.0)
    azimuth_deg, paths = rays_by_hand(receiver_m)
    paths = paths if has_map else paths[:1]
    total = sum(power for _, _, power in paths)
    device = np.arange(POINTS) % 2
    declared = Declared((Radio(antenna=antenna_of(downtilted_sector_dbi)), Radio()), FREQUENCY_HZ, False, antenna_of(dipole_dbi))
    ends = Ends(device_names=["mast", "other"], device_m=np.array([MAST_M, MAST_M]), anchors=frozenset([0, 1]), declared=declared)
    world = World(frequency_hz=FREQUENCY_HZ, city=plain.city if has_map else None, is_gain=True)
    found_db = declared_antenna_db(Links(columns=Columns.unmeasured(receiver_m, device), ends=ends, world=world))
    for row, of_device in enumerate((downtilted_sector_dbi, lambda azimuth_deg, elevation_deg: 0.0)):
        gains = [10 ** ((of_device(azimuth_deg - BORESIGHT_DEG, leaving_deg) + dipole_dbi(0.0, arriving_deg)) / 10)
                 for leaving_deg, arriving_deg, _ in paths]
        expected = sum(gain * power for gain, (_, _, power) in zip(gains, paths, strict=True)) / total
        np.testing.assert_allclose(found_db[device == row], 10 * np.log10(expected)[device == row], atol=0.03)


def test_positions_that_are_tried_are_heard_through_both_antennas(plain):
    receiver_m = points(60.0)
    azimuth_deg, paths = rays_by_hand(receiver_m)
    declared = Declared((Radio(antenna=antenna_of(downtilted_sector_dbi)), Radio()), FREQUENCY_HZ, False, antenna_of(dipole_dbi))
    relocation = Relocation((-600, 600, -600, 600), 100.0)
    ends = Ends(device_m=np.array([MAST_M, MAST_M]), device_names=["with", "without"], receiver_names=["uav"],
                flight_names=["f"], anchors=frozenset({0, 1}), declared=declared)
    world = World(frequency_hz=FREQUENCY_HZ, city=plain.city, is_gain=True)
    for device, of_device in enumerate((downtilted_sector_dbi, lambda azimuth_deg, elevation_deg: 0.0)):
        expected = sum(power * 10 ** ((of_device(azimuth_deg - BORESIGHT_DEG, leaving_deg) + dipole_dbi(0.0, arriving_deg)) / 10)
                       for leaving_deg, arriving_deg, power in paths)
        links = Links(columns=Columns.unmeasured(receiver_m, np.full(len(receiver_m), device)), ends=ends, world=world)
        power, _ = relocation.follow(links, device)
        np.testing.assert_allclose(10 * np.log10(power), 10 * np.log10(expected), atol=0.03)


def test_the_antenna_of_the_uavs_is_said_not_to_be_used(plain, monkeypatch):
    mast = Transmitter("mast", MAST_M, 0.0, frequency_hz=FREQUENCY_HZ)
    monkeypatch.setitem(plain.__dict__, "uav_antenna", antenna_of(dipole_dbi))
    for model in ("paths", "al_hourani_urban"):
        assert "for its UAVs is not used" in " ".join(source_over(model, plain, [mast]).notes(points(1.5)))
