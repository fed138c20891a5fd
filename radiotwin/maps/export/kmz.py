"""Write rasters as KMZ for Google Earth, with an overlay for each device and altitude.

Overlays are placed by their four corners (gx:LatLonQuad of Google's KML extension [1]), since the
local frame is slightly rotated against the meridians. Cells without a gain are transparent.

[1] https://developers.google.com/kml/documentation/kmlreference
"""

import io
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from radiotwin.geo import to_geographic
from radiotwin.io.budgets import MAP_PICTURES
from radiotwin.io.files import atomic_file
from radiotwin.io.forms import Origin
from radiotwin.maps.export.geotiff import cell_size_m, require_origin
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
COLOURS = "viridis"
OPACITY = 190  # of 255


@dataclass(frozen=True, eq=False)
class Overlay:
    """A picture on the ground.

    Attributes:
        folder: name of its folder, of which one picture is shown at a time.
        name: of the overlay.
        is_visible: whether the overlay is shown at first.
        draw: returns the picture as PNG, north up.
    """

    folder: str
    name: str
    is_visible: bool
    draw: Callable[[], bytes]


def write_kmz(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write a KMZ file with a legend and a folder for each device; shows the first device.

    Raises:
        BadInput: the lattice is not regular, or the scene has no origin.
    """
    values_db = radio_map.gain_db[np.isfinite(radio_map.gain_db)]
    low_db, high_db = np.quantile(values_db, [0.01, 0.995]) if len(values_db) else (-1.0, 0.0)
    norm = Normalize(low_db, max(high_db, low_db + 1e-3))
    MAP_PICTURES.check(int(np.prod(radio_map.gain_db.shape[:2])), path)
    half_m, lattice = cell_size_m(radio_map, scene) / 2, radio_map.lattice
    bounds_m = (lattice.x_m[0] - half_m, lattice.x_m[-1] + half_m,
                lattice.y_m[0] - half_m, lattice.y_m[-1] + half_m)

    def draw(row: int, level: int) -> bytes:
        gain_db = radio_map.gain_db[row, level]
        pixels = colormaps[COLOURS](norm(np.nan_to_num(gain_db)), bytes=True)
        pixels[..., 3] = np.where(np.isfinite(gain_db), OPACITY, 0)
        return enlarged_png(pixels)

    above = "" if lattice.ground_m is None else " above the ground"
    overlays = [Overlay(device, f"{device} at {altitude_m:g} m{above}", row == level == 0,
                        partial(draw, row, level))
                for row, device in enumerate(radio_map.devices)
                for level, altitude_m in enumerate(lattice.z_m)]
    declared = {device.device: (device.x_m, device.y_m) for device in scene.config.devices}
    marks = {name: declared[name] for name in radio_map.devices if name in declared}
    write_overlays(path, scene, bounds_m, overlays, marks, _legend(norm))


def write_overlays(path: Path, scene: Scene, bounds_m: tuple[float, float, float, float],
                   overlays: list[Overlay], marks: dict[str, tuple[float, float]],
                   legend: bytes) -> None:
    """Write a KMZ file of pictures over one area, which are sorted by folder.

    `bounds_m` are x_min, x_max, y_min, y_max of every picture [m], `marks` x and y of points by
    name [m]; the legend is a PNG for the left edge. BadInput if the scene has no origin.
    """
    origin = require_origin(scene, f"{path}: Google Earth needs")
    ET.register_namespace("", KML)
    ET.register_namespace("gx", GX)
    document = ET.Element(f"{{{KML}}}kml")
    top = _add(document, "Document", name=scene.config.name)
    _add_legend(top)
    for name, (x_m, y_m) in marks.items():
        longitude, latitude = to_geographic(origin, x_m, y_m)
        mark = _add(top, "Placemark", name=name)
        _add(_add(mark, "Point"), "coordinates").text = f"{longitude:.8f},{latitude:.8f}"
    corners = _corners(bounds_m, origin)
    files: dict[str, Overlay] = {}
    folders: dict[str, tuple[int, ET.Element]] = {}
    for each in overlays:
        if each.folder not in folders:
            folder = _add(top, "Folder", name=each.folder, open="0")
            _add(_add(folder, "Style"), "ListStyle", listItemType="radioFolder")  # one at a time
            folders[each.folder] = len(folders), folder
        row, folder = folders[each.folder]
        file = f"overlays/{row:03d}-{len(folder.findall(f'{{{KML}}}GroundOverlay')):02d}.png"
        files[file] = each
        overlay = _add(folder, "GroundOverlay", name=each.name,
                       visibility="1" if each.is_visible else "0")
        _add(_add(overlay, "Icon"), "href").text = file
        _add(_add(overlay, "LatLonQuad", GX), "coordinates").text = corners
    ET.indent(document)
    text = ET.tostring(document, encoding="utf-8", xml_declaration=True)
    with atomic_file(path) as out, zipfile.ZipFile(out, "w") as archive:
        archive.comment = b"radiotwin"
        _store(archive, "doc.kml", text)  # which must be the first
        _store(archive, "legend.png", legend)
        for file, each in files.items():
            _store(archive, file, each.draw())


def _store(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file without the time of writing, so that equal maps give equal bytes."""
    archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)


def _add(parent: ET.Element, tag: str, space: str = KML, **texts: str) -> ET.Element:
    """Add an XML element with a child `<name>text</name>` for each of `texts`; return it."""
    element = ET.SubElement(parent, f"{{{space}}}{tag}")
    for name, text in texts.items():
        ET.SubElement(element, f"{{{KML}}}{name}").text = text
    return element


def _corners(bounds_m: tuple[float, float, float, float], origin: Origin) -> str:
    """Return the corners of a rectangle [m] as KML text: counter-clockwise, south-west first."""
    west, east, south, north = bounds_m
    longitude, latitude = to_geographic(origin, [west, east, east, west],
                                        [south, south, north, north])
    return " ".join(f"{a:.8f},{b:.8f},0" for a, b in zip(longitude, latitude))


def enlarged_png(pixels: np.ndarray) -> bytes:
    """Return the PNG of a raster (ny, nx, 4), south row first, enlarged to 512 pixels or more.

    Viewers would blur a smaller picture.
    """
    times = -(-512 // max(pixels.shape))
    enlarged = pixels[::-1].repeat(times, axis=0).repeat(times, axis=1)
    data = io.BytesIO()
    Image.fromarray(enlarged).save(data, "PNG", optimize=True)
    return data.getvalue()


def _legend(norm: Normalize) -> bytes:
    """Return a PNG of the colour bar of gains [dB]."""
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
