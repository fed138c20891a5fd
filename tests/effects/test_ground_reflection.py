"""The ground's ray against two rays that are added up by hand, and in a world that has it."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.ground_reflection import GroundReflection, two_ray_db
from radiotwin.effects.catalogue.interference import Interference
from radiotwin.effects.catalogue.lock_loss import LockLoss
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin import Twin, TwinDevice
from radiotwin.twin.model.model import FittedModel
from tests.effects.conftest import with_params

FREQUENCY_HZ = 2.4e9
GROUND = {"strength": 0.8, "roughness_m": 0.0, "ground_m": 0.0, "wavelength_m": 0.125}


def two_rays_db(device_m, receiver_m, permittivity, strength=1.0, roughness_m=0.0):
    """Both rays' fields at each receiver, one at a time."""
    wave_number, level_db = 2 * np.pi * FREQUENCY_HZ / 299_792_458.0, []
    for a, b in zip(device_m, receiver_m):
        image = np.array([a[0], a[1], -a[2]])
        direct_m, bounced_m = np.linalg.norm(b - a), np.linalg.norm(b - image)
        grazing = np.arcsin((a[2] + b[2]) / bounced_m)
        root = np.sqrt(permittivity - np.cos(grazing) ** 2)
        coefficient = (permittivity * np.sin(grazing) - root) / (permittivity * np.sin(grazing) + root)
        coefficient *= strength * np.exp(-2 * (wave_number * roughness_m * np.sin(grazing)) ** 2)
        field = np.exp(-1j * wave_number * direct_m) / direct_m \
            + coefficient * np.exp(-1j * wave_number * bounced_m) / bounced_m
        level_db.append(20 * np.log10(np.abs(field) * direct_m))
    return np.array(level_db)


def ends(seed, count=200):
    rng = np.random.default_rng(seed)
    return (np.column_stack([rng.uniform(0, 300, (count, 2)), rng.uniform(1, 3, count)]),
            np.column_stack([rng.uniform(0, 300, (count, 2)), rng.uniform(40, 80, count)]))


@pytest.mark.parametrize("strength, roughness_m, ground_m", [(1.0, 0.0, 0.0), (0.4, 0.0, -0.25), (0.8, 0.02, 0.25)])
def test_the_level_is_that_of_two_rays(strength, roughness_m, ground_m):
    device_m, receiver_m = ends(0)
    # Medium dry ground of ITU-R P.2040-4 at 2.4 GHz, worked out by hand: 15 f^-0.1, and 0.035 f^1.63 S/m.
    permittivity = 15 * 2.4**-0.1 - 1j * 0.035 * 2.4**1.63 / (2 * np.pi * FREQUENCY_HZ * 8.854e-12)
    above_m = np.array([0, 0, ground_m])
    expected_db = two_rays_db(device_m - above_m, receiver_m - above_m, permittivity, strength, roughness_m)
    found_db = two_ray_db(device_m, receiver_m, FREQUENCY_HZ, strength, roughness_m, ground_m)
    np.testing.assert_allclose(found_db, expected_db, atol=0.01)
    assert np.ptp(expected_db) > 2


def test_no_fringe_is_deeper_than_what_is_ever_measured():
    level_db = two_ray_db(np.array([[0.0, 0, 1.5]]), np.array([[200_000.0, 0, 1.5]]), 1e9, 1.0, 0.0, 0.0)
    assert level_db[0] == pytest.approx(-30)


def test_a_bounce_that_a_building_hides_is_none(make_links, small_scene):
    """Devices on a roof see receivers above, but not the street below."""
    city = small_scene.city
    top = city.vertices[city.vertices[:, 2].argmax()]
    x, y = np.meshgrid(np.linspace(-15, 15, 31) + top[0], np.linspace(-15, 15, 31) + top[1])
    roof_m = np.column_stack([x.ravel(), y.ravel(), city.height_at(x, y).ravel() + 1.5])
    roof_m = roof_m[roof_m[:, 2] > top[2] - 0.5]
    receiver_m = np.array([roof_m[:, 0].mean() + 40, roof_m[:, 1].mean(), top[2] + 120])
    links = make_links(roof_m[len(roof_m) // 2], [receiver_m], city=city)
    assert links.los.all()
    np.testing.assert_array_equal(with_params(GroundReflection, **GROUND).term(links, None).offset_db, 0)


def test_a_map_has_it_and_does_not_have_what_belongs_to_receivers(small_scene):
    found = [with_params(GroundReflection, **GROUND), with_params(LockLoss, receivers={0: 0.2}),
             with_params(Interference, place_m=(50.0, 50.0), level_db=-60.0, within_m=(0, 0, 100, 100))]
    devices = [TwinDevice(device.device, *position_m, "anchor", True, 0.0, None)
               for device, position_m in zip(small_scene.config.devices, small_scene.device_m)]

    def mapped(effects):
        channel = LogDistance(LogDistanceLine(-40.0, -2.2, 3.0))
        fitted = FittedModel(channel, tuple(effects), (np.zeros(0),) * len(effects), np.zeros(2), np.array([2.0]), 5.0,
                             small_scene.device_m, ("g0",), np.nan, 0.0)
        return Twin(fitted, devices, "gain_db", None).radio_map(small_scene)

    plain, corrected = mapped([]), mapped(found)
    added_db = (corrected.gain_db - plain.gain_db).reshape(len(devices), -1)
    receiver_m = small_scene.lattice.positions_m
    for device_m, change_db, los in zip(small_scene.device_m, added_db, plain.los.reshape(len(devices), -1)):
        assert np.abs(change_db[~los]).max(initial=0) == 0
        changed = change_db != 0
        expected_db = two_ray_db(np.tile(device_m, (changed.sum(), 1)), receiver_m[changed],
                                 small_scene.config.radio.frequency_hz, 0.8, 0.0, 0.0)
        np.testing.assert_allclose(change_db[changed], expected_db, atol=1e-3)
    assert (added_db != 0).mean() > 0.1 and np.abs(added_db).max() > 1


@pytest.mark.slow
def test_a_world_of_two_rays_is_named(open_ground, loop):
    """Of another soil than the one that is fitted, and heights that are 5 cm wrong."""
    world = open_ground.fly(20)
    world.gain_db += two_rays_db(world.device_m[world.device] - (0, 0, 0.05), world.receiver_m, 10 - 0.6j, 0.9)
    found = loop(open_ground.measured(world))
    assert found.names == ["ground_reflection"]
    assert found.first["ground_m"].value == pytest.approx(0.05, abs=0.02)
    assert 0.6 < found.first["strength"].value < 1.1 and found.first["roughness_m"].value < 0.02
    assert found.error["after"]["rmse_db"] < 1.06 * 2.0 < 0.92 * found.error["before"]["rmse_db"]
