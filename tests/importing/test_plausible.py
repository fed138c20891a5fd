"""Values that contradict physics, or the rest of their file: left out, read as what they are, or told."""

import numpy as np
import pytest

from radiotwin.errors import BadInput

MAPPING = {"columns": {"time": "2024-02-28 {t}", "x": "x", "y": "always 0", "level": "l", "device": "d"}, "length_unit": "m",
           "time_format": "%Y-%m-%d %H:%M:%S", "time_zone": "UTC"}


def rows(times, levels=None, device="a"):
    levels = levels or [-80 - i % 20 for i in range(len(times))]
    return "t,x,l,d\n" + "".join(f"{time},{i},{level},{device}\n" for i, (time, level) in enumerate(zip(times, levels)))


MIDNIGHT = ["23:59:58", "23:59:59", "00:00:00", "00:00:01"]


def test_rows_after_midnight_are_of_the_next_day(bring_in):
    result = bring_in(rows(MIDNIGHT), **MAPPING)
    assert list(np.diff(result.table["time_s"])) == [1, 1, 1]
    assert any("row 4: the clock passes midnight" in text for text in result.report["warnings"])
    flights = bring_in(rows(MIDNIGHT), **{**MAPPING, "columns": MAPPING["columns"] | {"flight": "by day"}}).table["flight"]
    assert list(flights) == ["2024-02-28", "2024-02-28", "2024-02-29", "2024-02-29"]


def test_a_clock_with_a_date_that_goes_back_is_told(bring_in):
    given = {**MAPPING, "columns": MAPPING["columns"] | {"time": "t"}}
    result = bring_in(rows([f"2024-02-28 {time}" for time in MIDNIGHT]), **given)
    assert result.table["time_s"].max() - result.table["time_s"].min() == 86_399
    assert any("row 4: the clock goes back by 23:59:59 (1 times" in text for text in result.report["warnings"])


def test_devices_one_after_the_other_are_no_midnight(bring_in):
    text = rows(MIDNIGHT[:2]) + rows(["00:00:00", "00:00:01"], device="b").partition("\n")[2]
    assert bring_in(text, **MAPPING).table["time_s"].max() - bring_in(text, **MAPPING).table["time_s"].min() == 86_399


@pytest.mark.parametrize(("form", "message"), [
    ("%H:%M:%S", "it has no date: put the date before it.*--columns 'time=2024-05-01 {Time}'"),
    ("ISO 8601", "it has no date: put the date before it"), ("%Y-%m-%d %H:%M:%S %p", "%p .AM, PM. belongs to %I"),
    ("%Y-%m-%d %I:%M:%S", "%p .AM, PM. belongs to %I")])
def test_formats_that_lack_something(bring_in, form, message):
    with pytest.raises(BadInput, match=message):
        bring_in(rows(MIDNIGHT), **{**MAPPING, "time_format": form, "columns": MAPPING["columns"] | {"time": "t"}})


@pytest.mark.parametrize(("code", "side"), [(-1, "above"), (-160, "below")])
def test_a_level_far_from_all_others_is_told(bring_in, code, side):
    levels = [-80 - i for i in range(30)] + [code, code]
    text = rows([f"10:00:{i:02}" for i in range(32)], levels)
    assert any(f"2 of the levels are {code}," in note and side in note and f"--not-measured {code}" in note
               for note in bring_in(text, **MAPPING).report["warnings"])
    assert len(bring_in(text, **MAPPING, not_measured=[code]).table) == 30


def test_path_losses(bring_in):
    losses = rows(MIDNIGHT, [120, 125.5, 139, 141])
    with pytest.raises(BadInput, match="nothing is left.*--path-loss"):
        bring_in(losses, **MAPPING, level_unit="dB")
    with pytest.raises(BadInput, match="path_loss is in dB"):
        bring_in(losses, **MAPPING, path_loss=True)
    given = {**MAPPING, "level_unit": None}
    np.testing.assert_allclose(bring_in(losses, **given, path_loss=True, level_offset_db=3.0).table["gain_db"],
                               [-117, -122.5, -136, -138])
    assert list(bring_in(losses, **given, path_loss=True, not_detected_at_or_below=139.0).table["gain_db"].isna()) == \
        [False, False, True, True]


def test_names_whose_digits_were_cut_are_told(bring_in):
    notes = bring_in(rows(MIDNIGHT, device="2.62013E+13"), **MAPPING).report["warnings"]
    assert any("device '2.62013E+13' is a number whose last digits" in note for note in notes)


def test_a_column_may_name_its_unit(bring_in):
    text = "x_m,Height (ft),l,d\n1,10,-80,a\n"
    columns = {"x": "x_m", "y": "always 0", "z": "Height (ft)", "level": "l", "device": "d"}
    result = bring_in(text, columns=columns)  # and zero is so in any unit
    assert list(result.table["receiver_z_m"]) == [3.048] and list(result.table["receiver_y_m"]) == [0]
    with pytest.raises(BadInput, match="always 1.5: length_unit is not given"):
        bring_in(text, columns=columns | {"z": "always 1.5"})


def test_the_note_on_time_zones_is_of_undeclared_ones(bring_in):
    text = ("WigleWifi-1.4,appRelease=2\nMAC,SSID,AuthMode,FirstSeen,Channel,RSSI,CurrentLatitude,CurrentLongitude,"
            "AltitudeMeters,AccuracyMeters,Type\n02:00,net,[W],2020-01-31 11:44:00,6,-60,48.1,11.5,520.5,4.0,WIFI\n")
    assert any("are read as UTC" in note for note in bring_in(text).report["warnings"])
    assert not any("are read as UTC" in note for note in bring_in(text, time_zone="Europe/Berlin").report["warnings"])


@pytest.mark.parametrize(("latitude", "longitude", "left_out"), [
    (-48.1, 11.5, 1), (4.81, 11.5, 1), (48.1, -150, 1), (49.3, 11.5, 1), (48.2, 11.5, 1), (48.104, 11.5, 0), (-677.7, 11.5, 1)])
def test_one_fix_that_is_none(bring_in, latitude, longitude, left_out):
    """The others go north by 11 m in a second; one lies 11 km off, or farther."""
    places = [(48.1 + i * 1e-4, 11.5) for i in range(40)]
    places[20] = (latitude, longitude)
    text = "t,lat,lon,l,d\n" + "".join(f"2024-05-01T10:00:{i:02}Z,{lat},{lon},{-80 - i % 9},a\n" for i, (lat, lon) in enumerate(places))
    columns = {"time": "t", "latitude": "lat", "longitude": "lon", "level": "l", "device": "d"}
    report = bring_in(text, columns=columns, time_format="ISO 8601").report
    assert report["kept"] == 40 - left_out and [each["first"] for each in report["left_out"]] == ["row 22"] * left_out


def test_two_campaigns_are_no_glitches(bring_in):
    text = "x,l,d\n" + "".join(f"{i + 300_000 * (i > 20)},{-80 - i % 9},a\n" for i in range(40))
    assert bring_in(text, columns={"x": "x", "y": "always 0", "level": "l", "device": "d"}, length_unit="m").report["kept"] == 40


def test_a_far_gateway_is_no_glitch(bring_in):
    text = "x,l,d,g\n" + "".join(f"{150_000 * (i == 7)},{-80 - i % 9},a,{'far' if i == 7 else 'near'}\n" for i in range(40))
    columns = {"x": "x", "y": "always 0", "level": "l", "device": "d", "receiver": "g"}
    assert "far" in set(bring_in(text, columns=columns, length_unit="m").table["receiver"])


@pytest.mark.parametrize("height_m", [-9999, -32768, 99999, 65535])
def test_placeholders_of_heights_are_left_out(bring_in, height_m):
    text = "x,z,l,d\n" + "".join(f"{i},{height_m if i in given else 60},{-80 - i % 9},a\n" for given in [(3, 4)] for i in range(40))
    columns = {"x": "x", "y": "always 0", "z": "z", "level": "l", "device": "d"}
    report = bring_in(text, columns=columns, length_unit="m").report
    assert report["kept"] == 38 and report["left_out"][0]["reason"] == "impossible height" and report["left_out"][0]["first"] == "row 5"
    with pytest.raises(BadInput, match="nothing is left of 40 readings: 40 impossible height.*no heights, leave their column out"):
        bring_in(text.replace(",60,", f",{height_m},"), columns=columns, length_unit="m")
