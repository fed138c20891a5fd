"""A scene that declares no limit of detection, and readings far below its default of -120 dBm."""


import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.output.result_file import errors
from radiotwin.links import prepare_links
from radiotwin.links.limits import with_usual_limits
from radiotwin.links.measurements import Measurements
from tests.closeloop.looking import based

LIMIT_DBM, DEFAULT_DBM, LINKS = -140.0, -120.0, 2000
DEVICE_M = [(20.0, 20.0, 10.0), (150.0, 130.0, 10.0)]


def walked(seed, scene):
    """Readings of a phone at 1.5 m: -45 dBm - 40 log10(d / 1 m) + 7 dB, blank below -140 dBm."""
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    receiver_m = np.column_stack([rng.uniform(x_min, x_max, LINKS), rng.uniform(y_min, y_max, LINKS),
                                  np.full(LINKS, 50.0)])
    device = rng.integers(0, len(DEVICE_M), LINKS)
    distance_m = np.linalg.norm(receiver_m - np.array(DEVICE_M)[device], axis=1)
    level_dbm = -45.0 - 40.0 * np.log10(distance_m) + rng.normal(0, 7, LINKS)
    level_dbm[level_dbm < LIMIT_DBM] = np.nan
    table = pd.DataFrame({
        "time_s": np.nan, "flight": "walk", "receiver": "phone",
        **{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")},
        "device": [f"d{i}" for i in device], "rssi_dbm": level_dbm})
    devices = pd.DataFrame(DEVICE_M, columns=["x_m", "y_m", "z_m"]).assign(device=["d0", "d1"], role="anchor")
    return Measurements(table, devices)


def held_out(links):
    """Return errors of links in blocks that the law was not fitted to."""
    links = with_usual_limits(links)
    model, _ = based(links, by="block")
    return errors(links.level_db, model.held_out_mean_db)


def test_the_limit_is_that_of_the_readings_and_leaves_no_bias(small_scene):
    assert small_scene.config.radio.sensitivity_dbm == DEFAULT_DBM  # which its file does not have
    links = prepare_links(walked(0, small_scene), small_scene)
    below = (links.level_db < DEFAULT_DBM).sum() / np.isfinite(links.level_db).sum()
    assert below > 0.3 and np.isnan(links.level_db).any()
    assert links.usual_limit_db == pytest.approx(LIMIT_DBM, abs=0.6)
    (note,) = [each for each in links.notes if "limit of detection" in each]
    assert f"{below:.0%}" in note and "Used instead: -1" in note and "for phone" in note
    assert abs(held_out(links)["bias_db"]) <= 0.5
    claimed = links.with_columns(limit_db=np.full(len(links), DEFAULT_DBM))
    assert abs(held_out(claimed)["bias_db"]) > 2.0
