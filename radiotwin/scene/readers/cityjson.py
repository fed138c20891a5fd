"""Reader of CityJSON 1.0 to 2.0 [1] and CityJSON text sequences.

cjio, the package of the format's authors, is a command for changing such files: it reads a file
without any limit of size, and needs further packages to triangulate.

[1] https://www.cityjson.org/specs/2.0.1
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import VERTICES
from radiotwin.scene.readers.city_objects import CityObject, Geometry, Polygon, city_features
from radiotwin.scene.readers.features import MapFile

# Levels of lists around a surface (a list of rings) in `boundaries`
_DEPTHS = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2,
           "CompositeSolid": 2}


def cityjson_map(path: Path, documents: Sequence[Any], crs: str | None = None) -> MapFile:
    """Return the buildings in CityJSON with their surfaces; those without, with their outlines.

    Args:
        path: file, for messages.
        documents: the model; of a text sequence, its lines, the first with the metadata.
        crs: coordinate reference system of a file that names none; None: refuse it.

    Raises:
        BadInput: not CityJSON, or an impossible value, with the object's name.
    """
    head = documents[0]
    transform = _transform(path, head)
    objects: list[CityObject] = []
    for document in documents:
        objects += _objects(path, document, *transform)
    metadata = head.get("metadata")
    system = metadata.get("referenceSystem") if isinstance(metadata, dict) else None
    found = city_features(path, objects, [system] if isinstance(system, str) else [], crs)
    known = [one.get("attributes") for document in documents
             for one in document["CityObjects"].values()]
    return replace(found, columns={str(key) for each in known if isinstance(each, dict)
                                   for key in each})


def _transform(path: Path, head: Mapping) -> tuple[np.ndarray, np.ndarray]:
    """Return scale and translation (3,) from the file's whole numbers to its coordinates."""
    known = head.get("transform")
    if known is None:  # optional up to version 1.0
        return np.ones(3), np.zeros(3)
    try:
        scale, offset = (np.array(known[key], dtype=float).reshape(3)
                         for key in ("scale", "translate"))
        if not (np.isfinite(scale).all() and np.isfinite(offset).all()):
            raise ValueError
    except (TypeError, ValueError, KeyError, IndexError, OverflowError):
        raise BadInput(f"{path}: its transform is not a scale and a translate of three finite "
                       "numbers; export the model again") from None
    return scale, offset


def _objects(path: Path, document: Any, scale: np.ndarray,
             offset: np.ndarray) -> Iterator[CityObject]:
    """Yield the objects of a CityJSON document; its vertices × scale + offset are corners."""
    try:
        vertices = np.array(document["vertices"], dtype=float).reshape(-1, 3)
        objects = document["CityObjects"]
        if not isinstance(objects, dict):
            raise TypeError
    except (TypeError, ValueError, KeyError, OverflowError):
        raise BadInput(f"{path}: vertices or CityObjects are missing, or no vertices of three "
                       "numbers; export the model again") from None
    VERTICES.check(len(vertices), path)
    corners = vertices * scale + offset
    groups = {name for name, known in objects.items()
              if isinstance(known, dict) and known.get("type") == "CityObjectGroup"}
    parents = {child: name for name, known in objects.items() if isinstance(known, dict)
               and name not in groups for child in _names(known.get("children"))}
    for name, known in objects.items():
        try:
            geometries = [one for geometry in known.get("geometry") or []
                          for one in _geometries(geometry, corners)]
            named = [one for one in _names(known.get("parents")) if one not in groups]
            yield CityObject(name[:200], str(known["type"]).lstrip("+"),
                             _attributes(known.get("attributes")),
                             (named or [parents.get(name, "")])[0][:200], geometries)
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError):
            raise BadInput(f"{path}: the object {name[:60]!r} is not as CityJSON has it (a type, "
                           "and geometries whose boundaries are indices of vertices); export the "
                           "model again") from None


def _names(value: Any) -> list[str]:
    """Return the texts in a list; empty if it is no list."""
    return [name for name in value if isinstance(name, str)] if isinstance(value, list) else []


def _attributes(known: Any) -> dict[str, str]:
    """Return name in lower case -> text, of attributes that are a number, text or boolean."""
    if not isinstance(known, dict):
        return {}
    return {str(key).lower(): f"{value:g}" if isinstance(value, float) else str(value)
            for key, value in known.items() if isinstance(value, str | int | float)}


def _geometries(geometry: Mapping, corners: np.ndarray) -> Iterator[Geometry]:
    """Yield a CityJSON geometry's parts: each solid's outer shell, or its surfaces together."""
    kind = geometry["type"]
    if kind not in _DEPTHS:  # such as points
        return
    boundaries = geometry["boundaries"]
    lod = float(geometry.get("lod", 2))
    depth = _DEPTHS[kind]
    solids = boundaries if depth == 2 else [boundaries] if depth == 1 else [[boundaries]]
    for shells in solids:
        # Only the outer shell: no ray gets into cavities
        yield Geometry(lod, [_polygon(surface, corners) for surface in shells[0]]
                       if shells else [])


def _polygon(rings: list, corners: np.ndarray) -> Polygon:
    """Return the rings (n, 3) of a surface, given as indices of corners; IndexError if negative."""
    indices = [np.array(ring, dtype=np.int64).reshape(-1) for ring in rings]
    if any((ring < 0).any() for ring in indices):
        raise IndexError
    return [corners[ring] for ring in indices]
