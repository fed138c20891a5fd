import math
from dataclasses import replace

import numpy as np
import pytest

from radiotwin.scene.readers.heights import Height, height_of, height_sds_m, parse_length_m


@pytest.mark.parametrize(("text", "metres"), [
    ("12", 12), ("12.5", 12.5), ("12,5", 12.5), (" 12 m", 12), ("12m", 12), ("9 metres", 9), (".5", 0.5), ("33'", 10.0584),
    ("33 ft", 10.0584), ("33 feet", 10.0584), ("6'6\"", 1.9812), ("33′ 6″", 10.2108), ("-5", -5), ("-3'", -0.9144)])
def test_lengths(text, metres):
    assert parse_length_m(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["", "tall", "1,234", "1'000", "12;14", "1e3", "12 km", "nan", "inf", "12 34", "'", "٣x"])
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
    ({"height": "20", "min_height": "-1"}, Height(0, 20, "height")),  # the rest of it is below the ground
    ({"building:levels": "2", "building:min_level": "-1"}, Height(0, 6, "building:levels")),
    ({"height": "20", "min_height": "low"}, Height(0, 20, "height", ["min_height=low"])),
    ({"building:levels": "3", "roof:levels": "2"}, Height(0, 15, "building:levels")),
    ({"building:levels": "3", "roof:height": "6", "roof:levels": "1"}, Height(0, 15, "building:levels")),
    ({"building:levels": "0", "roof:levels": "1"}, Height(0, 3, "building:levels")),
    ({"building:levels": "0"}, Height(0, 10, "default", ["building:levels=0"])),
    ({"building:levels": "2,5", "roof:levels": "low"}, Height(0, 7.5, "building:levels", ["roof:levels=low"])),
    ({"height": "12", "roof:height": "4"}, Height(0, 12, "height")),  # it counts the roof
    ({"est_height": "25", "building:levels": "3"}, Height(0, 25, "est_height")),
])
def test_height_and_its_source(tags, height):
    found = height_of(tags, 10.0)
    assert replace(found, sd_m=0.0) == replace(height, sd_m=0.0)
    sd_m = {"height": 1.5, "default": math.nan}.get(height.source, 3.0)
    assert found.sd_m == pytest.approx(sd_m, nan_ok=True)


def test_a_default_is_off_as_far_as_known_heights_of_the_same_map_lie_from_it():
    known_m = np.array([4.0, 22.0] * 6)  # 6 and 12 m from the default: 9.5 m in the mean of squares
    top_m, sd_m = np.append(known_m, [10.0, 10.0]), np.append(np.full(12, 1.5), [np.nan] * 2)
    assert height_sds_m(top_m, sd_m) == pytest.approx([1.5] * 12 + [math.sqrt(90.0)] * 2)
    near_m = np.append(np.full(12, 10.5), [10.0, 10.0])
    assert height_sds_m(near_m, sd_m)[-1] == 3.0  # no better than counted storeys
    assert height_sds_m(top_m[-5:], sd_m[-5:])[-1] == 6.0  # three tell nothing of the others
    assert height_sds_m(top_m[:12], sd_m[:12]).tolist() == [1.5] * 12
    assert len(height_sds_m(np.array([]), np.array([]))) == 0
