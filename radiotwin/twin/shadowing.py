"""ErrorCorrelation: correlation of a twin's map errors in space, and spread of devices' levels.

`sigma_db` of a map is the standard deviation of its errors. If it were drawn anew in every slot of
a simulated flight, hovering anywhere and waiting for a lucky slot would pay, which no real world
rewards. So the correlated share of the variance, and its correlation length, are estimated from the
residuals of the measurements, and written into the map's attributes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist, squareform

from radiotwin.links.links import Links
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.laws.kriging import ResidualField
from radiotwin.twin.twin import Twin

MAX_LINKS = 300  # links of a device in the estimate
MAP_ERRORS = "map_errors"  # key in the provenance of a twin
MIN_LINKS = 5  # links of a device needed to estimate its level
LEVEL_SD_DB, PRIOR_DEVICES = 1.5, 2.0  # prior sd of devices' levels [dB], and its weight in devices
MIN_SHARE = 0.05  # smaller correlated shares count as 0: drawing them takes as long as a large one


@dataclass(frozen=True)
class ErrorCorrelation:
    """Structure of a twin's prediction errors, beside their standard deviation at a link.

    Attributes:
        share: share of the variance that is correlated in space and lasts for a flight, without
            devices' levels; the other part is independent in every slot.
        length_m: distance over which that correlation falls to 1/e [m] (Gudmundson 1991,
            Electronics Letters 27).
        level_sd_db: standard deviation of devices' levels [dB].
        devices: number of devices from which it was estimated.
    """

    share: float = 0.5
    length_m: float = 50.0
    level_sd_db: float = LEVEL_SD_DB
    devices: int = 0

    @classmethod
    def of(cls, twin: Twin, links: Links, seed: int) -> "ErrorCorrelation":
        """Estimate how prediction errors are correlated in space from the residuals of a twin."""
        located = np.array([device.located for device in twin.devices])
        rows = _sampled(links.device, located[links.device] & np.isfinite(links.level_db), seed)
        sample = links.select(rows).with_located_devices(twin.device_m)
        if not len(sample):
            return cls()
        predicted = twin.predict(sample)
        return cls.of_residuals(sample.device, sample.receiver_m,
                                sample.level_db - predicted.mean_db, predicted.sd_db, seed,
                                twin.residual_field)

    @classmethod
    def of_residuals(cls, device: np.ndarray, receiver_m: np.ndarray, residual_db: np.ndarray,
                     sd_db: np.ndarray, seed: int, field: ResidualField | None = None
                     ) -> "ErrorCorrelation":
        """Estimate the spatial correlation of errors (n,) [dB], and the spread of devices' levels.

        The correlation is that of `field`; None: it is fitted. Devices with few links are left out.
        """
        rows = _sampled(device, np.isfinite(residual_db), seed)
        if not len(rows):
            return cls()
        device, receiver_m, residual_db, sd_db = (
            values[rows] for values in (device, receiver_m, residual_db, sd_db))
        precision = 1.0 / sd_db**2
        _, index = np.unique(device, return_inverse=True)
        level_db = np.bincount(index, residual_db * precision) / np.bincount(index, precision)
        if field is None:
            field = ResidualField().fit(device, receiver_m,
                                        (residual_db - level_db[index]) / sd_db, seed)
        # Subtract the variance of mean residuals that correlated map errors cause.
        by_map = [_mean_variance(receiver_m[index == k], precision[index == k], field)
                  for k in range(len(level_db))]
        squares = float(((level_db - np.median(level_db))**2 - by_map).sum())
        variance = (max(squares, 0.0) + PRIOR_DEVICES * LEVEL_SD_DB**2) / (
            len(level_db) - 1 + PRIOR_DEVICES)
        return cls(float(field.share), float(field.length_m), float(np.sqrt(variance)),
                   len(level_db))

    @classmethod
    def from_provenance(cls, twin: Twin) -> "ErrorCorrelation":
        """Return what is stored in a twin's provenance; the defaults if there is nothing."""
        return cls(**twin.provenance.get(MAP_ERRORS, {}))


def _sampled(device: np.ndarray, usable: np.ndarray, seed: int) -> np.ndarray:
    """Draw up to MAX_LINKS usable links of each device with at least MIN_LINKS; return rows."""
    rng, rows = np.random.default_rng(seed), [np.empty(0, dtype=np.int64)]
    for number in np.unique(device[usable]):
        device_rows = np.flatnonzero((device == number) & usable)
        if len(device_rows) >= MIN_LINKS:
            rows.append(rng.choice(device_rows, min(MAX_LINKS, len(device_rows)), replace=False))
    return np.sort(np.concatenate(rows))


def _mean_variance(receiver_m: np.ndarray, precision: np.ndarray, field: ResidualField) -> float:
    """Return the variance [dB²] of the precision-weighted mean of correlated residuals."""
    scaled = np.sqrt(precision)
    rho = field.share * np.exp(-squareform(pdist(receiver_m)) / field.length_m)
    np.fill_diagonal(rho, 1.0)
    return float(scaled @ rho @ scaled / precision.sum()**2)


def with_shadowing(radio_map: RadioMap, twin: Twin) -> RadioMap:
    """Add the correlated share and correlation length of errors to the attributes of a map.

    They are `shadowing_share` and `shadowing_length_m` [m]; the share is 0 if it is below
    MIN_SHARE, or the length below one cell.

    Args:
        radio_map: `twin.radio_map(scene)`.
        twin: its residual field gives the correlation, or else its stored `ErrorCorrelation`.
    """
    errors = twin.residual_field or ErrorCorrelation.from_provenance(twin)
    share, length_m = float(errors.share), float(errors.length_m)
    # A correlation within one cell cannot be distinguished from one within one slot.
    if length_m < radio_map.lattice.step_m or share < MIN_SHARE:
        share, length_m = 0.0, ErrorCorrelation.length_m
    return RadioMap(radio_map.dataset.assign_attrs(shadowing_share=share,
                                                   shadowing_length_m=length_m))
