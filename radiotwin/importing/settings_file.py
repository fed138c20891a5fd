"""Settings from and to TOML, and from pairs of the command line."""

import os
import tomllib
from pathlib import Path

import tomli_w
from pydantic import ValidationError

from radiotwin.errors import BadInput
from radiotwin.importing.settings import Columns, Settings, Wide
from radiotwin.tables import Origin


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
        lines = {_key(problem): _explain(problem, path) for problem in reversed(error.errors())}
        raise BadInput("\n".join(reversed(lines.values()))) from None


def _key(problem: dict) -> str:
    """`wide.0.level`; pydantic adds which of several types it has tried."""
    names = {*Settings.model_fields, *Columns.model_fields, *Wide.model_fields, *Origin.model_fields}
    return ".".join(str(part) for part in problem["loc"]
                    if isinstance(part, int) or part in names or problem["type"] == "extra_forbidden")


def _explain(problem: dict, path: Path | None) -> str:
    key = _key(problem)
    reason = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "extra_forbidden":
        table = Columns if problem["loc"][0] == "columns" else Wide if problem["loc"][0] == "wide" else Settings
        reason = f"unknown; allowed are {', '.join(table.model_fields)}"
    elif problem["type"] == "string_type" and problem["loc"][0] in ("columns", "wide"):
        reason = f'{problem["input"]!r}: give the name of a column, or "always {problem["input"]}" for a constant'
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
