import math

import pytest

from radiotwin.footprints.heights import Height, height_of, parse_length_m


@pytest.mark.parametrize(("text", "metres"), [
    ("12", 12), ("12.5", 12.5), (" 12 m", 12), ("12m", 12), ("9 metres", 9), (".5", 0.5), ("33'", 10.0584),
    ("33 ft", 10.0584), ("33 feet", 10.0584), ("6'6\"", 1.9812), ("33′ 6″", 10.2108), ("-5", -5), ("-3'", -0.9144)])
def test_lengths(text, metres):
    assert parse_length_m(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["", "tall", "12,5", "12;14", "1e3", "12 km", "nan", "inf", "12 34", "'", "٣x"])
def test_invalid_lengths(text):
    assert math.isnan(parse_length_m(text))


@pytest.mark.parametrize(("tags", "height"), [
    ({}, Height(0, 10, "default")),
    ({"height": "12"}, Height(0, 12, "height")),
    ({"height": "12", "building:levels": "9"}, Height(0, 12, "height")),
    ({"building:levels": "4"}, Height(0, 12, "building:levels")),
    ({"building:levels": "2.5"}, Height(0, 7.5, "building:levels")),
    ({"height": "-5", "building:levels": "2"}, Height(0, 6, "building:levels", ["height=-5"])),
    ({"height": "0"}, Height(0, 10, "default", ["height=0"])),
    ({"height": "5000"}, Height(0, 10, "default", ["height=5000"])),
    ({"height": "high", "building:levels": "-1"}, Height(0, 10, "default", ["height=high", "building:levels=-1"])),
    ({"height": "20", "min_height": "5"}, Height(5, 20, "height")),
    ({"height": "20", "min_height": "0"}, Height(0, 20, "height")),
    ({"height": "20", "building:min_level": "2"}, Height(6, 20, "height")),
    ({"height": "20", "min_height": "-1"}, Height(0, 20, "height", ["min_height=-1"])),
])
def test_height_and_its_source(tags, height):
    assert height_of(tags, 10.0) == height
