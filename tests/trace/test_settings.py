"""Settings that make no sense are refused before anything starts."""

import pytest

from radiotwin.errors import BadInput
from radiotwin.trace import QUALITIES, SolverSettings


@pytest.mark.parametrize("settings", [{"solver": "magic"}, {"combining": "sum"}, {"max_depth": -1}, {"seed": -1},
                                      {"samples_per_src": 0}, {"batch_receivers": 0},
                                      {"solver": "map", "combining": "coherent"}])
def test_impossible_settings(settings):
    with pytest.raises(BadInput, match=list(settings)[-1]):
        SolverSettings(**settings)


def test_unknown_quality_names_those_there_are():
    with pytest.raises(BadInput, match="fast, default, high"):
        SolverSettings.of_quality("best")


def test_qualities_send_more_and_more_rays_in_bounded_memory():
    settings = [SolverSettings.of_quality(quality) for quality in QUALITIES]
    samples = [one.samples_per_src for one in settings]
    assert samples == sorted(set(samples))
    assert max(one.max_depth * one.samples_per_src * one.batch_receivers for one in settings) <= 4e7 + 1


def test_finer_settings_take_no_more_memory():
    settings = SolverSettings()
    finer = settings.finer(10)
    assert finer.samples_per_src == 10 * settings.samples_per_src
    assert finer.samples_per_src * finer.batch_receivers <= settings.samples_per_src * settings.batch_receivers
