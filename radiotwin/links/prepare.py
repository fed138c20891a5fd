"""Join measurements with devices, 3D map and radio; check them and leave out unusable links."""

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.io.texts import percent
from radiotwin.links.checks import (
    COPIED,
    MIN_LINKS,
    ceiling_notes,
    check_names,
    check_positions,
    copied_rows,
    find_fill_value,
    receiver_notes,
    refuse_empty_levels,
    require_on_map,
    require_one_frame,
    unheard_devices,
    uninformative_receivers,
    unmapped_ends,
)
from radiotwin.links.correlation import devices_move
from radiotwin.links.declared import Declared, Radio, antenna_of_uavs, complete, radios_of
from radiotwin.links.limits import estimate_limits
from radiotwin.links.links import RESTART_NOTE, Columns, Ends, Flown, Links, World
from radiotwin.links.measurements import Measurements
from radiotwin.links.plausible import FAR_M, READS, high_notes
from radiotwin.links.sites import end_notes
from radiotwin.scene import Scene

MAX_FREQUENCY_OFF = 0.1  # relative; the level changes by less than 1 dB
ASSUMED_HEIGHT_M = 1.5  # of an end without a height: a hand-held phone


def join_links(measurements: Measurements, scene: Scene) -> Links:
    """Join all measurements with a scene (map, radio, antennas), without leaving out any.

    The links have estimated limits of detection; x and y of unknown devices are NaN.

    Raises:
        BadInput: measurements and scene are in different frames, or most receivers off the map.
    """
    require_one_frame(measurements, scene)
    device_m = measurements.device_m.copy()
    device_m[~measurements.is_anchor, :2] = np.nan
    receiver_m = measurements.receiver_m
    outside = require_on_map(receiver_m, scene)
    notes = [*measurements.notes, *receiver_notes(receiver_m, scene)]
    if outside.any():
        notes.append(f"{outside.sum():,} of {len(outside):,} links have their receiver outside the "
                     "3D map")
    return _join(measurements, scene, measurements.level_db, receiver_m, device_m,
                 np.ones(len(device_m), dtype=bool), notes)


def prepare_links(measurements: Measurements, scene: Scene | None,
                  to_locate: bool = False) -> Links:
    """Join measurements with a scene, and leave out unusable links, with notes.

    Args:
        measurements: links.
        scene: gives 3D map and radio; None: no map, and every link has line of sight.
        to_locate: prepare for locating devices, not for learning. Then devices of unknown position,
            few links, and receivers that detected nothing are kept, as they tell where a device can
            be.

    Returns:
        the usable links, with `notes` on what was left out or odd. Levels at a fill value become
        NaN, and empty heights `ASSUMED_HEIGHT_M` above ground (receivers' only without a scene).

    Raises:
        BadInput: too few links are usable, positions or levels are implausible, or measurements and
            scene are in different frames.
    """
    table = measurements.table.reset_index(drop=True)
    level_db, receiver_m = measurements.level_db, measurements.receiver_m
    device_index = measurements.device_index
    require_one_frame(measurements, scene)
    refuse_empty_levels(level_db, measurements.level_column)
    notes = list(measurements.notes)
    keep = np.ones(len(table), dtype=bool)

    def leave_out(bad: np.ndarray, why: str) -> None:
        bad = np.asarray(bad) & keep
        if bad.any():
            notes.append(f"{bad.sum():,} of {len(table):,} links left out: {why}")
            keep[bad] = False

    declared_z_m = measurements.device_m[:, 2]
    device_m = np.where(measurements.is_anchor[:, None], measurements.device_m, np.nan)
    device_m[:, 2] = np.where(np.isnan(declared_z_m), ASSUMED_HEIGHT_M, declared_z_m)
    if scene is not None and scene.city.terrain is not None:
        no_height = np.flatnonzero(np.isnan(declared_z_m))
        device_m[no_height, 2] += _ground_m(scene, device_m[no_height], receiver_m)
    notes += check_names(measurements)
    notes += [note for note in high_notes(_clearance_m(declared_z_m, device_m, receiver_m, scene))
              if not any(told.endswith(note) for told in notes)]
    notes += check_positions(receiver_m, device_m, scene)
    from_middle_m = np.abs(receiver_m[:, :2] - np.median(receiver_m[:, :2], axis=0)).max(axis=1)
    leave_out(from_middle_m > FAR_M,
              f"their receiver is more than {FAR_M / 1000:.0f} km from the others")
    from_device_m = np.abs(receiver_m[:, :2] - device_m[device_index, :2]).max(axis=1)
    leave_out(from_device_m > FAR_M, f"their receiver is more than {FAR_M / 1000:.0f}"
              " km from the device; both need one frame, in metres")
    leave_out(copied_rows(table), COPIED)
    no_z = np.isnan(receiver_m[:, 2])
    if no_z.any() and scene is not None:
        leave_out(no_z, "their receiver's height is empty, and the 3D map needs it: fill in "
                  "receiver_z_m, or import the file again with above_ground=always 1.5")
    elif no_z.any():
        notes.append(f"heights of receivers are empty in {no_z.sum():,} rows, and taken for "
                     f"{ASSUMED_HEIGHT_M} m")
        receiver_m = np.where(np.isnan(receiver_m), ASSUMED_HEIGHT_M, receiver_m)
    if scene is not None and not to_locate:
        leave_out(unmapped_ends(receiver_m, device_m[device_index], scene),
                  "they end below the roofs and off the 3D map, where it is not known what is in "
                  "the way; a scene built with a wider --bbox would keep them")
    unset = np.isnan(declared_z_m).sum()
    if unset:
        notes.append(f"heights of devices are empty in {unset:,} rows, and taken for "
                     f"{ASSUMED_HEIGHT_M} m above the ground")
    placed = np.asarray(np.isfinite(device_m).all(axis=1) | (scene is not None) | to_locate)
    leave_out(~placed[device_index],
              "without a scene, devices of unknown position cannot be located")
    for bad, why in [] if to_locate else uninformative_receivers(table, level_db, keep):
        leave_out(bad, why)
    fill_db, share = find_fill_value(level_db[keep])
    if fill_db is not None:
        at_fill = (level_db == fill_db) & keep
        level_db = np.where(at_fill, np.nan, level_db)
        notes.append(f"{at_fill.sum():,} links read exactly {fill_db:g}, the lowest value, "
                     f"{percent(share)} of all: taken for not detected")
    leave_out(*unheard_devices(table, level_db, keep))
    min_links, detected = 1 if to_locate else MIN_LINKS, int(np.isfinite(level_db[keep]).sum())
    if keep.sum() < min_links or detected < min_links // 2:
        raise BadInput(f"{int(keep.sum())} links can be used, {detected} of them detected; "
                       f"at least {min_links} are needed"
                       + f", {min_links // 2} of them detected" * (min_links > 1)
                       + ": " + ("; ".join(notes) or "measure more"))
    refuse_empty_levels(level_db[keep], measurements.level_column)
    links = _join(measurements.select(keep), scene, level_db[keep], receiver_m[keep],
                  device_m[placed], placed, notes)
    links = links if to_locate or devices_move(links) else links.with_notes(*end_notes(links))
    return links.with_notes(RESTART_NOTE) if links.time_restarts else links


def _clearance_m(declared_z_m: np.ndarray, device_m: np.ndarray, receiver_m: np.ndarray,
                 scene: Scene | None) -> np.ndarray:
    """Return the heights (k,) [m] of devices above the ground; NaN if not declared.

    Without a map, they are above the lowest receiver or z = 0, whichever is higher.
    """
    if scene is not None:
        return declared_z_m - _ground_m(scene, device_m, receiver_m)
    known_m = receiver_m[np.isfinite(receiver_m[:, 2]), 2]
    return declared_z_m - max(float(known_m.min(initial=np.inf)), 0.0) if len(known_m) \
        else np.full(len(device_m), np.nan)


def _ground_m(scene: Scene, device_m: np.ndarray, receiver_m: np.ndarray) -> np.ndarray:
    """Return the ground height (k,) [m] below devices; where unknown, the receivers' median."""
    city, unknown = scene.city, np.isnan(device_m[:, 0])
    below_m = np.zeros(len(device_m))
    below_m[~unknown] = city.ground_height_m(*device_m[~unknown, :2].T)
    over_m = receiver_m[np.isfinite(receiver_m[:, :2]).all(axis=1), :2]
    if unknown.any() and len(over_m):
        below_m[unknown] = np.median(city.ground_height_m(*over_m.T))
    return below_m


def _join(measurements: Measurements, scene: Scene | None, level_db: np.ndarray,
          receiver_m: np.ndarray, device_m: np.ndarray, kept: np.ndarray, notes: list[str]
          ) -> Links:
    """Make the links of n measurements, with radios and limits of detection.

    Levels (n,), receivers (n, 3) and devices (k, 3) are corrected ones; `kept` is the mask of
    usable devices among all. Notes are added to `notes` in place.
    """
    table, devices = measurements.table, measurements.devices[kept]
    receiver, receiver_names = pd.factorize(table["receiver"], sort=True)
    flight, flight_names = pd.factorize(table["flight"])
    heading_deg = _column(table, "heading_deg")
    turned = np.abs(heading_deg) > 360
    if turned.any():
        notes.append(f"{turned.sum():,} headings lie beyond 360° (such as "
                     f"{heading_deg[turned][0]:g}) and are taken for their remainder; heading_deg "
                     "is in degrees, clockwise from north")
    notes += ceiling_notes(receiver, receiver_names, level_db)
    is_gain = measurements.level_column == "gain_db"
    frequency_hz = _frequency_hz(measurements, scene)
    notes += _other_frequencies(_column(devices, "frequency_hz"), frequency_hz)
    radios, assumed = complete(list(devices["device"]), radios_of(
        devices, measurements.patterns, scene), not is_gain, scene)
    receiver_antenna, unused = antenna_of_uavs(scene, list(receiver_names))
    notes += [*assumed, *unused]
    if receiver_antenna is not None and not radios:
        radios = (Radio(),) * len(devices)
    columns = Columns(
        level_db=level_db, limit_db=np.full(len(level_db), -np.inf), receiver_m=receiver_m,
        device=(np.cumsum(kept) - 1)[measurements.device_index], receiver=receiver, flight=flight,
        time_s=_column(table, "time_s"), heading_deg=heading_deg % 360,
        pitch_deg=_column(table, "pitch_deg"), roll_deg=_column(table, "roll_deg"),
        quality=_column(table, "quality"))
    # A device with a declared pattern needs no estimated sector about its azimuth.
    of_sector = np.array([radio.antenna is None for radio in radios]) if radios else True
    ends = Ends(
        device_names=list(devices["device"]), receiver_names=list(receiver_names),
        flight_names=list(flight_names), device_m=device_m,
        anchors=frozenset(np.flatnonzero(measurements.is_anchor[kept]).tolist()),
        boresight_deg=np.where(of_sector, _column(devices, "azimuth_deg"), np.nan),
        tilt_deg=np.where(of_sector, _column(devices, "tilt_deg"), np.nan),
        declared=Declared(radios, frequency_hz, not is_gain, receiver_antenna),
        reads=(_column(devices, READS) == 1) if READS in devices else None,
        flown=Flown.of(columns))
    city = scene.city if scene is not None else None
    links = Links(columns=columns, ends=ends, notes=tuple(notes),
                  world=World(frequency_hz=frequency_hz, city=city, is_gain=is_gain))
    declared_db = None
    if scene is not None:
        declared_db = scene.config.gain_limit_db if is_gain else scene.config.radio.sensitivity_dbm
    limit_db, more = estimate_limits(links, declared_db)
    return links.with_columns(limit_db=limit_db).with_notes(*more)


def _frequency_hz(measurements: Measurements, scene: Scene | None) -> float:
    """Return the frequency of the scene, else the median of the devices, else NaN [Hz]."""
    if scene is not None:
        return scene.config.radio.frequency_hz
    if "frequency_hz" in measurements.devices:
        return float(measurements.devices["frequency_hz"].median())
    return float("nan")


def _other_frequencies(declared_hz: np.ndarray, frequency_hz: float) -> list[str]:
    """Note that devices (k,) declare another frequency than that of the predictions."""
    other = np.abs(declared_hz / frequency_hz - 1) > MAX_FREQUENCY_OFF
    if not other.any():
        return []
    known_ghz = np.unique(declared_hz[np.isfinite(declared_hz)]) / 1e9
    span = " to ".join(f"{each:g}" for each in known_ghz[[0, -1]][:len(known_ghz)])
    return [f"devices work at {span} GHz, and all are computed at {frequency_hz / 1e9:g} GHz: "
            "levels are moved by 20 lg f, as in free space, and losses of walls, edges and trees "
            "are those of that frequency; give measurements of one band at a time, with a scene of "
            "its frequency_hz"]


def _column(table: pd.DataFrame, name: str) -> np.ndarray:
    """Return a column as numbers (n,); NaN if the table lacks it."""
    return table[name].to_numpy(dtype=float) if name in table else np.full(len(table), np.nan)
