"""The rows of a file -> one row a link, as the mapping says."""

import re
from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.lengths import in_metres
from radiotwin.importing.levels import read_levels
from radiotwin.importing.read import Source
from radiotwin.importing.settings import POSITION, Settings, Wide
from radiotwin.importing.tally import Tally
from radiotwin.importing.times import day, seconds
from radiotwin.measurements import FREQUENCIES_HZ

ANGLES = ("heading", "pitch", "roll")
LIMITS_DEG = {"latitude": 90.0, "longitude": 360.0}
NAMES = ("device", "receiver", "flight")


@dataclass(frozen=True)
class LevelColumn:
    """One column of levels, who it belongs to, and what else stands in columns of its own."""

    spec: str
    own: dict[str, str]


def build_links(source: Source, settings: Settings, tally: Tally) -> tuple[pd.DataFrame, int]:
    """One row a link, in the order of the file; the index is the row's place in the file.

    Returns:
        links, with the columns `device, receiver, flight, level_db`, those of `POSITION` and of `device_` + `POSITION`
        that are given [degrees, m], and `time_s, heading_deg, pitch_deg, roll_deg, quality, frequency_hz` where given;
        and how many readings a row of the file holds

    Raises:
        BadInput: a column is missing, a cell cannot be read, a unit is not declared.
    """
    columns = settings.columns.model_dump(exclude_none=True)
    time_s = seconds(source, columns["time"], settings.time_format, settings.time_zone) if "time" in columns else None
    shared = pd.DataFrame(index=source.table.index)
    if time_s is not None:
        shared["time_s"] = time_s
    for name in (*(prefix + name for prefix in ("device_", "") for name in POSITION), *ANGLES, "quality",
                 "frequency_hz"):
        if name in columns:
            shared[f"{name}_deg" if name in ANGLES else name] = _quantity(source, name, columns[name], settings)
    for name in NAMES:
        if name in columns:
            shared[name] = _names(source, name, columns[name], shared, settings)
    levels = _level_columns(source, settings)
    links = pd.concat([_links_of(source, level, shared, settings, tally) for level in levels])
    return links.sort_index(kind="stable"), len(levels)


def _links_of(source: Source, level: LevelColumn, shared: pd.DataFrame, settings: Settings,
              tally: Tally) -> pd.DataFrame:
    """The links of one column of levels, without those that are of no use."""
    links = shared.copy()
    for name, spec in level.own.items():
        if name in NAMES:
            links[name] = spec
        else:
            prefix = "device_" if "device" in level.own else ""
            links[prefix + name] = _quantity(source, name, spec, settings)
    levels = read_levels(source, level.spec, settings)
    links["level_db"] = levels.db
    left = levels.not_measured
    links = tally.drop(links, left, "not measured", level.spec, source.where)
    links = tally.drop(links, levels.impossible[~left], "impossible level", level.spec, source.where)
    for name in NAMES:
        links = tally.drop(links, links[name] == "", f"no {name}", _spec(settings, level, name), source.where)
    for prefix in ("", "device_"):
        if prefix + "latitude" in links:
            for name, limit in LIMITS_DEG.items():
                _check_degrees(source, links, prefix, name, limit, _spec(settings, level, prefix + name))
            nowhere = (links[prefix + "latitude"] == 0) & (links[prefix + "longitude"] == 0)
            links = tally.drop(links, nowhere, f"{prefix}latitude, longitude 0, 0 (no fix)".replace("_", " "),
                               _spec(settings, level, prefix + "latitude"), source.where)
    return links


def _quantity(source: Source, name: str, spec: str, settings: Settings) -> np.ndarray:
    """(n,) numbers in the project's units."""
    numbers = source.numbers(spec, name)
    base = name.removeprefix("device_")
    if base in POSITION and base not in LIMITS_DEG and not (settings.crs and base in "xy"):
        return in_metres(numbers, settings.length_unit, f"{source.path}: column {spec}")
    if name == "frequency_hz":
        refuse_frequencies(source, spec, source.cells(spec, name), numbers)
    return numbers


def refuse_frequencies(source: Source, spec: str, cells, numbers: np.ndarray) -> None:
    """Raise BadInput for the first of the numbers (n,) of a column's cells that is no frequency [Hz]."""
    low, high = FREQUENCIES_HZ
    source.refuse(spec, cells, (numbers < low) | (numbers > high),
                  f"is no frequency; allowed are {low:g} to {high:g} Hz")


def _names(source: Source, name: str, spec: str, shared: pd.DataFrame, settings: Settings) -> np.ndarray:
    """(n,) names; "" where there is none."""
    if name == "flight" and spec == "by day":
        return day(shared["time_s"].to_numpy(), settings.time_zone)
    if name == "device" and spec == "by position":
        place = [column for column in shared if column.startswith("device_")]
        number = shared.groupby(place, sort=False, dropna=False).ngroup() + 1
        width = len(str(number.max()))
        unknown = shared[[c for c in place if c.endswith(("latitude", "longitude", "_x", "_y"))]].isna().any(axis=1)
        return ("p" + number.astype(str).str.zfill(width)).mask(unknown, "").to_numpy(dtype=object)
    return source.text(spec, name).to_numpy(dtype=object)


def _level_columns(source: Source, settings: Settings) -> list[LevelColumn]:
    if not settings.wide:
        return [LevelColumn(str(settings.columns.level), {})]
    found = [column for block in settings.wide for column in _columns_of(source, block)]
    specs = [column.spec for column in found]
    double = next((spec for spec in specs if specs.count(spec) > 1), None)
    if double:
        raise BadInput(f"{source.path}: column {double!r} fits two of the wide blocks; every column of levels belongs "
                       "to one: narrow their patterns")
    return found


def _columns_of(source: Source, block: Wide) -> list[LevelColumn]:
    own = block.model_dump(exclude_none=True, exclude={"level"})
    found = []
    for pattern in [block.level] if isinstance(block.level, str) else block.level:
        fitting = [str(name) for name in source.table if _star(pattern, str(name)) is not None]
        if not fitting:
            raise BadInput(f"{source.path}: no column fits {pattern!r} (wide.level); the file has "
                           f"{', '.join(map(str, source.table.columns))}. Correct the mapping")
        for name in fitting:
            star = _star(pattern, name)
            found.append(LevelColumn(name, {key: value.replace("*", star) for key, value in own.items()}))
    return found


def _star(pattern: str, name: str) -> str | None:
    """What `*` in `pattern` stands for in `name`; the whole name if there is none; None where it does not fit."""
    if "*" not in pattern:
        return name if name == pattern else None
    before, after = pattern.split("*", 1)
    match = re.fullmatch(f"{re.escape(before)}(.*){re.escape(after)}", name)
    return match and match[1]


def _spec(settings: Settings, level: LevelColumn, name: str) -> str:
    """Where a quantity stands in the file, for messages."""
    return level.own.get(name.removeprefix("device_") if "device" in level.own else name) \
        or getattr(settings.columns, name, None) or name


def _check_degrees(source: Source, links: pd.DataFrame, prefix: str, name: str, limit: float, spec: str) -> None:
    bad = links[prefix + name].abs() > limit
    if bad.any():
        other = links[prefix + "longitude"].abs()
        swapped = name == "latitude" and (other <= LIMITS_DEG["latitude"]).all() and bad.mean() > 0.5
        source.refuse(spec, links[prefix + name], bad, f"is no {name}; allowed are -{limit:g} to {limit:g} degrees"
                      + ("; are latitude and longitude swapped in the mapping?" if swapped else ""))
