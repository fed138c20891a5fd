import io
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image

from radiotwin.geo import to_local
from radiotwin.maps.export.kmz import GX, KML, OPACITY, write_kmz
from radiotwin.maps.radiomap import RadioMap


@pytest.fixture
def archive(radio_map, scene, tmp_path):
    write_kmz(radio_map, scene, tmp_path / "map.kmz")
    with zipfile.ZipFile(tmp_path / "map.kmz") as archive:
        yield archive


def overlays(archive):
    root = ElementTree.fromstring(archive.read("doc.kml"))
    return list(root.iter(f"{{{KML}}}GroundOverlay"))


def test_an_overlay_for_each_device_and_altitude(archive):
    names = [overlay.find(f"{{{KML}}}name").text for overlay in overlays(archive)]
    assert names == ["d0 at 50 m", "d0 at 60 m", "d1 at 50 m", "d1 at 60 m"]
    assert [overlay.find(f"{{{KML}}}visibility").text for overlay in overlays(archive)] == ["1", "0", "0", "0"]
    listed = {overlay.find(f"{{{KML}}}Icon/{{{KML}}}href").text for overlay in overlays(archive)}
    assert listed | {"doc.kml", "legend.png"} == set(archive.namelist()) and archive.namelist()[0] == "doc.kml"
    legend = Image.open(io.BytesIO(archive.read("legend.png")))
    assert legend.height > legend.width > 50


def test_corners_are_those_of_the_outer_cells(archive, scene):
    text = overlays(archive)[0].find(f"{{{GX}}}LatLonQuad/{{{KML}}}coordinates").text
    corners = np.array([[float(value) for value in corner.split(",")[:2]] for corner in text.split()])
    x_m, y_m = to_local(scene.config.origin, *corners.T)
    assert np.column_stack([x_m, y_m]) == pytest.approx(
        np.array([[-10, -10], [70, -10], [70, 50], [-10, 50]]), abs=2e-3)


def test_pictures_show_the_values_with_the_north_above(archive, radio_map):
    pixels = np.array(Image.open(io.BytesIO(archive.read("overlays/001-00.png"))))
    assert max(pixels.shape[:2]) >= 512
    cells = pixels[::pixels.shape[0] // 3, ::pixels.shape[1] // 4]
    assert cells.shape == (3, 4, 4)
    gain_db = radio_map.gain_db[1, 0, ::-1]
    assert np.array_equal(cells[..., 3] == 0, np.isnan(gain_db)) and set(np.unique(cells[..., 3])) == {0, OPACITY}
    low_db, high_db = np.nanquantile(radio_map.gain_db, [0.01, 0.995])
    expected = colormaps["viridis"]((gain_db - low_db) / (high_db - low_db), bytes=True)[..., :3]
    known = np.isfinite(gain_db)
    assert np.abs(cells[..., :3].astype(int) - expected)[known].max() <= 1


def test_equal_maps_give_equal_bytes_and_an_empty_one_a_file(radio_map, scene, tmp_path):
    for name in ("a.kmz", "b.kmz"):
        write_kmz(radio_map, scene, tmp_path / name)
    assert (tmp_path / "a.kmz").read_bytes() == (tmp_path / "b.kmz").read_bytes()
    empty = radio_map.dataset.assign(gain_db=radio_map.dataset["gain_db"] * np.nan)
    write_kmz(RadioMap(empty), scene, tmp_path / "empty.kmz")
    assert zipfile.is_zipfile(tmp_path / "empty.kmz")
