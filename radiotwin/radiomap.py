"""The radio map: channel gain at every lattice position for every device."""

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from radiotwin.errors import BadInput
from radiotwin.files import atomic_path
from radiotwin.geodesy import local_crs
from radiotwin.scene.lattice import Lattice
from radiotwin.tables import Origin

DIMS = ("device", "z", "y", "x")
SCHEMA = "radiotwin.radiomap/1"
CONVENTIONS = "CF-1.11"  # https://cfconventions.org
GRID_MAPPING = "crs"
_ATTRIBUTES: dict[str, dict[str, str]] = {
    "x": {"units": "m", "long_name": "east"},
    "y": {"units": "m", "long_name": "north"},
    "z": {"units": "m", "long_name": "height above the ground datum"},
    "gain_db": {"units": "dB", "long_name": "channel gain (NaN: not detected)"},
    "sigma_db": {"units": "dB", "long_name": "standard deviation of the gain"},
    "los": {"long_name": "line of sight by the 3D map"},
}
# Attributes of the file only, by the CF conventions; in memory they would be in the way.
_CF_ATTRIBUTES: dict[str, dict[str, str | np.ndarray]] = {
    "x": {"axis": "X", "standard_name": "projection_x_coordinate"},
    "y": {"axis": "Y", "standard_name": "projection_y_coordinate"},
    "z": {"axis": "Z", "standard_name": "height", "positive": "up"},
    "los": {"flag_values": np.array([0, 1], dtype=np.int8),
            "flag_meanings": "no_line_of_sight line_of_sight"},
}


@dataclass(frozen=True, eq=False)
class RadioMap:
    """Channel gain over a lattice.

    Attributes:
        dataset: variables `gain_db` (float32, NaN where not detected), `los` (bool) and optionally
            `sigma_db` (float32), each with dims (device, z, y, x); coordinates x, y, z [m];
            attributes hold the provenance (source, solver settings, seed, origin).
    """

    dataset: xr.Dataset

    @classmethod
    def build(cls, devices: list[str], lattice: Lattice, gain_db: np.ndarray, los: np.ndarray,
              sigma_db: np.ndarray | None = None,
              attributes: dict[str, Any] | None = None) -> "RadioMap":
        """Build a map from arrays.

        Args:
            devices: names of the devices, (n,).
            lattice: of the map.
            gain_db: channel gain [dB], (n, z, y, x) or (n, z * y * x); NaN where not detected.
            los: line of sight by the 3D map, of the same shape.
            sigma_db: standard deviation of the gain [dB], of the same shape.
            attributes: provenance.
        """
        shape = (len(devices), *lattice.shape)
        variables = {"gain_db": gain_db.astype(np.float32), "los": los.astype(bool)}
        if sigma_db is not None:
            variables["sigma_db"] = sigma_db.astype(np.float32)
        dataset = xr.Dataset(
            {name: (DIMS, values.reshape(shape)) for name, values in variables.items()},
            coords={"device": np.array(devices, dtype=object),
                    "z": lattice.z_m, "y": lattice.y_m, "x": lattice.x_m},
            attrs={"schema": SCHEMA, **(attributes or {})},
        )
        for name in dataset.variables:
            dataset[name].attrs.update(_ATTRIBUTES.get(str(name), {}))
        return cls(dataset)

    @classmethod
    def read(cls, path: Path | str) -> "RadioMap":
        """Read a NetCDF-4 file.

        Args:
            path: of the file, as `write` makes it.

        Raises:
            BadInput: no such file, not NetCDF-4, or not a radio map.
        """
        path = Path(path)
        if not path.is_file():
            raise BadInput(f"{path} does not exist; `radiotwin trace` or `radiotwin map` makes a "
                           "radio map")
        try:
            with xr.open_dataset(path, engine="h5netcdf") as file:
                dataset = file.load()
        except Exception as error:  # h5py raises OSError, KeyError or ValueError, by the damage
            raise BadInput(f"{path} is not a readable NetCDF-4 file ({error}); make it again"
                           ) from None
        problem = _problem(dataset)
        if problem:
            raise BadInput(f"{path} is not a radio map: {problem}; `radiotwin trace` or "
                           "`radiotwin map` makes one")
        dataset["los"] = dataset["los"].astype(bool)
        return cls(_without_cf(dataset))

    def write(self, path: Path | str) -> None:
        """Write compressed NetCDF-4 by the CF conventions, atomically.

        Args:
            path: of the file.

        Raises:
            BadInput: `path` cannot be written.
        """
        encoding: dict[Hashable, dict[str, int | None]] = {
            name: {"zlib": True, "complevel": 4} for name in self.dataset.data_vars}
        encoding |= {axis: {"_FillValue": None} for axis in "xyz"}
        with atomic_path(path) as temporary:
            _with_cf(self.dataset).to_netcdf(temporary, engine="h5netcdf", encoding=encoding)

    def placed(self, origin: Origin | None) -> "RadioMap":
        """Return the same map with another origin of the local frame.

        Args:
            origin: the new origin; None removes it.
        """
        new = {} if origin is None else {
            f"origin_{name}": value for name, value in origin.model_dump().items()}
        dataset = self.dataset.copy()
        dataset.attrs = {name: value for name, value in dataset.attrs.items()
                         if not name.startswith("origin_")} | new
        return RadioMap(dataset)

    @property
    def devices(self) -> list[str]:
        """Names of the devices."""
        return [str(name) for name in self.dataset["device"].values]

    @property
    def lattice(self) -> Lattice:
        """Positions of the map."""
        return Lattice(*(self.dataset[axis].values.astype(float) for axis in "xyz"))

    @property
    def gain_db(self) -> np.ndarray:
        """Channel gain [dB], (device, z, y, x) float32; NaN where not detected."""
        return self.dataset["gain_db"].values

    @property
    def los(self) -> np.ndarray:
        """Line of sight by the 3D map, (device, z, y, x) bool."""
        return self.dataset["los"].values


def _with_cf(dataset: xr.Dataset) -> xr.Dataset:
    """Add the CF attributes, and the grid mapping where the origin is known."""
    dataset = dataset.copy().assign_attrs(Conventions=CONVENTIONS)
    for name, attributes in _CF_ATTRIBUTES.items():
        if name in dataset.variables:
            dataset[name] = dataset[name].assign_attrs(attributes)
    latitude, longitude = (dataset.attrs.get(f"origin_{name}_deg")
                           for name in ("latitude", "longitude"))
    if latitude is None or longitude is None:
        return dataset
    from pyproj import CRS

    origin = Origin(latitude_deg=float(latitude), longitude_deg=float(longitude))
    dataset[GRID_MAPPING] = xr.Variable((), np.int32(0), CRS(local_crs(origin)).to_cf())
    for variable in dataset.data_vars:
        if variable != GRID_MAPPING:
            dataset[variable] = dataset[variable].assign_attrs(grid_mapping=GRID_MAPPING)
    return dataset


def _without_cf(dataset: xr.Dataset) -> xr.Dataset:
    """Remove the attributes that `_with_cf` adds."""
    dataset = dataset.drop_vars(GRID_MAPPING, errors="ignore")
    dataset.attrs.pop("Conventions", None)
    for name in dataset.variables:
        for key in ("grid_mapping", *_CF_ATTRIBUTES.get(str(name), ())):
            dataset[name].attrs.pop(key, None)
            dataset[name].encoding.pop(key, None)
    return dataset


def _problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why a dataset is not a radio map, or None."""
    for name in ("gain_db", "los", "sigma_db"):
        if name not in dataset.data_vars:
            if name == "sigma_db":
                continue
            return f"it lacks {name}; it has {list(dataset.data_vars)}"
        if dataset[name].dims != DIMS:
            return f"{name} has the dims {dataset[name].dims}, it needs {DIMS}"
        if dataset[name].dtype.kind not in ("biuf" if name == "los" else "iuf"):
            return f"{name} holds {dataset[name].dtype}, not numbers"
    for axis in DIMS:
        if axis not in dataset.coords or dataset.sizes[axis] == 0:
            return f"the coordinate {axis} is missing or empty"
    for axis in "xyz":
        values = dataset[axis].values
        if (values.dtype.kind not in "iuf" or not np.isfinite(values).all()
                or not (np.diff(values) > 0).all()):
            return f"the coordinate {axis} must hold finite numbers in ascending order [m]"
    names = dataset["device"].values.astype(str).tolist()
    if len(set(names)) < len(names):
        return f"two devices have one name in {names}"
    if np.isinf(dataset["gain_db"].values).any():
        return "gain_db is infinite somewhere; where nothing is detected it must be NaN"
    if dataset["los"].dtype != bool and not np.isin(dataset["los"].values, (0, 1)).all():
        return "los holds other values than 0 and 1"
    if "sigma_db" in dataset and (dataset["sigma_db"].values < 0).any():
        return "sigma_db is negative somewhere"
    return None
