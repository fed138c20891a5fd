"""What an import must be told, as its TOML file and the options of the command line hold it alike."""

import os
import tomllib
from pathlib import Path
from typing import Annotated, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from radiotwin.errors import BadInput

Spec = Annotated[str, Field(min_length=1)]
"""A column of the file, or `always VALUE`."""
Positive = Annotated[float, Field(gt=0)]
POSITION = ("latitude", "longitude", "altitude", "height", "x", "y", "z")


def check_position(given: set[str], prefix: str) -> None:
    """A position is latitude, longitude and one of altitude, height; or x, y and z. Raises ValueError."""
    for pair in (("latitude", "longitude"), ("x", "y")):
        if len(given & set(pair)) == 1:
            raise ValueError(f"{prefix}{pair[0]} and {prefix}{pair[1]} are given together or not at all")
    if {"latitude", "x"} <= given or len(given & {"altitude", "height", "z"}) > 1:
        raise ValueError(f"a position is either {prefix}latitude, {prefix}longitude with {prefix}altitude or "
                         f"{prefix}height, or {prefix}x, {prefix}y, {prefix}z; given are {sorted(given)}")


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Columns(_Table):
    """Quantity -> where it stands. Angles in degrees; `height` and `z` count from the scene's ground datum, `altitude`
    from wherever the altitude of the origin does."""

    level: Spec | None = None
    device: Spec | None = None
    receiver: Spec = "always receiver"
    flight: Spec = "always flight"
    time: Spec | None = None
    latitude: Spec | None = None
    longitude: Spec | None = None
    altitude: Spec | None = None
    height: Spec | None = None
    x: Spec | None = None
    y: Spec | None = None
    z: Spec | None = None
    device_latitude: Spec | None = None
    device_longitude: Spec | None = None
    device_altitude: Spec | None = None
    device_height: Spec | None = None
    device_x: Spec | None = None
    device_y: Spec | None = None
    device_z: Spec | None = None
    frequency_hz: Spec | None = None
    heading: Spec | None = None
    pitch: Spec | None = None
    roll: Spec | None = None
    quality: Spec | None = None

    @model_validator(mode="after")
    def _consistent(self):
        for prefix in ("", "device_"):
            check_position({name for name in POSITION if getattr(self, prefix + name)}, prefix)
        if self.device == "by position" and not (self.device_latitude or self.device_x):
            raise ValueError('device = "by position" needs the columns of the position: device_latitude and '
                             "device_longitude, or device_x and device_y")
        if self.flight == "by day" and not self.time:
            raise ValueError('flight = "by day" needs the column of the time: time = "..."')
        return self


class Wide(_Table):
    """Levels of several receivers or devices in one row: every column that fits `level` is one of them.

    `*` in `level` stands for any text; in the other values it stands for that same text, or for the whole name of the
    column where `level` has none.
    """

    level: Spec | list[Spec]
    receiver: Spec | None = None
    device: Spec | None = None
    latitude: Spec | None = None
    longitude: Spec | None = None
    altitude: Spec | None = None
    height: Spec | None = None
    x: Spec | None = None
    y: Spec | None = None
    z: Spec | None = None

    @model_validator(mode="after")
    def _consistent(self):
        if (self.receiver is None) == (self.device is None):
            raise ValueError('needs either receiver or device: what each column stands for, such as receiver = "*"')
        check_position({name for name in POSITION if getattr(self, name)}, "")
        return self


class Origin(_Table):
    """WGS84 position of the local frame's origin; `altitude_m` is the altitude of the scene's ground datum."""

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    altitude_m: float = 0.0


class Settings(_Table):
    """All that an import needs besides the file."""

    level_unit: Literal["dBm", "dB", "mW", "W"] | None = None
    length_unit: Literal["m", "ft"] | None = None
    time_format: str | None = Field(None, description="epoch s, epoch ms, ISO 8601, or as of strftime")
    time_zone: str | None = None
    not_detected: list[float | str] = Field([], description="levels that mean: not detected; `empty` is an empty cell")
    not_measured: list[float | str] = Field([], description="levels that mean: nobody listened; left out")
    not_detected_at_or_below: float | None = Field(None, description="in the file's unit")
    min_level: float | None = Field(None, description="[dBm, or dB for gains]")
    max_level: float | None = Field(None, description="[dBm, or dB for gains]")
    min_distance_m: float | None = Field(None, ge=0)
    max_distance_m: Positive | None = None
    average_m: Positive | None = Field(None, description="length of the bins of the local mean")
    average: Literal["power", "median"] = "power"
    crs: str | None = Field(None, description="of x and y, such as EPSG:32612; without one they are local")
    devices: str | None = Field(None, description="table of the devices' positions")
    receivers: str | None = Field(None, description="table of the fixed receivers' positions")
    origin: Origin | None = None
    columns: Columns = Columns()
    wide: list[Wide] = []

    @model_validator(mode="after")
    def _consistent(self):
        if not self.wide and not self.columns.level:
            raise ValueError('columns.level is missing: which column holds the level? Such as level = "rsrp"')
        if self.wide and self.columns.level:
            raise ValueError("columns.level and wide cannot both be given: the levels stand in one column or in many")
        if not self.columns.device and not (self.wide and all(block.device for block in self.wide)):
            raise ValueError('columns.device is missing: which device was heard? A column, "always NAME", or "by '
                             'position"')
        if self.average_m and self.columns.quality:
            raise ValueError("average_m writes the number of readings into quality; leave columns.quality out")
        for low, high in (("min_level", "max_level"), ("min_distance_m", "max_distance_m")):
            both = getattr(self, low), getattr(self, high)
            if None not in both and both[0] >= both[1]:
                raise ValueError(f"{low} = {both[0]:g} must be less than {high} = {both[1]:g}")
        return self


def parse_columns(text: str) -> dict[str, str]:
    """`latitude=lat,longitude=lon` as a dict; raises BadInput."""
    pairs = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (name and equals and value) or name in pairs:
            raise BadInput(f"{part!r} in {text!r} is not a new NAME=COLUMN; for example latitude=lat,longitude=lon, or "
                           "a file NAME.toml")
        pairs[name] = value
    return pairs


def read_settings(path: Path | str | None, given: dict) -> Settings:
    """Settings of a TOML file (tables named in it lie relative to it), overruled by those `given`; raises BadInput."""
    data = {}
    if path is not None:
        path = Path(path)
        try:
            data = tomllib.loads(path.read_text("utf-8"))
        except OSError as error:
            raise BadInput(f"{path} cannot be read: {error.strerror}; --columns takes a TOML file or pairs such as "
                           "latitude=lat,longitude=lon") from None
        except ValueError as error:
            raise BadInput(f"{path} is not TOML: {error}") from None
        for table in ("devices", "receivers"):
            if isinstance(data.get(table), str):
                data[table] = str(path.parent / data[table])
    try:
        return Settings.model_validate(data | given)
    except ValidationError as error:
        raise BadInput("\n".join(_explain(problem, path) for problem in error.errors())) from None


def _explain(problem: dict, path: Path | None) -> str:
    key = ".".join(str(part) for part in problem["loc"])
    reason = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "extra_forbidden":
        table = Columns if problem["loc"][0] == "columns" else Wide if problem["loc"][0] == "wide" else Settings
        reason = f"unknown; allowed are {', '.join(table.model_fields)}"
    elif problem["type"] != "value_error":
        reason = f"{problem['input']!r}: {reason}"
    return ": ".join(filter(None, [str(path or "the options"), key, reason]))


def write_settings(settings: Settings, path: Path, folder: Path) -> None:
    """Write `path`; the tables' paths become relative to `folder`, where the file will lie."""
    data = settings.model_dump(exclude_none=True, exclude_defaults=True)
    for table in ("devices", "receivers"):
        if table in data:
            data[table] = os.path.relpath(data[table], folder)
    with path.open("wb") as file:
        tomli_w.dump(data, file)
