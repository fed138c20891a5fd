"""Where receivers and devices are: from the file's own columns and from tables beside it."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.frame import Frame, find_frame, to_geographic
from radiotwin.importing.place_table import read_places
from radiotwin.importing.read import Source
from radiotwin.importing.settings import POSITION, Settings
from radiotwin.importing.tally import Tally
from radiotwin.measurements import DEVICE_OPTIONAL, GREATEST_COORDINATE_M

STILL_M = 1.0  # a device of which the file says places further apart than this moves


@dataclass(frozen=True)
class Placed:
    """Attributes:
        links: with `receiver_x_m, receiver_y_m, receiver_z_m`; those whose receiver is nowhere are gone.
        devices: as in `devices.csv`: those of the links, in the order of their first ones.
        device_m: (n, 3) the position of each link's device [m]; NaN where unknown.
        frame: that all of them are in.
    """

    links: pd.DataFrame
    devices: pd.DataFrame
    device_m: np.ndarray
    frame: Frame


def place(source: Source, links: pd.DataFrame, settings: Settings, tally: Tally) -> Placed:
    """Put receivers and devices into one local frame; raises BadInput."""
    tables = {name: None if path is None else read_places(path, name, settings)
              for name, path in (("receiver", settings.receivers), ("device", settings.devices))}
    receivers = _positions(links, "", tables["receiver"], links["receiver"], settings.crs)
    devices = _positions(links, "device_", tables["device"], links["device"], settings.crs)
    frame = find_frame(settings.origin, receivers, devices)
    receiver_m, device_m = frame.local_m(receivers), frame.local_m(devices)
    for ends_m, what in ((receiver_m, "receiver"), (device_m, "device")):
        far = (np.abs(ends_m) > GREATEST_COORDINATE_M).any(axis=1)
        if far.any():
            row = int(np.argmax(far))
            raise BadInput(f"{source.path}: {source.where(links.index[row])}: the {what} lies "
                           f"{np.nanmax(np.abs(ends_m[row])) / 1000:.0f} km from the origin ({far.sum()} such rows); "
                           "are position, unit and origin right?")
    nowhere = np.isnan(receiver_m[:, :2]).any(axis=1)
    links = links.assign(**{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")})
    lost = links["receiver"][nowhere]
    for name, rows in lost.groupby(lost, sort=False):
        tally.count(f"no position of receiver {name}", "", len(rows), source.where(rows.index[0]))
    links, device_m = links[~nowhere], device_m[~nowhere]
    return Placed(links, _device_table(source, links, device_m, tables["device"]), device_m, frame)


def _positions(links: pd.DataFrame, prefix: str, table: pd.DataFrame | None, names: pd.Series,
               crs: str | None) -> pd.DataFrame:
    """(n rows of `POSITION`) as the file says, else as the table does, else NaN."""
    own = {name: links[prefix + name] for name in POSITION if prefix + name in links}
    positions = to_geographic(pd.DataFrame(own, index=links.index), crs)
    if table is None:
        return positions
    values = positions.to_numpy(copy=True)
    unknown = np.isnan(values[:, [POSITION.index("latitude"), POSITION.index("x")]]).all(axis=1)
    taken = table[list(POSITION)].reindex(names[unknown]).to_numpy()
    values[unknown] = np.where(np.isnan(values[unknown]), taken, values[unknown])
    return pd.DataFrame(values, index=links.index, columns=positions.columns)


def _device_table(source: Source, links: pd.DataFrame, device_m: np.ndarray,
                  table: pd.DataFrame | None) -> pd.DataFrame:
    by_device = pd.DataFrame(device_m, columns=["x_m", "y_m", "z_m"], index=links.index).groupby(
        links["device"].to_numpy(), sort=False)
    spread = by_device.max() - by_device.min()
    moving = spread.index[(spread > STILL_M).any(axis=1)]
    if len(moving):
        raise BadInput(f"{source.path}: device {moving[0]!r} stands at places {spread.loc[moving[0]].max():.0f} m "
                       f"apart ({len(moving)} such devices); a device has one place: name it device = "
                       "\"by position\", or leave its position out to have it found")
    devices = by_device.median()
    devices["role"] = np.where(devices[["x_m", "y_m"]].notna().all(axis=1), "anchor", "unknown")
    devices.loc[devices["role"] == "unknown", ["x_m", "y_m"]] = np.nan
    for name in DEVICE_OPTIONAL:
        if table is not None and name in table:
            devices[name] = table[name].reindex(devices.index)
    if "frequency_hz" in links:
        measured = links.groupby("device", sort=False)["frequency_hz"].median()
        devices["frequency_hz"] = measured.fillna(devices["frequency_hz"]) if "frequency_hz" in devices else measured
    return devices.rename_axis("device").reset_index()
