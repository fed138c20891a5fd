"""Units of levels, and levels that are none."""

import numpy as np
import pytest

from radiotwin.errors import BadInput

HEAD = "device,x,y,level\n"


def rows(*levels):
    return HEAD + "".join(f"a,{10 * i},0,{level}\n" for i, level in enumerate(levels))


@pytest.mark.parametrize(("unit", "text", "column", "value"), [
    ("dBm", "-87.5", "rssi_dbm", -87.5), ("mW", "1e-9", "rssi_dbm", -90.0), ("W", "1e-9", "rssi_dbm", -60.0),
    ("dB", "-101.25", "gain_db", -101.25)])
def test_units(bring_in, local, unit, text, column, value):
    result = bring_in(rows(text), columns=local, level_unit=unit, length_unit="m")
    assert list(result.table[column]) == [value]


def test_not_detected_is_blank_and_not_measured_is_gone(bring_in, local):
    result = bring_in(rows(-140, "No Signal", "NaN", -101, -120, -119.5, "-inf"), columns=local, length_unit="m",
                      not_detected=[-140.0, "no signal", "-inf", "nan"], not_measured=[-101.0],
                      not_detected_at_or_below=-120.0)
    np.testing.assert_array_equal(result.table["rssi_dbm"], [np.nan] * 4 + [-119.5, np.nan])
    assert list(result.table["receiver_x_m"]) == [0, 10, 20, 40, 50, 60]
    assert [(item["reason"], item["readings"], item["first"]) for item in result.report["left_out"]] == [
        ("not measured", 1, "row 5")]


def test_the_word_nan_is_no_empty_cell(bring_in, local):
    result = bring_in(rows(-80, "", "nan"), columns=local, length_unit="m", not_detected=["empty"], not_measured=["nan"])
    np.testing.assert_array_equal(result.table["rssi_dbm"], [-80, np.nan])


def test_the_threshold_is_in_the_files_unit(bring_in, local):
    result = bring_in(rows("1e-12", "1e-9"), columns=local, length_unit="m", level_unit="mW",
                      not_detected_at_or_below=1e-11)
    np.testing.assert_array_equal(result.table["rssi_dbm"], [np.nan, -90])


@pytest.mark.parametrize(("unit", "levels", "kept"), [
    ("dBm", (0, 99, -90, -300), 1), ("dB", (0, 80, -90), 1), ("mW", (0, -5, 1e-9, 1), 1)])
def test_impossible_levels_are_counted_and_left_out(bring_in, local, unit, levels, kept):
    result = bring_in(rows(*levels), columns=local, length_unit="m", level_unit=unit)
    assert len(result.table) == result.report["kept"] == kept
    assert result.report["left_out"][0] == {"reason": "impossible level", "column": "level",
                                            "readings": len(levels) - kept, "first": "row 2"}
    assert any("impossible" in text for text in result.report["warnings"])


@pytest.mark.parametrize(("given", "levels", "message"), [
    ({"level_unit": None}, (-120, -60, -75),
     r"column level: level_unit is not given; allowed are dBm, mW and W.*dB.*run from -120 to -60, median -75"),
    ({}, (-90, "weak"), r"row 3, column level: 'weak' is not a number.*not_detected"),
    ({}, (-90, ""), r"row 3, column level: '' is empty; say what that means.*not_detected.*not_measured"),
    ({"not_detected": ["empty"]}, (-90, "NaN"), r"row 3, column level: 'NaN' is not a number.*not_detected.*not_measured"),
    ({}, (-90, "inf"), r"row 3, column level: 'inf' is not a number"),
    ({"level_unit": "dBW"}, (-90,), "level_unit.*dBW.*dBm"),
])
def test_levels_that_cannot_be_used(bring_in, local, tmp_path, given, levels, message):
    with pytest.raises(BadInput, match=message):
        bring_in(rows(*levels), columns=local, length_unit="m", **given)
    assert not (tmp_path / "out").exists()


def test_uncalibrated_levels_are_not_dropped(bring_in, local):
    rows = "".join(f"a,{i},0,{-25 + i}\n" for i in range(50))
    with pytest.raises(BadInput, match=r"column level: 50% of the levels are 0 dB or more, up to 24.*level_offset_db, such as -30"):
        bring_in("device,x,y,level\n" + rows, columns=local, length_unit="m")
    assert len(bring_in("device,x,y,level\n" + rows, columns=local, length_unit="m", level_offset_db=-30.0).table) == 50
    few = "".join(f"a,{i},0,{-80 - i % 7}\n" for i in range(50)) + "a,51,0,99\na,52,0,0\n"
    assert bring_in("device,x,y,level\n" + few, columns=local, length_unit="m").report["left_out"][0]["readings"] == 2
