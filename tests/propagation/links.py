"""Powers of the paths of links to several devices."""

import numpy as np

from radiotwin.propagation.paths import PathPowers, path_powers
from radiotwin.propagation.paths.powers import COMPONENTS, PathDirections


def powers_of_links(city, device_m, receiver_m, device, frequency_hz=2.4e9, **settings):
    """`path_powers` of receivers (n, 3), each from the device of its row (n,)."""
    arrays, directions = {name: np.zeros(len(receiver_m)) for name in COMPONENTS}, []
    for row in np.unique(device):
        links = np.flatnonzero(device == row)
        found = path_powers(city, device_m[row], receiver_m[links], frequency_hz, **settings)
        for name, values in arrays.items():
            values[links] = getattr(found, name)
        directions.append(found.directions._replace(link=links[found.directions.link]))
    return PathPowers(**arrays, directions=PathDirections.joined(directions), strongest=found.strongest)
