"""Measured links as arrays: what was read, both ends, map and radio; and their predicted levels.

`LinkGeometry` is the part that a channel model may see. Whether the times of different flights can
be compared is told from the tracks of their receivers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, Generic, TypeVar

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.links.declared import NOTHING, Declared
from radiotwin.scene.citymap import CityMap

Value = TypeVar("Value")
Tracks = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
"""(receiver, flight) -> times (t,) in order [s] and positions (t, 3) then [m]."""
ELSEWHERE_M = 20.0  # a receiver is not at two places so far apart at one time
MIN_ELSEWHERE = 0.5  # share of the common times of two flights
SAME_START_S = 1.0  # flights that all begin within it begin when their clock does
MIN_FLIGHT_S = 10.0  # shorter ones may begin together by chance
MAX_FLIGHTS = 40  # of a receiver, of which neighbours are compared
RESTART_NOTE = ("time_s begins anew in each flight (flights of one receiver overlap): only times "
                "within a flight are compared, and no change from flight to flight is looked for")
REFERENCE_DISTANCE_M = 1.0  # of the log-distance law; shorter links count as this long
ROOF_SAMPLES = 60  # points along a link at which the roofs below it are looked up
ROOF_CHUNK = 5000  # links a time: bounds the memory of that to 10 MB


def clocks_restart(tracks: Tracks) -> bool:
    """Return whether some receiver's clock begins anew in each flight.

    Then two of its flights begin at one time, or it would be at two places at once.
    """
    by_receiver: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for (receiver, _), track in tracks.items():
        by_receiver.setdefault(receiver, []).append(track)
    return any(_restarts(sorted(flights, key=lambda track: track[0][0])[:MAX_FLIGHTS])
               for flights in by_receiver.values() if len(flights) > 1)


def _restarts(flights: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Return whether flights of one receiver, by their start, are of a clock that begins anew."""
    starts_s = np.array([time_s[0] for time_s, _ in flights])
    lengths_s = np.array([time_s[-1] - time_s[0] for time_s, _ in flights])
    if np.ptp(starts_s) <= SAME_START_S and (lengths_s > MIN_FLIGHT_S).all():
        return True
    return any(_at_two_places(*pair) for pair in zip(flights, flights[1:], strict=False))


def _at_two_places(one: tuple[np.ndarray, np.ndarray],
                   other: tuple[np.ndarray, np.ndarray]) -> bool:
    (time_s, position_m), (other_s, other_m) = one, other
    both = (time_s >= other_s[0]) & (time_s <= other_s[-1])
    if both.sum() < 2:
        return False
    there_m = np.column_stack([np.interp(time_s[both], other_s, axis_m) for axis_m in other_m.T])
    apart_m = np.linalg.norm(position_m[both] - there_m, axis=1)
    return bool((apart_m > ELSEWHERE_M).mean() > MIN_ELSEWHERE)


@dataclass(frozen=True, eq=False)
class LinkGeometry:
    """n links between a device and a receiver: all that a channel model may depend on.

    It is asked for links that nobody measured, too: from candidates for the position of a device,
    or from the other end. So it takes both ends of each link rather than `Links`.

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
        return replace(self, device_m=self.device_m[rows], receiver_m=self.receiver_m[rows],
                       los=self.los[rows], device=self.device[rows], estimated=estimated)


def link_geometry(device_m: np.ndarray, receiver_m: np.ndarray, device: np.ndarray,
                  city: CityMap | None, frequency_hz: float = np.nan) -> LinkGeometry:
    """Return links between listed devices and receivers, with line of sight from the map.

    Args:
        device_m: (k, 3) positions of all devices [m].
        receiver_m: (n, 3) positions of the receivers [m].
        device: (n,) row of each link's device in `device_m`.
        city: 3D map; without one every link has line of sight.
        frequency_hz: of the radio [Hz]; NaN where it is unknown.

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
    return LinkGeometry(ends_m, receiver_m, np.asarray(los, bool), device, city, frequency_hz)


@dataclass(frozen=True, eq=False, kw_only=True)
class Columns:
    """What was measured of each of n links.

    Attributes:
        level_db: (n,) measured gain [dB] or power [dBm]; NaN = not detected.
        limit_db: (n,) level below which the link's receiver does not detect [dB]; -inf where it is
            unknown, and a blank says nothing of the level.
        receiver_m: (n, 3) positions of the receivers [m].
        device, receiver, flight: (n,) index into the names of the ends.
        time_s: (n,) NaN where unknown.
        heading_deg: (n,) clockwise from north; NaN where unknown.
        pitch_deg, roll_deg: (n,) nose up, and right side down, are positive; None if unknown.
        quality: (n,) as the receiver reports it; None if it does not.
        known_los: (n,) bool, line of sight where it is known already; None: from the map.
        time_in_flight_s: (n,) since the first measurement of the track [s]; None: from these links.
        evidence: (n, 2) piece of evidence and place of each link, see
            `radiotwin.links.with_evidence`; None before a residual has been looked at.
    """

    level_db: np.ndarray
    limit_db: np.ndarray
    receiver_m: np.ndarray
    device: np.ndarray
    receiver: np.ndarray
    flight: np.ndarray
    time_s: np.ndarray
    heading_deg: np.ndarray
    pitch_deg: np.ndarray | None = None
    roll_deg: np.ndarray | None = None
    quality: np.ndarray | None = None
    known_los: np.ndarray | None = None
    time_in_flight_s: np.ndarray = None  # type: ignore[assignment]  # filled in below
    evidence: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.time_in_flight_s is None:
            time_s = self.time_s
            if not np.isnan(time_s).all():
                first_s = np.full(self.track.max() + 1, np.inf)
                np.minimum.at(first_s, self.track, np.where(np.isnan(time_s), np.inf, time_s))
                time_s = time_s - first_s[self.track]
            object.__setattr__(self, "time_in_flight_s", time_s)

    @classmethod
    def unmeasured(cls, receiver_m: np.ndarray, device: np.ndarray,
                   limit_db: float | None = None) -> Columns:
        """Return n links that nobody measured: receiver, flight, time and heading are unset.

        Args:
            receiver_m: (n, 3) positions of the receivers [m].
            device: (n,) index of each link's device.
            limit_db: level below which receivers do not detect [dB]; None where it is unknown.
        """
        n = len(receiver_m)
        unset, unknown = np.full(n, -1), np.full(n, np.nan)
        return cls(level_db=unknown, limit_db=np.full(n, -np.inf if limit_db is None else limit_db),
                   receiver_m=receiver_m, device=device, receiver=unset, flight=unset,
                   time_s=unknown, heading_deg=unknown)

    @cached_property
    def track(self) -> np.ndarray:
        """(n,) index of the flight of a receiver that a link was measured on."""
        key = self.flight * (self.receiver.max() + 1) + self.receiver
        return np.unique(key, return_inverse=True)[1]

    def select(self, rows: np.ndarray | slice) -> Columns:
        """Return the links of a mask, a slice or an index array."""
        values: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        return Columns(**{name: value[rows] for name, value in values.items()
                          if value is not None})


@dataclass(frozen=True, eq=False, kw_only=True)
class Flown:
    """When and where receivers measured, in all the data: it stays when links are selected.

    Attributes:
        first_s, last_s: time of the first and the last measurement [s]; NaN without times.
        tracks: where each receiver was in each flight; only links with a time count.
        time_restarts: whether clocks begin anew in each flight, so that `time_s` orders readings
            within a flight only.
    """

    first_s: float = np.nan
    last_s: float = np.nan
    tracks: Tracks = field(default_factory=dict)
    time_restarts: bool = False

    @classmethod
    def of(cls, columns: Columns) -> Flown:
        """Return the tracks of links."""
        timed = np.flatnonzero(np.isfinite(columns.time_s))
        if not len(timed):
            return cls()
        tracks: Tracks = {}
        order = timed[np.lexsort((columns.time_s[timed], columns.flight[timed],
                                  columns.receiver[timed]))]
        ends = np.column_stack([columns.receiver[order], columns.flight[order]])
        starts = np.flatnonzero(np.diff(ends, axis=0).any(axis=1)) + 1
        for rows in np.split(order, starts):
            time_s, first = np.unique(columns.time_s[rows], return_index=True)
            key = int(columns.receiver[rows[0]]), int(columns.flight[rows[0]])
            tracks[key] = time_s, columns.receiver_m[rows[first]]
        return cls(first_s=float(np.nanmin(columns.time_s)), tracks=tracks,
                   last_s=float(np.nanmax(columns.time_s)), time_restarts=clocks_restart(tracks))


@dataclass(frozen=True, eq=False, kw_only=True)
class Ends:
    """The devices, receivers and flights that links have by their index.

    Attributes:
        device_names, receiver_names, flight_names: the names.
        device_m: (k, 3) positions of the devices as far as they are known [m]; NaN where not.
        anchors: indices of the devices whose positions are declared.
        boresight_deg: (k,) declared azimuth of each device's antenna, clockwise from north [deg];
            NaN where none is, and where None is given.
        tilt_deg: (k,) declared tilt of each device's antenna, upwards [deg]; likewise.
        declared: what is declared of the devices' powers, cables, antennas and carriers.
        reads: (k,) bool, devices at which levels are read, as by a gateway; None: none.
        flown: when and where receivers measured.
    """

    device_names: list[str]
    device_m: np.ndarray
    anchors: frozenset[int]
    receiver_names: list[str] = field(default_factory=list)
    flight_names: list[str] = field(default_factory=list)
    boresight_deg: np.ndarray = None  # type: ignore[assignment]  # filled in below, as the next
    tilt_deg: np.ndarray = None  # type: ignore[assignment]
    declared: Declared = NOTHING
    reads: np.ndarray | None = None
    flown: Flown = Flown()

    def __post_init__(self) -> None:
        for name in ("boresight_deg", "tilt_deg"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(len(self.device_names), np.nan))


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """What all links share.

    Attributes:
        frequency_hz: of the radio [Hz]; NaN where unknown.
        city: 3D map; None without a scene.
        is_gain: whether the level is a gain rather than a power.
    """

    frequency_hz: float
    city: CityMap | None
    is_gain: bool


class _Of(Generic[Value]):
    """An attribute of a part of links, under its name there."""

    def __init__(self, part: str) -> None:
        self._part = part

    def __set_name__(self, owner: type, name: str) -> None:
        self._get = attrgetter(f"{self._part}.{name}")

    def __get__(self, links: Links, owner: type) -> Value:
        return self._get(links)


@dataclass(frozen=True, eq=False, kw_only=True)
class Links:
    """n links, as arrays; made by `radiotwin.links.prepare_links` from measurements.

    What the parts hold is read under the same name here: `links.level_db`, `links.device_m`.

    Attributes:
        columns: what was measured of each link.
        ends: the devices, receivers and flights.
        world: the 3D map and the radio.
        notes: what the data's checks found and did about it, a sentence each.
    """

    columns: Columns
    ends: Ends
    world: World
    notes: tuple[str, ...] = ()

    level_db = _Of[np.ndarray]("columns")
    limit_db = _Of[np.ndarray]("columns")
    receiver_m = _Of[np.ndarray]("columns")
    device = _Of[np.ndarray]("columns")
    receiver = _Of[np.ndarray]("columns")
    flight = _Of[np.ndarray]("columns")
    time_s = _Of[np.ndarray]("columns")
    heading_deg = _Of[np.ndarray]("columns")
    pitch_deg = _Of[np.ndarray | None]("columns")
    roll_deg = _Of[np.ndarray | None]("columns")
    quality = _Of[np.ndarray | None]("columns")
    known_los = _Of[np.ndarray | None]("columns")
    time_in_flight_s = _Of[np.ndarray]("columns")
    evidence = _Of[np.ndarray | None]("columns")
    track = _Of[np.ndarray]("columns")
    device_names = _Of[list[str]]("ends")
    receiver_names = _Of[list[str]]("ends")
    flight_names = _Of[list[str]]("ends")
    device_m = _Of[np.ndarray]("ends")
    anchors = _Of[frozenset[int]]("ends")
    boresight_deg = _Of[np.ndarray]("ends")
    tilt_deg = _Of[np.ndarray]("ends")
    declared = _Of[Declared]("ends")
    reads = _Of[np.ndarray | None]("ends")
    first_s = _Of[float]("ends.flown")
    last_s = _Of[float]("ends.flown")
    tracks = _Of[Tracks]("ends.flown")
    time_restarts = _Of[bool]("ends.flown")
    frequency_hz = _Of[float]("world")
    city = _Of[CityMap | None]("world")
    is_gain = _Of[bool]("world")

    def __len__(self) -> int:
        return len(self.level_db)

    @cached_property
    def geometry(self) -> LinkGeometry:
        """The links as channel models see them."""
        estimated = ~np.isin(self.device, sorted(self.anchors))
        return LinkGeometry(self.device_m[self.device], self.receiver_m, self.los, self.device,
                            self.city, self.frequency_hz, estimated)

    @cached_property
    def declared_db(self) -> np.ndarray | float:
        """What is declared of the devices, in the levels (n,) [dB], see `Declared.added_db`."""
        return self.declared.added_db(self.device, self.offset_m)

    def gains(self, declared_db: np.ndarray | float | None = None
              ) -> tuple[LinkGeometry, np.ndarray, np.ndarray]:
        """Return what a channel learns from: the links, their gains and limits of these (n,) [dB].

        Args:
            declared_db: (n,) what of the levels is declared [dB]; None: `declared_db`.
        """
        taken_db = self.declared_db if declared_db is None else declared_db
        return self.geometry, self.level_db - taken_db, self.limit_db - taken_db

    @cached_property
    def receiver_limits_db(self) -> np.ndarray:
        """(r,) limit of detection of each receiver [dB], the median over its links; else -inf."""
        limits_db = pd.Series(self.limit_db).groupby(self.receiver).median()
        return limits_db.reindex(range(len(self.receiver_names)), fill_value=-np.inf).to_numpy()

    @property
    def level_unit(self) -> str:
        """Unit of the levels, and of limits."""
        return "dB" if self.is_gain else "dBm"

    @property
    def has_gains(self) -> bool:
        """Whether gains between antennas are known: levels are, or the devices' powers are."""
        return self.is_gain or self.declared.knows_powers

    @property
    def usual_limit_db(self) -> float | None:
        """The limit of detection of most receivers [dB]: the median; None where none is known."""
        known_db = np.sort(self.receiver_limits_db[np.isfinite(self.receiver_limits_db)])
        return float(known_db[(len(known_db) - 1) // 2]) if len(known_db) else None

    @property
    def has_boresights(self) -> bool:
        """Whether the azimuth of any device's antenna is declared."""
        return bool(np.isfinite(self.boresight_deg).any())

    @cached_property
    def offset_m(self) -> np.ndarray:
        """(n, 3) from the device to the receiver [m]."""
        return self.receiver_m - self.device_m[self.device]

    @cached_property
    def distance_m(self) -> np.ndarray:
        """(n,) at least `REFERENCE_DISTANCE_M` [m]."""
        return np.maximum(np.linalg.norm(self.offset_m, axis=1), REFERENCE_DISTANCE_M)

    @cached_property
    def azimuth_deg(self) -> np.ndarray:
        """(n,) direction from the device to the receiver, clockwise from north [deg]."""
        return np.degrees(np.arctan2(self.offset_m[:, 0], self.offset_m[:, 1])) % 360

    @cached_property
    def elevation_deg(self) -> np.ndarray:
        """(n,) angle at the device up to the receiver [deg]."""
        return np.degrees(np.arcsin(np.clip(self.offset_m[:, 2] / self.distance_m, -1, 1)))

    @cached_property
    def body_azimuth_deg(self) -> np.ndarray:
        """(n,) direction from the receiver to the device, clockwise from its heading [deg]."""
        return (self.azimuth_deg + 180 - self.heading_deg) % 360

    @cached_property
    def los(self) -> np.ndarray:
        """(n,) bool; without a map every link has line of sight."""
        if self.known_los is not None:
            return self.known_los
        if self.city is None:
            return np.ones(len(self), dtype=bool)
        return self.city.line_of_sight(self.device_m[self.device], self.receiver_m)

    @cached_property
    def receiver_axes(self) -> np.ndarray:
        """(n, 3, 3) unit vectors of the receiver's right, nose and top; NaN without a heading."""
        heading, pitch, roll = (
            np.radians(np.zeros(len(self)) if angle is None else angle) for angle in
            (self.heading_deg, *(angle if angle is None else np.nan_to_num(angle)
                                 for angle in (self.pitch_deg, self.roll_deg))))
        level, zero = np.cos(pitch), np.zeros(len(self))
        nose = np.column_stack([np.sin(heading) * level, np.cos(heading) * level, np.sin(pitch)])
        right = np.column_stack([np.cos(heading), -np.sin(heading), zero])
        top = np.cross(right, nose)
        lean, upright = np.sin(roll)[:, None], np.cos(roll)[:, None]
        return np.stack([upright * right - lean * top, nose, upright * top + lean * right], axis=1)

    @cached_property
    def metres_inside(self) -> np.ndarray:
        """(n,) length of the link within buildings [m]; 0 without a map."""
        if self.city is None:
            return np.zeros(len(self))
        return self.city.metres_inside(self.device_m[self.device], self.receiver_m)

    @cached_property
    def diffraction_parameter(self) -> np.ndarray:
        """(n,) the greatest ν (ITU-R P.526-15, Eq. 26) over the roofs; NaN without a map."""
        greatest = np.full(len(self), np.nan)
        if self.city is None or np.isnan(self.frequency_hz):
            return greatest
        wavelength_m = speed_of_light / self.frequency_hz
        share = (np.arange(ROOF_SAMPLES) + 0.5)[:, None] / ROOF_SAMPLES
        for start in range(0, len(self), ROOF_CHUNK):
            rows = slice(start, start + ROOF_CHUNK)
            a_m, b_m = self.device_m[self.device[rows], None], self.receiver_m[rows, None]
            on_link_m = a_m + share * (b_m - a_m)
            over_m = self.city.height_at(on_link_m[..., 0], on_link_m[..., 1]) - on_link_m[..., 2]
            length_m = self.distance_m[rows, None]
            near_m, far_m = length_m * share[:, 0], length_m * (1 - share[:, 0])
            nu = over_m * np.sqrt(2 * length_m / (wavelength_m * near_m * far_m))
            greatest[rows] = nu.max(axis=1)
        return greatest

    def select(self, rows: np.ndarray | slice) -> Links:
        """Return the links of a mask, a slice or an index array."""
        return replace(self, columns=replace(self.columns, known_los=self.los).select(rows))

    def with_columns(self, **columns: Any) -> Links:
        """Return the same links with other values (n,) of some `Columns`."""
        return replace(self, columns=replace(self.columns, **columns))

    def with_receivers(self, receiver_m: np.ndarray) -> Links:
        """Return the same links with the receivers at (n, 3) [m]."""
        return self.with_columns(receiver_m=receiver_m, known_los=None)

    def with_los(self, los: np.ndarray) -> Links:
        """Return the same links with lines of sight (n,) other than the map's."""
        return self.with_columns(known_los=los)

    def with_ends(self, **ends: Any) -> Links:
        """Return the same links with other values of some `Ends`, at the same positions."""
        return replace(self, ends=replace(self.ends, **ends))

    def with_devices(self, device_m: np.ndarray) -> Links:
        """Return the same links with the devices at (k, 3) [m]."""
        return self.with_ends(device_m=device_m).with_columns(known_los=None)

    def of_devices(self, device: np.ndarray, device_m: np.ndarray, names: list[str],
                   anchors: frozenset[int]) -> Links:
        """Return the same links as those of other devices.

        Args:
            device: (n,) index of each link's device.
            device_m: (k, 3) positions of the devices [m].
            names: k names.
            anchors: indices of the devices whose positions are declared.
        """
        radio = np.full(len(names), -1)
        radio[device] = self.device
        reads = None if self.reads is None else self.reads[radio] & (radio >= 0)
        links = self.with_columns(device=device, known_los=None)
        return links.with_ends(device_m=device_m, device_names=names, anchors=anchors,
                               declared=self.declared.of_devices(radio), reads=reads)

    def located(self, device_m: np.ndarray) -> Links:
        """Return the links of devices that have a position in (k, 3) [m], there; NaN: none."""
        rows = np.isfinite(device_m).all(axis=1)[self.device]
        return self.with_devices(np.nan_to_num(device_m)).select(rows)

    def since(self, first_s: float) -> Links:
        """Return the same links, with times that count from another first measurement [s]."""
        return self.with_ends(flown=replace(self.ends.flown, first_s=first_s))

    def with_city(self, city: CityMap | None) -> Links:
        """Return the same links over another map."""
        links = self.with_columns(known_los=None)
        return replace(links, world=replace(self.world, city=city))

    def with_notes(self, *notes: str) -> Links:
        """Return the same links with more notes."""
        return replace(self, notes=(*self.notes, *notes))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Expected levels of n links.

    Attributes:
        mean_db: (n,) mean gain [dB] or power [dBm], also below what can be detected.
        sd_db: (n,) standard deviation [dB].
        detection_probability: (n,) that the link is detected.
        reading_db: (n,) mean of a detected level: above `mean_db` near the limit of detection.
    """

    mean_db: np.ndarray
    sd_db: np.ndarray
    detection_probability: np.ndarray
    reading_db: np.ndarray

    @classmethod
    def concatenate(cls, parts: list[Prediction]) -> Prediction:
        """Return the predictions of several sets of links, one after the other."""
        arrays = zip(*(vars(each).values() for each in parts))
        return cls(*map(np.concatenate, arrays))
