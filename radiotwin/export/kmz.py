"""Radio maps for Google Earth: a KMZ file with an overlay for each device and altitude.

Overlays are placed by their four corners (gx:LatLonQuad of Google's KML extension [1]), as the
local frame is slightly rotated against the meridians. Cells that are not detected are transparent.

[1] https://developers.google.com/kml/documentation/kmlreference
"""

import io
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from radiotwin.budgets import MAP_PICTURES
from radiotwin.export.geotiff import cell_size_m
from radiotwin.files import atomic_file
from radiotwin.geodesy import to_geographic
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
COLOURS = "viridis"
OPACITY = 190  # of 255


def write_kmz(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write a KMZ file with a folder for each device and a legend.

    The first device is shown at first, and one altitude at a time.

    Args:
        radio_map: map to draw.
        scene: of the map, with an origin.
        path: of the .kmz file.

    Raises:
        BadInput: the lattice is not regular.
    """
    origin = scene.config.origin
    assert origin is not None, "check_format refuses scenes without"
    ET.register_namespace("", KML)
    ET.register_namespace("gx", GX)
    values_db = radio_map.gain_db[np.isfinite(radio_map.gain_db)]
    low_db, high_db = np.quantile(values_db, [0.01, 0.995]) if len(values_db) else (-1.0, 0.0)
    norm = Normalize(low_db, max(high_db, low_db + 1e-3))
    document = ET.Element(f"{{{KML}}}kml")
    top = _add(document, "Document", name=scene.config.name)
    pictures: dict[str, tuple[int, int]] = {}
    MAP_PICTURES.check(int(np.prod(radio_map.gain_db.shape[:2])), path)
    _add_legend(top)
    corners = _corners(radio_map, scene)
    declared = {device.device: device for device in scene.config.devices}
    for row, device in enumerate(radio_map.devices):
        folder = _add(top, "Folder", name=device, open="0")
        _add(_add(folder, "Style"), "ListStyle", listItemType="radioFolder")  # one at a time
        if device in declared:
            longitude, latitude = to_geographic(origin, declared[device].x_m, declared[device].y_m)
            mark = _add(top, "Placemark", name=device)
            _add(_add(mark, "Point"), "coordinates").text = f"{longitude:.8f},{latitude:.8f}"
        for level, altitude_m in enumerate(radio_map.lattice.z_m):
            name = f"overlays/{row:03d}-{level:02d}.png"
            pictures[name] = row, level
            overlay = _add(folder, "GroundOverlay", name=f"{device} at {altitude_m:g} m",
                           visibility="1" if row == level == 0 else "0")
            _add(_add(overlay, "Icon"), "href").text = name
            _add(_add(overlay, "LatLonQuad", GX), "coordinates").text = corners
    ET.indent(document)
    text = ET.tostring(document, encoding="utf-8", xml_declaration=True)
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        _store(archive, "doc.kml", text)  # which must be the first
        _store(archive, "legend.png", _legend(norm))
        for name, index in pictures.items():
            _store(archive, name, _picture(radio_map.gain_db[index], norm))


def _store(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file without the time of writing, so that equal maps give equal bytes."""
    archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)


def _add(parent: ET.Element, tag: str, space: str = KML, **texts: str) -> ET.Element:
    element = ET.SubElement(parent, f"{{{space}}}{tag}")
    for name, text in texts.items():
        ET.SubElement(element, f"{{{KML}}}{name}").text = text
    return element


def _corners(radio_map: RadioMap, scene: Scene) -> str:
    """Return longitude and latitude of the outer corners: counter-clockwise, south-west first."""
    assert scene.config.origin is not None
    half_m, lattice = cell_size_m(radio_map, scene) / 2, radio_map.lattice
    west, east = lattice.x_m[0] - half_m, lattice.x_m[-1] + half_m
    south, north = lattice.y_m[0] - half_m, lattice.y_m[-1] + half_m
    longitude, latitude = to_geographic(scene.config.origin, [west, east, east, west],
                                        [south, south, north, north])
    return " ".join(f"{a:.8f},{b:.8f},0" for a, b in zip(longitude, latitude))


def _picture(gain_db: np.ndarray, norm: Normalize) -> bytes:
    """Return the PNG of (ny, nx) gains, north up, transparent where not detected."""
    pixels = colormaps[COLOURS](norm(np.nan_to_num(gain_db)), bytes=True)
    pixels[..., 3] = np.where(np.isfinite(gain_db), OPACITY, 0)
    times = -(-512 // max(gain_db.shape))  # at least 512 pixels: viewers blur what they enlarge
    enlarged = pixels[::-1].repeat(times, axis=0).repeat(times, axis=1)
    data = io.BytesIO()
    Image.fromarray(enlarged).save(data, "PNG", optimize=True)
    return data.getvalue()


def _legend(norm: Normalize) -> bytes:
    """Return the PNG of the colour bar."""
    figure = Figure(figsize=(1.15, 3.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    figure.colorbar(ScalarMappable(norm, COLOURS), cax=figure.add_subplot(),
                    label="channel gain [dB]", extend="both")
    data = io.BytesIO()
    figure.savefig(data, dpi=90, format="png")
    return data.getvalue()


def _add_legend(top: ET.Element) -> None:
    """Put the colour bar at the left edge of the view."""
    legend = _add(top, "ScreenOverlay", name="legend")
    _add(_add(legend, "Icon"), "href").text = "legend.png"
    for tag, x, y in (("overlayXY", "0", "0.5"), ("screenXY", "0.01", "0.5")):
        _add(legend, tag).attrib.update(x=x, y=y, xunits="fraction", yunits="fraction")
