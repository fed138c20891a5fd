"""The mission as arrays: SNR maps, batteries, data to collect, known positions."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import MAP_VALUES
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import HOVER_COST, LOS_LAW, MOVE_COST, UNREACHABLE, FlightGrid
from radiotwin.scene import Scene
from radiotwin.scene.config import UavConfig

HOVER, NORTH, WEST, SOUTH, EAST, NO_OP = range(6)
MOVES = np.array([(0, 0), (1, 0), (0, -1), (-1, 0), (0, 1), (0, 0)], dtype=np.int64)
"""(row, column) of each action."""
COSTS = np.array([1, *[round(MOVE_COST / HOVER_COST)] * 4, 0], dtype=np.int64)
"""Battery cost of each action, in whole hovers, so that the battery is counted exactly."""
MAX_HOVERS = 20_000  # largest battery, which is stored in 16 bits [hovers]
# Plausible limits; larger values would overflow in single precision.
MAX_SNR_DB, MAX_GAIN_DB, MAX_SIGMA_DB = 1e4, 1e3, 100.0
MAX_UNITS, MAX_SLOT_S = 1e9, 1e6


class Mission(NamedTuple):
    """Inputs of a flight: U UAVs, K devices, a lattice of ny x nx cells at L levels.

    It is a tuple of arrays, so that compiled functions accept it.

    Attributes:
        snr_db: (L, K, ny, nx) float32 mean SNR [dB]; -inf = never received.
        sigma_db: (L, K, ny, nx) float32 standard deviation of the shadowing [dB].
        steps_home: (U, ny, nx) int64 moves to the UAV's terminal; `UNREACHABLE` without a way.
        start: (U, 2) int64 start cell (row, column) of each UAV.
        battery: (U,) int64 battery at take-off [hovers = half battery units].
        level: (U,) int64 level of the maps at which each UAV flies.
        altitude_m: (U,) altitude of each UAV [m].
        data_units: (K,) float64 data at each device.
        known_m: (K, 2) float64 horizontal positions of the devices as known to the UAVs, relative
            to the lattice's south-west corner [m]; NaN if unknown. They enter observations only.
        step_m: lattice step [m].
        rate_scale: data units per slot and bit/s/Hz.
        threshold_db: least SNR of a usable link [dB].
        detection_db: SNR below which a receiver does not detect anything [dB].
        uav_link_db: (2,) SNR between two UAVs at 1 m [dB], and its slope per decade of distance
            (the LoS law).
        max_rate: whether a UAV that loses its best device idles (the paper's Eq. 8); otherwise it
            gets the strongest remaining device.
        shadowing_share: share of the shadowing's variance that lasts for a flight; the rest is
            drawn in every slot.
        shadowing_m: distance at which the correlation of the lasting part is 1/e [m].
    """

    snr_db: np.ndarray
    sigma_db: np.ndarray
    steps_home: np.ndarray
    start: np.ndarray
    battery: np.ndarray
    level: np.ndarray
    altitude_m: np.ndarray
    data_units: np.ndarray
    known_m: np.ndarray
    step_m: float
    rate_scale: float
    threshold_db: float
    detection_db: float
    uav_link_db: np.ndarray
    max_rate: bool
    shadowing_share: float = 0.0
    shadowing_m: float = 50.0

    @property
    def uavs(self) -> int:
        """Number of UAVs."""
        return len(self.start)

    @property
    def devices(self) -> int:
        """Number of devices."""
        return len(self.data_units)

    @property
    def longest(self) -> int:
        """Slots of the longest possible flight: hovering until the largest battery is empty."""
        return int(self.battery.max())


@dataclass(frozen=True)
class Known:
    """Device positions that the UAVs know.

    Attributes:
        position_m: (x, y) by device [m]; devices without a known position are missing.
    """

    position_m: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, devices: Iterable[Any]) -> "Known":
        """Return the finite positions of a twin's or a scene's devices."""
        return cls({d.device: (d.x_m, d.y_m) for d in devices
                    if np.isfinite([d.x_m, d.y_m]).all()})

    @classmethod
    def truth(cls, scene: Scene) -> "Known":
        """Return the true positions of all devices, which a real UAV does not know."""
        return cls.of(scene.config.devices)

    @classmethod
    def anchors(cls, scene: Scene) -> "Known":
        """Return the positions of the anchors, which are known before the first flight."""
        return cls.of(d for d in scene.config.devices if d.role == "anchor")


def levels_of(scene: Scene) -> np.ndarray:
    """Return the lattice level (U,) nearest to each UAV's altitude."""
    return np.array([int(np.abs(scene.lattice.z_m - uav.altitude_m).argmin())
                     for uav in scene.config.uavs])


def snr_offset_db(scene: Scene, radio_map: RadioMap) -> np.ndarray:
    """Return the SNR minus the gain of each device (K,) of a scene [dB]: transmit power - noise.

    The transmit power is the map's, or else the scene's.
    """
    radio, powers_dbm = scene.config.radio, radio_map.tx_power_dbm
    return np.array([powers_dbm.get(device.device, radio.tx_power_dbm)
                     for device in scene.config.devices]) - radio.noise_dbm


def make_mission(scene: Scene, radio_map: RadioMap, known: Known, assignment: str = "matching",
                 keep_out: np.ndarray | None = None) -> Mission:
    """Combine a scene and a radio map (the truth's, or a twin's) into a mission.

    Args:
        scene: scene with UAVs, radio, batteries, data and buildings.
        radio_map: map over the scene's lattice. Devices that it lacks, and positions where its
            gain is NaN, are never received; a `sigma_db` of NaN counts as 0. Its
            `sigma_db`, if any, is the standard deviation of shadowing; with the attributes
            `shadowing_share` and `shadowing_length_m` (`radiotwin.twin.shadowing`) a part of it
            lasts for a flight.
        known: device positions that agents observe.
        assignment: `matching` or `max-rate`.
        keep_out: (nz, ny, nx) bool, closed positions besides the insides of buildings; None: none.

    Raises:
        BadInput: no UAV, no device, a map of another lattice or with impossible attributes, or a
            battery that does not reach the terminal.
    """
    _check(scene, radio_map, assignment)
    config, lattice = scene.config, scene.lattice
    levels, offset_db = levels_of(scene), snr_offset_db(scene, radio_map)
    used, level = np.unique(levels, return_inverse=True)
    to_snr_db = config.radio.tx_power_dbm - config.radio.noise_dbm
    keep_out = scene.blocked if keep_out is None else keep_out | scene.blocked
    shape = (len(used), len(config.devices), *lattice.shape[1:])
    MAP_VALUES.check(math.prod(shape), f"{scene.folder / 'scene.toml'}: the mission's map")
    snr_db, sigma_db = np.full(shape, -np.inf, np.float32), np.zeros(shape, np.float32)
    for k, device in enumerate(config.devices):
        if device.device not in radio_map.devices:
            continue
        row = radio_map.devices.index(device.device)
        gain_db = radio_map.gain_db[row, used]
        _check_values(device.device, "gain_db", gain_db, -MAX_GAIN_DB, MAX_GAIN_DB)
        snr_db[:, k] = np.where(np.isnan(gain_db), -np.inf, gain_db + offset_db[k])
        if "sigma_db" in radio_map.dataset:
            device_sigma_db = radio_map.dataset["sigma_db"].values[row, used]
            _check_values(device.device, "sigma_db", device_sigma_db, 0.0, MAX_SIGMA_DB)
            sigma_db[:, k] = np.nan_to_num(device_sigma_db)
    starts, homes = zip(*(_ends(scene, uav, ~keep_out[at])
                          for uav, at in zip(config.uavs, levels)))
    origin_m = np.array([lattice.x_m[0], lattice.y_m[0]])
    known_m = np.array([known.position_m.get(d.device, (np.nan, np.nan)) for d in config.devices])
    return Mission(
        snr_db, sigma_db, steps_home=np.array(homes), start=np.array(starts),
        battery=np.array([int(uav.battery / HOVER_COST + 1e-9) for uav in config.uavs]),
        level=level.astype(np.int64),
        altitude_m=np.array([uav.altitude_m for uav in config.uavs], dtype=float),
        data_units=np.array([config.mission.data_units if device.data_units is None
                             else device.data_units for device in config.devices], dtype=float),
        known_m=known_m - origin_m, step_m=lattice.step_m,
        rate_scale=float(config.mission.rate_scale),
        threshold_db=float(config.radio.snr_threshold_db),
        detection_db=float(config.gain_limit_db + to_snr_db),
        uav_link_db=np.array([to_snr_db + LOS_LAW.intercept_db, -10 * LOS_LAW.exponent]),
        max_rate=assignment == "max-rate",
        shadowing_share=float(radio_map.dataset.attrs.get("shadowing_share", 0.0)),
        shadowing_m=float(radio_map.dataset.attrs.get("shadowing_length_m", 50.0)))


def _check(scene: Scene, radio_map: RadioMap, assignment: str) -> None:
    """Refuse scenes and maps of which no mission can be made, BadInput."""
    config, lattice, path = scene.config, scene.lattice, scene.folder / "scene.toml"
    if assignment not in ("matching", "max-rate"):
        raise BadInput(f"assignment {assignment!r} is unknown; allowed are matching, max-rate")
    if not config.uavs or not config.devices:
        raise BadInput(
            f"{path}: a mission needs at least one UAV and one device, here are "
            f"{len(config.uavs)} and {len(config.devices)}; add [[uavs]] or [[devices]] tables")
    if radio_map.gain_db.shape[1:] != lattice.shape or \
            not np.allclose(radio_map.lattice.positions_m, lattice.positions_m):
        raise BadInput(f"the radio map's lattice {radio_map.gain_db.shape[1:]} (z, y, x) is not "
                       f"that of {path} {lattice.shape}; make the map for this scene")
    for uav in config.uavs:
        if not 1 <= uav.battery / HOVER_COST <= MAX_HOVERS:
            raise BadInput(f"{path}: uav {uav.uav!r}: battery = {uav.battery:g}; a mission allows "
                           f"{HOVER_COST:g} to {MAX_HOVERS * HOVER_COST:g}")
    mission = config.mission
    given = [(f"mission.{name}", getattr(mission, name), high) for name, high in (
        ("data_units", MAX_UNITS), ("rate_scale", MAX_UNITS), ("slot_s", MAX_SLOT_S))]
    given += [(f"device {each.device}: data_units", each.data_units, MAX_UNITS)
              for each in config.devices if each.data_units is not None]
    for name, value, high in given:
        if not 1e-6 <= value <= high:
            raise BadInput(f"{path}: {name} = {value:g}; a mission allows 1e-06 to {high:g}")
    attributes = radio_map.dataset.attrs
    share, length_m = (attributes.get(name, 1.0)
                       for name in ("shadowing_share", "shadowing_length_m"))
    if not (all(isinstance(each, int | float | np.number) for each in (share, length_m))
            and 0 <= share <= 1 and 0 < length_m < np.inf):
        raise BadInput(f"the radio map's attributes shadowing_share = {share}, shadowing_length_m "
                       f"= {length_m}: allowed are a share from 0 to 1 and a length above 0; make "
                       "the map again")


def _check_values(device: str, name: str, values: np.ndarray, low: float, high: float) -> None:
    """Refuse values of a device's map outside plausible limits; NaN is allowed."""
    wrong = values[~(np.isnan(values) | ((values >= low) & (values <= high)))]
    if len(wrong):
        raise BadInput(f"the radio map's {name} of {device} is {wrong[0]:g} somewhere; allowed are "
                       f"{low:g} to {high:g} dB; make the map again")


def _ends(scene: Scene, uav: UavConfig, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a UAV's start cell (2,), and the moves home (ny, nx) over allowed cells (ny, nx)."""
    lattice = scene.lattice
    start, terminal = ((round((y_m - lattice.y_m[0]) / lattice.step_m),
                        round((x_m - lattice.x_m[0]) / lattice.step_m))
                       for x_m, y_m in ((uav.start_x_m, uav.start_y_m),
                                        (uav.terminal_x_m, uav.terminal_y_m)))
    home = FlightGrid(allowed, terminal).steps_to(terminal)
    needed = home[start] * MOVE_COST
    if needed > uav.battery:
        moves = "there is no way" if home[start] == UNREACHABLE else f"{needed:g} are needed"
        raise BadInput(f"uav {uav.uav!r}: battery = {uav.battery:g} does not reach from its start "
                       f"to its terminal ({moves}); raise it in {scene.folder / 'scene.toml'}")
    return np.array(start), home
