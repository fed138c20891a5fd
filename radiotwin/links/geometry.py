"""Geometry of links: the two ends, line of sight, and the 3D map between them if there is one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.scene.citymap import CityMap

REFERENCE_DISTANCE_M = 1.0  # of the log-distance law; shorter links count as this long


@dataclass(frozen=True, eq=False)
class LinkGeometry:
    """n links between a device and a receiver, as channel models see them.

    Attributes:
        device_m: (n, 3) position of each link's device [m].
        receiver_m: (n, 3) position of each link's receiver [m].
        los: (n,) bool, line of sight.
        device: (n,) int, identity of the device for models that keep something per device.
        city: 3D map that `los` was taken from; None without one.
        frequency_hz: of the radio [Hz]; NaN where it is unknown.
        estimated: (n,) bool, whether the device's position is an estimate; None: all are declared.
    """

    device_m: np.ndarray
    receiver_m: np.ndarray
    los: np.ndarray
    device: np.ndarray
    city: CityMap | None = None
    frequency_hz: float = float("nan")
    estimated: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.receiver_m)
        shapes = {"device_m": (n, 3), "receiver_m": (n, 3), "los": (n,), "device": (n,)}
        for name, shape in shapes.items():
            given = np.shape(getattr(self, name))
            if given != shape:
                raise ValueError(f"LinkGeometry.{name}: shape {given}, expected {shape}")

    def __len__(self) -> int:
        return len(self.receiver_m)

    @cached_property
    def distance_m(self) -> np.ndarray:
        """(n,) distance between the ends [m], at least `REFERENCE_DISTANCE_M`."""
        offset = self.receiver_m - self.device_m
        return np.maximum(np.sqrt(np.einsum("ij,ij->i", offset, offset)), REFERENCE_DISTANCE_M)

    @cached_property
    def log_distance(self) -> np.ndarray:
        """(n,) log10(distance / 1 m)."""
        return np.log10(self.distance_m)

    @cached_property
    def elevation_rad(self) -> np.ndarray:
        """(n,) angle at the device up to the receiver [rad], arcsin((z_r - z_d) / d)."""
        rise_m = self.receiver_m[:, 2] - self.device_m[:, 2]
        return np.arcsin(np.clip(rise_m / self.distance_m, -1.0, 1.0))

    def select(self, rows: np.ndarray | slice) -> LinkGeometry:
        """Return the links of a mask, a slice or an index array."""
        estimated = None if self.estimated is None else self.estimated[rows]
        return LinkGeometry(self.device_m[rows], self.receiver_m[rows], self.los[rows],
                            self.device[rows], self.city, self.frequency_hz, estimated)


def link_geometry(device_m: np.ndarray, receiver_m: np.ndarray, device: np.ndarray,
                  city: CityMap | None) -> LinkGeometry:
    """Return links between listed devices and receivers, with line of sight from the map.

    Args:
        device_m: (k, 3) positions of all devices [m].
        receiver_m: (n, 3) positions of the receivers [m].
        device: (n,) row of each link's device in `device_m`.
        city: 3D map; without one every link has line of sight.

    Returns:
        n links.

    Raises:
        BadInput: a position that is used is not finite, or `device` points outside `device_m`.
    """
    device_m, receiver_m = np.asarray(device_m, float), np.asarray(receiver_m, float)
    device = np.asarray(device, np.int64)
    if len(device) and not 0 <= device.min() <= device.max() < len(device_m):
        raise BadInput(
            f"links name devices {device.min()} to {device.max()}, but there are {len(device_m)} "
            "devices: allowed are rows of the device table")
    ends_m = device_m[device]
    if not np.isfinite(ends_m).all():
        rows = np.unique(device[~np.isfinite(ends_m).all(axis=1)])
        raise BadInput(
            f"the position of device row {', '.join(map(str, rows[:5]))} is blank or not finite: "
            "a link needs both ends; give the position, or leave out the links of devices that are "
            "still to be located")
    if not np.isfinite(receiver_m).all():
        row = int(np.flatnonzero(~np.isfinite(receiver_m).all(axis=1))[0])
        raise BadInput(
            f"the receiver's position in row {row} is {tuple(map(float, receiver_m[row]))}: x, y "
            "and z must be finite numbers [m]; fill it in or leave the row out")
    los = np.ones(len(receiver_m), bool) if city is None else city.line_of_sight(ends_m, receiver_m)
    return LinkGeometry(ends_m, receiver_m, np.asarray(los, bool), device, city)
