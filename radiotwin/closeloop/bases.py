"""The models whose residual is looked at: the twin, the log-distance law, and (in `raytraced`) the ray tracer."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import pandas as pd

from radiotwin.channel import ChannelModel, Links, check_fit_data
from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.closeloop.records import Records
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.twin import Twin, TwinDevice, fit_twin

LEVEL_SPREAD_DB = 20.0
SLOPE_SPREAD_DB = 10.0  # per decade
ANY_LEVEL_DB = 300.0
LOST_M = 40.0  # a device that may be that far from where it seems to be says nothing about the channel


class FittedBase(ABC):
    """A base model that was fitted to some links and predicts any.

    Attributes:
        device_m: (k, 3) positions that it has for the devices; NaN where it could not locate one.
        found: the devices as they were located, those that are not relied on, too; empty where all were given.
    """

    device_m: np.ndarray
    found: Sequence[TwinDevice] = ()

    @abstractmethod
    def mean_db(self, records: Records) -> np.ndarray:
        """(n,) expected level of links between the receivers and `records.device_m`."""

    follows_paths: ClassVar[bool] = False

    def shifted_db(self, records: Records, exact: bool = False) -> np.ndarray:
        """(n,) what changes of the level are taken from, where ends are moved, lines of sight made up, or the map is
        another: `mean_db`, or, unless it is to be `exact`, something quicker."""
        return self.mean_db(records)

    @abstractmethod
    def columns(self, records: Records) -> tuple[np.ndarray, np.ndarray]:
        """(n, p) what of it is fitted again together with the effects, and (p,) its prior standard deviations."""

    @abstractmethod
    def group(self, records: Records) -> np.ndarray:
        """(n,) index of the error scale: with line of sight 1, without it 0, where the base tells them apart."""


class Base(ABC):
    """A kind of base model."""

    name: ClassVar[str]

    @abstractmethod
    def fit(self, records: Records) -> FittedBase:
        """Fit to links. Raises BadInput where they are too few or of no use."""


class LogDistanceBase(Base):
    """One exponent and one intercept for all links (ITU-R P.1411: basic transmission loss against distance)."""

    name = "log-distance"

    def __init__(self, scene: Scene | None, seed: int):
        self._scene, self._seed = scene, seed

    def fit(self, records: Records) -> FittedBase:
        if np.isnan(records.device_m).any():
            assert self._scene is not None  # without one, links of devices that are nowhere have been left out
            twin = _fit_twin(records, self._scene, "log_distance", self._seed)
            return FittedChannel(twin.channel, relied_on_m(twin.devices), twin.devices)
        return _fit_channel(records, LogDistance(), self._seed)


class TwinBase(Base):
    """The segmented channel network, and devices where it finds them."""

    name = "twin"

    def __init__(self, scene: Scene | None, seed: int):
        self.scene, self._seed = scene, seed
        self._fitted: dict[bytes, FittedChannel] = {}  # another base may ask for the same again

    def fit(self, records: Records) -> "FittedChannel":
        key = records.level_db.tobytes()
        if key not in self._fitted:
            self._fitted[key] = self._fit(records)
        return self._fitted[key]

    def _fit(self, records: Records) -> "FittedChannel":
        if self.scene is not None:
            twin = _fit_twin(records, self.scene, "segmented_log_distance", self._seed)
            return FittedChannel(twin.channel, relied_on_m(twin.devices, LOST_M), twin.devices)
        return _fit_channel(records, SegmentedLogDistance(), self._seed)


class FittedChannel(FittedBase):
    """Any channel model; its level and slope are fitted again for each class of line of sight."""

    def __init__(self, channel: ChannelModel, device_m: np.ndarray, found: Sequence[TwinDevice] = ()):
        self.channel, self.device_m, self.found = channel, device_m, found

    def mean_db(self, records: Records) -> np.ndarray:
        return self.channel.predict(_links(records))[0]

    def columns(self, records: Records) -> tuple[np.ndarray, np.ndarray]:
        slope = np.log10(records.distance_m / 100.0)
        los = records.los if self._by_class(records) else np.ones(len(records), dtype=bool)
        columns = [los, los * slope]
        if self._by_class(records):
            columns += [~los, ~los * slope]
        return np.column_stack(columns).astype(float), np.tile([LEVEL_SPREAD_DB, SLOPE_SPREAD_DB], len(columns) // 2)

    def group(self, records: Records) -> np.ndarray:
        return records.los.astype(int) if self._by_class(records) else np.zeros(len(records), dtype=int)

    def _by_class(self, records: Records) -> bool:
        return records.city is not None and self.channel.uses_map


def _links(records: Records) -> Links:
    return Links(records.device_m[records.device], records.receiver_m, records.los, records.device)


def _fit_channel(records: Records, channel: ChannelModel, seed: int) -> FittedChannel:
    links = _links(records)
    check_fit_data(links, records.level_db, needs_los=channel.uses_map and records.city is not None)
    return FittedChannel(channel.fit(links, records.level_db, records.limit_db, seed), records.device_m)


def relied_on_m(devices: Sequence[TwinDevice], lost_m: float = np.inf) -> np.ndarray:
    """(k, 3) positions that may be relied on: NaN where nine in ten of the guesses are farther off than `lost_m`."""
    located = np.array([device.located and device.credible_radius_m <= lost_m for device in devices])
    return np.where(located[:, None], [(device.x_m, device.y_m, device.z_m) for device in devices], np.nan)


def _fit_twin(records: Records, scene: Scene, model: str, seed: int) -> Twin:
    return fit_twin(as_measurements(records), scene, model=model, seed=seed)


def as_measurements(records: Records, level_db: np.ndarray | None = None) -> Measurements:
    """The links as measurements again, with other levels where they are given."""
    level_db = records.level_db if level_db is None else level_db
    table = pd.DataFrame({
        "time_s": records.time_s, "flight": np.array(records.flight_names)[records.flight],
        "receiver": np.array(records.receiver_names)[records.receiver],
        **{f"receiver_{axis}_m": records.receiver_m[:, i] for i, axis in enumerate("xyz")},
        "device": np.array(records.device_names)[records.device],
        "gain_db" if records.is_gain else "rssi_dbm": level_db})
    known = np.isfinite(records.device_m).all(axis=1)
    devices = pd.DataFrame({
        "device": records.device_names, "x_m": records.device_m[:, 0], "y_m": records.device_m[:, 1],
        "z_m": records.device_m[:, 2], "role": np.where(known, "anchor", "unknown")})
    return Measurements(table, devices)
