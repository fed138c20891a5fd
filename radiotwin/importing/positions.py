"""Positions of receivers and devices: from the file's own columns, then from tables."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.frame import Frame, find_frame, to_geographic
from radiotwin.importing.places import at_times, place_names
from radiotwin.importing.position_table import read_positions
from radiotwin.importing.settings import ABOVE_GROUND, HEIGHTS, POSITION, Settings
from radiotwin.importing.source import Source
from radiotwin.importing.tally import Tally
from radiotwin.measurement_columns import MAX_COORDINATE_M
from radiotwin.measurements import DEVICE_OPTIONAL

MOVING_M = 1.0  # a device whose positions differ by more than this is not at rest


@dataclass(frozen=True)
class PositionedLinks:
    """Links whose receivers have positions.

    Attributes:
        links: with `receiver_x_m, receiver_y_m, receiver_z_m`, and `receiver_above_ground_m` where
            heights are above the ground.
        devices: as in `devices.csv`: those of the links, in the order of their first ones.
        device_m: position of each link's device [m], (n, 3); NaN where unknown.
        frame: of all positions.
    """

    links: pd.DataFrame
    devices: pd.DataFrame
    device_m: np.ndarray
    frame: Frame

    def select(self, keep: np.ndarray, source: Source | None = None, tally: Tally | None = None,
               reason: str = "") -> "PositionedLinks":
        """Return some links with their devices.

        Args:
            keep: (n,) bool.
            source: the file, for the place of the first link that is left out.
            tally: counts the others, if there is one.
            reason: why they are left out.
        """
        links = self.links
        if tally is not None and source is not None:
            links = tally.drop(links, ~keep, reason, "", source.where)
        else:
            links = links[keep]
        devices = self.devices[self.devices["device"].isin(links["device"])]
        return PositionedLinks(links, devices.reset_index(drop=True), self.device_m[keep],
                               self.frame)


def add_positions(source: Source, links: pd.DataFrame, settings: Settings,
                  tally: Tally) -> PositionedLinks:
    """Find the positions of receivers and devices in one local frame.

    Args:
        source: the file, for messages.
        links: as of `build_links`.
        settings: tables, crs and origin.
        tally: counts the links whose receiver has no position.

    Raises:
        BadInput: a table that cannot be used, a position far from the origin, or a moving device.
    """
    tables = {name: None if path is None else read_positions(path, name, settings)
              for name, path in (("receiver", settings.receivers), ("device", settings.devices))}
    links = at_times(source, links, tables["device"])
    receivers = _positions(links, "", tables["receiver"], links["receiver"], settings.crs)
    devices = _positions(links, "device_", tables["device"], links["device"], settings.crs)
    frame = find_frame(settings.origin, receivers, devices)
    receiver_m, device_m = frame.local_m(receivers), frame.local_m(devices)
    del receivers, devices  # as much memory as the links themselves
    if settings.place_m:
        links = links.assign(device=place_names(source, links, device_m, settings.place_m))
    _check_near(source, links, receiver_m, "receiver")
    _check_near(source, links, device_m, "device")
    links = links.assign(**{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")})
    above_m = _above_ground_m(links, "", tables["receiver"], links["receiver"], receiver_m[:, 2])
    if np.isfinite(above_m).any():
        links = links.assign(receiver_above_ground_m=above_m)
    unknown = np.isnan(receiver_m[:, :2]).any(axis=1)
    names = links["receiver"][unknown]
    for name, rows in names.groupby(names, sort=False):
        tally.count(f"no position of receiver {name}", "", len(rows), source.where(rows.index[0]))
    if unknown.any():
        links, device_m = links[~unknown], device_m[~unknown]
    table = _device_table(source, links, device_m, tables["device"],
                          max(MOVING_M, 2 * (settings.place_m or 0.0)))
    return PositionedLinks(links, table, device_m, frame)


def _check_near(source: Source, links: pd.DataFrame, position_m: np.ndarray, end: str) -> None:
    far = (np.abs(position_m) > MAX_COORDINATE_M).any(axis=1)
    if far.any():
        row = int(np.argmax(far))
        raise BadInput(f"{source.path}: {source.where(links.index[row])}: the {end} lies "
                       f"{np.nanmax(np.abs(position_m[row])) / 1000:.10g} km from the origin "
                       f"({far.sum()} such rows); are position, unit and origin right?")


def _positions(links: pd.DataFrame, prefix: str, table: pd.DataFrame | None, names: pd.Series,
               crs: str | None) -> pd.DataFrame:
    """Return columns of `POSITION`: place and height each from the file, else from the table."""
    own = {name: links[prefix + name] for name in POSITION if prefix + name in links}
    positions = to_geographic(pd.DataFrame(own, index=links.index), crs)
    if table is None:
        return positions
    no_place = positions.reindex(columns=["latitude", "x"]).isna().all(axis=1)
    heights = positions.reindex(columns=list(HEIGHTS)).assign(
        **{ABOVE_GROUND: links.get(prefix + ABOVE_GROUND)})
    no_height = heights.isna().all(axis=1)
    row = table.index.get_indexer(names)
    for name in POSITION:
        if name not in table:
            continue
        values = (positions[name].to_numpy(dtype=float) if name in positions
                  else np.full(len(links), np.nan))
        declared = np.append(table[name].to_numpy(dtype=float), np.nan)[row]  # -1: not in it
        positions[name] = np.where(no_height if name in HEIGHTS else no_place, declared, values)
    return positions


def _above_ground_m(links: pd.DataFrame, prefix: str, table: pd.DataFrame | None, names: pd.Series,
                    z_m: np.ndarray) -> np.ndarray:
    """Return heights above the ground (n,) of links (n,) [m]: of the file, else of the table.

    NaN where there is none, or where the height above the datum is known.
    """
    above_m = np.full(len(names), np.nan)
    if table is not None and "above_ground_m" in table:
        above_m = names.map(table["above_ground_m"]).to_numpy(dtype=float)
    if prefix + ABOVE_GROUND in links:
        own_m = links[prefix + ABOVE_GROUND].to_numpy(dtype=float)
        above_m = np.where(np.isnan(own_m), above_m, own_m)
    return np.where(np.isnan(z_m), above_m, np.nan)


def _device_table(source: Source, links: pd.DataFrame, device_m: np.ndarray,
                  table: pd.DataFrame | None, moving_m: float) -> pd.DataFrame:
    """Return the devices of the links as in `devices.csv`."""
    by_device = pd.DataFrame(device_m, columns=["x_m", "y_m", "z_m"], index=links.index).groupby(
        links["device"].to_numpy(), sort=False)
    range_m = by_device.max() - by_device.min()
    moving = range_m.index[(range_m > moving_m).any(axis=1)]
    if len(moving):
        raise BadInput(f"{source.path}: device {moving[0]!r} has positions "
                       f"{range_m.loc[moving[0]].max():.0f} m apart ({len(moving)} such devices); "
                       "a device has one position: --place-m 5 makes one of each place that is 5 m "
                       "from the others, device = \"by position\" one of each position; or leave "
                       "its position out to have it found")
    devices = by_device.median()
    devices["role"] = np.where(devices[["x_m", "y_m"]].notna().all(axis=1), "anchor", "unknown")
    devices.loc[devices["role"] == "unknown", ["x_m", "y_m"]] = np.nan
    for name in DEVICE_OPTIONAL:
        if table is not None and name in table and name != "above_ground_m":
            devices[name] = table[name].reindex(devices.index)
    above_m = _above_ground_m(links, "device_", table, links["device"], device_m[:, 2])
    if np.isfinite(above_m).any():
        devices["above_ground_m"] = pd.Series(above_m).groupby(links["device"].to_numpy(),
                                                               sort=False).median()
    if "frequency_hz" in links:
        own_hz = links.groupby("device", sort=False)["frequency_hz"].median()
        devices["frequency_hz"] = own_hz.fillna(devices["frequency_hz"]) \
            if "frequency_hz" in devices else own_hz
    return devices.rename_axis("device").reset_index()
