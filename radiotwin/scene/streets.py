"""Streets as a background of plots: `streets.geojson` of a scene folder, in WGS84.

They are from the OpenStreetMap extract that a scene was built from. No result depends on them.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import shapely
from pydantic import Field

from radiotwin.errors import BadInput
from radiotwin.geo import to_geographic, to_local
from radiotwin.io.forms import Number, Origin, Record, read_record, validated
from radiotwin.io.inputs import require_within

STREETS = "streets.geojson"
CREDIT = "© OpenStreetMap contributors (ODbL)"
MAX_CORNERS = 20_000  # of all streets: half a megabyte
SIMPLIFIED_M = 1.0  # tolerance of simplified lines


class _Lines(Record):
    type: Literal["MultiLineString"]
    coordinates: list[Annotated[list[Annotated[list[Number], Field(min_length=2, max_length=2)]],
                                Field(min_length=2)]]


class _Feature(Record):
    geometry: _Lines


class _Streets(Record):
    features: list[_Feature] = Field(max_length=1)


def cut_streets(lines_deg: Sequence[np.ndarray], origin: Origin,
                box_m: tuple[float, float, float, float]) -> list[np.ndarray]:
    """Cut streets to a box and simplify them; with too many corners, keep the longest.

    Args:
        lines_deg: (n, 2) longitudes and latitudes of each street [degrees].
        origin: origin of the local frame.
        box_m: x_min, x_max, y_min, y_max [m].

    Returns:
        (n, 2) x and y of each line [m], the longest first.
    """
    x_min, x_max, y_min, y_max = box_m
    lines = [shapely.LineString(np.column_stack(to_local(origin, *line_deg.T)))
             for line_deg in lines_deg]
    cut = shapely.simplify(shapely.intersection(lines, shapely.box(x_min, y_min, x_max, y_max)),
                           SIMPLIFIED_M)
    parts = [part for part in shapely.get_parts(shapely.get_parts(cut))
             if part.geom_type == "LineString" and not part.is_empty]
    parts.sort(key=lambda part: -part.length)
    kept = np.searchsorted(np.cumsum([len(part.coords) for part in parts]), MAX_CORNERS, "right")
    return [np.array(part.coords) for part in parts[:kept]]


def write_streets(lines_m: Sequence[np.ndarray], origin: Origin, folder: Path) -> None:
    """Write `streets.geojson` of lines (n, 2) in the local frame [m]."""
    lines = [np.column_stack(to_geographic(origin, *line_m.T)).round(6).tolist()
             for line_m in lines_m]
    record = {"type": "FeatureCollection", "features": [{
        "type": "Feature", "properties": {"source": CREDIT},
        "geometry": {"type": "MultiLineString", "coordinates": lines}}]}
    (folder / STREETS).write_text(json.dumps(record), encoding="utf-8")


def read_streets(folder: Path, origin: Origin | None) -> list[np.ndarray]:
    """Read the streets (n, 2) of a scene folder [m]; [] without such a file or an origin.

    Raises:
        BadInput: a damaged file, or one that leads out of the folder.
    """
    path = folder / STREETS
    if origin is None or not path.is_file():
        return []
    require_within(folder, path, str(folder))
    found = validated(_Streets, read_record(path, "streets (GeoJSON)"), path,
                      "build the scene again, or remove the file")
    lines_deg = [np.array(line) for feature in found["features"]
                 for line in feature["geometry"]["coordinates"]]
    if sum(map(len, lines_deg)) > MAX_CORNERS:
        raise BadInput(f"{path} has more than {MAX_CORNERS:,} corners; remove the file")
    lines_m = [np.column_stack(to_local(origin, *line_deg.T)) for line_deg in lines_deg]
    return [line_m for line_m in lines_m if np.isfinite(line_m).all()]
