"""`closeloop.json`: what earlier versions wrote is read as what this one writes."""

import copy
import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from radiotwin.closeloop.output.result_file import (
    errors,
    make_report,
    read_report,
    upgrade_report,
    write_report,
)
from radiotwin.closeloop.run import close_loop
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.errors import BadInput
from radiotwin.report import closeloop_summary, write_closeloop_page

VERSION_1 = Path(__file__).parent / "version_1" / "closeloop.json"  # of radiotwin 0.1


@pytest.fixture
def old():
    return json.loads(VERSION_1.read_text(encoding="utf-8"))


def biases(value):
    """Return all `bias_db` of a report, in order."""
    if not isinstance(value, dict):
        return []
    return [each for name, part in value.items() for each in ([part] if name == "bias_db" else biases(part))]


def test_bias_is_predicted_minus_measured():
    found = errors(np.array([-80.0, -90.0, np.nan]), np.array([-77.0, -89.0, -100.0]))
    assert (found["n"], found["bias_db"], found["mae_db"]) == (2, 2.0, 2.0)


def test_a_report_of_version_0_1_is_read_with_new_names_and_the_bias_turned(old):
    assert old["schema"] == "radiotwin.closeloop/1" and len(old["effects"]) == 3
    before = copy.deepcopy(old)
    new = upgrade_report(old)
    assert old == before, "what was given is left as it is"
    assert new["schema"] == "radiotwin.closeloop/2"
    assert not {"remarks", "structure_before"} & set(new)
    assert new["notes"] == old["remarks"] and new["dependences_before"] == old["structure_before"]
    assert [each["params"] for each in new["effects"] if "params" in each] == \
        [each["setting"] for each in old["effects"] if "setting" in each]
    assert not any("setting" in each for each in new["effects"])
    for part in ("error", "baselines"):
        turned = biases(new[part])
        assert turned == [None if each is None else -each for each in biases(old[part])]
        assert max(abs(each) for each in turned if each is not None) > 0.01
    for name in ("base", "verdict", "candidates", "heldout", "remaining", "radiotwin_version"):
        assert new[name] == old[name]
    assert upgrade_report(new) == new


@pytest.mark.usefixtures("short_report")
def test_each_effect_has_its_own_name_and_a_score_that_was_kept(open_ground, monkeypatch):
    monkeypatch.setattr("radiotwin.closeloop.run.catalogue", lambda: (ReceiverGainOffset,))  # the others take long
    world = open_ground.fly(21)
    world.gain_db[world.receiver == 1] += 6.0
    loop = close_loop(open_ground.measured(world).select(world.slot % 4 == 0), base="log-distance")
    (only,) = make_report(loop)["effects"]
    assert only["name"] == loop.after.whole.effects[0].effect.name == "receiver_gain_offset"
    scores = [replace(each, kept=False) for each in loop.selection.scores]
    with pytest.raises(ValueError, match="zip"):
        make_report(replace(loop, selection=replace(loop.selection, scores=scores)))


@pytest.mark.usefixtures("quick_report")
def test_it_has_what_a_new_report_has(old, open_ground, tmp_path):
    world = open_ground.fly(21)
    world.gain_db[world.receiver == 1] += 6.0
    report = make_report(close_loop(open_ground.measured(world).select(world.slot % 4 == 0), base="log-distance"))
    write_report(report, tmp_path / "closeloop.json")
    assert upgrade_report(json.loads((tmp_path / "closeloop.json").read_text(encoding="utf-8"))) == report
    upgraded = upgrade_report(old)
    assert set(upgraded) == set(report) and set(upgraded["error"]) == set(report["error"])
    assert set(upgraded["effects"][0]) == set(report["effects"][0])


def test_other_schemas_are_refused():
    with pytest.raises(BadInput, match="schema is 'radiotwin.closeloop/7', this version reads"):
        upgrade_report({"schema": "radiotwin.closeloop/7"})


def places(value, at=()):
    """Return the path of every value of a report that is no object and no list."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [place for name, each in items for place in places(each, (*at, name))]
    return [at]


def changed(report, place, value):
    new = copy.deepcopy(report)
    part = new
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = value
    return new


def test_a_text_in_place_of_a_number_is_refused_anywhere(old, tmp_path):
    new = upgrade_report(old)
    shown = [place for place in places(new) if not {"params", "criteria"} & set(place)]
    one_of_each = {tuple(name if isinstance(name, str) else 0 for name in place): place for place in shown}
    assert len(one_of_each) > 100
    for place in one_of_each.values():
        text = isinstance(functools.reduce(lambda part, name: part[name], place, new), str)
        for value in ({"a": 1}, ["a"], 7) if text else ("<img src=x onerror=alert()>", {"a": 1}, ["a"], 1e308):
            with pytest.raises(BadInput, match="this version reads" if place == ("schema",) else "is damaged"):
                upgrade_report(changed(new, place, value))


@pytest.mark.parametrize("version", [1, 2])
def test_a_missing_part_is_one_message(old, tmp_path, version):
    report = old if version == 1 else upgrade_report(old)
    path = tmp_path / "closeloop.json"
    for name in ("schema", "base", "verdict", "effects", "candidates", "heldout", "error", "baselines", "remaining"):
        for new in ({key: value for key, value in report.items() if key != name}, report | {name: None}):
            path.write_text(json.dumps(new))
            with pytest.raises(BadInput, match=f"^{path}(:| is damaged) .*again$") as error:
                read_report(path)
            assert "\n" not in str(error.value)


def test_fields_that_are_not_checked_are_not_kept(old):
    new = upgrade_report(old)
    effect = new["effects"][0] | {"figure": "<img>", "__html__": "<img>"}
    assert upgrade_report(new | {"extra": "<img>", "effects": [effect, *new["effects"][1:]]}) == new


@pytest.fixture
def least():
    """The least that a report of this version has."""
    scores = {"n": 3, "rmse_db": 4.0}
    effect = {"name": "foliage", "rank": 1, "parameters": {}, "evidence": {"heldout_nll_gain": 1.0, "p_value": 0.1}}
    return {"schema": "radiotwin.closeloop/2", "base": "twin", "verdict": "effect", "effects": [effect], "candidates": [],
            "heldout": {"by": "flight", "folds": 2, "n": 3}, "baselines": {}, "notes": [],
            "error": {"before": dict(scores), "after": dict(scores), "noise_floor_db": None},
            "remaining": {"structured": False, "drivers": []}}


def test_the_least_that_the_schema_asks_for_makes_a_page(least, tmp_path):
    report = upgrade_report(least)
    write_closeloop_page(report, tmp_path, "least")
    assert "4.00" in closeloop_summary(report)


def test_what_a_sentence_computes_with_is_refused_where_it_is_not_known(least):
    least["error"]["after"]["rmse_db"] = None
    with pytest.raises(BadInput, match="verdict is effect, and error has no rmse_db"):
        upgrade_report(least)
    upgrade_report(least | {"verdict": "none", "effects": []})  # nothing was held out, so there is nothing to compare
    difference = {"value": None, "low": None, "high": None, "unit": "dB"}
    compared = [{"first": "a", "second": "b", "difference_db": difference, "pairs": 3, "places": 3}]
    with pytest.raises(BadInput, match=r"receivers_compared\.0\.difference_db\.value"):
        upgrade_report(least | {"verdict": "none", "receivers_compared": compared})
