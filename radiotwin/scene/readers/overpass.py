"""Download of buildings, vegetation and streets from the Overpass API of OpenStreetMap [1].

[1] https://wiki.openstreetmap.org/wiki/Overpass_API
"""

import http.client
import time
import urllib.parse
import urllib.request
from pathlib import Path
from typing import IO, Any

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.budgets import FILE_BYTES
from radiotwin.io.files import atomic_file
from radiotwin.scene.readers.features import BUILDING_KEYS
from radiotwin.scene.readers.osm import STREETS
from radiotwin.scene.readers.vegetation import TAGS

SERVER = "https://overpass-api.de/api/interpreter"
TIMEOUT_S = 180  # [s], the default of Overpass itself
MAX_DOWNLOAD_S = 1800.0  # [s], chosen: some 100 MB on a slow line
MAX_AREA_KM2 = 100.0  # [km²], chosen so that one request does not burden a public server


def download_osm(
    path: Path, bbox_deg: tuple[float, float, float, float], server: str = SERVER
) -> None:
    """Download buildings, vegetation and streets of an area to an `.osm` file that does not exist.

    Args:
        path: `.osm` file.
        bbox_deg: south, west, north, east [degrees].
        server: address of an Overpass interpreter.

    Raises:
        BadInput: the file exists, is not called `.osm`, or the area is too large.
        RunFailed: no network, or the server refuses.
    """
    from pyproj import Geod

    if path.suffix.lower() != ".osm":
        raise BadInput(f"--overpass writes {path}, which is not called .osm; choose such a name")
    if path.exists():
        raise BadInput(f"{path} exists already; leave --overpass out to build from it, or choose "
                       "another name")
    south, west, north, east = bbox_deg
    area_m2, _ = Geod(ellps="WGS84").polygon_area_perimeter(
        [west, east, east, west], [south, south, north, north])
    if abs(area_m2) > MAX_AREA_KM2 * 1e6:
        raise BadInput(f"--overpass: {abs(area_m2) / 1e6:.0f} km² are too much for a public "
                       f"server, {MAX_AREA_KM2:g} km² are allowed; make --bbox smaller, or "
                       "download an extract (.osm.pbf)")
    box = ",".join(f"{value:.7f}" for value in bbox_deg)
    filters = [*(f'["{key}"]' for key in BUILDING_KEYS),
               *(f'["{key}"="{value}"]' for key, value in TAGS),
               f'["highway"~"^({"|".join(STREETS)})$"]']
    selectors = "".join(f"{kind}{tag}({box});" for kind in ("way", "relation") for tag in filters)
    query = f"[out:xml][timeout:{TIMEOUT_S}];({selectors});(._;>;);out body;"
    request = urllib.request.Request(
        server, urllib.parse.urlencode({"data": query}).encode(),
        {"User-Agent": "radiotwin (https://pypi.org/project/radiotwin)"})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer, \
                atomic_file(path) as file:
            _copy(answer, file, path)
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise RunFailed(f"--overpass needs a network, and {server} did not answer ({reason}); try "
                        "again later, or download an extract and give the file") from None


def _copy(answer: Any, file: IO[bytes], path: Path) -> None:
    """Copy a server's answer to a file; OSError if it takes too long or is cut off."""
    read, deadline = 0, time.monotonic() + MAX_DOWNLOAD_S
    while part := answer.read1(2**16):
        read += len(part)
        FILE_BYTES.check(read, f"{path}, as the server sends it")
        if time.monotonic() > deadline:
            raise TimeoutError(f"its answer has not ended after {MAX_DOWNLOAD_S:g} s")
        file.write(part)
    if getattr(answer, "length", None):  # bytes that were announced and did not come
        raise ConnectionError("its answer was cut off")
