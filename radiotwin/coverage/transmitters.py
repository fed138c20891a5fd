"""Transmitters of a network, from a scene's devices or from a table."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.geo import read_frame
from radiotwin.importing.read_source import Expected, read_source
from radiotwin.links.declared import Radio, radios_of
from radiotwin.links.measurements import RADIO, read_antenna_files
from radiotwin.links.plausible import far_notes, high_notes
from radiotwin.links.site_table import SiteTable, is_site_table, read_site_table
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna, parse_pattern

_OPTIONAL = (*RADIO, "load")
_NAMED = 10  # at most so many names in a message


@dataclass(frozen=True, eq=False)
class Transmitter:
    """A transmitting antenna of a network.

    Attributes:
        name: in the scene or the table.
        position_m: (3,) x, y, and z above the ground datum [m]; NaN if unknown, such as that of a
            radio map's device.
        tx_power_dbm: transmit power [dBm]; None: not declared.
        cable_loss_db: loss between transmitter and antenna [dB]; None: not declared.
        antenna: None: isotropic.
        load: share of the time that the transmitter is active, 0 to 1; None: not declared.
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
        """Power at the antenna's port [dBm]: transmit power minus cable loss; undeclared: 0."""
        return (self.tx_power_dbm or 0.0) - (self.cable_loss_db or 0.0)


def scene_transmitters(scene: Scene) -> list[Transmitter]:
    """Return the devices of a scene as transmitters, with their antennas."""
    return [Transmitter(device.device, position_m, antenna=antenna) for device, position_m, antenna
            in zip(scene.config.devices, scene.device_m, scene.device_antennas)]


def read_transmitters(path: Path | str, scene: Scene) -> list[Transmitter]:
    """Read a table of transmitters, such as `devices.csv`.

    A column's name is a quantity and its unit, see `radiotwin.links.site_table`. A position with a
    height above datum, ground or sea is required. Power, EIRP, cable loss, load, frequency, and
    `antenna` (a pattern file below the table's folder) with azimuth and tilt (upwards) are
    optional.

    Args:
        path: table in any format that `import` reads.
        scene: positions are converted to its frame, if a `frame.toml` beside the table declares
            another one.

    Returns:
        The transmitters in the order of the table.

    Warns:
        A column is not used, or a position is implausible.

    Raises:
        BadInput: names file, row and column of the first value that cannot be used.
    """
    path = Path(path)
    source = read_source(path, expected=Expected(is_wanted=is_site_table))
    sites = read_site_table(path, source.table, source.where, "device", (*_OPTIONAL, "antenna"))
    names, values = sites.names, sites.values
    sites.refuse("device", names.duplicated(), "occurs twice; every name must be unique")
    position_m, notes = _positions(path, sites, scene)
    columns = {name: values[name].to_numpy() for name in _OPTIONAL if name in values}
    load = columns.pop("load", np.full(len(names), np.nan))
    if "load" in values:
        sites.refuse("load", (load < 0) | (load > 1), "is no load; allowed are 0 to 1; "
                     "call a column of percents load_percent")
    if "antenna" not in values and any(np.nan_to_num(columns.get(name, 0.0)).any()
                                       for name in ("azimuth_deg", "tilt_deg")):
        notes.append(f"{path}: azimuth and tilt are not used, as no column antenna names the file "
                     "of a pattern")
    for note in (*source.notes, *sites.notes, *notes):
        warnings.warn(note, stacklevel=2)
    files = values.get("antenna", pd.Series("", names.index))
    patterns = {name: parse_pattern(Path(name), content)
                for name, content in read_antenna_files(path, files).items()}
    radios = radios_of(pd.DataFrame({"device": names, "antenna": files, **columns}), patterns, None)
    return [Transmitter(name, place_m, radio.tx_power_dbm, radio.antenna,
                        None if np.isnan(share) else float(share), radio.frequency_hz,
                        radio.cable_loss_db or None)
            for name, place_m, share, radio in zip(names, position_m, load,
                                                   radios or [Radio()] * len(names))]


def select(transmitters: list[Transmitter], names: list[str] | None) -> list[Transmitter]:
    """Return the transmitters of given names, each once, in the order of the names; None: all.

    Raises:
        BadInput: there is no transmitter of a name.
    """
    if names is None:
        return transmitters
    known = {each.name: each for each in transmitters}
    for name in names:
        if name not in known:
            raise BadInput(f"device {name!r} is not among the transmitters; there are "
                           f"{some(known, _NAMED)}")
    return [known[name] for name in dict.fromkeys(names)]


def with_powers(transmitters: list[Transmitter], scene: Scene,
                tx_power_dbm: float | None) -> list[Transmitter]:
    """Return transmitters with a power where they declare none: the given [dBm], else the scene's.

    BadInput if neither declares one.
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
    return [replace(each, tx_power_dbm=tx_power_dbm) if each.tx_power_dbm is None else each
            for each in transmitters]


def _positions(path: Path, sites: SiteTable, scene: Scene) -> tuple[np.ndarray, list[str]]:
    """Return positions (k, 3) in the scene's frame [m], and notes on implausible ones."""
    names, values = sites.names, sites.values

    def named(row: int) -> str:
        return f"{path}: {sites.where(names.index[row])}: transmitter {names.iloc[row]!r}"

    place = "latitude, longitude" if "latitude" in values else "x, y"
    empty = values[place.split(", ")].isna().any(axis=1)
    sites.refuse_rows(empty, lambda row: (
        f"transmitter {names.iloc[row]!r} has no {place}; fill them in, or leave the row out"))
    above_m = values.get("above_ground_m", pd.Series(np.nan, names.index)).to_numpy()
    position_m = sites.local_m(scene.config.origin, read_frame(path.parent), "the scene")
    if "latitude" in values and scene.config.origin is not None:
        middle = np.array([scene.config.origin.latitude_deg, scene.config.origin.longitude_deg])
        notes = far_notes(values[["latitude", "longitude"]].to_numpy(), middle,
                          ("latitude", "longitude"), named, "the map")
    else:
        west, east, south, north = scene.config.extent.bounds
        notes = far_notes(position_m[:, :2], np.array([west + east, south + north]) / 2,
                          ("x", "y"), named, "the map")
    on_ground = np.isfinite(above_m)
    position_m[on_ground, 2] = above_m[on_ground] + scene.city.ground_height_m(
        *position_m[on_ground, :2].T)
    sites.refuse_rows(np.isnan(position_m[:, 2]), lambda row: (
        f"transmitter {names.iloc[row]!r} has no height; give it in a column z_m (above the "
        "datum), above_ground_m or altitude_m (above the sea)"))
    if not on_ground.any():
        notes += high_notes(position_m[:, 2] - scene.city.ground_height_m(*position_m[:, :2].T))
    return position_m, notes
