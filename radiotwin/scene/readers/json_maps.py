"""Maps in JSON, told apart by what they hold: CityJSON, GeoJSON, or an answer of Overpass."""

from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.io.budgets import DOCUMENT_BYTES, FEATURES
from radiotwin.io.inputs import decode_text, open_gzip, parse_json
from radiotwin.scene.readers.cityjson import cityjson_map
from radiotwin.scene.readers.features import MapFile
from radiotwin.scene.readers.gis_files import geojson_map
from radiotwin.scene.readers.osm import assemble, osm_of_json

LINES = (".jsonl", ".ndjson", ".geojsonl", ".geojsons", ".geojsonseq")
"""Endings of files with a feature in each line."""
_GEOJSON = ("FeatureCollection", "Feature", "Polygon", "MultiPolygon")
_RECORD = "\x1e"  # may begin each line (RFC 8142)


def read_json_map(path: Path, crs: str | None = None) -> MapFile:
    """Read a map in JSON; one that names no coordinate reference system may need `crs`.

    Raises:
        BadInput: no such file, none of the three, or an impossible value, with the object's name.
    """
    with open_gzip(path, "map in JSON", DOCUMENT_BYTES) as file:
        text = decode_text(file.read(), path)
    if path.name.lower().removesuffix(".gz").endswith(LINES):
        lines = [line for line in text.replace(_RECORD, "").split("\n") if line.strip()]
        FEATURES.check(len(lines), path)
        documents = [parse_json(line, f"{path}, row {row}") for row, line in
                     enumerate(lines, start=1)]
    else:
        documents = [parse_json(text, path)]
    head = documents[0] if documents and isinstance(documents[0], dict) else {}
    if head.get("type") == "CityJSON":
        return cityjson_map(path, documents, crs)
    if head.get("type") in _GEOJSON:
        return geojson_map(path, head if len(documents) == 1 else
                           {"type": "FeatureCollection", "features": documents}, crs)
    if not isinstance(head.get("elements"), list):
        raise BadInput(f"{path} is neither CityJSON (\"type\": \"CityJSON\"), GeoJSON, nor an "
                       "answer of Overpass ([out:json]); export the map as one of them")
    if crs is not None:
        raise BadInput(f"{path} is in longitude and latitude, as all of OpenStreetMap; leave --crs "
                       "out")
    return assemble(osm_of_json(path, head))
