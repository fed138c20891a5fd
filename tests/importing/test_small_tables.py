"""What a small table becomes, or why it is refused: one import a case."""

from typing import NamedTuple

import pandas as pd
import pytest

from radiotwin.errors import BadInput

COLUMNS = {"x": "x", "y": "y", "device": "d", "level": "l"}
HEAD = "x,y,d,l\n"
PLACES = "cell,lat,lon,level\n"
BY_PLACE = {"columns": {"device": "cell", "latitude": "lat", "longitude": "lon", "level": "level"}}
WIDE = "t,x,y,PCI_1,RSRP_1,PCI_2,RSRP_2\n1,0,0,17,-80,22,-95\n2,5,0,22,-90,,\n"
WIGLE = ("WigleWifi-1.4,appRelease=2\nMAC,SSID,AuthMode,FirstSeen,Channel,RSSI,CurrentLatitude,CurrentLongitude,"
         "AltitudeMeters,AccuracyMeters,Type\n02:00,net,[W],2020-01-31 11:44:00,6,-60,48.1,11.5,520.5,4.0,WIFI\n")
NAN = float("nan")


def local(**more):
    """Settings for local positions, with more columns, or other settings after `_`."""
    settings = {name.removeprefix("_"): more.pop(name) for name in [*more] if name.startswith("_")}
    return {"length_unit": "m", "columns": {name: spec for name, spec in (COLUMNS | more).items() if spec}} | settings


def wide(**settings):
    return {"length_unit": "m", "columns": {"x": "x", "y": "y"}} | settings


def along(*levels):
    return HEAD + "".join(f"{10 * i},0,a,{level}\n" for i, level in enumerate(levels))


def clock(*times, device="a"):
    return "t,x,l,d\n" + "".join(f"{time},{i},{-80 - i},{device}\n" for i, time in enumerate(times))


LATE = pd.Timestamp("2024-02-28 23:59:58Z").timestamp()
MIDNIGHT = ["23:59:58", "23:59:59", "00:00:00", "00:00:01"]
DATED = {"time": "2024-02-28 {t}", "y": "always 0", "_time_format": "%Y-%m-%d %H:%M:%S", "_time_zone": "UTC"}


class Case(NamedTuple):
    """A text, settings, and what they give.

    `table` and `devices` are columns of these tables, `left_out` reason -> readings, `says` a part of the warnings.
    """

    text: str
    given: dict
    table: dict = {}
    devices: dict = {}
    left_out: dict | None = None
    says: str = ""
    files: dict = {}


CASES = {
    # Heights
    "a constant height above the ground": Case(along(-80, -81), local(above_ground="always 1.5"), {
        "receiver_above_ground_m": [1.5] * 2, "receiver_z_m": [NAN] * 2}),
    "heights in feet, of receivers and devices": Case(
        "x,y,h,dx,dy,dh,d,l\n0,0,10,5,5,60,a,-80\n10,0,20,5,5,60,a,-81\n20,0,,9,9,,b,-82\n",
        local(above_ground="h", device_x="dx", device_y="dy", device_above_ground="dh", _length_unit="ft"),
        {"receiver_above_ground_m": [3.048, 6.096, NAN], "receiver_x_m": [0, 3.048, 6.096]},
        {"above_ground_m": [18.288, NAN], "z_m": [NAN, NAN]}),
    "heights of tables, but those of the file come first": Case(
        "who,d,l,h\nvan,a,-80,\nbike,b,-81,\nbike,a,-82,1.6\n",
        local(x=None, y=None, receiver="who", above_ground="h", _receivers="cars.csv", _devices="masts.csv"),
        {"receiver_above_ground_m": [2.5, 1.2, 1.6]}, {"above_ground_m": [25, NAN], "z_m": [NAN, 130]},
        files={"cars.csv": "receiver,x_m,y_m,above_ground_m\nvan,1,2,2.5\nbike,3,4,1.2\n",
               "masts.csv": "device,x_m,y_m,z_m,above_ground_m\na,0,0,,25\nb,9,9,130,\n"}),
    "a place of the file has the height of the table": Case(
        "x,y,dx,dy,dh,d,l\n0,0,1,1,,a,-80\n0,0,2,2,7,b,-81\n0,0,3,3,,c,-82\n",
        local(device_x="dx", device_y="dy", device_above_ground="dh", _devices="masts.csv"), {},
        {"x_m": [1, 2, 3], "y_m": [1, 2, 3], "z_m": [25, NAN, NAN], "above_ground_m": [NAN, 7, NAN]},
        files={"masts.csv": "device,x_m,y_m,z_m\na,0,0,25\nb,9,9,30\nc,1,1,\n"}),
    "a height of the file holds for positions of a table": Case(
        "who,d,l\nroof,a,-70\n", {"columns": {"receiver": "who", "device": "d", "level": "l", "height": "always 12"},
                                  "length_unit": "m", "receivers": "fixed.csv"}, {"receiver_z_m": [12]},
        files={"fixed.csv": "receiver,latitude,longitude\nroof,48,11\n"}),
    "altitudes of projected positions": Case(
        "x,y,a,d,l\n500000,5300000,530,a,-80\n", local(altitude="a", _crs="EPSG:32632", _origin={
            "latitude_deg": 47.8, "longitude_deg": 9, "altitude_m": 500}), {"receiver_z_m": [30]}),
    "devices without a height are named": Case(
        HEAD + "0,0,a,-80\n0,0,b,-80\n", local(_devices="sites.csv"), says="1 of 2 devices have no height (a): give it in sites.csv",
        files={"sites.csv": "device,x_m,y_m,agl_m\na,1,2,\nb,1,2,30\n"}),
    "a unit in the names of columns, and zero, which is so in any": Case(
        "x_m,Height (ft),d,l\n1,10,a,-80\n", local(x="x_m", y="always 0", z="Height (ft)", _length_unit=None), {
            "receiver_x_m": [1], "receiver_y_m": [0], "receiver_z_m": [3.048]}),
    # Names and columns
    "names of devices in columns beside their levels": Case(
        WIDE, wide(wide=[{"level": "RSRP_*", "device": "PCI_*"}]), {"device": ["17", "22", "22"], "rssi_dbm": [-80, -95, -90]},
        left_out={"no device": 1}),
    "names of receivers in columns": Case(
        "x,y,who 1,l 1,id\n0,0,roof,-80,b\n", {"length_unit": "m", "columns": {"x": "x", "y": "y", "device": "id"},
                                               "wide": [{"level": "l *", "receiver": "who *"}]}, {"receiver": ["roof"]}),
    "names that are made of the columns' names": Case(
        WIDE, wide(wide=[{"level": "RSRP_*", "device": "PIC_*"}], not_measured=["empty"]), {"device": ["PIC_1", "PIC_2", "PIC_1"]},
        says="wide.device = 'PIC_*' is no column of the file: the devices are named PIC_1, PIC_2"),
    "a column for each device": Case(
        "x,y,rssi A,rssi B\n1,2,-80,-81\n3,4,-101,-83\n",
        wide(wide=[{"level": "rssi *", "device": "*"}], not_measured=[-101.0], devices="sites.csv"),
        {"device": ["A", "B", "B"], "receiver_x_m": [1, 1, 3], "rssi_dbm": [-80, -81, -83]}, {"role": ["anchor", "unknown"]},
        {"not measured": 1}, files={"sites.csv": "device,x,y,z\nA,5,6,7\n"}),
    "a column for each receiver, fixed ones and one that moves": Case(
        "roof,yard,bus_l,bus_x,bus_y,id\n-70,-75,-80,7,8,d\n",
        {"length_unit": "m", "columns": {"device": "id"}, "receivers": "fixed.csv", "wide": [
            {"level": ["roof", "yard"], "receiver": "*"}, {"level": "*_l", "receiver": "*", "x": "*_x", "y": "*_y"}]},
        {"receiver": ["roof", "bus"], "receiver_x_m": [100, 7], "receiver_y_m": [0, 8], "rssi_dbm": [-70, -80]},
        left_out={"no position of receiver 'yard'": 1}, files={"fixed.csv": "receiver,x,y\nroof,100,0\n"}),
    "offsets of levels": Case(
        WIDE, wide(not_measured=["empty"], level_offset_db=-1.0, wide=[
            {"level": "RSRP_1", "device": "one", "level_offset_db": 10.0}, {"level": "RSRP_2", "device": "two"}]),
        {"device": ["one", "two", "one"], "rssi_dbm": [-71, -96, -81]}),
    "columns made of several, empty if one is": Case(
        "day,clock,mcc,cell,x,y,l\n01.02.2024,10:00:00,262,7,0,0,-80\n01.02.2024,,262,7,1,0,-81\n01.02.2024,10:00:02,262,,2,0,-82\n",
        local(time="{day} {clock}", device="cell {mcc}-{cell}", _time_format="%d.%m.%Y %H:%M:%S", _time_zone="UTC"),
        {"device": ["cell 262-7"] * 2, "time_s": [1706781600, NAN]}, left_out={"no device": 1}),
    "a name with braces": Case("x,y,{d},l\n0,0,a,-80\n", local(device="{d}"), {"device": ["a"]}),
    "constants and all other columns": Case(
        "x,y,d,l,h,p,r,q,t\n1,2,a,-80,370,3,-4,9,100.5\n", local(
            z="always 1.5", receiver="always phone", flight="by day", time="t", heading="h", pitch="p", roll="r", quality="q",
            _time_format="epoch s"),
        {"time_s": [100.5], "flight": ["1970-01-01"], "receiver": ["phone"], "receiver_x_m": [1], "receiver_y_m": [2],
         "receiver_z_m": [1.5], "device": ["a"], "rssi_dbm": [-80], "heading_deg": [370], "pitch_deg": [3], "roll_deg": [-4],
         "quality": [9]}, says="since 1970"),
    "rows are chosen before they are read": Case(
        "x,y,d,l,tech,gps\n0,0,a,-80,LTE,1\nnone,0,b,-81,GSM,1\n2,0,c,-82,NR,1\n3,0,d,-83,NR,0\n",
        local(_only={"tech": ["LTE", "NR"], "gps": [1.0]}), {"device": ["a", "c"]}, left_out={"is not one of only": 2}),
    "names whose digits were cut": Case(HEAD + "0,0,2.62013E+13,-80\n", local(),
                                        says="device '2.62013E+13' is a number whose last digits"),
    # Devices
    "positions of devices from columns": Case(
        "x,y,d,l,dx,dy,dz\n1,2,a,-80,30,40,5\n1,2,b,-80,,,\n9,9,a,-80,30,40,5\n", local(device_x="dx", device_y="dy", device_z="dz"), {},
        {"device": ["a", "b"], "x_m": [30, NAN], "y_m": [40, NAN], "z_m": [5, NAN], "role": ["anchor", "unknown"]}),
    "positions of devices from a table": Case(
        HEAD + "0,0,a,-80\n0,0,b,-81\n", local(_devices="sites.csv"), {},
        {"device": ["a", "b"], "role": ["unknown", "anchor"], "x_m": [NAN, 30.48], "z_m": [NAN, 24], "frequency_hz": [NAN, 9e8],
         "azimuth_deg": [NAN, 120]},
        files={"sites.csv": "device,x_ft,y_ft,z_m,frequency_hz,azimuth_deg\nb,100,0,24,9e8,120\nc,1,1,1,9e8,0\n"}),
    "carriers of several bands are told apart, channels of one are not": Case(
        "x,y,d,l,f\n0,0,12,-80,8e8\n1,0,12,-70,1.8e9\n2,0,12,-81,8.02e8\n0,0,n,-90,868.1e6\n1,1,n,-91,869.5e6\n",
        local(frequency_hz="f", _devices="sites.csv"), {"device": ["12 801 MHz", "12 1800 MHz", "12 801 MHz", "n", "n"]},
        {"x_m": [10, 10, 5], "above_ground_m": [30, 30, 2], "azimuth_deg": [120, 120, NAN], "frequency_hz": [8.01e8, 1.8e9, 868.8e6]},
        says="1 device read on carriers of several bands (12)",
        files={"sites.csv": "device,x,y,above_ground_m,azimuth_deg\n12,10,20,30,120\nn,5,5,2,\n"}),
    "a moving device is named by its position": Case(
        "x,y,d,l,tx,ty\n1,2,_,-80,30,40\n1,2,_,-81,50,60\n1,2,_,-82,30,40\n1,2,_,-83,,60\n",
        local(device_x="tx", device_y="ty", device="by position"), {"device": ["p1", "p2", "p1"]}, {"x_m": [30, 50], "y_m": [40, 60]},
        {"no device": 1}),
    "one device has no position": Case(HEAD + "0,0,a,-80\n", local(), says="1 of 1 devices have no position"),
    "where a transmitter was and when": Case(
        "t,x,y,d,l\n" + "".join(f"2024-03-01 {time},{i},0,b,-8{i}\n" for i, time in enumerate(
            ("09:00", "10:00", "10:59", "11:30", "12:00", "18:00"))),
        local(time="t", _time_format="ISO 8601", _time_zone="UTC", _devices="sites.csv"),
        {"device": ["b", "b@1", "b@1", "b", "b@2", "b@2"]},
        {"device": ["b", "b@1", "b@2"], "role": ["unknown", "anchor", "anchor"], "x_m": [NAN, 100, 500], "z_m": [NAN, 2, 3],
         "frequency_hz": [NAN, 8e8, 9e8]},
        files={"sites.csv": "device,x,y,z,since,until,frequency_hz\nb,500,0,3,2024-03-01 12:00,,9e8\n"
                            "b,100,0,2,2024-03-01 10:00,2024-03-01 11:00,8e8\nc,1,1,1,,,\n"}),
    "a beacon with its own GNSS at two places, and back at the first": Case(
        "x,y,d,l,dx,dy\n0,0,b,-80,100,0\n1,0,b,-81,100,1.5\n2,0,b,-82,900,0\n3,0,b,-83,900,1\n4,0,b,-84,100,0.5\n5,0,b,-85,,\n",
        local(device_x="dx", device_y="dy", _place_m=5.0), {"device": ["b@1", "b@1", "b@2", "b@2", "b@1", "b"]},
        {"device": ["b@1", "b@2", "b"], "x_m": [100, 900, NAN], "y_m": [0.5, 0.5, NAN], "role": ["anchor", "anchor", "unknown"]}),
    "tables of sites in words of their own": Case(
        "d,l,r\n262-01-9,-80,r1\n262-1-8,-81,r1\n", local(x=None, y=None, receiver="r", _devices="sites.csv", _receivers="roofs.csv",
                                                           _length_unit=None), {"receiver_above_ground_m": [3.048] * 2},
        {"device": ["262-01-9", "262-1-8"], "above_ground_m": [NAN, 27.432], "azimuth_deg": [NAN, 0], "tilt_deg": [NAN, 0],
         "eirp_dbm": [NAN, 50], "frequency_hz": [NAN, 8e8]}, says="1 of 2 names occur in no row of the log: 262-1-9 (262-01-9 there)",
        files={"sites.csv": "Cell ID;Lat;Long;Antenna Height (ft);Azimuth;Downtilt;EIRP (W);Freq (MHz);Owner\n"
                            "262-1-9;48,105;11,5;100;120;6;1000;1800;me\n262-1-8;48,1;11,5;90;0;0;100;800;me\n",
               "roofs.csv": "Station,lat,lng,mast height ft,colour\nr1,48.1,11.5,10,red\n"}),
    "columns of tables of sites that are not used": Case(
        HEAD + "0,0,a,-80\n", local(_devices="sites.csv"), says="sites.csv: column not used: Owner",
        files={"sites.csv": "device,x,y,Owner\na,1,1,me\n"}),
    # Levels
    "milliwatts": Case(along("1e-9"), local(_level_unit="mW", _level_offset_db=3.0), {"rssi_dbm": [-87]}),
    "watts": Case(along("1e-9"), local(_level_unit="W"), {"rssi_dbm": [-60]}),
    "gains": Case(along("-101.25"), local(_level_unit="dB"), {"gain_db": [-101.25]}),
    "not detected is blank, not measured is gone": Case(
        along(-140, "No Signal", "NaN", -101, -120, -119.5, "-inf"),
        local(_not_detected=[-140.0, "no signal", "-inf", "nan"], _not_measured=[-101.0], _not_detected_at_or_below=-120.0),
        {"rssi_dbm": [NAN] * 4 + [-119.5, NAN], "receiver_x_m": [0, 10, 20, 40, 50, 60]}, left_out={"not measured": 1}),
    "the word NaN is no empty cell": Case(along(-80, "", "nan"), local(_not_detected=["empty"], _not_measured=["nan"]),
                                          {"rssi_dbm": [-80, NAN]}, left_out={"not measured": 1}),
    "a threshold in the file's unit": Case(along("1e-12", "1e-9"), local(_level_unit="mW", _not_detected_at_or_below=1e-11),
                                           {"rssi_dbm": [NAN, -90]}),
    "impossible powers": Case(along(0, 99, -90, -300), local(), {"rssi_dbm": [-90]}, left_out={"impossible level": 3},
                              says="75% of the levels are impossible"),
    "impossible gains": Case(along(0, 80, -90), local(_level_unit="dB"), {"gain_db": [-90]}, left_out={"impossible level": 2}),
    "impossible milliwatts": Case(along(0, -5, 1e-9, 1), local(_level_unit="mW"), {"rssi_dbm": [-90]},
                                  left_out={"impossible level": 3}),
    "an impossible level is one after the offset": Case(along(5, -20), local(_level_offset_db=-10.0), {"rssi_dbm": [-5, -30]}),
    "path losses": Case(along(120, 125.5, 139, 141), local(_level_unit=None, _path_loss=True, _level_offset_db=3.0),
                        {"gain_db": [-117, -122.5, -136, -138]}),
    "path losses above a threshold": Case(
        along(120, 125.5, 139, 141), local(_level_unit=None, _path_loss=True, _not_detected_at_or_below=139.0),
        {"gain_db": [-120, -125.5, NAN, NAN]}),
    "most levels are not detected": Case(along("", "", -80), local(_not_detected=["empty"]),
                                         says="67% of the levels are not detected"),
    "the smallest level is frequent": Case(along(*(-90 - i % 5 for i in range(30))), local(),
                                           says="20% of the levels are -94, the smallest"),
    "a few codes among uncalibrated levels": Case(along(*(-80 - i % 7 for i in range(50)), 99, 0), local(),
                                                  left_out={"impossible level": 2}),
    "a code above all levels": Case(along(*(-80 - i for i in range(30)), -1, -1), local(),
                                    says="2 of the levels are -1, 79 dB above all others"),
    "a code below all levels": Case(along(*(-80 - i for i in range(30)), -160, -160), local(), says="give --not-measured -160"),
    # What is left out
    "each row that is not kept is counted": Case(
        PLACES + "a,48,11,-80\na,0,0,-80\na,,,-80\n,48,11,-80\na,48,11,0\na,48,11,-80\n", BY_PLACE, {"rssi_dbm": [-80]}, left_out={
            "impossible level": 1, "no device": 1, "latitude, longitude 0, 0 (no fix)": 1,
            "no position of receiver 'receiver'": 1, "repeats an earlier row exactly": 1}),
    "ranges; a device without a position and a blank level pass": Case(
        "x,y,z,d,l\n30,0,0,a,-60\n300,0,0,a,-70\n3000,0,0,a,-80\n1,0,0,b,-70\n300,0,0,a,-99\n301,0,0,a,-41\n302,0,0,a,none\n",
        local(z="z", _min_distance_m=51.0, _max_distance_m=1000.0, _min_level=-90.0, _max_level=-50.0, _not_detected=["empty"],
              _devices="sites.csv"),
        {"receiver_x_m": [300, 1, 302]},
        left_out={"nearer than 51.0 m": 1, "further than 1000.0 m": 1, "level below -90.0": 1, "level above -50.0": 1},
        files={"sites.csv": "device,x,y,z\na,0,0,40\n"}),
    "a distance in three dimensions": Case(
        "x,y,z,d,l\n30,0,0,a,-60\n", local(z="z", _min_distance_m=49.0, _devices="sites.csv"), {"receiver_x_m": [30]}, left_out={},
        files={"sites.csv": "device,x,y,z\na,0,0,40\n"}),
    "local means say of how many readings they are": Case(
        HEAD + "0,0,a,-80\n1,0,a,-80\n10,0,a,-90\n", local(frequency_hz="always 1e9", _average_m=5.0),
        {"quality": [2, 1], "receiver_x_m": [0.5, 10]}, says="17 wavelengths; 20 to 40 (Lee 1985) are 6.0 to 12.0 m"),
    "a stay counts once": Case(
        "t,x,y,d,l\n0,0,0,b,-80\n1,1,0,b,-81\n2,2,0,b,-82\n", local(time="t", _time_format="epoch s", _thin_m=1.5),
        {"rssi_dbm": [-81, -82]}, left_out={"stay within 1.5 m": 1}),
    "two campaigns are no glitches": Case(
        "x,l,d\n" + "".join(f"{i + 300_000 * (i > 20)},{-80 - i % 9},a\n" for i in range(40)), local(y="always 0"), left_out={},
        says="300 km apart"),
    "a far gateway is no glitch": Case(
        "x,l,d,g\n" + "".join(f"{150_000 if i == 7 else i},{-80 - i % 9},a,{'far' if i == 7 else 'near'}\n" for i in range(40)),
        local(y="always 0", receiver="g"), left_out={}),
    **{f"a walk north by 11 m in a second, and once at {place}": Case(
        "t,lat,lon,l,d\n" + "".join(f"2024-05-01T10:00:{i:02}Z,{place if i == 20 else f'{48.1 + i * 1e-4},11.5'},{-80 - i % 9},a\n"
                                    for i in range(40)),
        {"time_format": "ISO 8601", "columns": {"time": "t", "latitude": "lat", "longitude": "lon", "level": "l", "device": "d"}},
        {"rssi_dbm": [-80 - i % 9 for i in range(40) if i != 20 or not bad]}) for place, bad in (
            ("-48.1,11.5", 1), ("4.81,11.5", 1), ("48.1,-150", 1), ("48.2,11.5", 1), ("48.104,11.5", 0), ("-677.7,11.5", 1))},
    "a place that a program writes without a fix": Case(
        "d,lat,lon,r,l,n\n" + "".join(f"{row},{i}\n" for i, row in enumerate(
            [f"a,48.10{i},11.50{i},phone,-8{i}" for i in range(5)] + ["a,37.751,-97.822,phone,-70"] * 20 + ["a,52.5,13.4,mast,-90"] * 20)),
        {"columns": {"device": "d", "latitude": "lat", "longitude": "lon", "level": "l", "receiver": "r"}},
        {"receiver": ["phone"] * 5 + ["mast"] * 20},
        left_out={"no fix: a receiver that moves elsewhere stays at 37.751, -97.822": 20}),
    "placeholders of heights": Case(
        "x,z,l,d\n" + "".join(f"{i},{(-9999, -32768, 99999, 65535)[i // 2 % 4] if i < 8 else 60},{-80 - i % 9},a\n" for i in range(40)),
        local(y="always 0", z="z"), left_out={"impossible height": 8}),
    # Times
    "rows after midnight are of the next day": Case(
        clock(*MIDNIGHT), local(flight="by day", **DATED),
        {"time_s": [LATE, LATE + 1, LATE + 2, LATE + 3], "flight": ["2024-02-28"] * 2 + ["2024-02-29"] * 2},
        says="row 4: the clock passes midnight"),
    "a clock with a date that goes back": Case(
        clock(*(f"2024-02-28 {time}" for time in MIDNIGHT)), local(**DATED | {"time": "t"}),
        {"time_s": [LATE, LATE + 1, LATE - 86_398, LATE - 86_397]}, says="row 4: the clock goes back by 23:59:59 (1 times"),
    "devices one after the other are no midnight": Case(
        clock(*MIDNIGHT[:2]) + clock(*MIDNIGHT[2:], device="b").partition("\n")[2], local(**DATED),
        {"time_s": [LATE, LATE + 1, LATE - 86_398, LATE - 86_397]}),
    "times without a declared zone": Case(WIGLE, {"level_unit": None}, says="are read as UTC"),
}


def written(folder, given, files=()):
    """Write the tables of positions that settings name; return these settings, with the folder."""
    for file in files:
        (folder / file).write_text(files[file])
    return {key: str(folder / given[key]) for key in ("devices", "receivers") if key in given}


@pytest.mark.parametrize("name", CASES)
def test_a_table(bring_in, tmp_path, name):
    case = CASES[name]
    result = bring_in(case.text, **case.given | written(tmp_path, case.given, case.files))
    for expected, found in ((case.table, result.table), (case.devices, result.devices)):
        for column, values in expected.items():
            assert found[column].tolist() == pytest.approx(values, abs=1e-6, nan_ok=True), column
    reasons = {}
    for each in result.report["left_out"]:
        reasons[each["reason"]] = reasons.get(each["reason"], 0) + each["readings"]
    assert case.left_out is None or reasons == case.left_out
    assert result.report["readings"] == result.report["kept"] + sum(reasons.values())
    assert case.says in "\n".join(result.report["warnings"])


def lines(*cells):
    return HEAD + "".join(f"{each},a,-80\n" for each in cells)


ONE, CLOCK = lines("0,0"), "t,x,y,d,l\n23:59:58,0,0,a,-80\n"
REFUSED = [  # text, settings, words of the message, and tables
    # Columns
    (ONE, local(level="rsrp"), r"column 'rsrp' \(level\) is missing; the file has x, y, d, l"),
    (ONE, local(time="{day} {minute}", device="{d}-{lac}"), r"columns 'lac' \(device\), 'day' \(time\), 'minute' \(time\) are missing"),
    (ONE, local(x="d"), "row 2, column d: 'a' is not a number"), (lines(f"{'9' * 6000},0"), local(), "column x: '9999.* is not a number"),
    (ONE.replace("a,", "\x1b[2Ja,"), local(), r"column d: '\\x1b\[2Ja' is no name"),
    ("x,y,d,l,h\n0,0,a,-80,1e300\n", local(heading="h"), "row 2, column h: '1e300' is out of range"),
    (lines("0,0", "east,0", "west,0"), local(), r"row 3, column x: 'east' is not a number \(2 such rows\)"),
    (lines("5,7"), local(_length_unit=None), "column x: length_unit is not given; allowed are m and ft.*5 to 5"),
    (ONE, local(z="always 1.5", _length_unit=None), "always 1.5: length_unit is not given"),
    (ONE, local(height="x", z="y"), "with one of altitude, height, z, above_ground; given are height, x, y, z"),
    (ONE, local(z=1.5), 'columns.z: 1.5: give the name of a column, or "always 1.5"'),
    (ONE, local(y=None), "x and y are given together"),
    (ONE, local(latitude="x", longitude="y"), "a position is either"),
    (ONE, local(device=None), "columns.device is missing"),
    (ONE, local(level=None), "columns.level is missing"),
    (ONE, local(colour="x"), "columns.colour: unknown; allowed are .*level, device"),
    (ONE, local(device="by position"), "by position.*needs"),
    (ONE, local(flight="by day"), "by day.*needs"),
    (ONE, local(frequency_hz="always 3"), "'3' is no frequency"),
    (ONE, local(_wide=[{"level": "x", "receiver": "*"}]), "cannot both be given"),
    (ONE, local(level=None, _wide=[{"level": "no*", "receiver": "*"}]), "no column fits 'no\\*'"),
    (ONE, local(level=None, _wide=[{"level": ["x", "*"], "receiver": "*"}]), "'x' fits two"),
    (ONE, local(level=None, _wide=[{"level": "x"}]), "needs either receiver or device"),
    (WIDE.replace("PCI_2", "other"), wide(wide=[{"level": "RSRP_*", "device": "PCI_*"}]),
     r"wide.device = 'PCI_\*' names columns .* for RSRP_2 there is no column 'PCI_2'"),
    # Positions
    (lines("0,0", "1e9,0"), local(), "row 3: the receiver lies 1000000 km from the origin .1 such rows"),
    (PLACES + "a,48,11,-80\na,1000,11,-80\n", BY_PLACE, "row 3, column lat: '1000' is no latitude; allowed are -90 to 90"),
    (PLACES + "a,48,11,-80\na,48,400,-80\n", BY_PLACE, "row 3, column lon: '400' is no longitude"),
    (PLACES + "a,-111.8,40.7,-80\na,-111.9,40.8,-80\n", BY_PLACE, "row 2, column lat.*swapped"),
    (ONE, local(x=None, y=None), "nothing is left.*no position of receiver"),
    ("x,z,l,d\n" + "".join(f"{i},-9999,-80,a\n" for i in range(9)), local(y="always 0", z="z"),
     "nothing is left of 9 readings: 9 impossible height.*no heights, leave their column out"),
    ("x,y,d,l,dx,dy\n0,0,b,-80,100,0\n1,0,b,-81,900,0\n", local(device_x="dx", device_y="dy"),
     "positions 800 m apart.*--place-m 5 makes one of each place"),
    (ONE, local(_devices="nowhere.csv"), "nowhere.csv does not exist"),
    ("x,y,d,l,la,lo\n0,0,a,-80,48,11\n", local(device_latitude="la", device_longitude="lo"), "some positions are latitude.*--origin"),
    (ONE, local(_crs="EPSG:1"), "EPSG:1.*is unknown.*such as EPSG:32633"), (ONE, local(_crs="EPSG:4326"), "not a projected one"),
    *((ONE, local(_crs=crs), "is unknown.*AUTHORITY:CODE") for crs in (
        "+init=/etc/passwd:1", "+proj=utm +zone=32 +ellps=bessel +nadgrids=/etc/passwd")),
    (lines("11,48"), local(_crs="EPSG:32632"), "x, y = 11, 48 is latitude 0.000, longitude 4.511, far outside"),
    (lines("5.3e6,5e5"), local(_crs="EPSG:32632"), "far outside of the area of 'EPSG:32632'.*swapped"),
    *((clock("2024-03-01 10:00", device="b"), local(time="t", y="always 0", _time_format="ISO 8601", _devices="sites.csv"), message,
       {"sites.csv": sites}) for message, sites in (
        ("is not before the time until which", "device,x,y,since,until\nb,1,2,2024-03-01 12:00,2024-03-01 11:00\n"),
        ("'noon' is no time in the form ISO 8601", "device,x,y,since\nb,1,2,noon\n"),
        ("'b' occurs twice", "device,x,y\nb,1,2\nb,3,4\n"))),
    (ONE, local(_devices="sites.csv"), "'a' is at several places over time, and some of its readings have no time",
     {"sites.csv": "device,x,y,since\na,1,2,2024-03-01 12:00\na,3,4,2024-03-01 13:00\n"}),
    ("x,y,d,l,dx\n" + "".join(f"{i},0,b,-80,{100 * i}\n" for i in range(1100)), local(device_x="dx", device_y="y", _place_m=5.0),
     "more than 1000 places that are 5 m apart: it moves all the time"),
    *((PLACES + "a,-34.9,-56.2,-80\n", BY_PLACE | {"devices": "sites.csv"}, f"sites.csv: device 'a' at latitude .* km from the middle .*{slip}",
       {"sites.csv": f"device,lat,lon\na,{place}\n"})
      for place, slip in (("-3.489,-56.16", "slipped"), ("34.89,-56.16", "sign"), ("-56.16,-34.89", "swapped"))),
    # Levels
    (along(-120, -60, -75), local(_level_unit=None),
     r"column l: level_unit is not given; allowed are dBm, mW and W.*dB.*run from -120 to -60, median -75"),
    (along(-90, "weak"), local(), "row 3, column l: 'weak' is not a number.*not_detected"),
    (along(-90, ""), local(), "row 3, column l: '' is empty; say what that means.*not_detected.*not_measured"),
    (along(-90, "NaN"), local(_not_detected=["empty"]), "row 3, column l: 'NaN' is not a number.*not_detected.*not_measured"),
    (along(-90, "inf"), local(), "row 3, column l: 'inf' is not a number"),
    (ONE, local(_level_unit="dBW"), "level_unit.*dBW.*dBm"),
    (along(*range(-25, 25)), local(),
     "column l: 50% of the levels are 0 dB or more, up to 24.*level_offset_db, such as -30"),
    (along(120, 125.5, 139), local(_level_unit="dB"), "nothing is left.*--path-loss"),
    (ONE, local(_path_loss=True), "path_loss is in dB"),
    (ONE, local(_min_level=-50.0, _max_level=-90.0), "min_level = -50 must be less than max_level"),
    (ONE, local(_min_level=-70.0), "nothing is left of 1 readings: 1 level below -70"),
    (ONE, local(_average_m=-1.0), "average_m"), (ONE, local(_average_m=True), "average_m: True: Input should be a valid number"),
    # Times
    (CLOCK, local(time="t", _time_format="%H:%M:%S"), "it has no date: put the date before it.*--columns 'time=2024-05-01 {Time}'"),
    (CLOCK, local(time="t", _time_format="ISO 8601"), "it has no date: put the date before it"),
    (CLOCK, local(time="t", _time_format="%Y-%m-%d %H:%M:%S %p"), "%p .AM, PM. belongs to %I"),
    (CLOCK, local(time="t", _time_format="%Y-%m-%d %I:%M:%S"), "%p .AM, PM. belongs to %I")]


@pytest.mark.parametrize("row", REFUSED, ids=lambda row: row[2][:40])
def test_a_table_that_cannot_be_imported(bring_in, tmp_path, row):
    text, given, message, *files = row
    with pytest.raises(BadInput, match=message):
        bring_in(text, **{"time_zone": "UTC"} | given | written(tmp_path, given, *files))
    assert not (tmp_path / "out").exists()
