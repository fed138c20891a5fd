"""`closeloop.json`: what is written, and what is refused when it is read."""

import copy
import functools
import json
from pathlib import Path

import numpy as np
import pytest

from radiotwin.closeloop.output.result_file import (
    check_report,
    errors,
    make_report,
    read_report,
    write_report,
)
from radiotwin.closeloop.run import close_loop
from radiotwin.errors import BadInput
from radiotwin.report import closeloop_summary, write_closeloop_page

SAMPLE = Path(__file__).parent / "sample" / "closeloop.json"


@pytest.fixture
def sample():
    return json.loads(SAMPLE.read_text(encoding="utf-8"))


def test_bias_is_predicted_minus_measured():
    found = errors(np.array([-80.0, -90.0, np.nan]), np.array([-77.0, -89.0, -100.0]))
    assert (found["n"], found["bias_db"], found["mae_db"]) == (2, 2.0, 2.0)


@pytest.mark.usefixtures("quick_report")
def test_it_is_read_as_it_was_written(sample, open_ground, tmp_path):
    world = open_ground.fly(21)
    world.gain_db[world.receiver == 1] += 6.0
    report = make_report(close_loop(open_ground.measured(world).select(world.slot % 4 == 0), base="log-distance"))
    write_report(report, tmp_path / "closeloop.json")
    assert check_report(json.loads((tmp_path / "closeloop.json").read_text(encoding="utf-8"))) == report
    assert check_report(sample) == sample
    assert set(sample) == set(report) and set(sample["error"]) == set(report["error"])
    assert set(sample["effects"][0]) == set(report["effects"][0]) and report["effects"][0]["name"] == "receiver_gain_offset"
    assert {"log_distance", "regression_kriging"} <= report["baselines"].keys()  # the schema's names


def test_other_schemas_are_refused():
    with pytest.raises(BadInput, match="schema is 'radiotwin.closeloop/7', this version reads"):
        check_report({"schema": "radiotwin.closeloop/7"})


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


def test_a_text_in_place_of_a_number_is_refused_anywhere(sample, tmp_path):
    shown = [place for place in places(sample) if not {"params", "criteria"} & set(place)]
    one_of_each = {tuple(name if isinstance(name, str) else 0 for name in place): place for place in shown}
    assert len(one_of_each) > 100
    for place in one_of_each.values():
        text = isinstance(functools.reduce(lambda part, name: part[name], place, sample), str)
        for value in ({"a": 1}, ["a"], 7) if text else ("<img src=x onerror=alert()>", {"a": 1}, ["a"], 1e308):
            with pytest.raises(BadInput, match="this version reads" if place == ("schema",) else "is damaged"):
                check_report(changed(sample, place, value))


def test_a_missing_part_is_one_message(sample, tmp_path):
    path = tmp_path / "closeloop.json"
    for name in ("schema", "base", "verdict", "effects", "candidates", "heldout", "error", "baselines", "remaining"):
        for new in ({key: value for key, value in sample.items() if key != name}, sample | {name: None}):
            path.write_text(json.dumps(new))
            with pytest.raises(BadInput, match=f"^{path}(:| is damaged) .*again$") as error:
                read_report(path)
            assert "\n" not in str(error.value)


def test_fields_that_are_not_checked_are_not_kept(sample):
    effect = sample["effects"][0] | {"figure": "<img>", "__html__": "<img>"}
    assert check_report(sample | {"extra": "<img>", "effects": [effect, *sample["effects"][1:]]}) == sample


@pytest.fixture
def least():
    """The least that a report of this version has."""
    scores = {"n": 3, "rmse_db": 4.0}
    effect = {"name": "foliage", "rank": 1, "parameters": {}, "evidence": {"heldout_nll_gain": 1.0}}
    return {"schema": "radiotwin.closeloop/3", "base": "twin", "verdict": "effect", "effects": [effect], "candidates": [],
            "heldout": {"by": "flight", "folds": 2, "n": 3}, "baselines": {}, "notes": [],
            "error": {"before": dict(scores), "after": dict(scores), "noise_floor_db": None},
            "remaining": {"structured": False, "drivers": []}}


def test_the_least_that_the_schema_asks_for_makes_a_page(least, tmp_path):
    report = check_report(least)
    write_closeloop_page(report, tmp_path, "least")
    assert "4.00" in closeloop_summary(report)


def test_what_a_sentence_computes_with_is_refused_where_it_is_not_known(least):
    least["error"]["after"]["rmse_db"] = None
    with pytest.raises(BadInput, match="verdict is effect, and error has no rmse_db"):
        check_report(least)
    check_report(least | {"verdict": "none", "effects": []})  # nothing was held out, so there is nothing to compare
    difference = {"value": None, "low": None, "high": None, "unit": "dB"}
    compared = [{"first": "a", "second": "b", "difference_db": difference, "pairs": 3, "places": 3}]
    with pytest.raises(BadInput, match=r"receivers_compared\.0\.difference_db\.value"):
        check_report(least | {"verdict": "none", "receivers_compared": compared})
