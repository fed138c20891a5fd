"""The ray tracer as a base: paths over the 3D map, and devices where these say that they are."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from radiotwin.closeloop.bases import (
    ANY_LEVEL_DB,
    LOST_M,
    Base,
    FittedBase,
    FittedChannel,
    TwinBase,
    relied_on_m,
)
from radiotwin.closeloop.paths import COMPONENTS, paths_of
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.relocation import Relocation
from radiotwin.twin import RAYTRACE, Twin, TwinDevice

LEAST_HIDDEN = 30  # links without line of sight that the rest is fitted to
REST_LOW_DB, REST_EXPONENT = -150.0, 3.0
REST_BOUNDS = np.array([[REST_LOW_DB, 2.0], [-60.0, 6.0]])
REST_SCALE_DB = 4.0
MOST_RADIUS_M = 100.0
SURE_M = 15.0  # radius of a device of an earlier twin that is not looked for everywhere again


class RaytraceBase(Base):
    """Paths over the 3D map (`radiotwin.paths`), with a level of its own for each class of line of sight, and unknown
    devices where they explain the levels best.

    Args:
        twin: says where it is worth looking for them.
        start: an earlier twin; devices that it is sure of are looked for around its place, and the law's, only.
        most_radius_m: devices stay where the law has them if it is less sure. In the loop one that is surely somewhere
            else, because of what the map lacks, would be taken for an effect.
    """

    name = RAYTRACE

    def __init__(self, twin: TwinBase, start: Twin | None = None, most_radius_m: float = MOST_RADIUS_M):
        sure = [device for device in start.devices if device.role == "unknown" and device.located
                and device.credible_radius_m <= SURE_M] if start else []
        self._twin = twin
        assert twin.scene is not None
        places = {device.device: [(device.x_m, device.y_m)] for device in sure}
        self._relocation = Relocation(twin.scene.config.extent.bounds, most_radius_m, places=places)

    def fit(self, records: Records) -> FittedBase:
        law = self._twin.fit(records)
        # To be found from there, with all that is known of deep shadow, devices that are not relied on count, too.
        device_m = np.array([(device.x_m, device.y_m, device.z_m) for device in law.found])
        base = FittedPaths(law, _fit_rest(records, device_m), device_m)
        found = self._relocation.devices(records, FittedChannel(law.channel, device_m, law.found), base, base.level_db)
        device_m = relied_on_m(found, LOST_M)
        return FittedPaths(law, _fit_rest(records, device_m), device_m, found)


class FittedPaths(FittedBase):
    """Powers of paths, and of what reaches any place on ways that are not followed.

    Attributes:
        law: says what moving an end changes.
        rest: power of the paths that are not followed (more bounces and edges, rough walls): gain at 100 m [dB], and
            exponent of its fall with distance.
    """

    follows_paths = True

    def __init__(self, law: FittedBase, rest: tuple[float, float], device_m: np.ndarray,
                 found: Sequence[TwinDevice] = ()):
        self.law, self.rest, self.device_m, self.found = law, rest, device_m, found

    def mean_db(self, records: Records) -> np.ndarray:
        return self.level_db(paths_of(records, COMPONENTS), records)

    def level_db(self, power: np.ndarray, records: Records) -> np.ndarray:
        """(n,) expected level of links whose paths have these powers (n,)."""
        return _with_rest_db(power, records, *self.rest)

    def shifted_db(self, records: Records, exact: bool = False) -> np.ndarray:
        return self.mean_db(records) if exact else self.law.mean_db(records)

    def columns(self, records: Records) -> tuple[np.ndarray, np.ndarray]:
        los = records.los
        return np.column_stack([los, ~los]).astype(float), np.full(2, ANY_LEVEL_DB)

    def group(self, records: Records) -> np.ndarray:
        return records.los.astype(int)


def _with_rest_db(power: np.ndarray, records: Records, rest_db: float, exponent: float) -> np.ndarray:
    return 10 * np.log10(power + 10 ** (rest_db / 10) * (records.distance_m / 100.0) ** -exponent)


def _fit_rest(records: Records, device_m: np.ndarray) -> tuple[float, float]:
    """What explains the levels of links without line of sight best, beside a level of their own."""
    rows = np.isfinite(device_m).all(axis=1)[records.device]
    placed = records.with_devices(np.where(np.isfinite(device_m), device_m, 0.0)).select(rows)
    hidden = placed.select(~placed.los)
    power = paths_of(hidden, COMPONENTS)
    level_db = np.where(np.isnan(hidden.level_db), -np.inf if hidden.limit_db is None else hidden.limit_db,
                        hidden.level_db)
    blank, told = np.isnan(hidden.level_db), np.isfinite(level_db)
    # Blanks alone say no more than that it is weak, and the least is.
    if told.sum() < LEAST_HIDDEN or blank[told].all():
        return REST_LOW_DB, REST_EXPONENT

    def loss(numbers: np.ndarray) -> float:
        rest_db, exponent = np.clip(numbers, *REST_BOUNDS)
        error_db = level_db - _with_rest_db(power, hidden, rest_db, exponent)
        error_db = error_db - np.median(error_db[told & ~blank])
        error_db = np.where(blank, np.minimum(error_db, 0.0), error_db)[told]
        return float(np.log1p((error_db / REST_SCALE_DB) ** 2).sum() + np.abs(numbers - [rest_db, exponent]).sum())

    starts = [np.array([rest_db, REST_EXPONENT]) for rest_db in (-100.0, -110.0, -120.0, -130.0)]
    found = minimize(loss, min(starts, key=loss), method="Nelder-Mead", options={"xatol": 0.1, "fatol": 0.5}).x
    rest_db, exponent = np.clip(found, *REST_BOUNDS)
    return float(rest_db), float(exponent)
