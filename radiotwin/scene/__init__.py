"""A scene: a declared world in a folder (`scene.toml`, `city.xml`, `meshes/*.ply`)."""

import hashlib
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from radiotwin.antennas import Antenna, Pattern, read_pattern
from radiotwin.errors import BadInput
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import DeviceConfig, SceneConfig, UavConfig, read_config
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.own_files import require_within


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene folder that was read and checked.

    Attributes:
        folder: where it lies.
        config: the content of `scene.toml`.
    """

    folder: Path
    config: SceneConfig

    @classmethod
    def load(cls, folder: Path | str) -> "Scene":
        """Read a scene folder.

        Raises:
            BadInput: not a scene folder, an impossible value, a device inside a building, or a file that leads out of
                the folder.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise BadInput(f"{folder} is not a folder; give a scene folder, as `radiotwin build-scene` makes it")
        for name in ("scene.toml", "city.xml"):
            require_within(folder, folder / name, str(folder))
        scene = cls(folder, read_config(folder / "scene.toml"))
        scene.check_devices()
        scene.device_antennas, scene.uav_antenna  # read now: a broken file is said before any work
        return scene

    @property
    def xml_path(self) -> Path:
        return self.folder / "city.xml"

    @cached_property
    def city(self) -> CityMap:
        return CityMap.from_xml(self.xml_path)

    @cached_property
    def lattice(self) -> Lattice:
        return Lattice.over(*self.config.extent.bounds, self.config.lattice.step_m,
                            self.config.lattice.altitudes_m)

    @cached_property
    def device_m(self) -> np.ndarray:
        """(k, 3) true positions of the declared devices [m]."""
        return np.array([(d.x_m, d.y_m, d.z_m) for d in self.config.devices], dtype=float).reshape(-1, 3)

    @cached_property
    def blocked(self) -> np.ndarray:
        """(nz, ny, nx) bool: lattice positions inside a building, where no UAV can be."""
        return self.city.inside(self.lattice.positions_m).reshape(self.lattice.shape)

    @cached_property
    def device_antennas(self) -> list[Antenna | None]:
        """Antenna of each declared device; None: isotropic."""
        return [None if device.antenna is None else
                Antenna(self._pattern(device.antenna), device.azimuth_deg or 0.0, device.tilt_deg or 0.0)
                for device in self.config.devices]

    @cached_property
    def uav_antenna(self) -> Antenna | None:
        """Antenna of all UAVs, the mean over the headings that they may have; None: isotropic."""
        names = {uav.antenna for uav in self.config.uavs if uav.antenna is not None}
        return Antenna(self._pattern(names.pop()).heading_mean()) if names else None

    def copy_antennas(self, folder: Path) -> None:
        """Copy the files of all antennas into another scene folder, to where `scene.toml` looks for them."""
        ends: list[DeviceConfig | UavConfig] = [*self.config.devices, *self.config.uavs]
        for name in sorted({end.antenna for end in ends if end.antenna is not None}):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.folder / name, folder / name)

    def _pattern(self, name: str) -> Pattern:
        return read_pattern(require_within(self.folder, self.folder / name, str(self.folder / "scene.toml")))

    def check_devices(self) -> None:
        """Raise BadInput when a device is inside a building, or a UAV starts or ends in one."""
        path = self.folder / "scene.toml"
        for device, bad in zip(self.config.devices, self.city.inside(self.device_m)):
            if bad:
                top_m = float(self.city.height_at(device.x_m, device.y_m))
                raise BadInput(
                    f"{path}: device {device.device!r} at ({device.x_m:g}, {device.y_m:g}, {device.z_m:g}) m is "
                    f"inside a building {top_m:.1f} m high; move it, or put it on the roof (z_m > {top_m:.1f})")
        for uav in self.config.uavs:
            for end, x_m, y_m in (("start", uav.start_x_m, uav.start_y_m),
                                  ("terminal", uav.terminal_x_m, uav.terminal_y_m)):
                if self.city.inside(np.array([[x_m, y_m, uav.altitude_m]]))[0]:
                    raise BadInput(f"{path}: uav {uav.uav!r}: its {end} ({x_m:g}, {y_m:g}, {uav.altitude_m:g}) m "
                                   "is inside a building; move it or raise altitude_m")

    def check_map(self, radio_map) -> None:
        """Raise BadInput unless a `RadioMap` was made for this scene as it is now, with all its devices."""
        attributes = radio_map.dataset.attrs
        names = [device.device for device in self.config.devices]
        missing = [name for name in names if name not in radio_map.devices]
        if missing or not self.over_lattice(radio_map) or attributes.get("scene_hash") != self.content_hash():
            what = f"it lacks device {missing[0]!r}" if missing else "geometry, radio, devices or lattice differ"
            raise BadInput(f"the radio map was not made for the scene as it is now in {self.folder} ({what}); run "
                           "`radiotwin trace` again")

    def over_lattice(self, radio_map) -> bool:
        """Whether a `RadioMap` is over this scene's lattice."""
        return radio_map.gain_db.shape[1:] == self.lattice.shape and \
            np.allclose(radio_map.lattice.positions_m, self.lattice.positions_m)

    def content_hash(self) -> str:
        """SHA-256 over what decides a gain map: geometry, materials, frequency, sensitivity, devices and antennas."""
        digest = hashlib.sha256()
        for path in (self.xml_path, *sorted(path for path in self.folder.glob("meshes/*") if path.is_file())):
            require_within(self.folder, path, str(self.folder))
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
        radio = self.config.radio
        digest.update(f"{radio.frequency_hz!r},{radio.tx_power_dbm!r},{radio.sensitivity_dbm!r};".encode())
        for device in self.config.devices:
            digest.update(f"{device.device},{device.x_m!r},{device.y_m!r},{device.z_m!r};".encode())
        for number, antenna in enumerate((*self.device_antennas, self.uav_antenna)):
            if antenna is not None:
                digest.update(f"{number},{antenna.azimuth_deg!r},{antenna.tilt_deg!r};".encode())
                digest.update(np.ascontiguousarray(antenna.pattern.gain_dbi).tobytes())
        return digest.hexdigest()
