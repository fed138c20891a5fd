"""The errors of a twin's map: how long they last, and how far devices' levels differ.

Nearby, and over a flight, errors are much the same.

`sigma_db` of a map is the size of its errors. Drawn anew in every slot of a simulated flight, it
would pay to hover anywhere and wait for a lucky slot, which no real world rewards. So the share of
the variance that stays, and the distance over which it does, are estimated from the residuals of
the measurements and written into the map's attributes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import pdist, squareform

from radiotwin.inference.gaussian import standardised
from radiotwin.links.links import Links
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.laws.kriging import ResidualField
from radiotwin.twin.twin import Twin

MAX_LINKS = 300  # of a device, in the estimate
MAP_ERRORS = "map_errors"  # in the provenance of a twin
MIN_LINKS = 5  # of a device, to tell its level
LEVEL_SD_DB, PRIOR_DEVICES = 1.5, 2.0  # of devices' levels [dB], and what that counts for
MIN_SHARE = 0.05  # that is worth drawing: a small share takes as long to draw as a large one


class Shadowing(NamedTuple):
    """Correlation of a map's errors.

    Attributes:
        share: of the variance that stays for a flight; the rest is independent in every slot.
        length_m: distance over which the correlation of the part that stays falls to 1/e [m]
            (Gudmundson 1991, Electronics Letters 27).
    """

    share: float = 0.0
    length_m: float = 50.0


@dataclass(frozen=True)
class MapErrors:
    """What is to be expected of a twin's errors, besides their standard deviation at a link.

    Attributes:
        share: of their variance that stays for a flight, a device's own level left out.
        length_m: distance over which the correlation of that part falls to 1/e [m].
        level_sd_db: standard deviation of a device's own level [dB].
        devices: number of devices that tell it.
    """

    share: float = 0.5
    length_m: float = 50.0
    level_sd_db: float = LEVEL_SD_DB
    devices: int = 0

    @classmethod
    def of(cls, twin: Twin, links: Links, seed: int) -> "MapErrors":
        """Estimate them from the residuals of a twin.

        Args:
            twin: as it was fitted.
            links: n measured links, with the twin's devices.
            seed: of the selection of links.
        """
        located = np.array([each.located for each in twin.devices])
        rows = _sampled(links.device, located[links.device] & np.isfinite(links.level_db), seed)
        some = links.select(rows).with_located_devices(twin.device_m)
        if not len(some):
            return cls()
        predicted = twin.predict(some)
        return cls.of_residuals(some.device, some.receiver_m, some.level_db - predicted.mean_db,
                                predicted.sd_db, seed, twin.residual_field)

    @classmethod
    def of_residuals(cls, device: np.ndarray, receiver_m: np.ndarray, residual_db: np.ndarray,
                     sd_db: np.ndarray, seed: int, field: ResidualField | None = None
                     ) -> "MapErrors":
        """Estimate them from residuals.

        Args:
            device: (n,) index of each link's device.
            receiver_m: (n, 3) [m].
            residual_db: (n,) NaN where there is none.
            sd_db: (n,) their standard deviation [dB].
            seed: of the selection of links.
            field: whose correlation they have; None: it is fitted.
        """
        rows = _sampled(device, np.isfinite(residual_db), seed)
        if not len(rows):
            return cls()
        device, receiver_m, residual_db, sd_db = (
            each[rows] for each in (device, receiver_m, residual_db, sd_db))
        precision = 1.0 / sd_db**2
        _, index = np.unique(device, return_inverse=True)
        level_db = np.bincount(index, residual_db * precision) / np.bincount(index, precision)
        if field is None:
            field = ResidualField().fit(device, receiver_m,
                                        (residual_db - level_db[index]) / sd_db, seed)
        # Of a device's level, what its map's errors would bring anyway is left out.
        chance = [_mean_variance(receiver_m[index == k], precision[index == k], field)
                  for k in range(len(level_db))]
        off = float(((level_db - np.median(level_db))**2 - chance).sum())
        variance = (max(off, 0.0) + PRIOR_DEVICES * LEVEL_SD_DB**2) / (
            len(level_db) - 1 + PRIOR_DEVICES)
        return cls(float(field.share), float(field.length_m), float(np.sqrt(variance)),
                   len(level_db))

    @classmethod
    def kept(cls, twin: Twin) -> "MapErrors":
        """Return those that a twin was stored with; what is usual where it has none."""
        return cls(**twin.provenance.get(MAP_ERRORS, {}))


def _sampled(device: np.ndarray, usable: np.ndarray, seed: int,
             least: int = MIN_LINKS) -> np.ndarray:
    """Return rows of links that are usable (n,): some of each device that has enough of them."""
    rng, rows = np.random.default_rng(seed), [np.empty(0, dtype=np.int64)]
    for number in np.unique(device[usable]):
        mine = np.flatnonzero((device == number) & usable)
        if len(mine) >= least:
            rows.append(rng.choice(mine, min(MAX_LINKS, len(mine)), replace=False))
    return np.sort(np.concatenate(rows))


def _mean_variance(receiver_m: np.ndarray, precision: np.ndarray, field: ResidualField) -> float:
    """Return the variance of a device's weighted mean residual, by its map's errors [dB²]."""
    scaled = np.sqrt(precision)
    rho = field.share * np.exp(-squareform(pdist(receiver_m)) / field.length_m)
    np.fill_diagonal(rho, 1.0)
    return float(scaled @ rho @ scaled / precision.sum()**2)


def with_shadowing(radio_map: RadioMap, twin: Twin, measurements: Measurements, limit_db: float,
                   seed: int) -> RadioMap:
    """Return a twin's map with the attributes `shadowing_share` and `shadowing_length_m`.

    Args:
        radio_map: `twin.radio_map(scene)`.
        twin: where it interpolates, the correlation is that of its residual field, because it
            leaves next to no residual; otherwise that of `fit_shadowing`.
        measurements: that the twin was fitted to.
        limit_db: gain below which nothing is detected [dB].
        seed: of the selection of links.
    """
    if twin.residual_field is not None:
        found = Shadowing(twin.residual_field.share, twin.residual_field.length_m)
    else:
        found = fit_shadowing(radio_map, measurements, limit_db, seed)
    # A correlation within one cell cannot be distinguished from one within one slot.
    if found.length_m < radio_map.lattice.step_m or found.share < MIN_SHARE:
        found = Shadowing()
    return RadioMap(radio_map.dataset.assign_attrs(shadowing_share=float(found.share),
                                                   shadowing_length_m=float(found.length_m)))


def _nearest(axis_m: np.ndarray, there_m: np.ndarray) -> np.ndarray:
    """Return the (n,) rows of a rising axis that are nearest to coordinates (n,) [m]."""
    return np.searchsorted((axis_m[1:] + axis_m[:-1]) / 2, there_m)


def fit_shadowing(radio_map: RadioMap, measurements: Measurements, limit_db: float,
                  seed: int) -> Shadowing:
    """Estimate the correlation of a map's errors by maximum likelihood (`ResidualField`).

    Args:
        radio_map: of a twin, with `sigma_db`.
        measurements: that the twin was fitted to; receivers belong to the nearest cell.
        limit_db: gain below which nothing is detected [dB]; a link without level enters with its
            mean below it.
        seed: of the selection of links.
    """
    lattice = radio_map.lattice
    there_m = measurements.receiver_m.T
    x, y = (_nearest(axis_m, at_m) for axis_m, at_m in zip((lattice.x_m, lattice.y_m), there_m))
    ground_m = 0.0 if lattice.ground_m is None else lattice.ground_m[y, x]
    cell = [_nearest(lattice.z_m, there_m[2] - ground_m), y, x]
    on_map = measurements.devices["device"].isin(radio_map.devices).to_numpy()
    some = _sampled(measurements.device_index, on_map[measurements.device_index], seed, 1)
    names = measurements.devices["device"].to_numpy()[measurements.device_index[some]]
    at = (np.array([radio_map.devices.index(name) for name in names]),
          *(axis[some] for axis in cell))
    mean_db = radio_map.gain_db[at].astype(float)
    sigma_db = radio_map.dataset["sigma_db"].values[at].astype(float)
    residual = standardised(measurements.level_db[some], mean_db, sigma_db, limit_db)
    field = ResidualField().fit(measurements.device_index[some], measurements.receiver_m[some],
                                residual, seed)
    return Shadowing(field.share, field.length_m)
