"""Measured levels of links, and the devices they belong to: two tables, checked at the border."""

import csv
import gzip
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.files import atomic_path

REQUIRED = ["flight", "receiver", "receiver_x_m", "receiver_y_m", "receiver_z_m", "device"]
LEVELS = ["gain_db", "rssi_dbm"]
OPTIONAL = ["time_s", "heading_deg", "pitch_deg", "roll_deg", "quality"]
MAY_BE_EMPTY = {"time_s", "receiver_z_m", *LEVELS, *OPTIONAL}
DEVICE_REQUIRED = ["device", "x_m", "y_m", "z_m", "role"]
DEVICE_OPTIONAL = ["frequency_hz", "tx_power_dbm", "azimuth_deg", "tilt_deg"]
TEXT = {"flight", "receiver", "device", "role"}
ROLES = ("anchor", "unknown")
GREATEST_LEVEL_DB = 300.0
GREATEST_COORDINATE_M = 1e7
FREQUENCIES_HZ = (1e6, 450e9)
NEEDED = "every row needs one: fill it in, or leave the row out"


@dataclass(frozen=True, eq=False)
class Measurements:
    """Levels of links between devices and receivers.

    Attributes:
        table: one row a link, columns as in `measurements.csv`; NaN level = not detected.
        devices: one row a device, columns as in `devices.csv`; NaN x, y where the position is unknown.
    """

    table: pd.DataFrame
    devices: pd.DataFrame

    @property
    def level_column(self) -> str:
        """`gain_db`, or `rssi_dbm` where transmit power is unknown."""
        return next(name for name in LEVELS if name in self.table)

    @property
    def level_db(self) -> np.ndarray:
        """(n,) measured level [dB or dBm]; NaN = not detected."""
        return self.table[self.level_column].to_numpy(dtype=float)

    @property
    def receiver_m(self) -> np.ndarray:
        """(n, 3) receiver positions [m]"""
        return self.table[["receiver_x_m", "receiver_y_m", "receiver_z_m"]].to_numpy(dtype=float)

    @cached_property
    def device_index(self) -> np.ndarray:
        """(n,) row of each link's device in `devices`."""
        return pd.Index(self.devices["device"]).get_indexer(self.table["device"])

    @property
    def device_m(self) -> np.ndarray:
        """(k, 3) declared device positions [m]; NaN where unknown."""
        return self.devices[["x_m", "y_m", "z_m"]].to_numpy(dtype=float)

    @property
    def is_anchor(self) -> np.ndarray:
        """(k,) bool: the device's position is known."""
        return (self.devices["role"] == "anchor").to_numpy()

    @property
    def flights(self) -> list[str]:
        """Names of the flights, in the order of their first rows."""
        return list(dict.fromkeys(self.table["flight"]))

    def select(self, mask: np.ndarray) -> "Measurements":
        """The links where `mask` (n,) is true, with all devices."""
        return Measurements(self.table[np.asarray(mask)].reset_index(drop=True), self.devices)

    def write(self, path: Path | str) -> None:
        """Write the links to `path` (.csv, .csv.gz, .parquet) and the devices to `devices.csv` beside it.

        Raises:
            BadInput: `path` cannot be written, or a `devices.csv` with other devices lies beside it.
        """
        path = Path(path)
        _check_suffix(path)
        if path.name == "devices.csv":
            raise BadInput(f"{path}: this name is for the devices' table, which is written beside the links; give the "
                           "links another name, such as measurements.csv")
        self._check_replaceable(path.parent / "devices.csv")
        with atomic_path(path.parent / "devices.csv") as devices, atomic_path(path) as links:
            self.devices.to_csv(devices, index=False)
            if path.suffix == ".parquet":
                _needs_pyarrow(path)
                self.table.to_parquet(links, index=False)
            else:
                self.table.to_csv(links, index=False, compression="gzip" if path.suffix == ".gz" else None)

    def _check_replaceable(self, path: Path) -> None:
        """A table of the same devices may be replaced; any other one may be its user's only copy."""
        if not path.exists():
            return
        try:
            same = sorted(read_devices(path)["device"]) == sorted(self.devices["device"])
        except BadInput:
            same = False
        if not same:
            raise BadInput(f"{path} exists and is not a table of this survey's devices "
                           f"({_some(self.devices['device'])}); it is not overwritten: choose another output folder, "
                           "or move it away")


def read_measurements(path: Path | str, devices_path: Path | str | None = None) -> Measurements:
    """Read links and devices.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet` with the columns of `REQUIRED` and one of `LEVELS`.
        devices_path: the devices' table; by default `devices.csv` in the same folder.

    Raises:
        BadInput: names the file, row and column of the first value that cannot be used.
    """
    path = Path(path)
    table = _read_table(path, REQUIRED, OPTIONAL + LEVELS)
    levels = [name for name in LEVELS if name in table]
    if len(levels) != 1:
        raise BadInput(f"{path}: needs exactly one of the columns {LEVELS}, it has {levels or 'neither'}")
    devices_path = Path(devices_path) if devices_path else path.parent / "devices.csv"
    if not devices_path.is_file():
        raise BadInput(f"{devices_path} does not exist; the table of devices needs the columns "
                       f"{', '.join(DEVICE_REQUIRED)} (role: {' or '.join(ROLES)}); --devices names another file")
    devices = read_devices(devices_path)
    if table.empty:
        raise BadInput(f"{path}: has no rows; it needs at least one measured link")
    stranger = ~table["device"].isin(devices["device"])
    if stranger.any():
        row = int(np.flatnonzero(stranger)[0])
        raise BadInput(f"{path}: row {row + 2}, column device: {table['device'][row]!r} is not in {devices_path} "
                       f"(it has {_some(devices['device'])}); add it there or correct the name")
    return Measurements(table, devices)


def read_devices(path: Path | str) -> pd.DataFrame:
    """Read `devices.csv`; raises BadInput as `read_measurements` does."""
    path = Path(path)
    devices = _read_table(path, DEVICE_REQUIRED, DEVICE_OPTIONAL, may_be_empty={"x_m", "y_m", "z_m", *DEVICE_OPTIONAL})
    if devices.empty:
        raise BadInput(f"{path}: has no rows; it needs one for each device")
    double = devices["device"].duplicated()
    if double.any():
        row = int(np.flatnonzero(double)[0])
        raise BadInput(f"{path}: row {row + 2}, column device: {devices['device'][row]!r} stands there twice; every "
                       "device needs one row, and a name of its own")
    wrong = ~devices["role"].isin(ROLES)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise BadInput(f"{path}: row {row + 2}, column role: {devices['role'][row]!r}; allowed are {ROLES}")
    lost = (devices["role"] == "anchor") & devices[["x_m", "y_m"]].isna().any(axis=1)
    if lost.any():
        row = int(np.flatnonzero(lost)[0])
        raise BadInput(f"{path}: row {row + 2}: anchor {devices['device'][row]!r} has no x_m, y_m; "
                       "fill them in or give it the role unknown")
    return devices


def read_cells(path: Path) -> pd.DataFrame:
    """The cells of any table as they stand: text from .csv and .csv.gz (`""` where empty), typed from .parquet.

    Raises:
        BadInput: no such file, unreadable, no header, a name twice, or a row with too few or too many fields.
    """
    _check_suffix(path)
    if not path.is_file():
        raise BadInput(f"{path} does not exist")
    try:
        return _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    except BadInput:
        raise
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not text in UTF-8; allowed is comma-separated, UTF-8") from None
    except Exception as error:  # pandas, gzip and pyarrow each have their own
        raise BadInput(f"{path} cannot be read as {''.join(path.suffixes)}: {error}") from None


def _read_table(path: Path, required: list[str], optional: list[str], may_be_empty=MAY_BE_EMPTY) -> pd.DataFrame:
    raw = read_cells(path)
    missing = [name for name in required if name not in raw]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; it needs {required}, it has {list(raw.columns)}")
    table = raw[[name for name in raw.columns if name in required + optional]].copy()
    for name in table.columns:
        if name in TEXT:
            table[name] = table[name].astype(str).str.strip()
            _refuse(path, name, table[name], table[name] == "", "is empty; give a name")
        else:
            table[name] = _numbers(path, name, table[name], name in may_be_empty)
    return table


def _read_parquet(path: Path) -> pd.DataFrame:
    """Its columns, in the order of its rows. What pandas wrote about an index is not looked at: a table that was
    filtered or sorted before would keep its old labels, and here rows are counted."""
    _needs_pyarrow(path)
    from pyarrow.parquet import read_schema, read_table

    _check_header(path, read_schema(path).names)
    return read_table(path).to_pandas(ignore_metadata=True)


def _read_csv(path: Path) -> pd.DataFrame:
    """All cells as text. The fields are counted before, because pandas fills short rows with blanks, and a blank level
    means "not detected"."""
    rows = _fields(path)
    header = [name.strip() for name in next(rows, [])]
    if not header:
        raise BadInput(f"{path} is empty; it needs a first row with the names of the columns")
    _check_header(path, header)
    if len(header) == 1 and not header[0].isidentifier():
        raise BadInput(f"{path}: its header {header[0][:60]!r} is one single column; allowed is comma-separated, UTF-8")
    for number, fields in enumerate(rows, start=2):
        if len(fields) != len(header):
            raise BadInput(f"{path}: row {number} has {len(fields)} fields, the header has {len(header)}; every row "
                           "needs as many commas as the header")
    return pd.read_csv(path, dtype=str, keep_default_na=False, skipinitialspace=True, header=0, names=header,
                       index_col=False, encoding="utf-8-sig")


def _fields(path: Path) -> Iterator[list[str]]:
    """The fields of each line that is not blank."""
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt", encoding="utf-8-sig", newline="") as file:
        yield from filter(None, csv.reader(file, skipinitialspace=True))


def _check_header(path: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        if name in names[:number]:
            raise BadInput(f"{path}: row 1: column {name!r} stands there twice; every name must be unique")


def _numbers(path: Path, name: str, column: pd.Series, may_be_empty: bool) -> pd.Series:
    if column.dtype.kind in "fiu":
        numbers, empty = column.astype(float), column.isna()
    else:
        text = column.fillna("").astype(str).str.strip()
        empty = text == ""
        numbers = pd.to_numeric(text, errors="coerce")
        not_a_number = text.str.lower().isin(["nan", "na", "none"])
        _refuse(path, name, column, numbers.isna() & ~empty & ~not_a_number, "is not a number")
        _refuse(path, name, column, not_a_number,
                f"is not a number; {'leave the cell empty where there is no value' if may_be_empty else NEEDED}")
        numbers = numbers.astype(float)
    _refuse(path, name, column, np.isinf(numbers), "is not finite; leave the cell empty where nothing was detected"
            if name in LEVELS else "is not finite")
    if not may_be_empty:
        _refuse(path, name, column, empty, f"is empty; {NEEDED}")
    if name in LEVELS:
        _refuse(path, name, column, numbers.abs() > GREATEST_LEVEL_DB,
                f"is no level; allowed are -{GREATEST_LEVEL_DB:g} to {GREATEST_LEVEL_DB:g}")
    if name == "gain_db":
        _refuse(path, name, column, numbers > 0,
                "is above 0 dB, which no channel gain is; received power [dBm] goes into a column rssi_dbm, and a "
                "path loss needs a minus sign")
    if name == "frequency_hz":
        low, high = FREQUENCIES_HZ
        _refuse(path, name, column, (numbers < low) | (numbers > high),
                f"is no frequency; allowed are {low:g} to {high:g} Hz; the unit is Hz")
    if name.endswith("_m"):
        _refuse(path, name, column, numbers.abs() > GREATEST_COORDINATE_M,
                f"is too far away; allowed are -{GREATEST_COORDINATE_M:g} to {GREATEST_COORDINATE_M:g} m in the "
                "scene's frame")
    return numbers


def _refuse(path: Path, name: str, column: pd.Series, bad, why: str) -> None:
    bad = np.asarray(bad, dtype=bool)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        more = f" ({bad.sum()} such rows)" if bad.sum() > 1 else ""
        raise BadInput(f"{path}: row {row + 2}, column {name}: {str(column.iloc[row])!r} {why}{more}")


def _check_suffix(path: Path) -> None:
    if path.suffix not in (".csv", ".parquet") and path.suffixes[-2:] != [".csv", ".gz"]:
        raise BadInput(f"{path}: unknown format; allowed are .csv, .csv.gz and .parquet")


def _needs_pyarrow(path: Path) -> None:
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise BadInput(f"{path}: Parquet needs the package pyarrow; `pip install radiotwin[parquet]`, "
                       "or use .csv.gz") from None


def _some(names) -> str:
    names = list(names)
    return ", ".join(map(str, names[:6])) + (f", … {len(names)} in all" if len(names) > 6 else "")
