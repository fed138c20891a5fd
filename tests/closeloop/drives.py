"""Worlds of the tests of intervals: flights over open ground whose errors go along with the track.

No code of radiotwin makes their levels: laws, antennas and errors are written out here.
"""


import numpy as np
import pandas as pd

from radiotwin.links.measurements import Measurements
from radiotwin.twin.model.fitting import add_effect
from tests.closeloop.looking import based

FLIGHTS, POINTS, STEP_M = 8, 90, 12.0
MASTS_M = np.array([[170.0, 280.0, 25.0], [360.0, 140.0, 30.0], [380.0, 400.0, 20.0]])
RECEIVERS = ("north", "south")


def drive(seed, sd_db=3.0, length_m=40.0, noise_db=1.0, span_deg=360.0):
    """Fly `FLIGHTS` tracks past `MASTS_M`: a level each, with errors that a track shares with itself.

    Shadowing of each pair of mast and flight is an AR(1) process along the track, `length_m` its correlation length.
    `span_deg`: how much of the circle around the first mast is flown over.
    """
    rng = np.random.default_rng(seed)
    parts = []
    keep = np.exp(-STEP_M / length_m)
    for flight in range(FLIGHTS):
        turn = rng.normal(0, 0.12, POINTS).cumsum() + rng.uniform(0, 2 * np.pi)
        place_m = rng.uniform(20, 480, 2) + STEP_M * np.cumsum(np.column_stack([np.cos(turn), np.sin(turn)]), axis=0)
        place_m = 250 + 240 * np.sin((place_m - 250) / 240)  # stays in the area
        place_m = np.column_stack([place_m, np.full(POINTS, rng.uniform(40, 90))])
        for mast, mast_m in enumerate(MASTS_M):
            shock = rng.normal(size=POINTS)
            error = np.empty(POINTS)
            error[0] = shock[0]
            for i in range(1, POINTS):
                error[i] = keep * error[i - 1] + np.sqrt(1 - keep**2) * shock[i]
            to_m = place_m - mast_m
            distance_m = np.linalg.norm(to_m, axis=1)
            parts.append(pd.DataFrame({
                "time_s": 1000.0 * flight + np.arange(POINTS), "flight": f"f{flight}", "receiver": RECEIVERS[flight % 2],
                "receiver_x_m": place_m[:, 0], "receiver_y_m": place_m[:, 1], "receiver_z_m": place_m[:, 2],
                "device": f"d{mast}", "gain_db": -38.0 - 22.0 * np.log10(distance_m) + sd_db * error
                + noise_db * rng.normal(size=POINTS),
                "azimuth_deg": np.degrees(np.arctan2(to_m[:, 0], to_m[:, 1])) % 360, "distance_m": distance_m}))
    table = pd.concat(parts, ignore_index=True)
    if span_deg < 360:
        table = table[(table["device"] != "d0") | (table["azimuth_deg"] % 360 < span_deg)].reset_index(drop=True)
    return table


def fitted(table, effect, devices_m=MASTS_M):
    """Return the base log-distance with one effect: of all links, and of those outside each fold."""
    devices = pd.DataFrame({"device": [f"d{i}" for i in range(len(devices_m))], "x_m": devices_m[:, 0],
                            "y_m": devices_m[:, 1], "z_m": devices_m[:, 2], "role": "anchor", "frequency_hz": 2.4e9})
    measurements = Measurements(table.drop(columns=["azimuth_deg", "distance_m"]), devices)
    before, _ = based(measurements)
    whole = add_effect(before.whole, effect)
    return before.with_fits(whole, [add_effect(fold, effect, whole.effects[-1]) or fold for fold in before.folds])
