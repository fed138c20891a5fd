"""Worlds of the loop's tests, and links of these tests' own."""

from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.records import Records
from radiotwin.closeloop.report import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.effects.base import View
from tests.closeloop.conftest import open_ground

__all__ = ["open_ground"]


@pytest.fixture
def links():
    """Makes the links of every receiver position (n, 3) to every device (k, 3): Records of n k links."""
    def make(device_m, receiver_m, **given):
        device_m, receiver_m = np.atleast_2d(device_m).astype(float), np.atleast_2d(receiver_m).astype(float)
        each, count = len(device_m), len(receiver_m) * len(device_m)
        values = {"level_db": np.zeros(count), "receiver": np.zeros(count, int), "flight": np.zeros(count, int),
                  "time_s": np.full(count, np.nan), "heading_deg": np.full(count, np.nan), "limit_db": None} | given
        names = [[f"{letter}{i}" for i in range(total)] for letter, total in
                 (("d", each), ("r", values["receiver"].max() + 1), ("f", values["flight"].max() + 1))]
        return Records(values["level_db"], values["limit_db"], np.repeat(receiver_m, each, axis=0), device_m,
                       np.tile(np.arange(each), len(receiver_m)), values["receiver"], values["flight"],
                       values["time_s"], values["heading_deg"], *names, values.get("frequency_hz", 2.4e9),
                       values.get("city"), True, frozenset(range(each)))
    return make


@pytest.fixture
def view():
    """What an effect sees of links whose expected levels (n,) are known and whose errors have a known scale [dB]."""
    def make(records, mean_db, scale_db, at=None):
        limit_db = np.inf if records.limit_db is None else records.limit_db
        residual_db = np.where(np.isnan(records.level_db), np.minimum(limit_db - mean_db, 0.0),
                               records.level_db - mean_db)
        return View(records, residual_db, np.full(len(records), float(scale_db)), mean_db, at)
    return make


@pytest.fixture
def loop():
    """Runs the loop over measurements without a map: names of what it found, and the first one's parameters."""
    def run(measurements):
        report = make_report(close_loop(measurements, None, "log-distance", 0, lambda text: None))
        parameters = report["effects"][0]["parameters"] if report["effects"] else {}
        return SimpleNamespace(report=report, names=[effect["name"] for effect in report["effects"]],
                               first={name: SimpleNamespace(**parameter) for name, parameter in parameters.items()})
    return run
