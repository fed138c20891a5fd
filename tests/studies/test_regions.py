"""Cities of any number of buildings for the study of tiles, and its table."""

import json

import numpy as np
from shapely import STRtree, box

from studies.region_city import city_footprints, write_map
from studies.regions import region_cases, region_table
from studies.tables import read_frame


def test_a_city_has_as_many_buildings_as_asked_500_to_a_square_kilometre_none_touching():
    footprints = city_footprints(2_000, seed=3)
    x0, y0, x1, y1, height_m = footprints.T
    assert footprints.shape == (2_000, 5)
    area_km2 = np.ptp(footprints[:, [0, 2]]) * np.ptp(footprints[:, [1, 3]]) / 1e6
    assert 480 < 2_000 / area_km2 < 540
    assert ((x1 - x0 >= 14.98) & (x1 - x0 <= 30.02) & (y1 - y0 >= 14.98) & (y1 - y0 <= 30.02)).all()
    assert height_m.min() >= 4 and height_m.max() <= 60 and 14 < height_m.mean() < 16
    rectangles = box(x0, y0, x1, y1)
    first, second = STRtree(rectangles).query(rectangles, predicate="dwithin", distance=1.0)
    assert (first == second).all()


def test_a_seed_is_a_city_and_another_one_another():
    assert (city_footprints(100, 1) == city_footprints(100, 1)).all()
    assert (city_footprints(100, 1) != city_footprints(100, 2)).any()


def test_a_map_has_each_building_at_its_place(tmp_path):
    footprints = city_footprints(90, 0)
    write_map(footprints, tmp_path / "city.geojson")
    features = json.loads((tmp_path / "city.geojson").read_text())["features"]
    assert [each["properties"]["height"] for each in features] == footprints[:, 4].tolist()
    corners = np.array([each["geometry"]["coordinates"][0] for each in features])
    metres = (corners - [8.5, 47.4]) * np.array([75_300, 111_190])  # a degree at 47.4° north, as in the map's own frame
    assert np.allclose(metres.min(axis=1), footprints[:, :2], atol=0.01)
    assert np.allclose(metres.max(axis=1), footprints[:, 2:4], atol=0.01)


def test_costs_are_shown_beside_those_of_the_smaller_city():
    build = {"wall_s": 10.0, "cpu_s": 5.0, "peak_mib": 480.0}
    error = {"links": 190, "median_db": 0.01, "p90_db": 0.09, "mean_db": -0.02, "within_share": 0.91,
             "one_only_share": 0.005}
    results = {"2,000 buildings": {"link_ms": 10.0}, "50,000 buildings": {"link_ms": 12.0}}
    rows = [{"name": name, "seed": 0, "settings": settings, "cpu_s": 1.0, "results": {
        "build": build, "links": 200} | (
        {"errors": {"noise": error, "400": error | {"kept_share": 0.3}}} if settings["part"] == "error" else
        {"read_s": 3.0, "shapes": 700.0, "peak_gib": 2.0} | results[name])} for name, settings in region_cases(0).items()]
    table = region_table(read_frame(rows))
    assert "| 50,000 buildings | 0 | 10 | 5 | 480 | 3.0 | 200 | 700 | 12.0 | 1.20 | 2.00 |" in table
    assert "| radius 400 m | 30 % | 190 | 0.010 | 0.09 | -0.020 | 91 % | 0.5 % |" in table
    assert "| whole city, another seed | 100 % | 190 |" in table
