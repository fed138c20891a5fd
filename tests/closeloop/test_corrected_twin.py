"""How far positions are to be believed that a loop's twin locates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.output import corrected_twin
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.effects.catalogue.position_errors import DevicePositionError
from radiotwin.effects.catalogue.unexplained_trend import UnexplainedTrend
from tests.closeloop.drives import drive, fitted


@pytest.fixture(scope="module")
def model():
    table = drive(3, sd_db=1.5)
    return fitted(table.assign(gain_db=table["gain_db"] + 8.0 * (table["receiver"] == "north")), ReceiverGainOffset())


def asked(model, monkeypatch, scene=None):
    """Return what radii are calibrated with."""
    given = []
    monkeypatch.setattr(corrected_twin, "calibrate_radii", lambda *each: given.append(each))
    corrected_twin._calibration(SimpleNamespace(for_twin=model, links=model.links, seed=0), scene)
    return given[0]


def test_devices_that_the_loop_found_elsewhere_are_not_located_against_their_declared_position(model, monkeypatch):
    _, held_out, *_ = asked(model, monkeypatch)
    assert all(each.anchors == model.links.anchors for each in held_out)
    effect = DevicePositionError()
    moved = effect.with_params(effect.Params(device=1, move_m=(20.0, 5.0)))
    whole = replace(model.whole, model=model.whole.model.with_effects([*model.whole.effects, moved]))
    _, held_out, *_ = asked(model.with_fits(whole, model.folds), monkeypatch)
    assert all(each.anchors == model.links.anchors - {1} for each in held_out)


def test_what_only_describes_the_rest_does_not_locate(model, monkeypatch):
    trend = UnexplainedTrend("distance_m")
    folds = []
    for fold in model.folds:
        curved = fold.model.with_effects([*fold.effects, trend.with_params(trend.propose(fold.view)[0])])
        folds.append(replace(fold, model=curved, coefficients=np.r_[
            fold.coefficients, np.zeros(curved.terms[-1].columns.shape[1])]))
    models, *_ = asked(model.with_fits(model.whole, folds), monkeypatch)
    assert all([own.name for own in each.effects] == ["receiver_gain_offset"] for each in models)


def test_over_a_map_devices_are_sought_where_the_command_seeks_them(model, monkeypatch):
    scene = SimpleNamespace(config=SimpleNamespace(extent=SimpleNamespace(bounds=(0.0, 500.0, 0.0, 400.0))))
    assert asked(model, monkeypatch, scene)[2] == (0.0, 500.0, 0.0, 400.0)
