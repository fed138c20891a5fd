"""Links: what a channel model sees of a measurement, the two ends and whether they see each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

REFERENCE_DISTANCE_M = 1.0


@dataclass(frozen=True, eq=False)
class Links:
    """n links between a device and a receiver.

    device_m, receiver_m: (n, 3) positions [m]; los: (n,) bool; device: (n,) index of the device, its identity
    for models that keep something per device (any integers, equal for links of one device).
    """

    device_m: np.ndarray
    receiver_m: np.ndarray
    los: np.ndarray
    device: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.receiver_m)
        shapes = {"device_m": (n, 3), "receiver_m": (n, 3), "los": (n,), "device": (n,)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"Links.{name}: shape {np.shape(getattr(self, name))}, expected {shape}")

    def __len__(self) -> int:
        return len(self.receiver_m)

    @cached_property
    def distance_m(self) -> np.ndarray:
        """(n,) distance between the two ends [m], never below the reference distance of 1 m."""
        offset = self.receiver_m - self.device_m
        return np.maximum(np.sqrt(np.einsum("ij,ij->i", offset, offset)), REFERENCE_DISTANCE_M)

    @cached_property
    def log_distance(self) -> np.ndarray:
        """(n,) log10(distance / 1 m)."""
        return np.log10(self.distance_m)

    @cached_property
    def elevation_rad(self) -> np.ndarray:
        """(n,) angle at the device up to the receiver [rad], arcsin((z_r - z_d) / d)."""
        return np.arcsin(np.clip((self.receiver_m[:, 2] - self.device_m[:, 2]) / self.distance_m, -1.0, 1.0))

    def select(self, mask: np.ndarray | slice) -> Links:
        """The links that a mask, a slice or an index array picks."""
        return Links(self.device_m[mask], self.receiver_m[mask], self.los[mask], self.device[mask])


def make_links(
    device_m: np.ndarray, receiver_m: np.ndarray, device: np.ndarray, city: CityMap | None
) -> Links:
    """Links from the devices' positions, with line of sight from the map.

    device_m: (k, 3) positions of all devices [m]; receiver_m: (n, 3) [m]; device: (n,) each link's row in
    device_m. Without a map every link has line of sight.
    Raises BadInput where a position that is used is not finite, or where `device` points outside device_m.
    """
    device_m, receiver_m = np.asarray(device_m, float), np.asarray(receiver_m, float)
    device = np.asarray(device, np.int64)
    if len(device) and not 0 <= device.min() <= device.max() < len(device_m):
        raise BadInput(
            f"links name devices {device.min()} to {device.max()}, but there are {len(device_m)} devices: "
            "allowed are rows of the device table"
        )
    ends_m = device_m[device]
    if not np.isfinite(ends_m).all():
        rows = np.unique(device[~np.isfinite(ends_m).all(axis=1)])
        raise BadInput(
            f"the position of device row {', '.join(map(str, rows[:5]))} is blank or not finite: a link needs "
            "both ends; give the position, or leave out the links of devices that are still to be located"
        )
    if not np.isfinite(receiver_m).all():
        row = int(np.flatnonzero(~np.isfinite(receiver_m).all(axis=1))[0])
        raise BadInput(
            f"the receiver's position in row {row} is {tuple(map(float, receiver_m[row]))}: x, y and z must be "
            "finite numbers [m]; fill it in or leave the row out"
        )
    los = np.ones(len(receiver_m), bool) if city is None else city.line_of_sight(ends_m, receiver_m)
    return Links(ends_m, receiver_m, np.asarray(los, bool), device)
