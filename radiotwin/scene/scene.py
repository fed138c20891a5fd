"""`Scene`: a scene folder that was read and checked, with its 3D map, lattice and antennas."""

import hashlib
import os
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from radiotwin.display import Summarised, Summary, count, geo_data_frame, some
from radiotwin.errors import BadInput
from radiotwin.geo import origin_attributes, with_coordinates
from radiotwin.io.budgets import SHAPES
from radiotwin.io.files import atomic_folder
from radiotwin.io.forms import Origin
from radiotwin.io.inputs import is_within, open_input, read_bytes, require_within
from radiotwin.scene.antennas import Antenna, Pattern, read_pattern
from radiotwin.scene.citymap import GROUND_M, CityMap, shape_height_sds_m
from radiotwin.scene.config import (
    DeviceConfig,
    SceneConfig,
    UavConfig,
    read_config,
    write_config,
)
from radiotwin.scene.folder import SCENE_FILES, check_target, mesh_paths, read_city, write_city
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.streets import STREETS, read_streets
from radiotwin.scene.vegetation import Vegetation

if TYPE_CHECKING:
    import xarray as xr
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

LAYERS = ("buildings", "devices")
_BLOCK_BYTES = 2**20


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Summarised):
    """A scene folder that was read and checked.

    Attributes:
        folder: Path of the scene folder.
        config: Content of `scene.toml`.
    """

    folder: Path
    config: SceneConfig

    @classmethod
    def load(cls, folder: Path | str) -> "Scene":
        """Read a scene folder.

        Args:
            folder: As `radiotwin build-scene` makes it.

        Raises:
            BadInput: Not a scene folder, an impossible value, a device inside a building, or a file
                outside the folder.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise BadInput(f"{folder} is not a folder; give a scene folder, as "
                           "`radiotwin build-scene` makes it")
        for name in ("scene.toml", "city.xml"):
            require_within(folder, folder / name, str(folder))
        scene = cls(folder, read_config(folder / "scene.toml"))._with_datum_heights()
        scene._check_devices()
        # Report a broken file before any work.
        _ = scene.device_antennas, scene.uav_antenna, scene.streets_m
        return scene

    @classmethod
    def of(cls, given: "Scene | Path | str") -> "Scene":
        """Return a scene unchanged, or load it from the path of its folder.

        Raises:
            BadInput: Neither a scene nor a path, or as `load`.
        """
        if isinstance(given, Scene):
            return given
        if isinstance(given, str | os.PathLike):
            return cls.load(given)
        raise BadInput(f"a scene is needed, not {type(given).__name__}; pass the path of its "
                       "folder, or what Scene.load(folder) returns")

    def save(self, folder: Path | str) -> None:
        """Write a copy of the scene folder, with the configuration of this object.

        The preview and files of traces are not copied.

        Args:
            folder: Scene folder to write; a scene that is already in it is replaced.

        Raises:
            BadInput: The folder holds something else or this scene, or cannot be written.
        """
        folder = Path(folder)
        if is_within(self.folder, folder):
            raise BadInput(f"{folder} holds the scene itself, which the copy would replace; choose "
                           "another folder")
        check_target(folder, SCENE_FILES | {Path(name).parts[0] for name in self._antenna_files})
        with atomic_folder(folder) as temporary:
            write_city(temporary, read_city(self.xml_path))
            self.copy_antennas(temporary)
            write_config(self.config, temporary / "scene.toml")
            for name in ("buildings.csv", STREETS):
                self.copy(name, temporary)

    def plot(self, ax: "Axes | None" = None, *, geographic: bool | None = None) -> "Axes":
        """Draw buildings, vegetation, devices and the UAVs' starts from above.

        Args:
            ax: Axes of matplotlib to draw into; None: a new figure.
            geographic: Whether axes are longitude and latitude; None: if the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: Longitude and latitude are wanted and the scene has no origin.
        """
        from radiotwin.scene.plot import plot_scene

        return plot_scene(self, ax, geographic)

    def to_xarray(self, step_m: float = 1.0) -> "xr.Dataset":
        """Return the heights of the 3D map over the extent as a raster.

        Args:
            step_m: Width of a cell, above 0 [m].

        Returns:
            Variable `height_m` (y, x): height of the highest surface above z = 0 [m].
        """
        import xarray as xr

        if not step_m > 0:
            raise BadInput(f"step_m = {step_m:g} is not possible; give a length in metres, above 0")
        x_min, x_max, y_min, y_max = self.config.extent.bounds
        x_m, y_m = (np.arange(low + step_m / 2, high, step_m)
                    for low, high in ((x_min, x_max), (y_min, y_max)))
        attributes = {"name": self.config.name, **origin_attributes(self.config.origin)}
        height_m = self.city.height_at(*np.meshgrid(x_m, y_m)).astype(np.float32)
        units = {"units": "m"}
        return xr.Dataset(
            {"height_m": (("y", "x"), height_m,
                          units | {"long_name": "highest surface above the ground datum"})},
            {"y": ("y", y_m, units | {"long_name": "north"}),
             "x": ("x", x_m, units | {"long_name": "east"})}, attributes)

    def to_geodataframe(self, layer: str = "buildings") -> "GeoDataFrame":
        """Return buildings or devices as rows with a geometry, in metres of the local frame.

        Args:
            layer: `buildings` (columns `building`, `material`, `height_m`: largest height above
                the ground below, and the outline; without the ground) or `devices`.

        Raises:
            BadInput: GeoPandas is not installed, or another layer.
        """
        import shapely

        if layer not in LAYERS:
            raise BadInput(f"layer {layer!r} is unknown; allowed are {', '.join(LAYERS)}")
        if layer == "devices":
            table = self.devices[["device", "role", "x_m", "y_m", "z_m"]]
            return geo_data_frame(table, self.config.origin, position_m=self.device_m)
        terrain = self.config.terrain
        found, outlines = [], []
        for shape in read_city(self.xml_path):
            corners_m = shape.mesh.vertices[shape.mesh.faces]
            x_m, y_m, z_m = shape.mesh.vertices[np.unique(shape.mesh.faces)].T
            ground_m = 0.0 if terrain is None else self.city.ground_height_m(x_m, y_m)
            height_m = float((z_m - ground_m).max())
            if height_m < GROUND_M or terrain is not None and shape.name == terrain.shape:
                continue
            flat = np.asarray(shapely.polygons(corners_m[..., :2]))
            outlines.append(shapely.union_all(flat[shapely.area(flat) > 0], grid_size=1e-3))
            found.append((shape.name, shape.material.name, height_m))
        table = pd.DataFrame(found, columns=["building", "material", "height_m"])
        return geo_data_frame(table, self.config.origin, geometry=np.array(outlines, dtype=object))

    def __len__(self) -> int:
        """Return the number of declared devices."""
        return len(self.config.devices)

    def __getstate__(self) -> dict[str, object]:
        """Pickle folder and configuration: the 3D map is read again from the folder when needed."""
        return {"folder": Path(os.path.abspath(self.folder)), "config": self.config}

    @property
    def _summary(self) -> Summary:
        """Return the facts that are shown when a scene is printed."""
        config, (x_min, x_max, y_min, y_max) = self.config, self.config.extent.bounds
        anchors = sum(device.role == "anchor" for device in config.devices)
        size = f"{x_max - x_min:g} × {y_max - y_min:g} m"
        frequency = f"{config.radio.frequency_hz / 1e9:g} GHz"
        devices, uavs = count(len(self), "device"), count(len(config.uavs), "UAV")
        origin = config.origin
        place = "not known" if origin is None else (
            f"latitude {origin.latitude_deg:g}°, longitude {origin.longitude_deg:g}°")
        return Summary("Scene", f"{config.name}, {size}, {devices}, {uavs}, {frequency}", (
            ("folder", str(self.folder)), ("extent", size), ("origin", place),
            ("frequency", frequency), ("sensitivity", f"{config.radio.sensitivity_dbm:g} dBm"),
            ("devices", f"{devices}, {count(anchors, 'anchor')}"), ("UAVs", uavs),
            ("altitudes", some(f"{z:g}" for z in config.lattice.altitudes_m) + " m"),
            ("lattice step", f"{config.lattice.step_m:g} m")))

    def _with_datum_heights(self) -> "Scene":
        """Return the scene with the heights of its devices above the datum instead of the ground.

        On terrain, a device without a declared height is `ANTENNA_HEIGHT_M` above the ground.
        """
        if self.config.terrain is None and all(device.above_ground_m is None
                                               for device in self.config.devices):
            return self
        above_m = [device.above_ground_m if device.above_ground_m is not None else
                   None if "z_m" in device.model_fields_set else device.z_m
                   for device in self.config.devices]
        ground_m = self.city.ground_height_m(*np.array(
            [(device.x_m, device.y_m) for device in self.config.devices]).reshape(-1, 2).T)
        devices = [device if height_m is None else device.model_copy(update={
                       "z_m": round(float(low_m) + height_m, 3), "above_ground_m": None})
                   for device, height_m, low_m in zip(self.config.devices, above_m, ground_m)]
        scene = Scene(self.folder, self.config.model_copy(update={"devices": devices}))
        scene.__dict__["city"] = self.city
        return scene

    @property
    def origin(self) -> Origin | None:
        """WGS84 origin of the local frame; None: not known."""
        return self.config.origin

    @property
    def devices(self) -> pd.DataFrame:
        """Declared devices: `device, role, x_m, y_m, z_m`, and latitude and longitude if known."""
        named = [(device.device, device.role) for device in self.config.devices]
        return with_coordinates(pd.DataFrame(named, columns=["device", "role"]), self.device_m,
                           self.origin)

    @property
    def xml_path(self) -> Path:
        """Path of `city.xml`."""
        return self.folder / "city.xml"

    @cached_property
    def city(self) -> CityMap:
        """3D map of the city, with vegetation, terrain and standard deviations of heights."""
        terrain = self.config.terrain
        return CityMap.from_xml(self.xml_path, Vegetation.of(self.config.vegetation),
                                None if terrain is None else terrain.shape,
                                shape_height_sds_m(self.folder))

    @cached_property
    def lattice(self) -> Lattice:
        """Positions that UAVs fly on: at altitudes above the datum, or following the terrain."""
        declared = self.config.lattice
        lattice = Lattice.over(*self.config.extent.bounds, declared.step_m, declared.altitudes_m)
        if declared.above != "ground" or self.city.terrain is None:
            return lattice
        return replace(lattice, ground_m=self.city.ground_height_m(
            *np.meshgrid(lattice.x_m, lattice.y_m)))

    def altitude_m(self, x_m: float, y_m: float, declared_m: float) -> float:
        """Return the height above the datum z = 0 of a declared altitude at x and y [m].

        If the scene's lattice counts altitudes from the ground, the ground's height is added.
        """
        if self.config.lattice.above != "ground":
            return declared_m
        return float(self.city.ground_height_m(x_m, y_m)) + declared_m

    @cached_property
    def streets_m(self) -> list[np.ndarray]:
        """(n, 2) x and y of each street, for pictures [m]."""
        return read_streets(self.folder, self.config.origin)

    @cached_property
    def device_m(self) -> np.ndarray:
        """(k, 3) true positions of the declared devices [m]."""
        positions = [(device.x_m, device.y_m, device.z_m) for device in self.config.devices]
        return np.array(positions, dtype=float).reshape(-1, 3)

    @cached_property
    def blocked(self) -> np.ndarray:
        """(nz, ny, nx) bool: lattice positions inside a building, where no UAV can be."""
        return self.city.inside(self.lattice.positions_m).reshape(self.lattice.shape)

    @cached_property
    def device_antennas(self) -> list[Antenna | None]:
        """Antenna of each declared device; None: isotropic."""
        pattern = cache(self._pattern)  # devices may share a file
        return [None if device.antenna is None else
                Antenna(pattern(device.antenna), device.azimuth_deg or 0.0, device.tilt_deg or 0.0)
                for device in self.config.devices]

    @cached_property
    def uav_antenna(self) -> Antenna | None:
        """Antenna of all UAVs, averaged over all headings; None: isotropic."""
        names = {uav.antenna for uav in self.config.uavs if uav.antenna is not None}
        return Antenna(self._pattern(names.pop()).heading_mean()) if names else None

    @property
    def has_antennas(self) -> bool:
        """Whether the antenna of any device or UAV is declared."""
        return bool(self._antenna_files)

    @property
    def _antenna_files(self) -> set[str]:
        """Names of the antenna files of all devices and UAVs."""
        ends: list[DeviceConfig | UavConfig] = [*self.config.devices, *self.config.uavs]
        return {end.antenna for end in ends if end.antenna is not None}

    @property
    def files(self) -> list[Path]:
        """Paths of the files and folders that a scene folder consists of."""
        return [self.folder / name for name in sorted(SCENE_FILES | self._antenna_files)]

    def copy_antennas(self, folder: Path) -> None:
        """Copy the files of all antennas into another scene folder, under the same names.

        Raises:
            BadInput: A file outside the scene folder, or one that cannot be read.
        """
        for name in sorted(self._antenna_files):
            data = read_bytes(self._antenna_path(name), "antenna pattern")
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)

    def copy(self, name: str, folder: Path) -> None:
        """Copy a file of the scene folder, if there is one, into another folder.

        Raises:
            BadInput: A file outside the scene folder, or one that cannot be read.
        """
        if (self.folder / name).is_file():
            path = require_within(self.folder, self.folder / name, str(self.folder))
            (folder / name).write_bytes(read_bytes(path, "file of a scene"))

    def _antenna_path(self, name: str) -> Path:
        """Return the path of an antenna file; BadInput if it lies outside the folder."""
        return require_within(self.folder, self.folder / name, str(self.folder / "scene.toml"))

    def _pattern(self, name: str) -> Pattern:
        """Read the antenna pattern of a file in the scene folder."""
        return read_pattern(self._antenna_path(name))

    def _check_devices(self) -> None:
        """Raise BadInput if a device, or a start or end of a flight, is indoors or underground."""
        path = self.folder / "scene.toml"
        for device, where in zip(self.config.devices, self.city.misplaced(self.device_m)):
            if not where:
                continue
            if where == "on a surface":
                reason = ("on a surface of the city, from where rays would begin on either side of "
                          "it; move it 0.01 m or more off the wall, roof or ground")
            elif where == "below the ground":
                ground_m = float(self.city.ground_height_m(device.x_m, device.y_m))
                reason = (f"below the ground, which is {ground_m:.1f} m above the datum there; z_m "
                          "counts from the datum: raise it, or give above_ground_m instead")
            else:
                top_m = float(self.city.height_at(device.x_m, device.y_m))
                reason = (f"inside a building {top_m:.1f} m high; move it, or put it on the roof "
                          f"(z_m > {top_m:.1f})")
            raise BadInput(f"{path}: device {device.device!r} at ({device.x_m:g}, {device.y_m:g}, "
                           f"{device.z_m:g}) m is {reason}")
        ends = [(uav, end, (x_m, y_m, self.altitude_m(x_m, y_m, uav.altitude_m)))
                for uav in self.config.uavs
                for end, x_m, y_m in (("start", uav.start_x_m, uav.start_y_m),
                                      ("terminal", uav.terminal_x_m, uav.terminal_y_m))]
        points_m = np.array([point_m for *_, point_m in ends], dtype=float).reshape(-1, 3)
        for (uav, end, (x_m, y_m, z_m)), where in zip(ends, self.city.misplaced(points_m)):
            if where:
                raise BadInput(f"{path}: uav {uav.uav!r}: its {end} ({x_m:g}, {y_m:g}, {z_m:g}) m "
                               f"is {where}; move it or raise altitude_m")

    def content_hash(self) -> str:
        """Return the SHA-256 of everything that a traced map depends on.

        This is geometry, materials, frequency, power, sensitivity, devices and antennas.

        Raises:
            BadInput: A mesh outside the folder, or one that cannot be read.
        """
        digest = hashlib.sha256()
        meshes = sorted(path for path in self.folder.glob("meshes/*") if path.is_file())
        SHAPES.check(len(meshes), self.folder / "meshes")
        in_meshes = {path.resolve() for path in meshes}
        elsewhere = sorted(path for path in mesh_paths(self.xml_path)
                           if path.resolve() not in in_meshes)
        for path in (self.xml_path, *meshes, *elsewhere):
            require_within(self.folder, path, str(self.folder))
            name = os.path.relpath(path, self.folder) if path in elsewhere else path.name
            digest.update(os.fsencode(name) + b"\0")
            with open_input(path, "mesh") as file:
                while block := file.read(_BLOCK_BYTES):
                    digest.update(block)
        radio = self.config.radio
        digest.update(f"{radio.frequency_hz!r},{radio.tx_power_dbm!r},"
                      f"{radio.sensitivity_dbm!r};".encode())
        for device in self.config.devices:
            digest.update(f"{device.device},{device.x_m!r},{device.y_m!r},"
                          f"{device.z_m!r};".encode())
        for number, antenna in enumerate((*self.device_antennas, self.uav_antenna)):
            if antenna is not None:
                digest.update(f"{number},{antenna.azimuth_deg!r},{antenna.tilt_deg!r};".encode())
                digest.update(np.ascontiguousarray(antenna.pattern.gain_dbi).tobytes())
        return digest.hexdigest()
