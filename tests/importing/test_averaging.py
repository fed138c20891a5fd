"""Local means take the fast fading out and nothing else."""

import numpy as np
import pandas as pd

from radiotwin.importing.repeats import average


def track(x_m, level_db, **others):
    return pd.DataFrame({"receiver": "r", "device": "d", "flight": "f", "receiver_x_m": np.asarray(x_m, dtype=float),
                         "receiver_y_m": 0.0, "receiver_z_m": 1.5, "level_db": np.asarray(level_db, dtype=float)}
                        | others)


def test_standing_waves_become_their_mean_power():
    """Two waves of equal power: 2 P cos²(2πx/λ), mean P. Ten wavelengths a bin hold twenty whole periods."""
    wavelength_m = 0.5
    x_m = np.arange(0, 20, wavelength_m / 50) + wavelength_m / 200
    level_db = -80 + 10 * np.log10(2 * np.cos(2 * np.pi * x_m / wavelength_m) ** 2)
    result = average(track(x_m, level_db), 5.0, "power")
    np.testing.assert_allclose(result["quality"], [500] * 4, atol=1)  # one reading lies on each edge
    np.testing.assert_allclose(result["level_db"], -80, atol=0.02)
    np.testing.assert_allclose(result["receiver_x_m"], [2.5, 7.5, 12.5, 17.5], atol=0.02)
    assert level_db.mean() < -82.8, "a mean of decibels would be 3 dB low"


def test_a_median_does_not_follow_an_outlier():
    result = average(track([0, 1, 2], [-80, -82, -20]), 10.0, "median")
    assert result["level_db"].tolist() == [-80]


def test_readings_that_were_not_detected():
    """Half of them: zero power, so 3 dB less. More than half: the bin was not detected, either."""
    levels = [-80, np.nan, -80, np.nan, np.nan]
    result = average(track([0, 1, 10, 11, 12], levels), 5.0, "power")
    np.testing.assert_allclose(result["level_db"], [-80 - 10 * np.log10(2), np.nan])
    assert list(result["quality"]) == [2, 3]
    median = average(track([0, 1, 2, 10, 11, 12], [-70, -80, np.nan, *levels[2:]]), 5.0, "median")
    np.testing.assert_allclose(median["level_db"], [-80, np.nan])


def test_the_way_is_walked_in_the_order_of_time():
    forward = track([0, 4, 8, 11], [-80, -81, -82, -83], time_s=[1.7e9, 1.7e9 + 0.5, 1.7e9 + 1, 1.7e9 + 1.5])
    result = average(forward.iloc[[2, 0, 3, 1]], 6.0, "median")
    assert list(result["receiver_x_m"]) == [2, 9.5] and list(result["time_s"]) == [1.7e9 + 0.25, 1.7e9 + 1.25]


def test_tracks_are_not_mixed():
    links = pd.concat([track([0, 1], [-80, -80]), track([0, 1], [-60, -60]).assign(device="e"),
                       track([0, 1], [-50, -50]).assign(flight="g"), track([0, 1], [-40, -40]).assign(receiver="s")])
    result = average(links.sort_values("receiver_x_m", kind="stable"), 10.0, "power")
    assert sorted(result["level_db"].round(9)) == [-80, -60, -50, -40] and set(result["quality"]) == {2}


def test_angles_are_averaged_round_the_circle():
    """A drone upside down, and a logger that counts from 0 to 360."""
    result = average(track([0, 1, 20], [-80] * 3, heading_deg=[350.0, 20.0, 90.0], roll_deg=[179.0, -177.0, 5.0],
                           pitch_deg=[358.0, 4.0, np.nan]), 10.0, "power")
    np.testing.assert_allclose(result["heading_deg"], [5, 90])
    np.testing.assert_allclose(result["roll_deg"], [-179, 5])
    np.testing.assert_allclose(result["pitch_deg"], [1, np.nan])
