"""Everything that a file says of a device tells where it is: few links of many receivers, and silence."""

import numpy as np
import pandas as pd

from radiotwin.inference.censored_line import LogDistanceLine
from radiotwin.channel.log_distance import LogDistance
from radiotwin.closeloop import locate_file as module
from radiotwin.twin.corrected import corrected_model
from radiotwin.measurements import Measurements
from radiotwin.twin import Twin, TwinDevice

LIMIT_DB, GATEWAYS, PACKETS = -115.0, 30, 3


def test_a_device_is_found_by_three_packets_of_each_gateway_and_by_the_silence_of_others(monkeypatch):
    rng = np.random.default_rng(0)
    gateway_m, there_m = rng.uniform(0, 3000, (GATEWAYS, 2)), np.array([1400.0, 1600.0])
    gateway = np.repeat(np.arange(GATEWAYS), PACKETS)
    distance_m = np.hypot(*(gateway_m[gateway] - there_m).T)
    gain_db = -40 - 25 * np.log10(distance_m) + rng.normal(0, 2, len(gateway))
    gain_db[gain_db < LIMIT_DB] = np.nan
    table = pd.DataFrame({
        "time_s": np.arange(len(gateway), dtype=float), "flight": "f", "receiver": [f"g{i}" for i in gateway],
        "receiver_x_m": gateway_m[gateway, 0], "receiver_y_m": gateway_m[gateway, 1], "receiver_z_m": 1.5,
        "device": "x", "gain_db": gain_db})
    devices = pd.DataFrame({"device": ["x"], "x_m": np.nan, "y_m": np.nan, "z_m": 1.5, "role": "unknown"})
    anchor = TwinDevice("a", 100.0, 100.0, 1.5, "anchor", True, 0.0, None)
    twin = Twin(LogDistance(LogDistanceLine(-40.0, -2.5, 2.0)), [anchor], "gain_db", LIMIT_DB, {}, {
        "base": "log-distance", "coefficients": [0.0, 0.0], "dof": 30.0, "scale_db": [2.0], "receivers": ["g0"],
        "parts": [], "first_s": None, "device_spread_db": 0.0, "likelihood_power": 1.0})
    used, plain = [], module.locate

    def locate(model, links, *others):
        used.append(links)
        return plain(model, links, *others)
    monkeypatch.setattr(module, "locate", locate)
    places, _ = module.locate_file(Measurements(table, devices), twin, corrected_model(twin, None), None, lambda: None)
    silent = np.isnan(gain_db)
    assert 20 < silent.sum() < 70 and np.isnan(used[0].level_db).sum() == silent.sum()
    assert used[0].limit_db == LIMIT_DB and places["links"].tolist() == [GATEWAYS * PACKETS]
    assert np.hypot(places["x_m"][0] - there_m[0], places["y_m"][0] - there_m[1]) < 100
