"""What is said of a result is true of the links: the error of a map, what holds everywhere, what would have been seen."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.families import Readings
from radiotwin.closeloop.output.result_file import _explained_share, consistent_sizes, constant_over
from radiotwin.closeloop.scan import scan
from radiotwin.closeloop.scan_sensitivity import least_deviations
from radiotwin.closeloop.verdict.sensitivity import Detectable
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset
from radiotwin.effects.catalogue.unexplained_trend import UnexplainedTrend
from tests.closeloop.drives import drive, fitted

LOCK_DB, LOCKED = 19.0, 0.65


def of_base(table):
    """Return the base alone."""
    return fitted(table, DeviceGainOffset()).map(lambda fit: fit.model.with_effects([]).fit())


def test_the_error_of_a_map_does_not_know_the_state_of_each_reading():
    """Two states 19 dB apart: a map errs by the spread of the states, and is as likely as their mixture."""
    table = drive(3)
    lost = np.random.default_rng(3).random(len(table)) > LOCKED
    table = table.assign(gain_db=table["gain_db"] - LOCK_DB * lost, quality=(~lost).astype(float))
    model = fitted(table, UnexplainedTrend("quality"))
    known_db = model.rmse_db()
    spread_db = LOCK_DB * np.sqrt(LOCKED * (1 - LOCKED))
    assert known_db < 4.5 and model.reads_quality
    assert model.rmse_on_map_db() == pytest.approx(np.hypot(known_db, spread_db), rel=0.05)
    states = -(LOCKED * np.log(LOCKED) + (1 - LOCKED) * np.log(1 - LOCKED))  # nats that tell the states apart
    assert np.nanmean(model.on_map[1] - model.held_out_nll) == pytest.approx(states, abs=0.1)
    plain = model.map(lambda fit: fit.model.with_effects([]).fit())
    assert not plain.reads_quality and plain.on_map[0] is plain.held_out_mean_db


def test_a_device_that_is_off_by_what_would_have_been_seen_is_seen():
    table = drive(5, sd_db=1.0)
    (least,) = [each.size for each in least_deviations(of_base(table)) if (each.family, each.statistic) == ("device", "level")]
    assert 0.5 < least < 10.0
    for share, is_seen in ((0.3, False), (1.5, True)):
        off = table.assign(gain_db=table["gain_db"] + share * least * (table["device"] == "d1"))
        sure = [each.members for each in scan(Readings.of(of_base(off))) if each.probability >= 0.9]
        assert ({"device": ("d1",)} in sure) == is_seen


@pytest.mark.parametrize(("factor", "over"), (
    (lambda flight, octant: 1.0, ["flight", "direction"]), (lambda flight, octant: np.where(flight == 2, 0.0, 1.0), ["direction"]),
    (lambda flight, octant: np.where(octant == 5, -1.0, 1.0), ["flight"])))
def test_a_level_is_said_of_all_flights_and_directions_only_where_it_is_seen_there(factor, over):
    device, flight, octant, _ = pd.MultiIndex.from_product([range(4), range(5), range(8), range(12)]).to_frame().to_numpy().T
    level_db = np.random.default_rng(0).normal(0, 1, len(device)) - 6.0 * (device == 1) * factor(flight, octant)
    links = SimpleNamespace(level_db=level_db, flight=flight, azimuth_deg=45.0 * octant + 20.0)
    base = SimpleNamespace(links=links, held_out_mean_db=np.zeros(len(device)))
    found = SimpleNamespace(statistic="level", family="device", rows=device == 1, size=SimpleNamespace(value=-6.0))
    assert constant_over(found, base) == over
    found.statistic = "scatter"
    assert constant_over(found, base) == []


def test_what_was_seen_is_not_said_to_be_invisible():
    sizes = [Detectable(name, size, "dB", "") for name, size in (
        ("antenna_pattern", np.inf), ("foliage", 9.0), ("interference", np.inf), ("device_gain_offset", 2.0))]
    steps = [SimpleNamespace(probabilities={"antenna_pattern": 0.71, "interference": 0.01, "foliage": 0.4})]
    assert [each.name for each in consistent_sizes(sizes, {"device_gain_offset"}, steps)] == ["foliage", "interference"]


@pytest.mark.parametrize(("statistic", "size", "change_db", "scatters", "share"), (
    ("level", -6.0, -6.0, None, 1.0), ("level", -6.0, -1.0, None, 1 / 6), ("level", -6.0, 6.0, None, -1.0),
    ("scatter", 5.0, 0.0, 8.0, 1.0), ("scatter", 5.0, "noise", None, 1.0), ("scatter", 5.0, 0.0, None, 0.0)))
def test_an_effect_explains_a_group_whose_level_or_scatter_it_has(statistic, size, change_db, scatters, share):
    rows = np.arange(4000) < 1000
    noise_db = np.random.default_rng(1).normal(0, 1, (2, 4000))
    extra_db = np.sqrt(24.0) * noise_db[1] * rows if statistic == "scatter" else -6.0 * rows
    change_db = extra_db if change_db == "noise" else change_db * rows
    found = SimpleNamespace(statistic=statistic, rows=rows, size=SimpleNamespace(value=size))
    explained = _explained_share(found, noise_db[0] + extra_db, change_db, None if scatters is None else scatters * rows)
    assert explained == pytest.approx(share, abs=0.1)
