"""Footprints through `make_prisms` and `make_blocks`: areas and volumes against closed forms."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from radiotwin.geo import to_geographic
from radiotwin.io.forms import Origin
from radiotwin.scene.materials import STANDARD
from radiotwin.scene.readers.extrude import SLOT_M, make_blocks
from radiotwin.scene.readers.features import Feature
from radiotwin.scene.readers.solids import find_contacts, make_prisms, overlap_problems

ORIGIN = Origin(latitude_deg=47.5, longitude_deg=8.7)


def feature(area, name="way/1", **tags):
    """A building whose area is given in metres."""
    tags = {"building": "yes", "height": "10"} | {key.replace("__", ":"): value for key, value in tags.items()}
    tags = {key: value for key, value in tags.items() if value is not None}
    return Feature(name, tags, shapely.transform(area, lambda p: np.column_stack(to_geographic(ORIGIN, *p.T))))


def prisms_of(*features):
    return make_prisms(features, ORIGIN, STANDARD, 10.0)


def total_volume(blocks):
    return sum(block.mesh.volume for block in blocks)


COURTYARD = shapely.box(0, 0, 40, 30).difference(shapely.box(10, 10, 30, 20))
BOW_TIE = shapely.Polygon([(0, 0), (20, 10), (20, 0), (0, 10)])
AT_THE_WALL = shapely.Polygon([(0, 0), (20, 0), (20, 20), (0, 20)], [[(0, 10), (10, 5), (10, 15)]])  # a courtyard
CORNERS = shapely.MultiPolygon([shapely.box(0, 0, 10, 10), shapely.box(10, 10, 20, 20)])


@pytest.mark.parametrize(("area", "blocks", "area_m2", "is_fixed"), [
    (COURTYARD, 1, 1000, False), (BOW_TIE, 2, 100, True), (AT_THE_WALL, 1, 350, True), (CORNERS, 2, 200, False)],
    ids=["courtyard", "bow tie", "courtyard at the wall", "corners"])
def test_outlines_become_watertight_solids(area, blocks, area_m2, is_fixed):
    prisms, problems = prisms_of(feature(area))
    found = make_blocks(prisms, find_contacts(prisms))
    assert len(found) == blocks and all(block.mesh.is_watertight for block in found)
    assert total_volume(found) == pytest.approx(10 * area_m2, rel=0.01)
    assert [(problem.severity, "way/1" in problem.message) for problem in problems] == [("fixed", True)] * is_fixed


@pytest.mark.parametrize(("parts", "area_m2"), [
    ([(0, 0, 30, 20), (10, 5, 20, 15)], 600), ([(0, 0, 10, 10), (6, 0, 20, 10)], 200),
    ([(0, 0, 30, 20), (10, 5, 20, 15), (12, 7, 18, 13)], 600)])
def test_parts_of_an_outline_that_overlap_are_united(parts, area_m2):
    """A courtyard is a ring of a polygon; a polygon in another one is no hole."""
    prisms, problems = prisms_of(feature(shapely.MultiPolygon([shapely.box(*part) for part in parts])))
    assert sum(prism.area.area for prism in prisms) == pytest.approx(area_m2, rel=1e-3)
    (problem,) = problems
    assert problem.severity == "fixed" and "overlap or lie in each other: united ('way/1')" in problem.message


@pytest.mark.parametrize(("area", "tags", "message"), [
    (shapely.Polygon([(0, 0), (10, 0), (20, 0)]), {}, "no area"), (shapely.Polygon([(0, 0)] * 4), {}, "no area"),
    (shapely.box(0, 0, 30, 0.1), {}, "sliver"), (shapely.box(0, 0, 0.9, 0.9), {}, "sliver"),
    (shapely.box(0, 0, 9, 9), {"min_height": "10"}, "no lower than they end")])
def test_omissions_are_reported(area, tags, message):
    prisms, problems = prisms_of(feature(area, **tags), feature(shapely.box(50, 50, 60, 60), "way/2"))
    assert {prism.name for prism in prisms} == {"way/2"}
    assert len(problems) == 1 and message in problems[0].message and "'way/1'" in problems[0].message


def test_row_houses_become_one_solid_without_inner_walls():
    prisms, _ = prisms_of(feature(shapely.box(0, 0, 10, 12)), feature(shapely.box(10, 0, 20, 12), height="14"))
    (block,) = make_blocks(prisms, find_contacts(prisms))
    assert block.mesh.is_watertight and block.mesh.volume == pytest.approx(120 * 24, rel=1e-3)
    # ground and roofs, walls around, and the 4 m step between the roofs
    assert block.mesh.area == pytest.approx(2 * 240 + 2 * 10 * 10 + 2 * 10 * 14 + 12 * 10 + 12 * 14 + 12 * 4, rel=2e-3)


def test_neighbours_of_other_materials_have_a_slot_between_them():
    prisms, _ = prisms_of(feature(shapely.box(0, 0, 10, 12)),
                          feature(shapely.box(10, 0, 14, 12), building__material="wood"))
    wall, other = sorted(make_blocks(prisms, find_contacts(prisms)), key=lambda block: -block.mesh.volume)
    assert {wall.material.name, other.material.name} == {"concrete", "wood"}
    assert wall.mesh.is_watertight and other.mesh.is_watertight
    assert other.mesh.bounds[0, 0] - wall.mesh.bounds[1, 0] == pytest.approx(SLOT_M, abs=2e-3)


def test_overlaps_are_found_and_built_once():
    prisms, _ = prisms_of(feature(shapely.box(0, 0, 10, 10)), feature(shapely.box(8, 0, 18, 10), "way/2"),
                          feature(shapely.box(8, 0, 18, 10), "way/3", min_height="12", height="15"))
    (problem,) = overlap_problems(prisms, find_contacts(prisms))
    assert "1 pair(s) of buildings overlap" in problem.message and "'way/1 and way/2: 20 m²'" in problem.message
    assert total_volume(make_blocks(prisms, find_contacts(prisms))) == pytest.approx(180 * 10 + 100 * 3, rel=5e-3)


def part(area, name, **tags):
    return feature(area, name, building=None, building__part="yes", height=tags.pop("height", None), **tags)


def test_parts_replace_their_outline():
    prisms, problems = prisms_of(
        feature(shapely.box(0, 0, 30, 10), height="40", building__material="glass"),
        part(shapely.box(0, 0, 10, 10), "way/2", height="40"),
        part(shapely.box(10, 0, 20, 10), "way/3", height="9", min_height="5"),
        part(shapely.box(20, 0, 30, 10), "way/4", building__levels="3"))
    heights = {prism.name: (prism.height.bottom_m, prism.height.top_m) for prism in prisms}
    assert heights == {"way/2": (0, 40), "way/3": (5, 9), "way/4": (0, 9)} and not problems
    assert {prism.material.name for prism in prisms} == {"glass"}  # inherited
    (block,) = make_blocks(prisms, find_contacts(prisms))
    assert block.mesh.is_watertight and block.mesh.volume == pytest.approx(100 * (40 + 4 + 9), rel=2e-3)
    assert not block.mesh.contains([[15, 5, 2]])[0]  # the passage


def test_the_rest_of_an_outline_is_kept_and_reported():
    prisms, problems = prisms_of(feature(shapely.box(0, 0, 30, 10), height="8"),
                                 part(shapely.box(0, 0, 10, 10), "way/2", height="20"))
    assert {(prism.name, round(prism.area.area)) for prism in prisms} == {("way/1", 200), ("way/2", 100)}
    assert "covered to less than 90%" in problems[0].message


@pytest.mark.parametrize("bottoms_m", [(10,), (10, 4), (10, 2.5), (10, 0), (0, 10), ()])
def test_a_building_that_does_not_reach_the_ground_is_named(bottoms_m):
    """Parts replace their outline: where one begins at 10 m over all of it, nothing is left below."""
    prisms, problems = prisms_of(feature(shapely.box(0, 0, 30, 10), height="10"), *(
        part(shapely.box(0, 0, 30, 10), f"way/{row}", height="40", min_height=str(bottom_m))
        for row, bottom_m in enumerate(bottoms_m, start=2)))
    low_m = min(bottoms_m, default=0)
    assert min(prism.height.bottom_m for prism in prisms) == low_m
    named = [problem.message for problem in problems if "nothing of them reaches it" in problem.message]
    assert len(named) == (low_m > 2.5)
    assert all(text.startswith("1 building(s) begin more than 2.5 m") and "('way/1')" in text for text in named)
    # What a lone part stands on is not known
    assert not prisms_of(part(shapely.box(0, 0, 30, 10), "way/2", height="40", min_height="10"))[1]


rectangles = st.tuples(*[st.integers(0, 12)] * 2, *[st.integers(1, 8)] * 2, st.integers(1, 4),
                       st.sampled_from(["concrete", "wood"]))


@settings(max_examples=40, deadline=None)
@given(st.lists(rectangles, min_size=1, max_size=8))
def test_any_heap_of_boxes_becomes_watertight_solids(boxes):
    """Walls, corners and roofs that touch in every way; the volume is that of the union, counted cell by cell."""
    prisms, _ = prisms_of(*(feature(shapely.box(x, y, x + w, y + d), f"way/{i}", height=str(3 * h),
                                    building__material=m) for i, (x, y, w, d, h, m) in enumerate(boxes)))
    blocks = make_blocks(prisms, find_contacts(prisms))
    grid = np.zeros((20, 20))
    for x, y, w, d, h, _ in boxes:
        part = grid[x:x + w, y:y + d]
        np.maximum(part, 3 * h, out=part)
    assert all(block.mesh.is_volume for block in blocks)
    slots_m3 = SLOT_M * 8 * 12 * 4 * len(boxes)
    assert grid.sum() - slots_m3 <= total_volume(blocks) <= 1.005 * grid.sum() + 0.5
