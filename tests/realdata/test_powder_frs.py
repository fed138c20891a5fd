"""Receivers without calibration, on days that are held out: gains, floors and what changed between days."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import wilcoxon

from radiotwin import close_loop, make_report
from radiotwin.twin.localize import locate, whole_area
from studies.closeloop_real import floor_errors_db, permuted

pytestmark = pytest.mark.slow

DAYS = ("2022-04-25", "2022-07-05", "2022-07-06", "2022-07-11")  # on the fifth half of the receivers were others
CHANGED = "ebc-nuc1-b210"  # 19 dB less after April
DEVICES_A_DAY = 60


@pytest.fixture(scope="module")
def loop(powder):
    return close_loop(powder, base="log-distance", hold_out="flight")


def day_mean_db(loop, model) -> float:
    names = loop.links.flight_names
    return float(np.mean([model.rmse_db(loop.links.flight == names.index(day)) for day in DAYS]))


def test_gains_floors_and_the_step_of_one_receiver_are_named(loop):
    effects = loop.after.whole.effects
    assert {"receiver_gain_offset", "noise_floor_censoring"} <= {each.name for each in effects}
    form, when_s = next(drift for each in effects if each.name == "receiver_drift"
                        for receiver, drift in each.params.receivers.items()
                        if loop.links.receiver_names[receiver] == CHANGED)
    assert form == "step"
    assert pd.Timestamp("2022-04-26").timestamp() < when_s < pd.Timestamp("2022-07-06").timestamp()


def test_floors_are_those_of_readings_without_a_transmitter(loop, folder):
    """Which the fit has never read."""
    off_db = floor_errors_db(make_report(loop), folder("powder_frs"))
    assert np.isfinite(off_db).sum() >= 25 and np.nanmedian(np.abs(off_db)) <= 3.0


def test_the_error_on_days_that_are_held_out(loop):
    assert day_mean_db(loop, loop.before) == pytest.approx(9.6, abs=0.4)
    assert day_mean_db(loop, loop.after) < day_mean_db(loop, loop.before) - 1.4


def test_transmitters_of_days_that_are_held_out_are_located_better(loop):
    """The same transmitters before and after, so that chance in which ones are asked for does not count."""
    def errors_m(model) -> np.ndarray:
        off_m = []
        for number, fold in enumerate(model.folds):
            day, learnt = loop.links.select(model.index == number), fold.learnt
            devices = np.random.default_rng(0).permutation(np.unique(day.device))[:DEVICES_A_DAY]
            asked = day.select(np.isin(day.device, devices))
            row = {name: row for row, name in enumerate(loop.links.device_names)}
            off_m += [np.hypot(*(loop.links.device_m[row[each.device], :2] - (each.x_m, each.y_m)))
                      for each in locate(learnt, asked, whole_area(learnt, asked))]
        return np.array(off_m)
    before_m, after_m = errors_m(loop.before), errors_m(loop.after)
    assert np.median(after_m) < np.median(before_m)
    assert wilcoxon(np.log(after_m / before_m), alternative="less").pvalue < 0.05


def test_of_permuted_levels_nothing_is_named(powder):
    loop = close_loop(permuted(powder, 0), base="log-distance", hold_out="flight")
    assert not [each for each in loop.after.whole.effects if each.is_cause]
