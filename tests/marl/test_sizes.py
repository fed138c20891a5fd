"""What would not fit in memory is refused before any is taken."""

import pytest

from marl.replicas import check_sizes
from marl.settings import LearnerSettings, RunSettings, settings_of
from radiotwin.errors import BadInput


@pytest.mark.parametrize("run, learner, option", [
    ({"episodes": 10**7}, {"replay": 10**6}, "--replay 1000000"), ({}, {"batch": 10_000, "hidden": 4096}, "--batch 10000"),
    ({"flights": 100_000, "algorithm": "random"}, {}, "--flights 100000"),
    ({}, {"selection_flights": 100_000}, "--selection-flights 100000")])
def test_the_option_that_takes_too_much_is_named(run, learner, option, city_mission, monkeypatch):
    check_sizes(RunSettings(**run), LearnerSettings(), city_mission)
    monkeypatch.setenv("RADIOTWIN_MAX_TRAINING_BYTES", "1_000_000_000")
    with pytest.raises(BadInput, match=f"{option} with .*RADIOTWIN_MAX_TRAINING_BYTES"):
        check_sizes(RunSettings(**run), LearnerSettings(**learner), city_mission)


def test_the_defaults_are_allowed(city_mission):
    check_sizes(RunSettings(), LearnerSettings(), city_mission)
    check_sizes(*settings_of({"preset": "paper"}), city_mission)


@pytest.mark.parametrize("name", [*RunSettings.model_fields, *LearnerSettings.model_fields])
@pytest.mark.parametrize("text", ["1e18", "-1", "nan", "inf", "1e308", "9" * 5000, "1000000000000000000", "x\0y"])
def test_numbers_are_bounded(name, text):
    kind = (RunSettings.model_fields.get(name) or LearnerSettings.model_fields[name]).annotation
    if kind in (int, float):
        with pytest.raises(BadInput) as error:
            settings_of({name: text})
        assert f"--{name.replace('_', '-')}" in str(error.value) and len(str(error.value)) < 400
