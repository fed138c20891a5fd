"""Nine houses, a flight over them, and its levels, made by the path engine over the true map."""

import numpy as np
import trimesh

from radiotwin.links import LinkGeometry
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material
from tests.propagation.links import powers_of_links

DEVICES_M = np.array([[45.0, 42.0, 1.5], [100.0, 155.0, 1.5], [160.0, 60.0, 1.5]])


def houses(shift_m=(0.0, 0.0), off_m=0.0, move_m=0.0, rise_m=0.0, seed=0, material="concrete"):
    """Houses all shifted alike; each off by a normal error; or each side of each, and each height."""
    rng, boxes = np.random.default_rng(seed), []
    for east in (10.0, 75.0, 140.0):
        for north in (10.0, 75.0, 140.0):
            low, height_m = np.array([east, north]) + shift_m, 22.0
            if off_m:
                low = low + off_m * rng.normal(size=2)
            high = low + 25
            if move_m or rise_m:
                low, high = low + move_m * rng.normal(size=2), high + move_m * rng.normal(size=2)
                height_m = max(22 + rise_m * rng.normal(), 5)
            boxes.append(trimesh.creation.box(bounds=[[*low, 0], [*high, height_m]]))
    mesh = trimesh.util.concatenate(boxes)
    return CityMap(mesh.vertices, mesh.faces, [itu_material(material)])


def flight(count, seed):
    """Positions of receivers (n, 3) [m], and the device that each hears."""
    rng = np.random.default_rng(seed)
    receiver_m = np.column_stack([rng.uniform(0, 175, (count, 2)), rng.uniform(25, 50, count)])
    return receiver_m, rng.integers(0, 3, count)


def links_over(city, receiver_m, device):
    device_m = DEVICES_M[device]
    return LinkGeometry(device_m, receiver_m, city.line_of_sight(device_m, receiver_m), device, city, 2.4e9)


def levels(city, receiver_m, device, seed, *, factors=(1.0, 1.0), diffuse=1e-14, noise_db=1.0):
    """Levels [dB] of a world whose reflections and diffractions carry so many times their power."""
    powers = powers_of_links(city, DEVICES_M, receiver_m, device)
    diffracted = powers.diffracted + powers.reflected_diffracted + powers.diffracted_2
    power = powers.direct + factors[1] * diffracted + factors[0] * (powers.total - powers.direct - diffracted)
    distance_m = np.linalg.norm(receiver_m - DEVICES_M[device], axis=1)
    power += diffuse * (distance_m / 100) ** -3.0
    return 10 * np.log10(power) + np.random.default_rng(seed).normal(0, noise_db, len(device))
