"""What a candidate is held against before it is fitted along paths, and whom it belongs to."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from radiotwin.closeloop.search.scoring import Candidate, ends_of, fit_candidate
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.effects import registry
from radiotwin.effects.antennas import SectorPattern
from radiotwin.effects.boxes import Box
from radiotwin.links import prepare_links
from radiotwin.propagation.laws.log_distance import LogDistance, LogDistanceLine
from radiotwin.scene.citymap import CityMap
from radiotwin.twin.model.model import Model

DEVICES_M, MOVED_M = np.array([[0.0, 0.0, 10.0], [300.0, 200.0, 10.0]]), np.array([[14.0, -18.0, 0.0], [0.0, 0.0, 0.0]])


class SlowLaw(LogDistance):
    """A law whose exact levels are the quick ones, and counted."""

    follows_paths = True

    def __init__(self, line):
        super().__init__(line)
        self.followed = 0

    def level_at(self, links, exact=False):
        self.followed += exact
        return self.predict(links.geometry)[0]


@pytest.fixture
def moved(make_links):
    """A model of two anchors, one of them elsewhere, and its channel."""
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-150, 400, 300), rng.uniform(-150, 350, 300), rng.uniform(20, 60, 300)])
    distance_m = np.linalg.norm(receiver_m[:, None] - (DEVICES_M + MOVED_M), axis=2).ravel()
    links = make_links(DEVICES_M, receiver_m, level_db=-40 - 22 * np.log10(distance_m) + rng.normal(0, 0.5, 600))
    channel = SlowLaw(LogDistanceLine(-40.0, 2.2, 0.5))
    return SimpleNamespace(whole=Model.build(links, channel, 5.0).fit(), links=links), channel


class Asked(registry.DevicePositionError):
    """A position that remembers the links that it was held against, and what they say."""

    def __init__(self, answer=""):
        super().__init__()
        self.links, self.answer = [], answer

    def contradicted(self, links):
        self.links.append(links)
        return self.answer


def fitted(model, effect, hypotheses=None):
    return fit_candidate(model, effect, SelectionCriteria(), hypotheses)


def test_paths_are_followed_whatever_quick_levels_say(moved):
    model, channel = moved
    found = fitted(model, registry.DevicePositionError(), SimpleNamespace(effect_evidence_nats=lambda *_: -1.0))
    assert isinstance(found, Candidate) and channel.followed and found.whole.effects[-1].params.device == 0


def test_no_paths_are_followed_for_what_the_map_speaks_against(moved):
    model, channel = moved
    channel.followed = 0
    assert fitted(model, Asked("a lake is there")).reason == "a lake is there" and not channel.followed


def test_links_of_devices_that_are_nowhere_do_not_speak_against_anything(moved):
    model, _ = moved
    lost = SimpleNamespace(links=model.links, whole=replace(model.whole, model=replace(
        model.whole.model, usable=model.links.device == 0)))
    effect = Asked()
    assert isinstance(fitted(lost, effect), Candidate)
    assert set(effect.links[0].device) == {0}


def test_a_building_that_was_found_is_in_the_map_that_the_next_is_held_against(moved):
    model, _ = moved
    house = trimesh.creation.box(bounds=[[400, 400, 0], [410, 410, 10]])
    whole = replace(model.whole.model, links=model.whole.links.with_city(CityMap(house.vertices, house.faces)))
    for found, height_m in (([], 0.0), ([Box(40.0, 60.0, 20.0, 20.0, 25.0, 0.0)], 25.0)):
        base = whole.with_effects([registry.MissingObstacle().with_params(registry.MissingObstacle.Params(box=box)) for box in found]).fit()
        effect = Asked("it is noted")
        assert fitted(SimpleNamespace(whole=base, links=base.links), effect).reason == "it is noted"
        assert float(effect.links[0].city.height_at(40.0, 60.0)) == pytest.approx(height_m)


@pytest.mark.parametrize("effect, params, coefficients, devices, receivers", [
    (registry.DeviceGainOffset(), {"members": [0, 1, 2], "offsets_sd_db": 3.0}, [0.1, -4.0, 0.3], ["d1"], []),
    (registry.ReceiverGainOffset(), {"members": [0], "offsets_sd_db": 3.0}, [2.0], [], ["r0"]),
    (registry.DevicePositionError(), {"device": 2, "move_m": (3.0, 4.0)}, [], ["d2"], []),
    (registry.ReceiverClockOffset(), {"receiver": 1, "offset_s": 2.0, "speed_m_s": 10.0}, [], [], ["r1"]),
    (registry.SectorAntenna(), {"devices": {0: SectorPattern(), 2: SectorPattern()}}, [0.0, 0.0], ["d0", "d2"], []),
    (registry.Foliage(), {"box": (0.0, 0.0, 9.0, 9.0, 9.0, 0.0)}, [], [], [])])
def test_names_are_of_the_ends_that_parameters_belong_to(open_ground, effect, params, coefficients, devices, receivers):
    links = prepare_links(open_ground.measured(open_ground.fly(0)), None)
    names = {"d": list(links.device_names), "r": list(links.receiver_names)}
    expected = [tuple(names[each[0]][int(each[1:])] for each in ends) for ends in (devices, receivers)]
    assert list(ends_of(effect.with_params(effect.Params(**params)), np.array(coefficients), links)) == expected
