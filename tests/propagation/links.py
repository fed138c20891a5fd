"""Powers of the paths of links to several devices."""

import numpy as np

from radiotwin.propagation.paths import PathPowers, path_powers


def powers_of_links(city, device_m, receiver_m, device, frequency_hz=2.4e9, **settings):
    """`path_powers` of receivers (n, 3), each from the device of its row (n,)."""
    arrays = None
    for row in np.unique(device):
        links = np.flatnonzero(device == row)
        found = path_powers(city, device_m[row], receiver_m[links], frequency_hz, **settings)
        if arrays is None:
            arrays = {name: np.zeros((len(receiver_m), *values.shape[1:])) for name, values in vars(found).items()}
        for name, values in vars(found).items():
            arrays[name][links] = values
    return PathPowers(**arrays)
