"""Two effects that are probable together."""

import pytest

from radiotwin.closeloop.search.causes import add_causes
from radiotwin.closeloop.search.stages import SearchState, search
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.effects.catalogue.position_errors import DevicePositionError
from tests.closeloop.looking import based


@pytest.fixture
def selected(open_ground):
    """Function that declares anchors away from where they are, and selects with a probability that is needed."""
    def run(moved_m, min_probability):
        world = open_ground.fly(2)
        for device, east_m in moved_m.items():
            world.device_m[device, 0] += east_m
        model, inputs = based(open_ground.measured(world), DevicePositionError(), ReceiverGainOffset(),
                              criteria=SelectionCriteria(min_probability=min_probability))
        return search(SearchState(model), [add_causes], inputs)
    return run


def best_alone(result):
    return max(trial.probability for trial in result.log.trials if trial.probability == trial.probability)


def test_two_anchors_of_which_none_is_probable_alone_are_named_together(selected):
    moved_m = {1: 45.0, 3: -45.0}
    needed = best_alone(selected(moved_m, 1.0)) + 0.005
    result = selected(moved_m, needed)
    assert {each.params.device for each in result.model.whole.effects} == set(moved_m)
    kept = result.log.kept
    assert len(kept) == 2 and {trial.reason for trial in kept} == {""}
    assert all(trial.probability >= needed for trial in kept)


@pytest.mark.slow
def test_one_anchor_has_no_second_beside_it(selected):
    needed = best_alone(selected({1: 45.0}, 1.0)) + 0.005
    assert selected({1: 45.0}, needed).model.whole.effects == ()
