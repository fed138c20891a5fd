from pathlib import Path

import pytest

TOWN = Path(__file__).with_name("town.osm")


@pytest.fixture
def town_osm():
    """A map made by hand with all the defects of real extracts."""
    return TOWN


class Map:
    """An `.osm` file of squares and other outlines, in metres east and north of (10°, 20°)."""

    def __init__(self):
        self.nodes, self.ways = [], []

    def way(self, points, **tags):
        refs = []
        for x_m, y_m in points:
            self.nodes.append(f'<node id="{len(self.nodes) + 1}" lat="{10 + y_m / 110_608:.9f}" '
                              f'lon="{20 + x_m / 109_640:.9f}"/>')
            refs.append(len(self.nodes))
        nodes = "".join(f'<nd ref="{ref}"/>' for ref in [*refs, refs[0]])
        tags = {"building": "yes"} | {key.replace("__", ":"): value for key, value in tags.items()}
        self.ways.append(f'<way id="{len(self.ways) + 1}">{nodes}'
                         + "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items()) + "</way>")
        return self

    def box(self, x0, y0, x1, y1, **tags):
        return self.way([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], **tags)

    def write(self, path):
        path.write_text("<osm>" + "".join(self.nodes + self.ways) + "</osm>")
        return path


@pytest.fixture
def empty_map():
    return Map()
