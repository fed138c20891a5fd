"""A flown scene and its twin; many tests only read them."""

import pytest

from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.twin import fit_twin
from tests.command_line import run
from tests.worlds import narrow_street, only_effects, open_ground, quick_report

__all__ = ["narrow_street", "only_effects", "open_ground", "quick_report", "run"]


@pytest.fixture(scope="session")
def flown(small_scene):
    return fly_survey(small_scene, segmented_truth(small_scene), flights=2, pattern="random-waypoint", seed=0,
                      noise_db=0.0)


@pytest.fixture(scope="session")
def twin(small_scene, flown):
    return fit_twin(flown, small_scene, model="segmented_log_distance", seed=0)
