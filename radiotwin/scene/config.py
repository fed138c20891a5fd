"""`scene.toml`: radio, extent, lattice, devices, UAVs, mission; how it is read and checked."""

import os
import re
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from radiotwin.errors import BadInput
from radiotwin.geo import local_crs
from radiotwin.io.budgets import DEVICES, UAVS
from radiotwin.io.files import atomic_path
from radiotwin.io.forms import MAX_COORDINATE_M, Metres, Number, Origin, Table
from radiotwin.io.inputs import read_toml
from radiotwin.scene.lattice import check_lattice, positions
from radiotwin.scene.vegetation import VegetationConfig

ANTENNA_HEIGHT_M = 1.5  # of a device above the ground [m]: a person, a meter, a low pole
_MAX_MESSAGES = 10
# Names become parts of file names: none begins with a dot (hidden files, `.` and `..`).
Name = Annotated[str, Field(min_length=1, max_length=64,
                            pattern=r"^[A-Za-z0-9_+-][A-Za-z0-9_.+-]*$")]
Altitude = Annotated[Number, Field(gt=0, le=MAX_COORDINATE_M)]
Vertical = Literal["geoid", "ellipsoid", "unknown"]


def _file_below(name: str) -> str:
    """Return the name of a file; ValueError if it could mean a file outside the scene folder."""
    parts = PurePosixPath(name).parts
    if (not parts or ".." in parts or re.search(r"^/|[\\:]", name) or not name.isprintable()
            or len(name) > 255):
        raise ValueError("give the name of a file below the scene folder, such as "
                         "antennas/NAME.msi, without .., \\, : or control characters")
    return name


FileName = Annotated[str, AfterValidator(_file_below)]


class RadioConfig(Table):
    """The radio of all links."""

    frequency_hz: Number = 2.4e9
    bandwidth_hz: Number = Field(1e6, gt=0, le=450e9)
    tx_power_dbm: Number = Field(0.0, ge=-100, le=100)
    noise_dbm: Number = Field(-102.0, ge=-200, le=50)
    sensitivity_dbm: Number = Field(-120.0, ge=-250, le=50)
    snr_threshold_db: Number = Field(10.0, ge=-50, le=100)

    @field_validator("frequency_hz")
    @classmethod
    def _in_the_models_range(cls, frequency_hz: float) -> float:
        if not 1e6 <= frequency_hz <= 450e9:
            raise ValueError("allowed is 1e6 Hz to 450e9 Hz (1 MHz to 450 GHz); the unit is Hz")
        return frequency_hz

    @model_validator(mode="after")
    def _something_is_detected(self) -> "RadioConfig":
        """Check that the sensitivity lies below the transmit power; return the table."""
        if self.sensitivity_dbm >= self.tx_power_dbm:
            raise ValueError(
                f"sensitivity_dbm = {self.sensitivity_dbm:g} must lie below tx_power_dbm = "
                f"{self.tx_power_dbm:g}, or nothing is ever detected")
        return self

    @property
    def declares_power(self) -> bool:
        """Whether the transmit power differs from the default, which may just have been left."""
        return self.tx_power_dbm != type(self)().tx_power_dbm


class Extent(Table):
    """The rectangle that UAVs fly over and devices are searched in."""

    x_min_m: Metres
    x_max_m: Metres
    y_min_m: Metres
    y_max_m: Metres

    @model_validator(mode="after")
    def _not_empty(self) -> "Extent":
        if self.x_max_m <= self.x_min_m or self.y_max_m <= self.y_min_m:
            raise ValueError("x_max_m and y_max_m must be greater than x_min_m and y_min_m")
        return self

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(x_min, x_max, y_min, y_max) [m]."""
        return self.x_min_m, self.x_max_m, self.y_min_m, self.y_max_m


class LatticeConfig(Table):
    """Step and altitudes of the lattice over the extent."""

    step_m: Number = Field(20.0, ge=1e-6, le=MAX_COORDINATE_M)
    altitudes_m: list[Altitude] = Field(min_length=1)
    above: Literal["datum", "ground"] | None = Field(None, description=(
        "reference of all altitudes: z = 0 [datum], or the ground below each position"))

    @field_validator("altitudes_m")
    @classmethod
    def _unique(cls, altitudes_m: list[float]) -> list[float]:
        for altitude_m, count in Counter(altitudes_m).items():
            if count > 1:
                raise ValueError(f"{altitude_m:g} is listed twice; every altitude must be unique")
        return altitudes_m


class DeviceConfig(Table):
    """True position of a device; a survey reports only those of anchors."""

    device: Name
    x_m: Metres
    y_m: Metres
    z_m: Altitude = Field(ANTENNA_HEIGHT_M, description="above the datum z = 0")
    above_ground_m: Altitude | None = Field(None, description="instead of z_m; becomes z_m when a "
                                                              "scene is loaded")
    role: Literal["anchor", "unknown"] = "unknown"
    antenna: FileName | None = Field(None, description="file in the scene folder; None: isotropic")
    azimuth_deg: Number | None = Field(None, ge=-360, le=360,
                                       description="clockwise from north [0]")
    tilt_deg: Number | None = Field(None, ge=-90, le=90, description="upwards is positive [0]")
    data_units: Number | None = Field(None, gt=0, le=1e15, description="data waiting at it [that "
                                                                       "of the mission]")

    @model_validator(mode="after")
    def _one_height(self) -> "DeviceConfig":
        if self.above_ground_m is not None and "z_m" in self.model_fields_set:
            raise ValueError("z_m (above the datum) and above_ground_m are both given; give one")
        return self

    @model_validator(mode="after")
    def _isotropic_has_no_direction(self) -> "DeviceConfig":
        if self.antenna is None and (self.azimuth_deg is not None or self.tilt_deg is not None):
            raise ValueError("azimuth_deg and tilt_deg belong to an antenna; name its file: "
                             'antenna = "antennas/NAME.msi"')
        return self


class UavConfig(Table):
    """A UAV: flies at one altitude from start to terminal; a move takes 1 unit, hovering 0.5."""

    uav: Name
    altitude_m: Altitude
    start_x_m: Metres
    start_y_m: Metres
    terminal_x_m: Metres
    terminal_y_m: Metres
    battery: Number = Field(gt=0, le=100_000)
    antenna: FileName | None = Field(None, description="file in the scene folder; None: isotropic")


class MissionConfig(Table):
    """The data-harvesting mission of Chen et al., GLOBECOM Workshops 2023."""

    data_units: Number = Field(16_000.0, gt=0, le=1e15, description="data at each device that "
                                                                     "declares none")
    rate_scale: Number = Field(100.0, gt=0, le=1e15, description="data units per slot and bit/s/Hz")
    slot_s: Number = Field(2.0, gt=0, le=86_400, description="duration of one move or hover")


class TerrainConfig(Table):
    """The ground of a scene, declared in `scene.toml`; without it the ground is flat, at z = 0.

    Attributes:
        shape: name of the ground's shape in `city.xml`.
        source: file of the terrain heights.
        datum_m: height of z = 0 above the zero of `reference` [m].
        reference: name of the vertical reference of the file's heights.
        kind: kind of that reference: geoid, ellipsoid, or unknown.
    """

    shape: str = Field(min_length=1, max_length=200)
    source: str = Field("", max_length=300)
    datum_m: Number = Field(0.0, ge=-12_000, le=100_000)
    reference: str = Field("not declared", max_length=200)
    kind: Vertical = "unknown"


class SceneConfig(Table):
    """Content of `scene.toml`."""

    schema_: Literal["radiotwin.scene/1"] = Field("radiotwin.scene/1", alias="schema")
    name: Name
    radio: RadioConfig = RadioConfig()
    extent: Extent
    lattice: LatticeConfig
    origin: Origin | None = None
    crs: str | None = Field(None, description="PROJ string of the local frame, for other programs")
    devices: list[DeviceConfig] = []
    uavs: list[UavConfig] = []
    mission: MissionConfig = MissionConfig()
    vegetation: list[VegetationConfig] = []
    terrain: TerrainConfig | None = Field(None, description="None: flat ground at z = 0")
    provenance: dict[str, str] = {}

    model_config = ConfigDict(populate_by_name=True)

    @model_validator(mode="after")
    def _consistent(self) -> "SceneConfig":
        """Check what several tables must agree on: names, frame, lattice, antennas, positions."""
        for kind, names in (("device", [device.device for device in self.devices]),
                            ("uav", [uav.uav for uav in self.uavs])):
            if double := [name for name, count in Counter(names).items() if count > 1]:
                raise ValueError(f"{kind} {min(double)!r} is declared twice; every name must "
                                 "be unique")
        if self.crs is not None and (self.origin is None or self.crs != local_crs(self.origin)):
            remedy = f'crs = "{local_crs(self.origin)}"' if self.origin else "an [origin]"
            raise ValueError("crs is not that of the local frame about [origin]; remove it, or "
                             f"write {remedy}")
        check_lattice(*self.extent.bounds, self.lattice.step_m, self.lattice.altitudes_m)
        if len({uav.antenna for uav in self.uavs}) > 1:
            raise ValueError("uavs have different antennas; one radio map serves all of them, so "
                             "give all the same")
        x_min_m, x_max_m, y_min_m, y_max_m = self.extent.bounds
        for device in self.devices:
            if not (x_min_m <= device.x_m <= x_max_m and y_min_m <= device.y_m <= y_max_m):
                raise ValueError(
                    f"device {device.device!r} at ({device.x_m:g}, {device.y_m:g}) m lies outside "
                    f"the extent (x {x_min_m:g} to {x_max_m:g} m, y {y_min_m:g} to {y_max_m:g} m); "
                    "move it or widen the extent")
        altitudes_m = set(self.lattice.altitudes_m)
        for uav in self.uavs:
            if uav.altitude_m not in altitudes_m:
                known = str(self.lattice.altitudes_m[:10]).replace("]", ", …]" if len(
                    altitudes_m) > 10 else "]")
                raise ValueError(f"uav {uav.uav!r}: altitude_m = {uav.altitude_m:g} is not one of "
                                 f"lattice.altitudes_m = {known}")
            for end in ("start", "terminal"):
                self._check_on_lattice(uav, end)
        return self

    def _check_on_lattice(self, uav: UavConfig, end: str) -> None:
        """Raise ValueError if the start or terminal of a UAV is not on the lattice."""
        step_m = self.lattice.step_m
        for axis, low, high in (("x", self.extent.x_min_m, self.extent.x_max_m),
                                ("y", self.extent.y_min_m, self.extent.y_max_m)):
            value = getattr(uav, f"{end}_{axis}_m")
            last_m = low + (positions(low, high, step_m) - 1) * step_m
            steps = (value - low) / step_m
            if not low <= value <= last_m + 0.01 or abs(steps - round(steps)) * step_m > 0.01:
                raise ValueError(f"uav {uav.uav!r}: {end}_{axis}_m = {value:g} is not on the "
                                 f"lattice ({low:g} to {last_m:g} m in steps of {step_m:g} m)")

    @property
    def gain_limit_db(self) -> float:
        """Limit of detection: links with a lower gain are not detected [dB]."""
        return self.radio.sensitivity_dbm - self.radio.tx_power_dbm


_UNITS = {"m": "m", "hz": "Hz", "dbm": "dBm", "db": "dB", "deg": "degrees", "s": "s"}


def _explain(path: Path, error: ValidationError) -> str:
    """Format the errors of an invalid `scene.toml`: a line each with file, key, value, remedy."""
    lines = []
    problems = error.errors(include_url=False)
    for problem in problems[:_MAX_MESSAGES]:
        key = ".".join(str(part)[:60] for part in problem["loc"]) or "scene"
        reason = problem["msg"].removeprefix("Value error, ")
        unit = _UNITS.get(re.sub(r"\.\d+$", "", key).rpartition("_")[2], "")
        given = repr(problem["input"])
        if problem["type"].startswith(("greater_than", "less_than")) and unit:
            reason += f" {unit}"
        if problem["type"] == "extra_forbidden":
            lines.append(f"{path}: {key}: unknown key; remove it or correct its name")
        elif problem["type"] == "missing":
            lines.append(f"{path}: {key}: missing; add it")
        elif isinstance(problem["input"], dict | BaseModel):
            lines.append(f"{path}: {key}: {reason}")
        else:
            lines.append(f"{path}: {key} = {given[:80] + '…' * (len(given) > 80)}: {reason}")
    if len(problems) > _MAX_MESSAGES:
        lines.append(f"{path}: and {len(problems) - _MAX_MESSAGES} more such mistakes")
    return "\n".join(lines)


def parse_config(data: dict[str, Any], path: Path | str) -> SceneConfig:
    """Check the content of `scene.toml`, nested dictionaries as a TOML parser returns them.

    Raises:
        BadInput: An unknown key, an impossible value, or too many devices or UAVs; the message has
            path, key, value and what is allowed.
    """
    for name, budget in (("devices", DEVICES), ("uavs", UAVS)):
        if isinstance(data.get(name), list):
            budget.check(len(data[name]), path)
    try:
        return SceneConfig.model_validate(data)
    except BadInput as bad:  # a limit is exceeded
        raise BadInput(f"{path}: {bad}") from None
    except ValidationError as error:
        raise BadInput(_explain(Path(path), error)) from None


def read_config(path: Path | str) -> SceneConfig:
    """Read and check `scene.toml`.

    Raises:
        BadInput: No such file, not TOML, an unknown key or an impossible value.
    """
    path = Path(path)
    if not os.path.lexists(path):
        raise BadInput(f"{path} does not exist; `radiotwin build-scene` makes a scene folder")
    return parse_config(read_toml(path, "scene.toml"), path)


def write_config(config: SceneConfig, path: Path | str) -> None:
    """Write `scene.toml`, defaults included.

    Devices and UAVs become `[[devices]]` and `[[uavs]]` tables, so that more can be appended by
    hand; tomli_w alone would write each list as one array.
    """
    data = config.model_dump(by_alias=True, exclude_none=True)
    lists = {name: data.pop(name) for name in ("uavs", "devices")}
    parts = [tomli_w.dumps(data)]
    parts += [f"[[{name}]]\n{tomli_w.dumps(table)}" for name, tables in lists.items()
              for table in tables]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")
