"""Worlds of the close-loop's tests, and links made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

import radiotwin as rt
from radiotwin.closeloop.result_file import scores
from radiotwin.effects.residual_view import ResidualView
from radiotwin.links import LinkData
from tests.worlds import open_ground

__all__ = ["open_ground"]


@pytest.fixture
def make_links():
    """Make the links of every receiver position (n, 3) to every device (k, 3): LinkData of n k links."""
    def make(device_m, receiver_m, **given):
        device_m, receiver_m = np.atleast_2d(device_m).astype(float), np.atleast_2d(receiver_m).astype(float)
        each, count = len(device_m), len(receiver_m) * len(device_m)
        values = {"level_db": np.zeros(count), "receiver": np.zeros(count, int), "flight": np.zeros(count, int),
                  "time_s": np.full(count, np.nan), "heading_deg": np.full(count, np.nan), "limit_db": None} | given
        names = [[f"{letter}{i}" for i in range(total)] for letter, total in
                 (("d", each), ("r", values["receiver"].max() + 1), ("f", values["flight"].max() + 1))]
        limit_db = -np.inf if values["limit_db"] is None else values["limit_db"]
        return LinkData(values["level_db"], np.full(count, float(limit_db)), np.repeat(receiver_m, each, axis=0), device_m,
                        np.tile(np.arange(each), len(receiver_m)), values["receiver"], values["flight"],
                        values["time_s"], values["heading_deg"], *names, values.get("frequency_hz", 2.4e9),
                        values.get("city"), True, frozenset(range(each)))
    return make


@pytest.fixture
def view():
    """Make the view of links whose predicted levels (n,) and whose scale of the errors [dB] are known."""
    def make(links, mean_db, scale_db, level_at=None):
        excess_db = np.where(np.isfinite(links.limit_db), links.limit_db - mean_db, 0.0)
        residual_db = np.where(np.isnan(links.level_db), np.minimum(excess_db, 0.0),
                               links.level_db - mean_db)
        return ResidualView(links, residual_db, np.full(len(links), float(scale_db)), mean_db, level_at)
    return make


@pytest.fixture
def loop():
    """Close the loop over measurements without a map: names of the effects found, and the first one's parameters."""
    def run(measurements):
        closed = rt.close_loop(measurements, base="log-distance")
        return SimpleNamespace(error={"before": scores(closed.before), "after": scores(closed.after)},
                               names=[each.effect.name for each in closed.after.whole.effects],
                               first=(closed.parameters or [{}])[0])
    return run
