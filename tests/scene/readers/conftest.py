import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

TOWN = Path(__file__).with_name("town.osm")


@pytest.fixture
def town_osm():
    """A map made by hand with all the defects of real extracts."""
    return TOWN


def ring(points_m):
    """A closed ring in degrees, of points in metres east and north of 8.5°, 47.4°."""
    points = [[8.5 + x_m / 75_300, 47.4 + y_m / 111_190] for x_m, y_m in points_m]
    return [*points, points[0]]


def box(x_m, y_m=0.0, width_m=20.0, depth_m=12.0):
    return ring([(x_m, y_m), (x_m + width_m, y_m), (x_m + width_m, y_m + depth_m), (x_m, y_m + depth_m)])


def polygon(outline, properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [outline]}}


def write_geojson(path, rows, **more):
    """Write outlines with their columns, (ring, properties) each."""
    features = [polygon(outline, properties) for outline, properties in rows]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features} | more))
    return path


def write_table(path, areas, crs="EPSG:4326", layer=None, kind="Polygon", **columns):
    """Write a layer of a GeoPackage, or a Shapefile, with the columns' values by name, as GDAL does."""
    values = [np.array(column, dtype=object if isinstance(column[0], str) else None) for column in columns.values()]
    pyogrio.raw.write(path, shapely.to_wkb(list(areas)), values, list(columns), layer=layer, geometry_type=kind, crs=crs,
                      driver="GPKG" if path.suffix == ".gpkg" else "ESRI Shapefile", append=path.exists())
    return path


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
