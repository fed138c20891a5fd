"""Settings from and to TOML, and from pairs of the command line."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel, ValidationError

from radiotwin.errors import BadInput
from radiotwin.importing.settings import HEIGHTS, Columns, Settings, TrackFile, Wide
from radiotwin.inputs import is_within, read_toml
from radiotwin.tables import Origin


def parse_columns(text: str) -> dict[str, str]:
    """Parse pairs of the command line.

    Args:
        text: such as `latitude=lat,longitude=lon`.

    Raises:
        BadInput: not pairs, or a name that is repeated.
    """
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
    """Read settings.

    Args:
        path: TOML file, in which the paths of tables are relative to it; None for no file.
        given: fields of `Settings`, which replace those of the file.
        data_folder: of the file to import; tables that the settings name may be in it, in the
            settings' folder, and in the current one.

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
    """Return settings with defaults for what they do not declare.

    Args:
        settings: of the import.
        defaults: fields of `Settings`; a position counts only where none is declared.

    Raises:
        BadInput: both together are not allowed.
    """
    own = settings.model_dump(exclude_unset=True, exclude_none=True)
    columns = dict(defaults.get("columns", {}))
    declared = set(own.get("columns", {}))
    for prefix in ("", "device_"):
        for group in (("latitude", "longitude", "x", "y"), HEIGHTS):
            names = {prefix + name for name in group}
            if declared & names:
                columns = {name: spec for name, spec in columns.items() if name not in names}
    data = {**defaults, **own, "columns": columns | own.get("columns", {})}
    try:
        return Settings.model_validate(data)
    except ValidationError as error:
        raise BadInput("\n".join(_message(problem, None) for problem in error.errors())) from None


def _table_of(settings: Path, name: str, data_folder: Path | None) -> Path:
    """Return the path of a table that a settings file names, which may be a stranger's."""
    path = settings.parent / name
    if not is_within(path, settings.parent, Path.cwd(), data_folder or Path.cwd()):
        raise BadInput(f"{settings}: {path} is neither in its folder nor in the current one, nor "
                       "beside the data; give the table on the command line, or copy it there")
    return path


def _key(problem: Mapping[str, Any]) -> str:
    """Return the key of a problem, such as `wide.0.level`, without the types that were tried."""
    names = {*Settings.model_fields, *Columns.model_fields, *Wide.model_fields,
             *Origin.model_fields, *TrackFile.model_fields}
    extra = problem["type"] == "extra_forbidden"
    return ".".join(str(part) for part in problem["loc"]
                    if isinstance(part, int) or part in names or extra)


def _source_of(problem: Mapping[str, Any], path: Path | None, given: Mapping[str, Any]) -> str:
    """Return where a problem is from: an option overrules the file."""
    key = problem["loc"][0] if problem["loc"] else None
    if key in given:
        return f"--{str(key).replace('_', '-')}"
    if path is None:
        return "the options"
    return f"{path} with the options" if key is None and given else str(path)


def _message(problem: Mapping[str, Any], source: str | None) -> str:
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
    """Write settings as TOML.

    Args:
        settings: those that differ from the defaults are written.
        path: of the file.
        folder: where the file will be in the end; the paths of tables become relative to it.
    """
    data = settings.model_dump(exclude_none=True, exclude_defaults=True)
    for table in ("devices", "receivers"):
        if table in data:
            data[table] = os.path.relpath(data[table], folder)
    for track in data.get("track", []):
        track["file"] = os.path.relpath(track["file"], folder)
    with path.open("wb") as file:
        tomli_w.dump(data, file)
