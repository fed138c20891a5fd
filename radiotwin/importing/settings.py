"""What an import must be told, as its TOML file and the options of the command line hold it alike."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from radiotwin.tables import Number, Origin, Table

Spec = Annotated[str, Field(min_length=1)]
"""A column of the file, or `always VALUE`."""
Positive = Annotated[Number, Field(gt=0)]
POSITION = ("latitude", "longitude", "altitude", "height", "x", "y", "z")


def check_position(given: set[str], prefix: str) -> None:
    """A position is latitude, longitude or x, y, with one of altitude, height, z or none. Raises ValueError."""
    for pair in (("latitude", "longitude"), ("x", "y")):
        if len(given & set(pair)) == 1:
            raise ValueError(f"{prefix}{pair[0]} and {prefix}{pair[1]} are given together or not at all")
    if {"latitude", "x"} <= given or len(given & {"altitude", "height", "z"}) > 1:
        raise ValueError(f"a position is either {prefix}latitude, {prefix}longitude or {prefix}x, {prefix}y, with one "
                         f"of {prefix}altitude, {prefix}height, {prefix}z; given are {', '.join(sorted(given))}")


class Position(Table):
    """Where a quantity of a place stands."""

    latitude: Spec | None = None
    longitude: Spec | None = None
    altitude: Spec | None = None
    height: Spec | None = None
    x: Spec | None = None
    y: Spec | None = None
    z: Spec | None = None


class Columns(Position):
    """Quantity -> where it stands. Angles in degrees; `height` and `z` count from the scene's ground datum, `altitude`
    from wherever the altitude of the origin does."""

    level: Spec | None = None
    device: Spec | None = None
    receiver: Spec = "always receiver"
    flight: Spec = "always flight"
    time: Spec | None = None
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


class Wide(Position):
    """Levels of several receivers or devices in one row: every column that fits `level` is one of them.

    `*` in `level` stands for any text; in the other values it stands for that same text, or for the whole name of the
    column where `level` has none.
    """

    level: Spec | list[Spec]
    receiver: Spec | None = None
    device: Spec | None = None

    @model_validator(mode="after")
    def _consistent(self):
        if (self.receiver is None) == (self.device is None):
            raise ValueError('needs either receiver or device: what each column stands for, such as receiver = "*"')
        check_position({name for name in POSITION if getattr(self, name)}, "")
        return self


class Settings(Table):
    """All that an import needs besides the file."""

    level_unit: Literal["dBm", "dB", "mW", "W"] | None = None
    length_unit: Literal["m", "ft"] | None = None
    time_format: str | None = Field(None, description="epoch s, epoch ms, ISO 8601, or as of strftime")
    time_zone: str | None = None
    not_detected: list[Number | str] = Field([], description="levels that mean: not detected; `empty` is an empty cell")
    not_measured: list[Number | str] = Field([], description="levels that mean: nobody listened; left out")
    not_detected_at_or_below: Number | None = Field(None, description="in the file's unit")
    min_level: Number | None = Field(None, description="[dBm, or dB for gains]")
    max_level: Number | None = Field(None, description="[dBm, or dB for gains]")
    min_distance_m: Number | None = Field(None, ge=0)
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
