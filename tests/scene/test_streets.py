"""Streets of OpenStreetMap come into the scene folder, for pictures."""

import json

import numpy as np
import osmium
import pytest

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.scene import Scene
from radiotwin.scene.readers import build_scene
from radiotwin.scene.streets import MAX_CORNERS, STREETS, cut_streets

PLACES = ((47.5, 8.7), (47.5, 8.7003), (47.5002, 8.7003), (47.5002, 8.7),  # a house of 22 by 22 m
          (47.4995, 8.6995), (47.4995, 8.7005), (47.4995, 8.9))  # along 47.4995° north


@pytest.fixture
def town_osm(tmp_path):
    def way(number, nodes, **tags):
        return f'<way id="{number}" version="1">' + "".join(f'<nd ref="{node}"/>' for node in nodes) + "".join(
            f'<tag k="{key}" v="{value}"/>' for key, value in tags.items()) + "</way>"

    nodes = "".join(f'<node id="{n}" version="1" lat="{lat}" lon="{lon}"/>' for n, (lat, lon) in enumerate(PLACES, 1))
    path = tmp_path / "town.osm"
    path.write_text(f'<osm version="0.6">{nodes}' + way(1, (1, 2, 3, 4, 1), building="yes")
                    + way(2, (5, 6, 7), highway="residential") + way(3, (5, 2), highway="footway")
                    + way(4, (1, 2, 3, 1), highway="pedestrian", area="yes") + "</osm>")
    return path


@pytest.mark.parametrize("suffix", [".osm", ".osm.pbf"])
def test_a_scene_has_the_streets_of_its_map_cut_to_its_extent(town_osm, tmp_path, suffix):
    path = tmp_path / f"again{suffix}"
    with osmium.SimpleWriter(str(path)) as writer:
        for element in osmium.FileProcessor(str(town_osm)):
            writer.add(element)
    build_scene(path, tmp_path / "scene", origin=(47.5, 8.7), extent_m=(-80.0, 80.0, -80.0, 80.0))
    scene = Scene.load(tmp_path / "scene")
    (line_m,) = scene.streets_m
    x_m, y_m = line_m.T
    assert y_m == pytest.approx(-0.0005 * 111_180, abs=0.3)  # metres of a degree of latitude there
    assert x_m.min() == pytest.approx(-0.0005 * 75_330, abs=0.3) and x_m.max() == pytest.approx(80.0, abs=0.3)
    scene.save(tmp_path / "copy")
    np.testing.assert_array_equal(Scene.load(tmp_path / "copy").streets_m[0], line_m)
    (tmp_path / "copy" / STREETS).unlink()
    assert Scene.load(tmp_path / "copy").content_hash() == scene.content_hash()


@pytest.mark.parametrize("coordinates", [[[[8.7, 47.5], [8.7, "x"]]], [[[8.7, 47.5]]], [[[8.7], [8.8]]], "x",
                                         [[[8.7, 47.5]] * (MAX_CORNERS + 1)]])
def test_a_damaged_file_is_refused_before_any_work(town_osm, tmp_path, coordinates):
    build_scene(town_osm, tmp_path / "scene")
    feature = {"geometry": {"type": "MultiLineString", "coordinates": coordinates}}
    (tmp_path / "scene" / STREETS).write_text(json.dumps({"features": [feature]}))
    with pytest.raises(BadInput, match=r"streets\.geojson.*remove the file"):
        Scene.load(tmp_path / "scene")


def test_of_too_many_streets_the_longest_are_kept():
    zigzag = np.column_stack([np.arange(7000) % 2, np.linspace(0, 1, 7000)])
    found = cut_streets([scale * zigzag for scale in (0.1, 0.3, 0.2)],
                        Origin(latitude_deg=0.0, longitude_deg=0.0), (-1e6, 1e6, -1e6, 1e6))
    assert len(found) == 2 and np.ptp(found[0], axis=0)[0] > np.ptp(found[1], axis=0)[0]
