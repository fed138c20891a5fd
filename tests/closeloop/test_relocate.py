"""Unknown devices move to where an effect, once it is known, puts them."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.closeloop.crossfit import make_bases
from radiotwin.closeloop.search import relocate
from radiotwin.closeloop.search.relocate import moves_help, relocate_devices
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.twin.model.model import Model
from tests.closeloop.drives import MASTS_M, drive, fitted

WRONG_M = np.array([25.0, -30.0])


def misplaced(seed, device=1):
    """Return a model with a receiver's offset whose base has put a device `WRONG_M` off."""
    table = drive(seed, sd_db=1.5)
    model = fitted(table.assign(gain_db=table["gain_db"] + 8.0 * (table["receiver"] == "north")), ReceiverGainOffset())

    def moved(each):
        unknown = each.links.with_ends(anchors=each.links.anchors - {device})
        device_m = unknown.device_m.copy()
        device_m[device, :2] += WRONG_M
        built = Model.build(unknown, each.channel, each.model.dof, device_m=device_m, train=each.train)
        return built.with_effects(each.effects).fit()
    return model.map(moved)


def test_a_device_moves_to_where_it_is_in_every_fold():
    before = misplaced(3)
    after = relocate_devices(before, before.links, make_bases(None, 0)["twin"])
    for each in after.fits:
        assert np.hypot(*(each.links.device_m[1, :2] - MASTS_M[1, :2])) < 0.5 * np.hypot(*WRONG_M)
    assert after.rmse_db() < before.rmse_db()
    assert (after.links.device_m[[0, 2]] == before.links.device_m[[0, 2]]).all()


def test_known_devices_stay():
    model = fitted(drive(3), ReceiverGainOffset())
    assert relocate_devices(model, model.links, make_bases(None, 0)["twin"]) is model


@pytest.mark.parametrize(("change_nats", "lost", "kept"), [
    (-0.02, 0, True), (0.005, 0, False), (0.005, 40, True), (0.05, 40, False)])
def test_a_device_that_is_found_counts_for_more_than_chance_on_the_links_of_others(change_nats, lost, kept):
    """200 links of which some could not be predicted; the others change by so much each."""
    before_nll = np.where(np.arange(200) < lost, np.nan, 2.0)
    after_nll = np.where(np.isnan(before_nll), 2.0, 2.0 + change_nats)
    assert moves_help(before_nll, after_nll) == kept


class Following:
    """A channel that follows paths, and is otherwise another one."""

    follows_paths = True

    def __init__(self, channel):
        self._channel = channel

    def __getattr__(self, name):
        return getattr(self._channel, name)


@pytest.mark.parametrize(("moved_m", "asked"), [(1.0, 1), (np.nan, 7), (12.0, 7)])
def test_along_paths_folds_are_located_anew_only_where_a_device_moves(monkeypatch, moved_m, asked):
    """By what the whole says; NaN: the device is lost over the corrected map."""
    model = misplaced(3)
    assert len(model.fits) == 7
    model = model.map(lambda fit: replace(fit, model=replace(fit.model, channel=Following(fit.channel))))
    located = []

    def anew(each, links, mine, base, wanted):
        assert wanted == [1]
        located.append(mine.sum())
        device_m = each.links.device_m.copy()
        device_m[1, 0] += moved_m
        return Model.build(each.links, each.channel, each.model.dof, device_m=device_m, train=mine), model.twin.devices

    monkeypatch.setattr(Model, "corrected_map", property(lambda each: "another map"))
    monkeypatch.setattr(relocate, "_located_anew", anew)
    found = relocate_devices(model, model.links, make_bases(None, 0)["twin"])
    assert len(located) == asked and located[0] == len(model.links)
    assert found is model or asked > 1
