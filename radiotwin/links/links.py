"""Links as arrays: readings, both ends, map and radio; and the levels predicted for them.

`LinkGeometry` is the part that a channel model sees. Clocks that restart in each flight are found
by comparing the tracks of receivers.
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
"""(receiver, flight) -> sorted times (t,) [s], and positions (t, 3) [m] at these times."""
ELSEWHERE_M = 20.0  # positions of a receiver that are farther apart are two places
MIN_ELSEWHERE = 0.5  # share of the common times at which a receiver would be at two places
SAME_START_S = 1.0  # flights that start so close together started their clock anew
MIN_FLIGHT_S = 10.0  # shorter flights may start together by chance
MAX_FLIGHTS = 40  # of a receiver; later ones are not compared
RESTART_NOTE = ("time_s begins anew in each flight (flights of one receiver overlap): only times "
                "within a flight are compared, and no change from flight to flight is looked for")
REFERENCE_DISTANCE_M = 1.0  # of the log-distance law; the smallest distance of a link
ROOF_SAMPLES = 60  # points along a link at which the roof height is looked up
ROOF_CHUNK = 5000  # links per batch; bounds the memory of these points to 10 MB


def clocks_restart(tracks: Tracks) -> bool:
    """Return whether the clock of any receiver starts anew in each flight.

    It does if all flights of that receiver start at the same time, or if two successive ones would
    put it at two places at once. `tracks`: (receiver, flight) -> times [s] and positions [m].
    """
    by_receiver: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for (receiver, _), track in tracks.items():
        by_receiver.setdefault(receiver, []).append(track)
    return any(_restarts(sorted(flights, key=lambda track: track[0][0])[:MAX_FLIGHTS])
               for flights in by_receiver.values() if len(flights) > 1)


def _restarts(flights: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Return whether a receiver's clock starts anew in each of its flights, sorted by start."""
    starts_s = np.array([time_s[0] for time_s, _ in flights])
    lengths_s = np.array([time_s[-1] - time_s[0] for time_s, _ in flights])
    if np.ptp(starts_s) <= SAME_START_S and (lengths_s > MIN_FLIGHT_S).all():
        return True
    return any(_at_two_places(*pair) for pair in zip(flights, flights[1:], strict=False))


def _at_two_places(one: tuple[np.ndarray, np.ndarray],
                   other: tuple[np.ndarray, np.ndarray]) -> bool:
    """Return whether two tracks (times, positions) are far apart at most of their common times."""
    (time_s, position_m), (other_s, other_m) = one, other
    common = (time_s >= other_s[0]) & (time_s <= other_s[-1])
    if common.sum() < 2:
        return False
    other_m = np.column_stack([np.interp(time_s[common], other_s, axis_m) for axis_m in other_m.T])
    apart_m = np.linalg.norm(position_m[common] - other_m, axis=1)
    return bool((apart_m > ELSEWHERE_M).mean() > MIN_ELSEWHERE)


@dataclass(frozen=True, eq=False)
class LinkGeometry:
    """Both ends of n links: everything that a channel model may depend on.

    Models also predict links that nobody measured, such as those of candidate device positions, so
    they take this view in place of `Links`.

    Attributes:
        device_m: (n, 3) position of each link's device [m].
        receiver_m: (n, 3) position of each link's receiver [m].
        los: (n,) bool, line of sight.
        device: (n,) index of each link's device, for models with parameters of each device.
        city: 3D map that `los` was taken from; None without one.
        frequency_hz: of the radio [Hz]; NaN: unknown.
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
    """Make links between listed devices and receivers, with line of sight from the map.

    Args:
        device_m: (k, 3) positions of all devices [m].
        receiver_m: (n, 3) positions of the receivers [m].
        device: (n,) row of each link's device in `device_m`.
        city: 3D map; without one every link has line of sight.
        frequency_hz: of the radio [Hz]; NaN: unknown.

    Raises:
        BadInput: the position of an end is not finite, or `device` points outside `device_m`.
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
    """Measured values of n links.

    Attributes:
        level_db: (n,) measured gain [dB] or power [dBm]; NaN = not detected.
        limit_db: (n,) limit of detection of the link's receiver [as levels]; -inf: unknown, and a
            blank does not bound the level.
        receiver_m: (n, 3) positions of the receivers [m].
        device, receiver, flight: (n,) index into the names in `Ends`.
        time_s: (n,) time [s]; NaN: unknown.
        heading_deg: (n,) clockwise from north [deg]; NaN: unknown.
        pitch_deg, roll_deg: (n,) positive with the nose up, and right side down [deg]; None:
            unknown.
        quality: (n,) as the receiver reports it; None: not reported.
        known_los: (n,) bool, line of sight; None: it is looked up in the map.
        time_in_flight_s: (n,) since the first measurement of the track [s]; None: it is computed
            from these links.
        evidence: (n, 2) piece of evidence and place of each link, see
            `radiotwin.links.with_evidence`; None before that.
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
        """Make n links to predict: level, time, heading NaN; index of receiver and flight -1.

        Args:
            receiver_m: (n, 3) positions of the receivers [m].
            device: (n,) index of each link's device.
            limit_db: limit of detection of all receivers [dB or dBm, as levels]; None: -inf.
        """
        n = len(receiver_m)
        unset, unknown = np.full(n, -1), np.full(n, np.nan)
        return cls(level_db=unknown, limit_db=np.full(n, -np.inf if limit_db is None else limit_db),
                   receiver_m=receiver_m, device=device, receiver=unset, flight=unset,
                   time_s=unknown, heading_deg=unknown)

    @cached_property
    def track(self) -> np.ndarray:
        """(n,) index of the track, one receiver on one flight, that a link was measured on."""
        key = self.flight * (self.receiver.max() + 1) + self.receiver
        return np.unique(key, return_inverse=True)[1]

    def select(self, rows: np.ndarray | slice) -> Columns:
        """Return the links of a mask, a slice or an index array."""
        values: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        return Columns(**{name: value[rows] for name, value in values.items()
                          if value is not None})


@dataclass(frozen=True, eq=False, kw_only=True)
class Flown:
    """Tracks of the receivers in all the data; a selection of links keeps them whole.

    Attributes:
        first_s, last_s: time of the first and the last measurement [s]; NaN without times.
        tracks: times and positions of each receiver on each flight, from links with a time.
        time_restarts: whether clocks restart in each flight, so that times of different flights
            cannot be compared.
    """

    first_s: float = np.nan
    last_s: float = np.nan
    tracks: Tracks = field(default_factory=dict)
    time_restarts: bool = False

    @classmethod
    def of(cls, columns: Columns) -> Flown:
        """Collect the track of each receiver and flight from those links that have a time."""
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
    """The k devices, and the receivers and flights, that links refer to by index.

    Attributes:
        device_names, receiver_names, flight_names: the names.
        device_m: (k, 3) positions of the devices [m]; NaN: unknown.
        anchors: indices of the devices whose positions are declared.
        boresight_deg: (k,) declared azimuth of each device's antenna, clockwise from north [deg];
            NaN: not declared. None sets all to NaN.
        tilt_deg: (k,) declared tilt of each device's antenna, upwards [deg]; likewise.
        declared: the devices' powers, cables, antennas and carriers.
        reads: (k,) bool, devices at which levels are read, such as gateways; None: none.
        flown: tracks of the receivers.
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
    """The map and the radio of all links.

    Attributes:
        frequency_hz: of the radio [Hz]; NaN: unknown.
        city: 3D map; None without a scene.
        is_gain: whether the level is a gain rather than a power.
    """

    frequency_hz: float
    city: CityMap | None
    is_gain: bool


class FromPart(Generic[Value]):
    """Descriptor: an attribute of a part, such as `columns` of `Links`, under the same name."""

    def __init__(self, part: str) -> None:
        self._part = part

    def __set_name__(self, owner: type, name: str) -> None:
        self._get = attrgetter(f"{self._part}.{name}")

    def __get__(self, whole: Any, owner: type) -> Value:
        return self._get(whole)


@dataclass(frozen=True, eq=False, kw_only=True)
class Links:
    """n links as arrays; made by `radiotwin.links.prepare_links` from measurements.

    Attributes of the parts are also attributes of the links: `links.level_db`, `links.device_m`.

    Attributes:
        columns: measured values of each link.
        ends: the devices, receivers and flights.
        world: the 3D map and the radio.
        notes: findings of the data checks, a sentence each.
    """

    columns: Columns
    ends: Ends
    world: World
    notes: tuple[str, ...] = ()

    level_db = FromPart[np.ndarray]("columns")
    limit_db = FromPart[np.ndarray]("columns")
    receiver_m = FromPart[np.ndarray]("columns")
    device = FromPart[np.ndarray]("columns")
    receiver = FromPart[np.ndarray]("columns")
    flight = FromPart[np.ndarray]("columns")
    time_s = FromPart[np.ndarray]("columns")
    heading_deg = FromPart[np.ndarray]("columns")
    pitch_deg = FromPart[np.ndarray | None]("columns")
    roll_deg = FromPart[np.ndarray | None]("columns")
    quality = FromPart[np.ndarray | None]("columns")
    known_los = FromPart[np.ndarray | None]("columns")
    time_in_flight_s = FromPart[np.ndarray]("columns")
    evidence = FromPart[np.ndarray | None]("columns")
    track = FromPart[np.ndarray]("columns")
    device_names = FromPart[list[str]]("ends")
    receiver_names = FromPart[list[str]]("ends")
    flight_names = FromPart[list[str]]("ends")
    device_m = FromPart[np.ndarray]("ends")
    anchors = FromPart[frozenset[int]]("ends")
    boresight_deg = FromPart[np.ndarray]("ends")
    tilt_deg = FromPart[np.ndarray]("ends")
    declared = FromPart[Declared]("ends")
    reads = FromPart[np.ndarray | None]("ends")
    first_s = FromPart[float]("ends.flown")
    last_s = FromPart[float]("ends.flown")
    tracks = FromPart[Tracks]("ends.flown")
    time_restarts = FromPart[bool]("ends.flown")
    frequency_hz = FromPart[float]("world")
    city = FromPart[CityMap | None]("world")
    is_gain = FromPart[bool]("world")

    def __len__(self) -> int:
        return len(self.level_db)

    @cached_property
    def geometry(self) -> LinkGeometry:
        """Both ends of the links, as channel models take them."""
        estimated = ~np.isin(self.device, sorted(self.anchors))
        return LinkGeometry(self.device_m[self.device], self.receiver_m, self.los, self.device,
                            self.city, self.frequency_hz, estimated)

    @cached_property
    def declared_db(self) -> np.ndarray | float:
        """Part of each level that is declared, (n,) [dB]: power, cable, antennas, carrier; or 0.

        See `Declared.added_db`.
        """
        return self.declared.added_db(self.device, self.offset_m)

    def gains(self, declared_db: np.ndarray | float | None = None
              ) -> tuple[LinkGeometry, np.ndarray, np.ndarray]:
        """Return the input of channel learning: geometry, and isotropic gains and limits (n,) [dB].

        An isotropic gain is the level without the declared part, `declared_db` (n,) [dB]: power,
        cable and antennas (None: `Links.declared_db`).
        """
        part_db = self.declared_db if declared_db is None else declared_db
        return self.geometry, self.level_db - part_db, self.limit_db - part_db

    @cached_property
    def receiver_limits_db(self) -> np.ndarray:
        """(r,) limit of detection of each receiver, median over its links [dB]; -inf: unknown."""
        limits_db = pd.Series(self.limit_db).groupby(self.receiver).median()
        return limits_db.reindex(range(len(self.receiver_names)), fill_value=-np.inf).to_numpy()

    @property
    def level_unit(self) -> str:
        """Unit of the levels, and of limits."""
        return "dB" if self.is_gain else "dBm"

    @property
    def has_gains(self) -> bool:
        """Whether channel gains are known: levels are gains, or the devices' powers are known."""
        return self.is_gain or self.declared.knows_powers

    @property
    def usual_limit_db(self) -> float | None:
        """Lower median of the receivers' known limits of detection, as levels; None: unknown."""
        known_db = self.receiver_limits_db[np.isfinite(self.receiver_limits_db)]
        return float(np.quantile(known_db, 0.5, method="lower")) if len(known_db) else None

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
        """(n,) distance between the ends [m], at least `REFERENCE_DISTANCE_M`."""
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
        """Whether each link has line of sight, (n,) bool; without a map all have."""
        if self.known_los is not None:
            return self.known_los
        if self.city is None:
            return np.ones(len(self), dtype=bool)
        return self.city.line_of_sight(self.device_m[self.device], self.receiver_m)

    @cached_property
    def receiver_axes(self) -> np.ndarray:
        """(n, 3, 3) receiver's right, nose, top [east, north, up]; NaN: no heading; no tilt: 0."""
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
        """(n,) largest knife-edge ν over roofs (ITU-R P.526-15, Eq. 26); NaN: no map or carrier."""
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
        """Return a copy with other values (n,) of some `Columns`."""
        return replace(self, columns=replace(self.columns, **columns))

    def with_receivers(self, receiver_m: np.ndarray) -> Links:
        """Return a copy with the receivers at (n, 3) [m]."""
        return self.with_columns(receiver_m=receiver_m, known_los=None)

    def with_los(self, los: np.ndarray) -> Links:
        """Return a copy with given lines of sight (n,), bool, in place of the map's."""
        return self.with_columns(known_los=los)

    def with_ends(self, **ends: Any) -> Links:
        """Return a copy with other values of some `Ends`; for positions see `with_devices`."""
        return replace(self, ends=replace(self.ends, **ends))

    def with_devices(self, device_m: np.ndarray) -> Links:
        """Return a copy with the devices at (k, 3) [m]."""
        return self.with_ends(device_m=device_m).with_columns(known_los=None)

    def of_devices(self, device: np.ndarray, device_m: np.ndarray, names: list[str],
                   anchors: frozenset[int]) -> Links:
        """Return a copy in which the links belong to other devices, such as candidate positions.

        Args:
            device: (n,) index of each link's new device, which gets the radio of the link's old
                device.
            device_m: (k, 3) positions of the new devices [m].
            names: k names.
            anchors: indices of the new devices whose positions are declared.
        """
        radio = np.full(len(names), -1)
        radio[device] = self.device
        reads = None if self.reads is None else self.reads[radio] & (radio >= 0)
        links = self.with_columns(device=device, known_los=None)
        return links.with_ends(device_m=device_m, device_names=names, anchors=anchors,
                               declared=self.declared.of_devices(radio), reads=reads)

    def with_located_devices(self, device_m: np.ndarray) -> Links:
        """Place the devices at (k, 3) [m], and drop the links of devices at NaN."""
        rows = np.isfinite(device_m).all(axis=1)[self.device]
        return self.with_devices(np.nan_to_num(device_m)).select(rows)

    def with_city(self, city: CityMap | None) -> Links:
        """Return a copy over another map; None: without one."""
        links = self.with_columns(known_los=None)
        return replace(links, world=replace(self.world, city=city))

    def with_notes(self, *notes: str) -> Links:
        """Return a copy with further notes."""
        return replace(self, notes=(*self.notes, *notes))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted levels of n links.

    Attributes:
        mean_db: (n,) mean gain [dB] or power [dBm], which may be below the limit of detection.
        sd_db: (n,) standard deviation [dB].
        detection_probability: (n,) probability that the link is detected.
        reading_db: (n,) mean level given that it is detected: above `mean_db` near the limit.
    """

    mean_db: np.ndarray
    sd_db: np.ndarray
    detection_probability: np.ndarray
    reading_db: np.ndarray

    @classmethod
    def concatenate(cls, parts: list[Prediction]) -> Prediction:
        """Join the predictions of several sets of links."""
        arrays = zip(*(vars(each).values() for each in parts))
        return cls(*map(np.concatenate, arrays))
