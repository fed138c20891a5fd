"""Tables of sites: names of columns and their units, what is not used, and what cannot be meant."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.links.plausible import far_notes, tilt_notes, unmatched_notes
from radiotwin.links.site_table import read_site_table

ALL = ("above_ground_m", "tx_power_dbm", "eirp_dbm", "cable_loss_db", "frequency_hz", "azimuth_deg", "tilt_deg",
       "load", "antenna")


def read(text, end="device", uses=ALL, **given):
    rows = [line.replace("~", " ").split(",") for line in text.split()]
    cells = pd.DataFrame(rows[1:], columns=rows[0], dtype=str)
    return read_site_table("sites.csv", cells, lambda row: f"row {row + 2}", end, uses, **given)


@pytest.mark.parametrize(("column", "cell", "quantity", "value"), [
    ("above_ground_ft", "100", "above_ground_m", 30.48), ("Antenna~Height~(m)", "30", "above_ground_m", 30),
    ("antennaHeightFt", "100", "above_ground_m", 30.48), ("AGL[m]", "30", "above_ground_m", 30),
    ("rad_center_ft", "10", "above_ground_m", 3.048), ("altitude_m", "519", "altitude", 519),
    ("amsl_ft", "1000", "altitude", 304.8), ("z_m", "7", "z", 7), ("height_km", "0.1", "height", 100),
    ("Antenna~Height~(ft~AGL)", "100", "above_ground_m", 30.48), ("height~(m~a.g.l.)", "30", "above_ground_m", 30),
    ("alt~(ft~MSL)", "1000", "altitude", 304.8), ("Altitude~[m~ASL]", "519", "altitude", 519), ("agl_m", "3", "above_ground_m", 3),
    ("azimuth", "120", "azimuth_deg", 120), ("Azimuth~(deg)", "120", "azimuth_deg", 120), ("azi", "9", "azimuth_deg", 9),
    ("azimuth_rad", "3.141592653589793", "azimuth_deg", 180), ("tilt", "-6", "tilt_deg", -6),
    ("downtilt", "6", "tilt_deg", -6), ("Mechanical~Tilt", "4", "tilt_deg", -4),
    ("tx_power_w", "20", "tx_power_dbm", 43.0103), ("txPower_dBm", "43", "tx_power_dbm", 43),
    ("tx_power_dbw", "13", "tx_power_dbm", 43), ("power_mw", "100", "tx_power_dbm", 20),
    ("EIRP~(dBm)", "63", "eirp_dbm", 63), ("erp_w", "1000", "eirp_dbm", 62.15),
    ("frequency_mhz", "1800", "frequency_hz", 1.8e9), ("Freq.GHz", "3.5", "frequency_hz", 3.5e9),
    ("frequency", "1800000000", "frequency_hz", 1.8e9), ("feeder_loss", "2", "cable_loss_db", 2),
    ("load_percent", "50", "load", 0.5)])
def test_a_quantity_is_known_by_its_usual_names_and_units(column, cell, quantity, value):
    table = read(f"device,x_m,y_m,{column}\na,1,2,{cell}\n")
    assert table.values[quantity][0] == pytest.approx(value, abs=1e-4) and table.columns[quantity] == column.replace("~", " ")
    assert not table.notes


@pytest.mark.parametrize("names", ["lat,lon", "Latitude,Longitude", "latitude_deg,longitude_deg", "site_lat,site_lng",
                                   "LAT_WGS84,LONG_WGS84"])
@pytest.mark.parametrize("name", ["device", "Cell~ID", "site_name", "gateway"])
def test_places_and_names_by_any_spelling(names, name):
    table = read(f"{name},{names},z_m\nb7,48.1,11.5,3\n")
    assert table.values[["latitude", "longitude", "z"]].values.tolist() == [[48.1, 11.5, 3]]
    assert table.names.tolist() == ["b7"] and not table.notes


@pytest.mark.parametrize(("lat", "lon"), [("48°06'00\"N", "11°30'00\"W"), ("48~06~00~N", "11:30:00W"), ("N48°6'", "-11°30′"),
                                          ("48.1N", "W~11.5"), ("48.1°", "11.5°W"), ("48°06′00.0″", "-11°30'00''")])
def test_degrees_minutes_and_seconds(lat, lon):
    table = read(f"device,lat,lon\na,{lat},{lon}\n")
    np.testing.assert_allclose(table.values[["latitude", "longitude"]], [[48.1, -11.5]])


@pytest.mark.parametrize("lat", ["48°66'N", "48°6'E", "N48S", "48°N6", "north"])
def test_degrees_that_are_none(lat):
    with pytest.raises(BadInput, match="column lat: .* is not a number"):
        read(f"device,lat,lon\na,{lat},11.5\n")


def test_of_several_columns_that_with_the_names_of_the_log_is_taken():
    text = "site,cell,x_m,y_m\ns1,c1,1,2\ns1b,c2,1,2\n"
    assert read(text).names.tolist() == ["c1", "c2"]
    table = read(text, names={"s1"})
    assert table.names.tolist() == ["s1", "s1b"] and table.notes == ("sites.csv: column not used: cell (site has the names)",)


def test_projected_places():
    assert read("device,easting,northing\na,691000,5334000\n", crs=True).values["x"].tolist() == [691000]
    with pytest.raises(BadInput, match="there is no position.*easting"):
        read("device,easting,northing\na,691000,5334000\n")


def test_every_column_that_is_not_used_is_reported():
    (note,) = read("device,x_m,y_m,height_m,height_ft,load,owner\na,1,2,3,9.8,1,me\n", uses=()).notes
    assert note == "sites.csv: columns not used: height_ft (height_m says it), owner, load (not used here)"


@pytest.mark.parametrize("column", ["azimut_degg", "lattitude", "tx_powr_dbm", "antena_height_m", "frequncy_mhz",
                                    "above_grond_ft", "eirp_dmb", "longtitude", "Azimuht"])
def test_a_column_that_is_nearly_a_known_one_is_refused(column):
    with pytest.raises(BadInput, match=f"column '{column}' is nearly a name of"):
        read(f"device,x_m,y_m,{column}\na,1,2,3\n")


@pytest.mark.parametrize("column", ["altitude2_m", "note", "band", "region", "azimuth_source", "vendor"])
def test_another_column_is_none_that_is_misspelt(column):
    assert column in read(f"device,x_m,y_m,altitude_m,{column}\na,1,2,3,4\n").notes[0]


@pytest.mark.parametrize(("text", "message"), [
    ("device,x_m,y_m,frequency\na,1,2,1800\n", "'frequency': the unit of its numbers from 1800 to 1800 is not known; .*mhz"),
    ("device,x_m,y_m,power\na,1,2,43\n", "'power': the unit .*power_dbm or power_w"),
    ("a,1,2\nb,3,4\n", "a table without a header needs one"),
    ("device,x,y\na,1,2\n", "'x': the unit .*x_m or x_ft"),
    ("device,x_m,y_m,tx_power_w\na,1,2,0\n", "column tx_power_w: '0' is no power above zero"),
    ("device,x_m,y_m,z_m\na,1,2,30ft\n", "row 2, column z_m: '30ft' is not a number"),
    ("device,x_m,y_m,power\na,1,2,1MW\n", "column power: '1MW' is not a number"),
    ("device,x_m,y_m,height\na,1,2,30m\nb,1,2,30\n", "'height': the unit of its numbers from 30 to 30 is not known"),
    ("device,x_m,y_m,z_m\na,1,2,-9999\n", "column z_m: '-9999' is no height; .*leave the cell empty"),
    ("device,x_m,y_m,agl_ft\na,1,2,999999\n", "column agl_ft: '999999' is no height"),
    ("device,x_m,y_m,azimuth\na,1,2,65535\n", "column azimuth: '65535' is no azimuth; .*leave the cell empty"),
    ("device,lat_deg,lat_min,lon_deg,lon_min\na,48,6,11,30\n", "'lat_min' is a part of an angle.*decimal degrees"),
    ("device,x_m,y_m,altitude_m,above_ground_m\na,1,2,500,30\n", "row 2: 'a' has several heights, altitude_m and above"),
    ("device,lat,lon\na,111.5,48.1\n", "column lat: '111.5' is no latitude.*swapped"),
    ("device,x_m,y_m,tilt\na,1,2,95\n", "column tilt: '95' is no tilt"),
    ("device,x_m,y_m,azimuth\na,1,2,north\n", "column azimuth: 'north' is not a number")])
def test_what_cannot_be_used_is_named(text, message):
    with pytest.raises(BadInput, match=message):
        read(text)


@pytest.mark.parametrize(("column", "cell", "quantity", "value"), [
    ("height", "30m", "height", 30), ("Antenna~Height", "100'", "above_ground_m", 30.48), ("z_m", "30~m", "z", 30),
    ("height_ft", "10~ft", "height", 3.048), ("power", "20~W", "tx_power_dbm", 43.0103), ("erp", "50~dBm", "eirp_dbm", 52.15),
    ("power_dbm", "43~dBm", "tx_power_dbm", 43), ("downtilt", "6°", "tilt_deg", -6), ("frequency", "1.8~GHz", "frequency_hz", 1.8e9),
    ("height_mm", "30000~mm", "height", 30), ("load", "50%", "load", 0.5)])
def test_cells_may_have_their_units(column, cell, quantity, value):
    cells = pd.DataFrame([["a", "1", "2", cell.replace("~", " ")], ["b", "1", "2", ""]],
                         columns=["device", "x_m", "y_m", column.replace("~", " ")], dtype=str)
    table = read_site_table("sites.csv", cells, lambda row: f"row {row + 2}", "device", ALL)
    np.testing.assert_allclose(table.values[quantity], [value, np.nan], rtol=1e-6)


def test_rows_that_are_all_empty_are_none():
    assert read("device,x_m,y_m,note\na,1,2,\n,,,\nb,3,4,\n,,,\n").names.tolist() == ["a", "b"]
    with pytest.raises(BadInput, match="row 3, column device: '' is empty"):
        read("device,x_m,y_m,note\na,1,2,\n,,,roof\n")


def test_a_place_at_zero_is_a_placeholder():
    with pytest.raises(BadInput, match="0, 0 is a placeholder; leave both empty"):
        far_notes(np.zeros((1, 2)), np.array([52.5, 13.4]), ("latitude", "longitude"), lambda row: "s.csv: 'a'", "it")


def test_what_is_probably_not_meant_is_said():
    assert "2 of 3 declared tilts are above zero" in tilt_notes(np.array([6.0, 4.0, np.nan, 0.0]))[0]
    assert not tilt_notes(np.array([6.0, -4.0]))
    assert "2 of 2 declared tilts" in read("device,x_m,y_m,tilt\na,1,2,8\nb,1,2,2\n").notes[0]
    assert "lowest of 2 sites is 519 m above the ground" in read("device,x_m,y_m,agl_m\na,1,2,519\nb,1,2,533\n").notes[0]
    assert not read("device,x_m,y_m,agl_m\na,1,2,519\nb,1,2,33\n").notes


@pytest.mark.parametrize(("place", "message"), [
    ((-46.6, -23.5), "swapped"), ((23.5, -46.6), r"is a sign wrong \(-23.5, -46.6\)"),
    ((-2.35, -46.6), r"has a decimal point slipped \(-23.5, -46.6\)"),
    ((-23.5, -466e5), r"has a decimal point slipped"), ((60.0, 25.0), "one frame, and one unit")])
def test_a_place_far_away_is_refused_with_the_slip(place, message):
    with pytest.raises(BadInput, match=rf"site a at latitude .* km from the log.*{message}"):
        far_notes(np.array([(-23.4, -46.5), place]), np.array([-23.5, -46.6]), ("latitude", "longitude"),
                  lambda row: f"site {'ba'[row]}", "the log")


def test_a_place_somewhat_far_away_is_said():
    (note,) = far_notes(np.array([[0.0, 0.0], [250e3, 0], [np.nan, 0]]), np.zeros(2), ("x", "y"), "site {}".format, "the log")
    assert "site 1 at x 250000, y 0 is 250 km from the log" in note


def test_names_that_nobody_has_are_said():
    idle, lacking = unmatched_notes("s.csv", ["262-1-100", "13828122", "a", "x"], {"262-01-100", "13828122.0", "a"},
                                    "device")
    assert idle == ("s.csv: 3 of 4 names occur in no row of the log: 262-1-100 (262-01-100 there), 13828122 (13828122.0 "
                    "there); names are compared letter by letter: make them equal")
    assert lacking == "s.csv: 2 of 3 devices of the log are not in it: 13828122.0, 262-01-100"
    assert not unmatched_notes("s.csv", ["a"], {"a", "b"}, "device")
