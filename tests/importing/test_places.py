"""Transmitters at several places over time, stays of a receiver, and clocks that begin anew."""

import numpy as np
import pandas as pd

from radiotwin.importing.repeats import stay_representatives
from radiotwin.importing.units import clock_notes

COLUMNS = {"level": "level", "device": "device", "x": "x", "y": "y", "time": "t"}
GIVEN = {"columns": COLUMNS, "length_unit": "m", "time_format": "ISO 8601", "time_zone": "UTC"}


def log(*times):
    return "t,device,x,y,level\n" + "".join(f"2024-03-01 {time},b,{i},0,-8{i}\n" for i, time in enumerate(times))


def links_of(x_m, level_db, **columns):
    n = len(x_m)
    return pd.DataFrame({"receiver": "r", "device": "d", "flight": "f", "receiver_x_m": np.asarray(x_m, dtype=float),
                         "receiver_y_m": 0.0, "receiver_z_m": np.nan, "level_db": np.asarray(level_db, dtype=float),
                         "time_s": np.arange(n, dtype=float)} | columns, index=np.arange(n) + 7)


def test_of_a_stay_the_reading_of_the_median_level_is_kept():
    links = links_of([0, 0.5, 0.2, 10, 20, 20.5, 20, 20.9], [-80, -85, -70, -90, np.nan, -95, np.nan, -99])
    assert np.flatnonzero(stay_representatives(links, 1.0)).tolist() == [0, 3, 6]  # two of four were not detected
    shuffled = links.sample(frac=1, random_state=1)
    assert set(shuffled.index[stay_representatives(shuffled, 1.0)]) == {7, 10, 13}


def test_stays_are_of_one_device_and_flight():
    links = pd.concat([links_of([0, 0], [-80, -81]), links_of([0, 0], [-80, -81], device="e"),
                       links_of([0, 0], [-80, -81], flight="g")])
    assert stay_representatives(links, 5.0).sum() == 3


def test_a_clock_that_begins_anew_is_told():
    """Two minutes along a line, then the clock restarts a kilometre away."""
    x_m = np.r_[np.arange(120) * 5.0, 1000 + np.arange(60) * 5.0]
    links = links_of(x_m, np.full(180, -80.0), time_s=np.r_[np.arange(120.0), np.arange(60.0)])
    assert len(clock_notes(links)) == 1 and "first in flight 'f'): its clock began anew" in clock_notes(links)[0]
    flights = links.assign(flight=np.r_[["f"] * 120, ["g"] * 60])
    assert "the times of flights 'f' and 'g' overlap, and receiver 'r' would be at two places" in clock_notes(flights)[0]
    two = flights.assign(receiver=np.r_[["r"] * 120, ["s"] * 60])
    assert not clock_notes(two)


def test_clocks_that_are_right_are_not_told():
    x_m = np.arange(200) * 30.0  # 30 m/s
    assert not clock_notes(links_of(x_m, np.full(200, -80.0)))
    twice = pd.concat([links_of(x_m, np.full(200, -80.0)), links_of(x_m, np.full(200, -70.0), device="e", flight="g")])
    assert not clock_notes(twice)  # two files of one drive
    fast = links_of(np.arange(600) * 45.0, np.full(600, -80.0), time_s=np.arange(600) // 2)  # 90 m/s, two a second
    assert not clock_notes(fast) and clock_notes(fast.assign(time_s=fast["time_s"] + 0.01))
    jump = links_of(np.r_[x_m, 1e5], np.full(201, -80.0))
    assert not clock_notes(jump)  # one bad fix
    assert not clock_notes(links_of([0, 1], [-80, -80]).drop(columns="time_s"))


def test_a_device_whose_name_ends_in_a_number_is_itself(bring_in, tmp_path):
    """Of `b` and `b@7` each has one place; readings of the first were given to the second."""
    (tmp_path / "sites.csv").write_text("device,x,y,z,since\nb,500,0,3,\nb@7,100,0,2,\n")
    result = bring_in(log("09:00", "10:00"), devices=str(tmp_path / "sites.csv"), **GIVEN)
    assert list(result.table["device"]) == ["b", "b"]
    (tmp_path / "sites.csv").write_text("device,x,y,z,since\nb@7,100,0,2,\n")
    again = bring_in(log("09:00", "10:00"), devices=str(tmp_path / "sites.csv"), **GIVEN)
    assert list(again.table["device"]) == ["b", "b"]
