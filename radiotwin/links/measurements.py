"""`Measurements`: a table of links and a table of devices, read, checked and written."""

import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import xarray as xr

from radiotwin.display import (
    GAIN_COLOURS,
    PlotFrame,
    Summarised,
    Summary,
    count,
    level_range_db,
    new_axes,
    plain,
    some,
    span,
)
from radiotwin.errors import BadInput
from radiotwin.geo import (
    FRAME_FILE,
    GroundHeight,
    between_frames,
    is_same_frame,
    map_positions,
    origin_text,
    read_frame,
    with_datum_heights,
    write_frame,
)
from radiotwin.io.budgets import DOCUMENT_BYTES
from radiotwin.io.cells import (
    cell_text,
    check_suffix,
    column_names,
    read_cells,
    require_pyarrow,
    write_csv,
)
from radiotwin.io.files import atomic_path
from radiotwin.io.forms import MAX_POSITION_M, Origin, as_origin
from radiotwin.io.inputs import is_within, read_bytes, require_within
from radiotwin.links.link_table import (
    DEVICE_POSITION,
    FRAME,
    OPTIONAL,
    RECEIVER_POSITION,
    REQUIRED,
    is_table_of_links,
    links_of_frame,
    read_links,
    require_level,
)
from radiotwin.links.plausible import LEVELS, MAX_APART_M, READS
from radiotwin.links.site_table import read_site_table, unused_columns
from radiotwin.links.view import links_dataset, links_table, of_device, plot_links
from radiotwin.scene.antennas import Pattern, parse_pattern

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

    from radiotwin.scene import Scene

DEVICE_REQUIRED = ["device", "x_m", "y_m", "z_m", "role"]
# Declared radio of a device, besides its antenna.
RADIO = ["tx_power_dbm", "eirp_dbm", "cable_loss_db", "frequency_hz", "azimuth_deg", "tilt_deg"]
DEVICE_OPTIONAL = [*RADIO, "above_ground_m", READS]
ROLES = ("anchor", "unknown")
_DEVICE_POSITION = ["x_m", "y_m", "z_m"]


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Summarised):
    """Levels of links between devices and receivers.

    Data frames of other layouts are converted: `Measurements(frame)`, or `Measurements(frame,
    devices, origin)`. Each row of `frame` needs `gain_db` or `rssi_dbm`, a `device` and a receiver
    position, such as `latitude, longitude, height_m`; `flight` and `receiver` are optional.
    `devices` needs the column `device`, and positions of the anchors. Without `devices`, positions
    are taken from columns `device_x_m, device_y_m, device_z_m`, or are unknown.

    Attributes:
        table: one row per link, columns as in `measurements.csv`; NaN level = not detected.
        devices: one row per device, columns as in `devices.csv`; NaN x, y: unknown.
        origin: of the local frame of both tables, or its latitude and longitude; None: unknown, and
            the middle of latitudes and longitudes becomes the origin.
        antenna_files: name in the column `antenna` of `devices` -> content of the file.
        notes: on unused columns and implausible values.
        files: names of both tables, for messages.
    """

    table: pd.DataFrame
    devices: pd.DataFrame = None  # type: ignore[assignment]  # filled in below
    origin: Origin | None = None
    antenna_files: Mapping[str, bytes] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    files: tuple[str, str] = ("measurements", "devices")

    def __post_init__(self) -> None:
        for what, rows in (("links", self.table), ("devices", self.devices)):
            if not isinstance(rows, pd.DataFrame) and (rows is not None or what == "links"):
                raise BadInput(f"Measurements are made of a data frame of {what}, not of "
                               f"{type(rows).__name__}; Measurements.load(path) reads a file")
        origin, notes = as_origin(self.origin), self.notes
        if not is_table_of_links(self.table):
            table, origin, more = links_of_frame(self.table, origin)
            self._fill(table=table, origin=origin, notes=(*notes, *more))
        require_level(FRAME, self.table)
        if self.devices is None:
            self._fill(devices=_devices_of_links(self.table))
        elif not {*DEVICE_REQUIRED} <= set(self.devices):
            devices, more = _devices(FRAME + " of devices", self.devices.reset_index(drop=True),
                                     origin, origin, "row {}".format)
            self._fill(devices=devices, notes=(*self.notes, *more))
        if self.origin is not origin:
            self._fill(origin=origin)
        undeclared = self.device_index < 0
        if undeclared.any():
            raise BadInput(f"device {self.table['device'][undeclared].iloc[0]!r} has links and is "
                           f"not among the devices ({some(self.devices['device'])}); add it "
                           "there, without a position if that is to be found")

    def _fill(self, **values: object) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def level_column(self) -> str:
        """`gain_db`, or `rssi_dbm` where the transmit power is unknown."""
        return next(name for name in LEVELS if name in self.table)

    @property
    def level_db(self) -> np.ndarray:
        """Measured levels [dB or dBm], (n,); NaN = not detected."""
        return self.table[self.level_column].to_numpy(dtype=float)

    @property
    def receiver_m(self) -> np.ndarray:
        """Receiver positions [m], (n, 3)."""
        return self.table[RECEIVER_POSITION].to_numpy(dtype=float)

    @cached_property
    def device_index(self) -> np.ndarray:
        """Row of each link's device in `devices`, (n,)."""
        return pd.Index(self.devices["device"]).get_indexer(self.table["device"])

    @cached_property
    def patterns(self) -> dict[str, Pattern]:
        """Antenna patterns, by file name in `devices`; BadInput if a file holds none."""
        return {name: parse_pattern(Path(name), content)
                for name, content in self.antenna_files.items()}

    @property
    def device_m(self) -> np.ndarray:
        """Declared device positions [m], (k, 3); NaN where unknown."""
        return self.devices[_DEVICE_POSITION].to_numpy(dtype=float)

    @property
    def is_anchor(self) -> np.ndarray:
        """Whether the position of each device is known, (k,) bool."""
        return (self.devices["role"] == "anchor").to_numpy()

    @property
    def flights(self) -> list[str]:
        """Names of the flights, in the order of their first rows."""
        return list(dict.fromkeys(self.table["flight"]))

    def select(self, mask: np.ndarray) -> "Measurements":
        """Select links by a mask (n,), bool; all devices stay.

        Raises:
            BadInput: the argument is not such a mask.
        """
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (len(self),):
            raise BadInput(f"select takes a mask of {len(self)} true or false, one for each link, "
                           'such as measurements.table["flight"] == "f1"')
        return replace(self, table=self.table[mask].reset_index(drop=True))

    def moved(self, position_m: Callable[[np.ndarray], np.ndarray],
              origin: Origin | None) -> "Measurements":
        """Move all positions to another frame, with that origin (None: unknown).

        `position_m` converts positions (n, 3) [m], in which NaN is unknown.
        """
        return replace(
            self, table=map_positions(self.table, RECEIVER_POSITION, position_m),
            devices=map_positions(self.devices, _DEVICE_POSITION, position_m), origin=origin)

    def on_ground(self, ground_height_m: GroundHeight | None) -> "Measurements":
        """Convert heights above the ground to heights above the datum of the frame.

        See `with_datum_heights`. `ground_height_m` gives the ground's z at x, y [m]; None: it is
        flat, at z = 0.
        """
        if "receiver_above_ground_m" not in self.table and "above_ground_m" not in self.devices:
            return self
        table, devices = (with_datum_heights(rows, name, position, ground_height_m)
                          for rows, name, position in (
                              (self.table, self.files[0], RECEIVER_POSITION),
                              (self.devices, self.files[1], _DEVICE_POSITION)))
        return replace(self, table=table, devices=devices)

    def in_frame(self, origin: Origin) -> "Measurements":
        """Convert all positions exactly to the frame about another origin.

        Raises:
            BadInput: the origin of the present frame is not known.
        """
        old = self.origin
        if old is None:
            raise BadInput("the origin of the measurements' frame is not known; give it to "
                           "Measurements, or move them")
        return self.moved(lambda position_m: between_frames(position_m, old, origin), origin)

    @classmethod
    def load(cls, path: Path | str, devices_path: Path | str | None = None) -> "Measurements":
        """Read links and devices, see `read_measurements`."""
        return read_measurements(path, devices_path)

    def save(self, path: Path | str) -> None:
        """Write the links to a path, and `devices.csv` and antenna files to the same folder.

        The path ends in `.csv`, `.csv.gz` or `.parquet`. A known origin goes to `frame.toml` there.

        Raises:
            BadInput: `path` cannot be written, or the folder has a `devices.csv` of other devices,
                or a `frame.toml` of another frame.
        """
        path = Path(path)
        check_suffix(path)
        if path.name == "devices.csv":
            raise BadInput(f"{path}: this name is for the devices' table, which is written beside "
                           "the links; give the links another name, such as measurements.csv")
        self._check_replaceable(path.parent / "devices.csv")
        self._check_frame(path.parent)
        with ExitStack() as together:
            if self.origin is not None:
                frame = together.enter_context(atomic_path(path.parent / FRAME_FILE))
                write_frame(self.origin, frame)
            for name, content in self.antenna_files.items():
                (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
                together.enter_context(atomic_path(path.parent / name)).write_bytes(content)
            devices = together.enter_context(atomic_path(path.parent / "devices.csv"))
            links = together.enter_context(atomic_path(path))
            write_csv(self.devices, devices)
            if path.suffix.lower() == ".parquet":
                require_pyarrow(path)
                self.table.to_parquet(links, index=False)
            else:
                write_csv(self.table, links)

    def plot(self, device: str | None = None, ax: "Axes | None" = None, *,
             scene: "Scene | None" = None, geographic: bool | None = None) -> "Axes":
        """Draw the levels of a device's links at the end that moves.

        Args:
            device: name; None: the one with the most detected links.
            ax: axes of matplotlib to draw into; None: a new figure.
            scene: whose buildings are outlined; None: none are.
            geographic: whether axes are longitude and latitude; None: where the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: no such device, no link at all, or longitude and latitude without an origin.
        """
        if self.table.empty:
            raise BadInput("there are no links to draw")
        if device is None:
            detected = self.table["device"][np.isfinite(self.level_db)]
            device = str((detected if len(detected) else self.table["device"]).mode()[0])
        origin = self.origin or (scene.config.origin if scene is not None else None)
        frame = PlotFrame.choose(origin, geographic)
        links = of_device(self._links_with_devices(), device)
        level = links[self.level_column].to_numpy(dtype=float)
        ax, (low, high) = new_axes(ax), level_range_db(level)
        label = "channel gain [dB]" if self.level_column == "gain_db" else "received power [dBm]"
        plot_links(links, level, ax, frame, scene, label, True, cmap=GAIN_COLOURS, vmin=low,
                   vmax=high)
        ax.set_title(f"device {plain(device)}: {count(len(links), 'link')}, "
                     f"{np.isfinite(level).sum():,} detected")
        return ax

    def to_xarray(self) -> xr.Dataset:
        """Return links with the positions of both ends as variables over the dimension `link`."""
        return links_dataset(self._links_with_devices(), self.origin)

    def to_geodataframe(self) -> "GeoDataFrame":
        """Return a GeoDataFrame of the links, as points at their moving ends in local metres.

        The moving end is the receiver, or the device if devices are at more positions.

        Raises:
            BadInput: GeoPandas is not installed.
        """
        return links_table(self._links_with_devices(), self.origin)

    def _links_with_devices(self) -> pd.DataFrame:
        device = self.devices.iloc[self.device_index].reset_index(drop=True)
        columns = {f"device_{name}": device[name] for name in _DEVICE_POSITION}
        return self.table.reset_index(drop=True).assign(role=device["role"], **columns)

    def __len__(self) -> int:
        """Return the number of links."""
        return len(self.table)

    @property
    def _summary(self) -> Summary:
        """Describe links, receivers, devices, flights and levels for display."""
        seen = np.isfinite(self.level_db)
        known = self.level_db[seen]
        unit = "dB" if self.level_column == "gain_db" else "dBm"
        levels = span(float(known.min()), float(known.max()), unit) if len(known) else "–"
        anchors, receivers = int(self.is_anchor.sum()), self.table["receiver"].unique()
        missed = f"{1 - seen.mean():.1%}" if len(seen) else "–"
        return Summary(
            "Measurements", f"{count(len(self), 'link')}, {count(len(receivers), 'receiver')}, "
            f"{count(len(self.devices), 'device')}, {count(len(self.flights), 'flight')}, "
            f"{self.level_column} {levels}, {missed} not detected", (
                ("links", f"{len(self):,}"), ("flights", some(self.flights)),
                ("receivers", some(receivers)), ("devices", some(self.devices["device"])),
                ("of these", count(anchors, "anchor")), (self.level_column, levels),
                ("not detected", missed),
                ("origin", "not known" if self.origin is None else origin_text(self.origin))))

    def _check_frame(self, folder: Path) -> None:
        """Raise BadInput if the folder's `frame.toml` declares another frame."""
        there = read_frame(folder)
        if there is not None and (self.origin is None or not is_same_frame(there, self.origin)):
            raise BadInput(f"{folder / FRAME_FILE} says that tables of this folder are in the "
                           f"frame about {origin_text(there)}, and these are "
                           + (f"about {origin_text(self.origin)}" if self.origin else
                              "in one of unknown origin") + "; choose another output folder")

    def _check_replaceable(self, path: Path) -> None:
        """Raise BadInput if `path` exists and is not a table of the same devices."""
        if not os.path.exists(path):  # False, not an error, of a name that no file can have
            return
        try:
            same = sorted(read_devices(path)["device"]) == sorted(self.devices["device"])
        except BadInput:
            same = False
        if not same:
            raise BadInput(f"{path} exists and is not a table of this survey's devices "
                           f"({some(self.devices['device'])}); it is not overwritten: choose "
                           "another output folder, or move it away")


def read_measurements(path: Path | str, devices_path: Path | str | None = None) -> Measurements:
    """Read a table of links and a table of devices.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet` with the columns of `REQUIRED` and one of `LEVELS`.
        devices_path: table of the devices; by default `devices.csv` in the same folder.

    Returns:
        links and devices in the frame of the `frame.toml` beside the links. Devices of another
        folder are converted from the frame declared there.

    Raises:
        BadInput: names file, row and column of the first value that cannot be used.
    """
    if not isinstance(path, str | os.PathLike):
        raise BadInput(f"the path of a table is needed, not {type(path).__name__}; Measurements("
                       "frame) takes a data frame")
    path = Path(path)
    table = read_links(path)
    require_level(path, table)
    named = devices_path is not None
    devices_path = Path(devices_path) if devices_path else path.parent / "devices.csv"
    if not os.path.exists(devices_path):
        raise BadInput(f"{devices_path} does not exist; the table of devices needs the columns "
                       f"{', '.join(DEVICE_REQUIRED)} (role: {' or '.join(ROLES)}); --devices "
                       "names another file")
    if not named and not is_within(devices_path, path.parent):
        raise BadInput(f"{devices_path} is a link out of its folder; name the table that it leads "
                       "to with --devices")
    origin, of_devices = read_frame(path.parent), read_frame(devices_path.parent)
    devices, notes = _devices(devices_path, read_cells(devices_path), origin, of_devices,
                              lambda row: f"row {row + 2}")
    if table.empty:
        raise BadInput(f"{path}: has no rows; it needs at least one measured link")
    undeclared = ~table["device"].isin(devices["device"])
    if undeclared.any():
        row = int(np.flatnonzero(undeclared)[0])
        raise BadInput(f"{path}: row {row + 2}, column device: {table['device'][row]!r} is not in "
                       f"{devices_path} (it has {some(devices['device'])}); add it there or "
                       "correct the name")
    _check_spread(path, table, devices_path, devices)
    unused = unused_columns(path, column_names(path), table.columns, REQUIRED + OPTIONAL + LEVELS)
    return Measurements(table, devices, origin, read_antenna_files(
        devices_path, devices.get("antenna", ())), (*unused, *notes),
        (str(path), str(devices_path)))


def read_devices(path: Path | str) -> pd.DataFrame:
    """Read a table of devices, one row each, into a table with the columns of `DEVICE_REQUIRED`.

    The file may use other column names (see `radiotwin.links.site_table`), and latitudes and
    longitudes in place of x and y if a `frame.toml` beside it declares the local frame.

    Raises:
        BadInput: names file, row and column of the first value that cannot be used.
    """
    path = Path(path)
    own = read_frame(path.parent)
    return _devices(path, read_cells(path), own, own, lambda row: f"row {row + 2}")[0]


def _devices_of_links(table: pd.DataFrame) -> pd.DataFrame:
    """Make the table of devices from columns `device_x_m, …`, by the first link of each device."""
    first = table.drop_duplicates("device").reset_index(drop=True)
    position_m = first.reindex(columns=DEVICE_POSITION).astype(float).to_numpy()
    placed = np.isfinite(position_m[:, :2]).all(axis=1)
    return pd.DataFrame({"device": first["device"], **dict(zip(_DEVICE_POSITION, position_m.T)),
                         "role": np.where(placed, *ROLES)})


def _devices(path: Path | str, cells: pd.DataFrame, origin: Origin | None, own: Origin | None,
             where: Callable[[int], str]) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Make the table of devices, and notes, from cells; x, y move from origin `own` to `origin`.

    Without a column `role`, devices with a position are anchors.
    """
    sites = read_site_table(path, cells, where, "device", [*DEVICE_OPTIONAL, "antenna", "role"])
    names, values = sites.names, sites.values
    sites.refuse("device", names.duplicated(),
                 "occurs twice; every device needs one row, and a name of its own")
    position_m = sites.local_m(origin or own, own, "the measurements")
    sites.refuse_rows((np.abs(position_m) > MAX_POSITION_M).any(axis=1), lambda row: (
        f"device {names[row]!r} is too far away; allowed are {MAX_POSITION_M:g} m"))
    placed = np.isfinite(position_m[:, :2]).all(axis=1)
    role = values.get("role", pd.Series(np.where(placed, *ROLES)))
    if "role" in values:
        sites.refuse("role", ~role.isin(ROLES), f"is no role; allowed are {' and '.join(ROLES)}")
    sites.refuse_rows((role == "anchor") & ~placed, lambda row: (
        f"anchor {names[row]!r} has no x_m, y_m; fill them in or give it the role unknown"))
    devices = pd.DataFrame({"device": names, **dict(zip(_DEVICE_POSITION, position_m.T)),
                            "role": role})
    others = [name for name in (*DEVICE_OPTIONAL, "antenna") if name in values]
    return devices.assign(**{name: values[name] for name in others}), sites.notes


def read_antenna_files(path: Path, names: Iterable[str], are_rows: bool = True
                       ) -> dict[str, bytes]:
    """Read the antenna files, name -> content, that a table names in its column `antenna`.

    They are in or below its folder; an empty name is no file. With `are_rows` there is a name for
    each row, for messages. BadInput if one is missing, outside, or no antenna pattern.
    """
    files = {}
    for row, name in enumerate(names):
        if name and name not in files:
            where = f"row {row + 2}" if are_rows else "column antenna"
            file = require_within(path.parent, path.parent / name, f"{path}, {where}")
            if not file.exists():
                raise BadInput(f"{path}, {where}: antenna {cell_text(name)} is no file of a "
                               "pattern in the table's folder; put it there, or call the column "
                               "antenna_model if it names a product")
            files[name] = read_bytes(file, "pattern of an antenna", DOCUMENT_BYTES)
            parse_pattern(file, files[name])
    return files


def _check_spread(path: Path, table: pd.DataFrame, devices_path: Path,
                  devices: pd.DataFrame) -> None:
    """Raise BadInput if some anchors, not all, are `MAX_APART_M` from the middle of the receivers.

    If all are, links and devices are in different frames, which is checked later, with the scene.
    """
    middle_m = table[["receiver_x_m", "receiver_y_m"]].median().to_numpy()
    anchor = (devices["role"] == "anchor").to_numpy()
    far = anchor & (np.abs(devices[["x_m", "y_m"]].to_numpy() - middle_m).max(axis=1) > MAX_APART_M)
    if far.any() and far.sum() < anchor.sum():
        row = int(np.argmax(far))
        x_m, y_m = devices.loc[row, ["x_m", "y_m"]]
        raise BadInput(f"{devices_path}: row {row + 2}: anchor {devices['device'][row]!r} at "
                       f"({x_m:g}, {y_m:g}) m is more than {MAX_APART_M / 1000:g} km from the "
                       f"middle of the receivers of {path.name}, ({middle_m[0]:g}, "
                       f"{middle_m[1]:g}) m; both need one frame, in metres")
