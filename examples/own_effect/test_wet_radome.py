"""The wet radome and the crane, in links that were made with one; nothing needs to be installed."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import radiotwin as rt
from radiotwin.closeloop.verdict.posterior import features, probability_of
from radiotwin.effects import register
from radiotwin.effects.base import ResidualView
from radiotwin.links import prepare_links
from radiotwin.report.closeloop_words import closeloop_summary
from radiotwin.report.labels import parameter_label, parameter_labels

START_S, END_S, LOSS_DB = 400.0, 800.0, 4.0


@pytest.fixture
def effect(monkeypatch):
    """The effect, in the catalogue for the duration of a test."""
    monkeypatch.setattr("radiotwin.effects.registry._registered", [])
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from wet_radome import WetRadome
    return register(WetRadome)


def made(loss_db, slots=100):
    """Measurements of 2 receivers and 4 devices in 1200 s: a log-distance law, noise, and rain."""
    rng = np.random.default_rng(0)
    device_m = np.column_stack([rng.uniform(0, 400, (4, 2)), np.full(4, 1.5)])
    axes = np.meshgrid(np.arange(slots), [0, 1], [0, 1, 2, 3])
    slot, receiver, device = (axis.ravel() for axis in axes)
    ground_m = rng.uniform(0, 400, (2 * slots, 2))
    receiver_m = np.column_stack([ground_m, np.full(2 * slots, 50.0)])
    position_m, time_s = receiver_m[2 * slot + receiver], 1200.0 / slots * slot
    gain_db = -35 - 26 * np.log10(np.linalg.norm(position_m - device_m[device], axis=1))
    gain_db += rng.normal(0, 2, len(gain_db)) - loss_db * ((time_s >= START_S) & (time_s <= END_S))
    table = pd.DataFrame({
        "time_s": time_s, "flight": "f0", "receiver": [f"r{i}" for i in receiver],
        **{f"receiver_{axis}_m": position_m[:, i] for i, axis in enumerate("xyz")},
        "device": [f"d{i}" for i in device], "gain_db": gain_db})
    devices = pd.DataFrame({"device": [f"d{i}" for i in range(4)], "role": "anchor",
                            **{f"{axis}_m": device_m[:, i] for i, axis in enumerate("xyz")}})
    return rt.Measurements(table, devices)


def test_rain_is_found_with_its_loss(effect):
    report = rt.make_report(rt.close_loop(made(LOSS_DB), base="log-distance"))
    found = report["effects"][0]
    assert found["name"] == effect.name
    loss_db = found["parameters"]["loss_db"]
    assert loss_db["low"] < LOSS_DB < loss_db["high"] and loss_db["high"] - loss_db["low"] < 1
    assert found["params"]["start_s"] == pytest.approx(START_S, abs=60)
    assert found["params"]["end_s"] == pytest.approx(END_S, abs=60)


@pytest.mark.slow
def test_without_rain_nothing_is_found(effect):
    report = rt.make_report(rt.close_loop(made(0.0), base="log-distance"))
    assert report["verdict"] == "none"
    assert effect.name in {candidate["name"] for candidate in report["candidates"]}
    (seen,) = [each for each in report["detectable"] if each["name"] == effect.name]
    assert 0.1 < seen["size"] < LOSS_DB, "a loss of 4 dB would have been seen"


def test_what_pages_say_of_it(effect):
    assert parameter_label("loss_db", parameter_labels(effect.name)) == "loss of the wet antennas"
    undecided = {"posterior": [{"step": 1, "rest_db": None, "noise_db": None, "probabilities": [
        {"name": effect.name, "probability": 0.6}]}], "verdict": "undecided", "candidates": [],
        "effects": [], "remaining": {"drivers": []}, "error": {"before": {"rmse_db": 3.0}}}
    assert "To settle it: repeat the flight in dry weather" in closeloop_summary(undecided)
    values = features((20.0, 20.0, 20.0), 1.0, False)
    assert probability_of(effect.name, values) == probability_of("episode", values)


def test_a_crane_has_a_place(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from crane import Crane
    links = prepare_links(made(0.0, slots=300), None)
    crane = Crane().with_params(Crane.Params(place_m=(200.0, 200.0)))
    through = crane.term(links, None).columns[:, 0] < 0
    assert 10 < through.sum() < 0.2 * len(links) and crane.reach(links)[through].all()
    residual_db = np.random.default_rng(1).normal(0, 2, len(links)) - 9.0 * through
    view = ResidualView(links, residual_db, np.full(len(links), 2.0), links.level_db - residual_db,
                        None)
    (found,) = crane.propose(view)
    assert np.hypot(*np.subtract(found.place_m, crane.params.place_m)) < 25
    assert all(pattern.change_db.min() == -1 for pattern in crane.typical_patterns(view))
    assert crane.with_params(found).mark(links).text == "crane"
    assert len(crane.with_params(found).correction(links).boxes) == 1
