"""A small map, and a large one that is computed block by block."""

import numpy as np
import pytest

from radiotwin.maps.file import MapStream
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene.lattice import Lattice

LATTICE = Lattice.over(0, 40, 0, 20, 20, [50, 60])
DTYPES = {"gain_db": np.dtype("f4"), "los": np.dtype(bool), "sigma_db": np.dtype("f4")}


def small_map(ground=False, **attributes):
    """Two devices on LATTICE; every gain another, one not detected."""
    gain_db = -np.arange(2 * 2 * 2 * 3, dtype=float).reshape(2, 2, 2, 3)
    gain_db[1, 0, 1, 2] = np.nan
    lattice = Lattice(LATTICE.x_m, LATTICE.y_m, LATTICE.z_m, np.full((2, 3), 7.5)) if ground else LATTICE
    return RadioMap.build(["a", "bé"], lattice, gain_db, gain_db > -10, gain_db * 0 + 3, {"frequency_hz": 2.4e9} | attributes)


@pytest.fixture
def large_stream():
    """A map larger than a block and than what HDF5 stores in chunks of its own choice; and the shapes of its parts so far."""
    lattice = Lattice(np.arange(0.0, 1100.0), np.arange(0.0, 1000.0), np.array([50.0]))
    made = []

    def make(device, part):
        made.append(part.shape)
        x_m, y_m, _ = part.positions_m.T
        gain_db = (-50 - (3 if device == "b" else 1) * x_m / 100 - y_m / 100).reshape(part.shape)
        return {"gain_db": gain_db, "los": gain_db > -55, "sigma_db": gain_db * 0 + 3}

    return MapStream(["a", "b"], lattice, {"source": "test"}, tuple(DTYPES), make), made
