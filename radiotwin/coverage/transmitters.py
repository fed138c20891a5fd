"""Transmitters of a network: those that a scene declares, or a table of them."""

import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.geo import between_frames, is_same_frame, read_frame, to_local
from radiotwin.io.budgets import DEVICES
from radiotwin.io.cells import as_numbers, read_cells, refuse
from radiotwin.io.forms import name_fault
from radiotwin.links.declared import Radio, radios_of
from radiotwin.links.measurements import RADIO, read_antenna_files, refuse_limits
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna, parse_pattern

_LOCAL, _GLOBAL = ("x_m", "y_m"), ("latitude_deg", "longitude_deg")
_OPTIONAL = (*RADIO, "load")
_NAMED = 10  # transmitters in a message


@dataclass(frozen=True, eq=False)
class Transmitter:
    """A transmitting antenna of a network.

    Attributes:
        name: as in a scene or a table.
        position_m: (3,) x, y, and z above the ground datum [m]; NaN where it is not known, as of a
            radio map's devices.
        tx_power_dbm: None: not declared [dBm].
        cable_loss_db: between transmitter and antenna [dB]; None: not declared.
        antenna: None: isotropic.
        load: share of the time that it is active, 0 to 1; None: not declared.
        frequency_hz: None: that of the scene.
    """

    name: str
    position_m: np.ndarray
    tx_power_dbm: float | None = None
    antenna: Antenna | None = None
    load: float | None = None
    frequency_hz: float | None = None
    cable_loss_db: float | None = None

    @property
    def fed_dbm(self) -> float:
        """Power that reaches the antenna [dBm]."""
        return (self.tx_power_dbm or 0.0) - (self.cable_loss_db or 0.0)


def scene_transmitters(scene: Scene) -> list[Transmitter]:
    """Return the devices that a scene declares, with their antennas."""
    return [Transmitter(device.device, position_m, antenna=antenna) for device, position_m, antenna
            in zip(scene.config.devices, scene.device_m, scene.device_antennas)]


def read_transmitters(path: Path | str, scene: Scene) -> list[Transmitter]:
    """Read a table of transmitters, such as `devices.csv`.

    Columns: `device`, `x_m, y_m` or `latitude_deg, longitude_deg`, and `z_m` above the ground
    datum. Optional: `tx_power_dbm` or `eirp_dbm`, `cable_loss_db`, `load`, `frequency_hz`, and
    `antenna` (a file below the table's folder) with `azimuth_deg` and `tilt_deg` (upwards) as in
    `scene.toml`.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet`.
        scene: whose frame the positions are converted to, where a `frame.toml` beside the table
            declares theirs.

    Returns:
        The transmitters in the order of the table.

    Raises:
        BadInput: names file, row and column of the first value that cannot be used.
    """
    path = Path(path)
    table = read_cells(path, ("device", "z_m"), (*_LOCAL, *_GLOBAL, *_OPTIONAL, "antenna"))
    if table.empty:
        raise BadInput(f"{path}: has no rows; it needs one for each transmitter")
    DEVICES.check(len(table), path)
    names = table["device"].astype(str).str.strip()
    for text in names.unique():
        if fault := name_fault(text):
            refuse(path, "device", names, names == text, fault)
    refuse(path, "device", names, names.duplicated(), "occurs twice; every name must be unique")
    position_m = _positions(path, table, scene)
    columns = {name: _column(path, table, name, may_be_empty=True)
               for name in _OPTIONAL if name in table}
    if "load" in columns:
        refuse(path, "load", table["load"], (columns["load"] < 0) | (columns["load"] > 1),
               "is no load; allowed are 0 to 1")
    if "antenna" not in table and any(np.nan_to_num(columns.get(name, 0.0)).any()
                                      for name in ("azimuth_deg", "tilt_deg")):
        warnings.warn(f"{path}: azimuth_deg and tilt_deg are not used, as no column antenna names "
                      "the file of a pattern", stacklevel=3)
    files = table.get("antenna", pd.Series("", table.index)).fillna("").astype(str).str.strip()
    patterns = {name: parse_pattern(Path(name), content)
                for name, content in read_antenna_files(path, files).items()}
    load = columns.pop("load", np.full(len(table), np.nan))
    radios = radios_of(pd.DataFrame({"device": names, "antenna": files, **columns}), patterns, None)
    return [Transmitter(name, place_m, radio.tx_power_dbm, radio.antenna,
                        None if np.isnan(share) else float(share), radio.frequency_hz,
                        radio.cable_loss_db or None)
            for name, place_m, share, radio in zip(names, position_m, load,
                                                   radios or [Radio()] * len(table))]


def select(transmitters: list[Transmitter], names: list[str] | None) -> list[Transmitter]:
    """Return some transmitters, in the order of their names; None: all.

    Raises:
        BadInput: there is none of that name.
    """
    if names is None:
        return transmitters
    known = {each.name: each for each in transmitters}
    for name in names:
        if name not in known:
            raise BadInput(f"device {name!r} is not among the transmitters; there are "
                           f"{some(known, _NAMED)}")
    return [known[name] for name in dict.fromkeys(names)]


def with_defaults(transmitters: list[Transmitter], scene: Scene, tx_power_dbm: float | None,
                  load: float) -> list[Transmitter]:
    """Return the transmitters with a power, a load and a frequency each.

    Args:
        transmitters: as they are declared.
        scene: its power is used where neither they nor `tx_power_dbm` say.
        tx_power_dbm: of those that declare none [dBm].
        load: of those that declare none.

    Raises:
        BadInput: a power that nobody declared.
    """
    radio = scene.config.radio
    unknown = [each.name for each in transmitters if each.tx_power_dbm is None]
    if tx_power_dbm is not None and not unknown:
        warnings.warn(f"the transmit power of {tx_power_dbm:g} dBm for transmitters that declare "
                      "none is not used: all of them declare theirs", stacklevel=4)
    if tx_power_dbm is None and radio.declares_power:
        tx_power_dbm = radio.tx_power_dbm
    if unknown and tx_power_dbm is None:
        raise BadInput(
            f"the transmit power of {some(unknown, _NAMED)} is not known: "
            f"{scene.folder / 'scene.toml'} has the default tx_power_dbm = "
            f"{radio.tx_power_dbm:g}; give --tx-power-dbm, or a table --transmitters with the "
            "column tx_power_dbm")
    return [replace(each, tx_power_dbm=tx_power_dbm if each.tx_power_dbm is None
                    else each.tx_power_dbm, load=load if each.load is None else each.load,
                    frequency_hz=each.frequency_hz or radio.frequency_hz)
            for each in transmitters]


def _positions(path: Path, table: pd.DataFrame, scene: Scene) -> np.ndarray:
    """Return positions (n, 3) in the scene's frame [m]."""
    z_m = _column(path, table, "z_m")
    if all(name in table for name in _LOCAL):
        x_m, y_m = (_column(path, table, name) for name in _LOCAL)
        position_m = np.column_stack([x_m, y_m, z_m])
        origin, own = scene.config.origin, read_frame(path.parent)
        if origin is not None and own is not None and not is_same_frame(own, origin):
            position_m = between_frames(position_m, own, origin)
        return position_m
    if not all(name in table for name in _GLOBAL):
        raise BadInput(f"{path}: needs the columns {', '.join(_LOCAL)} or {', '.join(_GLOBAL)}")
    if scene.config.origin is None:
        raise BadInput(f"{path}: latitude and longitude need the scene's position, and "
                       f"{scene.folder / 'scene.toml'} has no [origin]; give x_m and y_m, or add "
                       "it")
    latitude, longitude = (_column(path, table, name) for name in _GLOBAL)
    for name, value, limit in zip(_GLOBAL, (latitude, longitude), (90, 180)):
        refuse(path, name, table[name], np.abs(value) > limit, f"is not within {limit} degrees")
    return np.column_stack([*to_local(scene.config.origin, longitude, latitude), z_m])


def _column(path: Path, table: pd.DataFrame, name: str, may_be_empty: bool = False) -> np.ndarray:
    """Return the numbers (n,) of a column, NaN where it is empty."""
    text = table[name].fillna("").astype(str).str.strip()
    numbers = as_numbers(text)
    refuse(path, name, text, ~np.isfinite(numbers) & ((text != "") | (not may_be_empty)),
           "is not a finite number")
    refuse_limits(partial(refuse, path, name, text), name, numbers)
    return numbers

