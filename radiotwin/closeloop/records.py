"""Measured links as the loop sees them: numbers only, checked, with everything that a residual may depend on."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.closeloop.oddities import (
    LEAST_ROWS,
    fill_value,
    odd_names,
    odd_places,
    refuse_empty_levels,
    unheard_devices,
    useless_receivers,
)
from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap

FAR_M = 100_000.0
MISSING_HEIGHT_M = 1.5
ROOF_SAMPLES = 60  # along a link
ROWS_AT_ONCE = 5000  # bounds memory


@dataclass(frozen=True, eq=False)
class Records:
    """n links.

    Attributes:
        level_db: (n,) measured gain [dB] or power [dBm]; NaN = not detected.
        limit_db: the level below which receivers do not detect; None where it is not known.
        receiver_m: (n, 3) positions [m].
        device_m: (k, 3) positions of the devices as far as known [m]; NaN where unknown.
        device, receiver, flight: (n,) index into the names.
        time_s: (n,) NaN where unknown.
        heading_deg: (n,) clockwise from north; NaN where unknown.
        device_names, receiver_names, flight_names: names.
        frequency_hz: of the radio; NaN where unknown.
        city: 3D map; None without a scene.
        is_gain: whether the level is a gain rather than a power.
        anchors: indices of the devices whose positions are declared.
        remarks: what was found odd in the file and what was done about it, a sentence each.
        pitch_deg, roll_deg: (n,) nose up, and right side down, are positive; None or NaN where unknown.
        quality: (n,) as the receiver told it; None or NaN where it did not.
    """

    level_db: np.ndarray
    limit_db: float | None
    receiver_m: np.ndarray
    device_m: np.ndarray
    device: np.ndarray
    receiver: np.ndarray
    flight: np.ndarray
    time_s: np.ndarray
    heading_deg: np.ndarray
    device_names: list[str]
    receiver_names: list[str]
    flight_names: list[str]
    frequency_hz: float
    city: CityMap | None
    is_gain: bool
    anchors: frozenset[int]
    remarks: list[str] = field(default_factory=list)
    pitch_deg: np.ndarray | None = None
    roll_deg: np.ndarray | None = None
    quality: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.level_db)

    @cached_property
    def track(self) -> np.ndarray:
        """(n,) index of the flight of a receiver that a link was measured on."""
        return np.unique(self.flight * (self.receiver.max() + 1) + self.receiver, return_inverse=True)[1]

    @cached_property
    def offset_m(self) -> np.ndarray:
        """(n, 3) from the device to the receiver [m]"""
        return self.receiver_m - self.device_m[self.device]

    @cached_property
    def distance_m(self) -> np.ndarray:
        """(n,) at least 1 m [m]"""
        return np.maximum(np.linalg.norm(self.offset_m, axis=1), 1.0)

    @cached_property
    def azimuth_deg(self) -> np.ndarray:
        """(n,) direction from the device to the receiver, clockwise from north [deg]"""
        return np.degrees(np.arctan2(self.offset_m[:, 0], self.offset_m[:, 1])) % 360

    @cached_property
    def elevation_deg(self) -> np.ndarray:
        """(n,) angle at the device up to the receiver [deg]"""
        return np.degrees(np.arcsin(np.clip(self.offset_m[:, 2] / self.distance_m, -1, 1)))

    @cached_property
    def body_azimuth_deg(self) -> np.ndarray:
        """(n,) direction from the receiver to the device, clockwise from its heading [deg]; NaN without one"""
        return (self.azimuth_deg + 180 - self.heading_deg) % 360

    @cached_property
    def time_in_flight_s(self) -> np.ndarray:
        """(n,) since the first measurement of the track [s]"""
        first = np.full(self.track.max() + 1, np.inf)
        np.minimum.at(first, self.track, np.where(np.isnan(self.time_s), np.inf, self.time_s))
        return self.time_s - first[self.track]

    @cached_property
    def tracks(self) -> dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]:
        """Of each receiver and flight: times (t,) in order [s], and where it was then (t, 3) [m]; only links with a
        time count"""
        found = {}
        timed = np.flatnonzero(np.isfinite(self.time_s))
        order = timed[np.lexsort((self.time_s[timed], self.flight[timed], self.receiver[timed]))]
        ends = np.column_stack([self.receiver[order], self.flight[order]])
        for rows in np.split(order, np.flatnonzero(np.diff(ends, axis=0).any(axis=1)) + 1) if len(order) else ():
            time_s, first = np.unique(self.time_s[rows], return_index=True)
            found[int(self.receiver[rows[0]]), int(self.flight[rows[0]])] = time_s, self.receiver_m[rows[first]]
        return found

    @cached_property
    def first_s(self) -> float:
        """Time of the first measurement [s]; NaN without times"""
        return float(np.nanmin(self.time_s)) if np.isfinite(self.time_s).any() else np.nan

    @cached_property
    def last_s(self) -> float:
        """Time of the last measurement [s]; NaN without times"""
        return float(np.nanmax(self.time_s)) if np.isfinite(self.time_s).any() else np.nan

    @cached_property
    def los(self) -> np.ndarray:
        """(n,) bool; every link has line of sight where there is no map"""
        if self.city is None:
            return np.ones(len(self), dtype=bool)
        return self.city.line_of_sight(self.device_m[self.device], self.receiver_m)

    @cached_property
    def receiver_axes(self) -> np.ndarray:
        """(n, 3, 3) unit vectors of the receiver's right, nose and top in the world; NaN without a heading"""
        heading, pitch, roll = (np.radians(angle) for angle in (
            self.heading_deg, *(np.zeros(len(self)) if angle is None else np.nan_to_num(angle)
                                for angle in (self.pitch_deg, self.roll_deg))))
        level, zero = np.cos(pitch), np.zeros(len(self))
        nose = np.column_stack([np.sin(heading) * level, np.cos(heading) * level, np.sin(pitch)])
        right = np.column_stack([np.cos(heading), -np.sin(heading), zero])
        top = np.cross(right, nose)
        lean, upright = np.sin(roll)[:, None], np.cos(roll)[:, None]
        return np.stack([upright * right - lean * top, nose, upright * top + lean * right], axis=1)

    @cached_property
    def metres_inside(self) -> np.ndarray:
        """(n,) length of the link within buildings [m]; 0 without a map"""
        if self.city is None:
            return np.zeros(len(self))
        return self.city.metres_inside(self.device_m[self.device], self.receiver_m)

    @cached_property
    def diffraction_parameter(self) -> np.ndarray:
        """(n,) the greatest ν of ITU-R P.526-15, Eq. 26, over the roofs below and above the link; NaN without a map"""
        greatest = np.full(len(self), np.nan)
        if self.city is None or np.isnan(self.frequency_hz):
            return greatest
        wavelength_m = speed_of_light / self.frequency_hz
        for start in range(0, len(self), ROWS_AT_ONCE):
            rows = slice(start, start + ROWS_AT_ONCE)
            a_m, b_m = self.device_m[self.device[rows], None], self.receiver_m[rows, None]
            share = (np.arange(ROOF_SAMPLES) + 0.5)[:, None] / ROOF_SAMPLES
            on_link_m = a_m + share * (b_m - a_m)
            over_m = self.city.height_at(on_link_m[..., 0], on_link_m[..., 1]) - on_link_m[..., 2]
            length_m = self.distance_m[rows, None]
            near_m, far_m = length_m * share[:, 0], length_m * (1 - share[:, 0])
            greatest[rows] = (over_m * np.sqrt(2 * length_m / (wavelength_m * near_m * far_m))).max(axis=1)
        return greatest

    def select(self, rows: np.ndarray | slice) -> "Records":
        """The links of a mask, a slice or an index array."""
        names = ("level_db", "receiver_m", "device", "receiver", "flight", "time_s", "heading_deg", "pitch_deg",
                 "roll_deg", "quality")
        values = {name: getattr(self, name) for name in names}
        part = replace(self, **{name: value[rows] for name, value in values.items() if value is not None})
        for name in ("los", "time_in_flight_s"):  # costly, or not to be had from a part
            part.__dict__[name] = getattr(self, name)[rows]
        part.__dict__.update(first_s=self.first_s, last_s=self.last_s, tracks=self.tracks)
        return part

    def with_devices(self, device_m: np.ndarray) -> "Records":
        """The same links, devices elsewhere."""
        return replace(self, device_m=device_m)

    def with_receivers(self, receiver_m: np.ndarray) -> "Records":
        """The same links, receivers elsewhere."""
        return replace(self, receiver_m=receiver_m)

    def with_los(self, los: np.ndarray) -> "Records":
        """The same links, with other lines of sight than the map tells."""
        other = replace(self)
        other.__dict__["los"] = los
        return other


def make_records(measurements: Measurements, scene: Scene | None, to_locate: bool = False) -> Records:
    """Prepare measurements: what cannot be used is left out and told.

    Args:
        measurements: links.
        scene: the 3D map and the radio, if there is one.
        to_locate: whether devices are to be found, and nothing is learned: those of unknown position are kept where
            there is no scene, and so are few links, and receivers that heard nothing, which tells a place, too.

    Raises:
        BadInput: nothing that can be used is left, or positions or levels that cannot be what they are said to be.
    """
    table = measurements.table.reset_index(drop=True)
    level_db, receiver_m, device_index = measurements.level_db, measurements.receiver_m, measurements.device_index
    refuse_empty_levels(level_db, measurements.level_column)
    remarks: list[str] = []
    keep = np.ones(len(table), dtype=bool)

    def leave_out(bad: np.ndarray, why: str) -> None:
        bad = np.asarray(bad) & keep
        if bad.any():
            remarks.append(f"{bad.sum():,} of {len(table):,} links left out: {why}")
            keep[bad] = False

    device_m = np.where(measurements.is_anchor[:, None], measurements.device_m, np.nan)
    device_m[:, 2] = np.where(np.isnan(measurements.device_m[:, 2]), MISSING_HEIGHT_M, measurements.device_m[:, 2])
    remarks += odd_names(measurements) + odd_places(receiver_m, device_m, scene)
    leave_out(np.abs(receiver_m[:, :2] - np.median(receiver_m[:, :2], axis=0)).max(axis=1) > FAR_M,
              f"their receiver is more than {FAR_M / 1000:.0f} km from the others")
    leave_out(np.abs(receiver_m[:, :2] - device_m[device_index, :2]).max(axis=1) > FAR_M,
              f"their receiver is more than {FAR_M / 1000:.0f} km from the device; both need one frame, in metres")
    if "time_s" in table:  # without a time, equal rows may be equal measurements
        leave_out(table.duplicated().to_numpy() & table["time_s"].notna().to_numpy(), "they stand there twice")
    low_z = np.isnan(receiver_m[:, 2])
    if low_z.any() and scene is not None:
        leave_out(low_z, "their receiver's height is empty, and the 3D map needs it")
    elif low_z.any():
        remarks.append(f"{low_z.sum():,} receiver heights are empty and taken for {MISSING_HEIGHT_M} m")
        receiver_m = np.where(np.isnan(receiver_m), MISSING_HEIGHT_M, receiver_m)
    flat = np.isnan(measurements.device_m[:, 2]).sum()
    if flat:
        remarks.append(f"{flat:,} device heights are empty and taken for {MISSING_HEIGHT_M} m")
    placed = np.asarray(np.isfinite(device_m).all(axis=1) | (scene is not None) | to_locate)
    leave_out(~placed[device_index], "without a scene, devices of unknown position cannot be located")
    for bad, why in [] if to_locate else useless_receivers(table, level_db, keep):
        leave_out(bad, why)
    fill_db, share = fill_value(level_db[keep])
    if fill_db is not None:
        at_fill = (level_db == fill_db) & keep
        level_db = np.where(at_fill, np.nan, level_db)
        remarks.append(f"{at_fill.sum():,} links read exactly {fill_db:g}, the lowest value, {share:.0%} of all: taken "
                       "for not detected")
    leave_out(*unheard_devices(table, level_db, keep))
    least = 1 if to_locate else LEAST_ROWS
    if keep.sum() < least or np.isfinite(level_db[keep]).sum() < least // 2:
        raise BadInput(f"{int(keep.sum())} links can be used, {int(np.isfinite(level_db[keep]).sum())} of them "
                       f"detected; at least {least} are needed, {least // 2} of them detected: "
                       + ("; ".join(remarks) or "measure more"))
    refuse_empty_levels(level_db[keep], measurements.level_column)
    table = table[keep]
    receiver, receiver_names = pd.factorize(table["receiver"], sort=True)
    flight, flight_names = pd.factorize(table["flight"])
    heading_deg = _column(table, "heading_deg")
    turned = np.abs(heading_deg) > 360
    if turned.any():
        remarks.append(f"{turned.sum():,} headings lie beyond 360° (such as {heading_deg[turned][0]:g}) and are taken "
                       "for their remainder; heading_deg is in degrees, clockwise from north")
    is_gain = measurements.level_column == "gain_db"
    limit_db = _limit(level_db[keep], scene, is_gain)
    return Records(
        level_db[keep], limit_db, receiver_m[keep], device_m[placed],
        (np.cumsum(placed) - 1)[device_index[keep]], receiver, flight,
        _column(table, "time_s"), heading_deg % 360, list(measurements.devices["device"][placed]),
        list(receiver_names), list(flight_names), _frequency(measurements, scene),
        scene.city if scene else None, is_gain,
        frozenset(np.flatnonzero(measurements.is_anchor[placed]).tolist()), remarks, _column(table, "pitch_deg"),
        _column(table, "roll_deg"), _column(table, "quality"))


def _limit(level_db: np.ndarray, scene: Scene | None, is_gain: bool) -> float | None:
    if scene is not None:
        return scene.config.gain_limit_db if is_gain else scene.config.radio.sensitivity_dbm
    # Without a scene nobody declares it; nothing detected lies below the lowest that was.
    return float(np.nanmin(level_db)) if np.isnan(level_db).any() else None


def _frequency(measurements: Measurements, scene: Scene | None) -> float:
    if scene is not None:
        return scene.config.radio.frequency_hz
    if "frequency_hz" in measurements.devices:
        return float(measurements.devices["frequency_hz"].median())
    return float("nan")


def _column(table: pd.DataFrame, name: str) -> np.ndarray:
    return table[name].to_numpy(dtype=float) if name in table else np.full(len(table), np.nan)
