"""Powers of links over a city, and closed forms that several tests compare them with."""

import numpy as np

from radiotwin.propagation.paths import PathPowers, path_powers
from radiotwin.propagation.paths.powers import COMPONENTS, PathDirections
from radiotwin.scene.citymap import CityMap

FREQUENCY_HZ = 2.4e9
WAVELENGTH_M = 299_792_458.0 / FREQUENCY_HZ


def powers_of_links(city, device_m, receiver_m, device, frequency_hz=FREQUENCY_HZ, **settings):
    """`path_powers` of receivers (n, 3), each from the device of its row (n,)."""
    arrays, directions = {name: np.zeros(len(receiver_m)) for name in COMPONENTS}, []
    for row in np.unique(device):
        links = np.flatnonzero(device == row)
        found = path_powers(city, device_m[row], receiver_m[links], frequency_hz, **settings)
        for name, values in arrays.items():
            values[links] = getattr(found, name)
        directions.append(found.directions._replace(link=links[found.directions.link]))
    return PathPowers(**arrays, directions=PathDirections.joined(directions), strongest=found.strongest)


def one_link(city, device_m, receiver_m, **settings):
    """Powers of one link by kind of path."""
    powers = path_powers(city, device_m, np.array([receiver_m]), FREQUENCY_HZ, **settings)
    return {name: float(getattr(powers, name)[0]) for name in COMPONENTS}


def friis(length_m):
    return (WAVELENGTH_M / (4 * np.pi * length_m)) ** 2


def knife_edge_db(height_m, before_m, after_m):
    """Loss of an edge above the straight line (ITU-R P.526-15, eq. 26 and 31)."""
    v = height_m * np.sqrt(2 / WAVELENGTH_M * (1 / before_m + 1 / after_m))
    return 6.9 + 20 * np.log10(np.sqrt((v - 0.1) ** 2 + 1) + v - 0.1)


def flat(half_m=500.0, z_m=0.0, **given):
    """A map of nothing but a square of ground."""
    corners = [[-half_m, -half_m, z_m], [half_m, -half_m, z_m], [half_m, half_m, z_m], [-half_m, half_m, z_m]]
    return CityMap(corners, [[0, 1, 2], [0, 2, 3]], **given)


def sharp_roofs(*roofs, half_m=2.0):
    """Long roofs without walls, (x, height) each, whose ridges are wedges of a few degrees."""
    corners_m = [(x_m + x, y, z) for x_m, height_m in roofs for y in (-3000, 3000)
                 for x, z in ((-half_m, 0), (half_m, 0), (0, height_m))]
    faces = np.array([[0, 2, 3], [3, 2, 5], [1, 4, 2], [2, 4, 5], [0, 1, 2], [3, 5, 4]])
    return CityMap(corners_m, np.concatenate([faces + 6 * roof for roof in range(len(roofs))]))
