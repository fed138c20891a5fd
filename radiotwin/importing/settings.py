"""Settings of an import, in a TOML file and in the options of the command line."""

import codecs
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tomli_w
from pydantic import (
    AliasChoices,
    BaseModel,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from radiotwin.errors import BadInput
from radiotwin.io.cells import listed
from radiotwin.io.forms import Number, Origin, Table
from radiotwin.io.inputs import is_within, read_toml

Spec = Annotated[str, Field(min_length=1)]
"""Name of a column of the file, or `always VALUE` for a constant."""
Positive = Annotated[Number, Field(gt=0)]
_NO_TEXTS = ("idna", "punycode", "unicode_escape", "raw_unicode_escape", "undefined")
"""Codecs of names and of source code: none is the encoding of a file."""
DELIMITERS = (",", ";", "\t", "|")
BLANKS = ("  ", " ")
"""Separators of two and more blanks, and of any number of them."""
BY_DAY, BY_FILE, BY_POSITION = "by day", "by file", "by position"
POSITION = ("latitude", "longitude", "altitude", "height", "x", "y", "z")
ABOVE_GROUND = "above_ground"  # in place of a height of `POSITION`, which no frame can convert
HEIGHTS = ("altitude", "height", "z", ABOVE_GROUND)
QUANTITIES = (*POSITION, ABOVE_GROUND)


def check_position(given: set[str], prefix: str) -> None:
    """Raise ValueError unless a position is whole: latitude, longitude or x, y; one height."""
    for pair in (("latitude", "longitude"), ("x", "y")):
        if len(given & set(pair)) == 1:
            raise ValueError(f"{prefix}{pair[0]} and {prefix}{pair[1]} are given together or not "
                             "at all")
    if {"latitude", "x"} <= given or len(given & set(HEIGHTS)) > 1:
        raise ValueError(f"a position is either {prefix}latitude, {prefix}longitude or {prefix}x, "
                         f"{prefix}y, with one of {', '.join(prefix + name for name in HEIGHTS)}; "
                         f"given are {', '.join(sorted(given))}")


class Position(Table):
    """Columns of a position."""

    latitude: Spec | None = None
    longitude: Spec | None = None
    altitude: Spec | None = None
    height: Spec | None = None
    x: Spec | None = None
    y: Spec | None = None
    z: Spec | None = None
    above_ground: Spec | None = None


class Columns(Position):
    """Columns of all quantities; angles in degrees.

    `height` and `z` are above the scene's ground datum, `altitude` is above the same zero as the
    altitude of the origin, `above_ground` above the terrain below.
    """

    level: Spec | None = None
    device: Spec | None = None
    receiver: Spec = "always receiver"
    flight: Spec | None = None
    time: Spec | None = None
    device_latitude: Spec | None = None
    device_longitude: Spec | None = None
    device_altitude: Spec | None = None
    device_height: Spec | None = None
    device_x: Spec | None = None
    device_y: Spec | None = None
    device_z: Spec | None = None
    device_above_ground: Spec | None = None
    frequency_hz: Spec | None = None
    heading: Spec | None = None
    pitch: Spec | None = None
    roll: Spec | None = None
    quality: Spec | None = None
    snr: Spec | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Raise ValueError about columns that are incomplete, or contradict each other."""
        for prefix in ("", "device_"):
            check_position({name for name in QUANTITIES if getattr(self, prefix + name)}, prefix)
        if self.device == "by position" and not (self.device_latitude or self.device_x):
            raise ValueError('device = "by position" needs the columns of the position: '
                             "device_latitude and device_longitude, or device_x and device_y")
        if self.flight == "by day" and not self.time:
            raise ValueError('flight = "by day" needs the column of the time: time = "..."')
        return self


class Wide(Position):
    """Columns with the levels of several receivers or devices in one row.

    Every column that matches `level` has levels. `*` in `level` matches any text; in the other
    values it is replaced by that text, or by the column's name if `level` has no `*`.
    """

    level: Spec | list[Spec]
    receiver: Spec | None = None
    device: Spec | None = None
    level_offset_db: Number = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Raise ValueError unless one of receiver and device is given, and a position is whole."""
        if (self.receiver is None) == (self.device is None):
            raise ValueError("needs either receiver or device: the name that belongs to each "
                             'column, such as receiver = "*"')
        check_position({name for name in QUANTITIES if getattr(self, name)}, "")
        return self


class TrackFile(Table):
    """Positions of a receiver over time."""

    file: Spec
    receiver: Spec | None = None
    topic: Spec | None = Field(None, description="of a ROS bag with several")
    columns: dict[str, Spec] = Field({}, description="time, latitude, … -> column, of a table")
    time_format: str | None = Field(None, max_length=200, description="of a table")
    time_zone: str | None = Field(None, description="of a table whose times have no offset")
    length_unit: Literal["m", "ft"] | None = Field(None, description="of a table; metres")
    time_offset_s: Number = 0.0


class Settings(Table):
    """Settings of an import.

    The lines and marks of a text are found in each file where they are not declared.
    """

    format: str | None = Field(None, max_length=50, description="name of a known format")
    encoding: str | None = Field(None, max_length=50)
    delimiter: Literal[",", ";", "\t", "|", " ", "  "] | None = Field(
        None, description="a blank is any number of them, two are two and more")
    decimal: Literal[".", ","] | None = None
    quotes: bool = Field(True, description="whether quotation marks of a text hold a field "
                                           "together; else they are letters")
    sheet: str | None = Field(None, max_length=200, description="of a workbook; the first one")
    list_name: str | None = Field(
        None, max_length=200, validation_alias=AliasChoices("list_name", "list"),
        description="of JSON, the list whose objects are rows")
    header: list[Spec] = Field([], max_length=5000, description="names of the columns of a text "
                                                                "without a header")
    lines_before_header: int | None = Field(None, ge=0, le=100)
    lines_after_table: int | None = Field(None, ge=0, le=10_000)
    skip_bad_rows: int = Field(
        0, ge=0, le=1_000_000, description="rows that cannot be read are left out, if they are not "
                                           "more in all files")
    only: dict[Spec, list[Number | str]] = Field(
        {}, description="column -> texts of the rows that are kept")
    band_hz: Annotated[list[Positive], Field(min_length=2, max_length=2)] | None = Field(
        None, description="edges of the band whose power counts, of a spectrum scan")
    level_unit: Literal["dBm", "dB", "mW", "W"] | None = None
    path_loss: bool = Field(False, description="levels are path losses, positive [dB]")
    level_offset_db: Number = Field(0.0, description="added to each level")
    read_at: Literal["receiver", "device"] = Field(
        "receiver", description="which end reads the levels: of a node that sends to gateways, "
                                "which are the devices, these do")
    length_unit: Literal["m", "ft"] | None = None
    time_format: str | None = Field(
        None, max_length=200,
        description="epoch s, epoch ms, ISO 8601, or a strftime format")
    time_zone: str | None = None
    not_detected: list[Number | str] = Field(
        [], description="levels that mean: not detected; `empty` is an empty cell")
    not_measured: list[Number | str] = Field(
        [], description="levels that mean: the receiver did not listen; left out")
    not_detected_at_or_below: Number | None = Field(None, description="in the file's unit")
    min_level: Number | None = Field(None, description="[dBm, or dB for gains]")
    max_level: Number | None = Field(None, description="[dBm, or dB for gains]")
    min_distance_m: Number | None = Field(None, ge=0)
    max_distance_m: Positive | None = None
    thin_m: Positive | None = Field(None, description="of a stay within it one reading is kept")
    place_m: Positive | None = Field(None, description="between the places of a device")
    average_m: Positive | None = Field(None, description="length of the bins of the local mean")
    average: Literal["power", "median"] = "power"
    crs: str | None = Field(
        None, max_length=10_000,
        description="of x and y, such as EPSG:32612; without one they are local")
    devices: str | None = Field(None, description="table of the devices' positions")
    receivers: str | None = Field(None, description="table of the fixed receivers' positions")
    track: list[TrackFile] = Field([], description="positions over time; of all receivers, or one")
    track_max_gap_s: Positive = Field(
        5.0, description="largest time between two positions of a track that are interpolated")
    origin: Origin | None = None
    columns: Columns = Columns()
    wide: list[Wide] = []

    @model_validator(mode="before")
    @classmethod
    def _losses_are_in_db(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("path_loss") and data.get("level_unit") is None:
            return {**data, "level_unit": "dB"}
        return data

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Raise ValueError about settings that contradict each other."""
        if self.wide and self.columns.level:
            raise ValueError("columns.level and wide cannot both be given: the levels are in one "
                             "column or in many")
        if self.average_m and self.columns.quality:
            raise ValueError("average_m writes the number of readings into quality; leave "
                             "columns.quality out")
        if self.path_loss and self.level_unit not in (None, "dB"):
            raise ValueError(f"path_loss is in dB; leave level_unit = {self.level_unit} out")
        if self.band_hz and self.band_hz[0] >= self.band_hz[1]:
            raise ValueError("band_hz: give the lower edge first, such as [433.05e6, 434.79e6]")
        for low, high in (("min_level", "max_level"), ("min_distance_m", "max_distance_m")):
            both = getattr(self, low), getattr(self, high)
            if None not in both and both[0] >= both[1]:
                raise ValueError(f"{low} = {both[0]:g} must be less than {high} = {both[1]:g}")
        return self

    @field_validator("encoding")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        """Return the name of a text encoding; ValueError if Python has no such encoding."""
        try:
            if name is not None:
                codecs.getincrementaldecoder(name)
                "a".encode(name)  # of some names are no texts
                bytes(range(256)).decode(name, "replace")
                if codecs.lookup(name).name.replace("-", "_") in _NO_TEXTS:
                    raise LookupError
        except (LookupError, ValueError):
            raise ValueError("unknown; allowed are utf-8, utf-16, cp1252, latin-1 and other names "
                             "that Python knows") from None
        return name

    def require_columns(self, source: str, header: Iterable[str]) -> None:
        """Raise BadInput unless columns of levels and of devices are declared."""
        missing = []
        if not self.wide and not self.columns.level:
            missing += ["columns.level is missing: which column holds the level? For example "
                        'level = "rsrp"']
        wide_devices = self.wide and all(block.device for block in self.wide)
        if not self.columns.device and not wide_devices:
            missing += ["columns.device is missing: which device was heard? A column, "
                        '"always NAME", or "by position"']
        if missing:
            raise BadInput(f"{source}: {'; '.join(missing)}. The file has {listed(header)}")


def parse_columns(text: str) -> dict[str, str]:
    """Parse pairs such as `latitude=lat,longitude=lon`; BadInput if one is no pair, or repeated."""
    pairs: dict[str, str] = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (name and equals and value) or name in pairs:
            raise BadInput(f"{part!r} in {text!r} is not a new NAME=COLUMN; for example "
                           "latitude=lat,longitude=lon, or a file NAME.toml")
        pairs[name] = value
    return pairs


def read_settings(path: Path | str | None, given: Mapping[str, Any],
                  data_folder: Path | None = None) -> Settings:
    """Read the settings of an import.

    Args:
        path: TOML file; paths in it are relative to it. None: no file.
        given: fields of `Settings`, which replace those of the file.
        data_folder: of the file to import. Tables that the settings name must be there, in the
            settings' folder, or in the current folder.

    Raises:
        BadInput: not readable, not TOML, values that are not allowed, or a table elsewhere.
    """
    data: dict[str, Any] = {}
    if path is not None:
        path = Path(path)
        data = read_toml(path, "TOML file, or pairs such as latitude=lat,longitude=lon")
        for table in ("devices", "receivers"):
            if isinstance(data.get(table), str) and table not in given:
                data[table] = str(_table_of(path, data[table], data_folder))
        tracks = data.get("track")
        for track in tracks if isinstance(tracks, list) and "track" not in given else []:
            if isinstance(track, dict) and isinstance(track.get("file"), str):
                track["file"] = str(_table_of(path, track["file"], data_folder))
    try:
        return Settings.model_validate(data | dict(given))
    except ValidationError as error:
        # Pydantic reports each type of a union that it tried; the first report of a key is kept.
        lines = {_key(problem): _message(problem, _source_of(problem, path, given))
                 for problem in reversed(error.errors())}
        raise BadInput("\n".join(reversed(lines.values()))) from None


def merged(settings: Settings, defaults: Mapping[str, Any]) -> Settings:
    """Fill in defaults for settings that are not declared.

    If any coordinate of a position is declared, no default coordinate of it is used; likewise for
    heights.

    Raises:
        BadInput: the combination is not allowed.
    """
    given = settings.model_dump(exclude_unset=True, exclude_none=True)
    columns = dict(defaults.get("columns", {}))
    declared = set(given.get("columns", {}))
    for prefix in ("", "device_"):
        for group in (("latitude", "longitude", "x", "y"), HEIGHTS):
            names = {prefix + name for name in group}
            if declared & names:
                columns = {name: spec for name, spec in columns.items() if name not in names}
    data = {**defaults, **given, "columns": columns | given.get("columns", {})}
    try:
        return Settings.model_validate(data)
    except ValidationError as error:
        raise BadInput("\n".join(_message(problem, None) for problem in error.errors())) from None


def _table_of(settings: Path, name: str, data_folder: Path | None) -> Path:
    """Return the path of a table that a settings file names; BadInput outside known folders."""
    path = settings.parent / name
    if not is_within(path, settings.parent, Path.cwd(), data_folder or Path.cwd()):
        raise BadInput(f"{settings}: {path} is neither in its folder nor in the current one, nor "
                       "beside the data; give the table on the command line, or copy it there")
    return path


def _key(problem: Mapping[str, Any]) -> str:
    """Return the setting that a pydantic error is about, such as `wide.0.level`."""
    names = {*Settings.model_fields, *Columns.model_fields, *Wide.model_fields,
             *Origin.model_fields, *TrackFile.model_fields}
    extra = problem["type"] == "extra_forbidden"
    return ".".join(str(part) for part in problem["loc"]
                    if isinstance(part, int) or part in names or extra)


def _source_of(problem: Mapping[str, Any], path: Path | None, given: Mapping[str, Any]) -> str:
    """Return where a bad setting was given, for a message: an option, or the settings file."""
    key = problem["loc"][0] if problem["loc"] else None
    if key in given:
        return f"--{str(key).replace('_', '-')}"
    if path is None:
        return "the options"
    return f"{path} with the options" if key is None and given else str(path)


def _message(problem: Mapping[str, Any], source: str | None) -> str:
    """Return the message about a pydantic error: its source, the setting, and the reason."""
    key = _key(problem)
    reason = problem["msg"].removeprefix("Value error, ")
    table = problem["loc"][0] if problem["loc"] else ""
    if problem["type"] == "extra_forbidden":
        models: dict[Any, type[BaseModel]] = {"columns": Columns, "wide": Wide,
                                                  "track": TrackFile}
        allowed = models.get(table, Settings).model_fields
        reason = f"unknown; allowed are {', '.join(allowed)}"
    elif problem["type"] == "string_type" and table in ("columns", "wide"):
        reason = (f'{problem["input"]!r}: give the name of a column, or "always '
                  f'{problem["input"]}" for a constant')
    elif problem["type"] != "value_error":
        reason = f"{problem['input']!r}: {reason}"
    return ": ".join(filter(None, [source or "the options", key, reason]))


def write_settings(settings: Settings, path: Path, folder: Path) -> None:
    """Write the settings that differ from the defaults as TOML to a (temporary) path.

    Paths of tables and tracks become relative to `folder`, where the file will lie in the end.
    """
    data = settings.model_dump(exclude_none=True, exclude_defaults=True)
    for table in ("devices", "receivers"):
        if table in data:
            data[table] = os.path.relpath(data[table], folder)
    for track in data.get("track", []):
        track["file"] = os.path.relpath(track["file"], folder)
    with path.open("wb") as file:
        tomli_w.dump(data, file)
