"""Powers of the paths of links, each followed once."""

from collections import OrderedDict

import numpy as np

from radiotwin.closeloop.records import Records
from radiotwin.paths import path_powers
from radiotwin.paths.powers import COMPONENTS
from radiotwin.scene.citymap import CityMap

GRID_M = 0.25  # positions of devices that differ by less share their paths
KEPT = 400  # devices' paths that are remembered


def paths_of(records: Records, kinds: tuple[str, ...]) -> np.ndarray:
    """(n,) power gain of some kinds of paths, followed once for each pair of positions."""
    power = np.zeros(len(records))
    for device in np.unique(records.device):
        rows = np.flatnonzero(records.device == device)
        x_m, y_m = np.round(records.device_m[device, :2] / GRID_M) * GRID_M
        place_m = (float(x_m), float(y_m), float(records.device_m[device, 2]))
        found = _followed(records.city, place_m, records.receiver_m[rows], records.frequency_hz)
        power[rows] = sum(found[:, COMPONENTS.index(kind)] for kind in kinds)
    return power


_remembered: OrderedDict[tuple, tuple[np.ndarray, np.ndarray]] = OrderedDict()


def _followed(city: CityMap, place_m: tuple[float, float, float], ends_m: np.ndarray,
              frequency_hz: float) -> np.ndarray:
    """(n, kinds) powers of the paths from one place to ends (n, 3); what was followed before is remembered."""
    key = (id(city), place_m, frequency_hz)
    wanted = np.ascontiguousarray(np.round(ends_m * 100).astype(np.int64)).view([("", np.int64)] * 3).ravel()
    known, powers = _remembered.pop(key, (wanted[:0], np.zeros((0, len(COMPONENTS)))))
    new, first = np.unique(wanted[~np.isin(wanted, known)], return_index=True)
    if len(new):
        new_m = ends_m[~np.isin(wanted, known)][first]
        found = path_powers(city, np.array([place_m]), new_m, np.zeros(len(new_m), int), frequency_hz, "vertical")
        known = np.concatenate([known, new])
        powers = np.vstack([powers, np.column_stack([getattr(found, name) for name in COMPONENTS])])
        order = np.argsort(known)
        known, powers = known[order], powers[order]
    _remembered[key] = known, powers
    if len(_remembered) > KEPT:
        _remembered.popitem(last=False)
    return powers[np.searchsorted(known, wanted)]
