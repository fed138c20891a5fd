"""What the study of foreign worlds counts as right, false, tolerated and held, on made-up reports."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from studies import foreign, foreign_figures, foreign_roc, foreign_table

NUISANCE = {"unmapped": [[[0, 0], [10, 0], [10, 10], [0, 10]]], "gone": [], "declared": "silent", "limit_db": [-100.0, -100.5],
            "sent_dbm": 20.0}


def case(*effects):
    return SimpleNamespace(answer={"effects": list(effects), "nuisance": NUISANCE})


def effect(name, **values):
    return {"name": name, "parameters": {key: {"value": value, "low": value - 1, "high": value + 1, "unit": "dB"}
                                         for key, value in values.items()}}


def row(name, hidden, named, *, split="judge", size_db=2.0, tolerated=(), parameters=(), statements=(), families=(),
        candidates=(), seen=()):
    errors = {"rmse_db": 3.0, "bias_db": 0.0, "nll": 2.5}
    return {"name": name, "split": split, "hidden": hidden, "size_db": size_db, "verdict": "effect", "named": list(named),
            "probabilities": list(named.values()), "tolerated": list(tolerated), "parameters": list(parameters),
            "statements": list(statements), "families": list(families), "before": errors | {"rmse_db": 4.0},
            "after": errors, "combined": errors, "seen": list(seen), "nuisance": NUISANCE | {"unmapped": 0, "gone": 0},
            "candidates": [[1, name, nats, 0.01, 3.0, False, nats / 10, [], probability]
                           for name, nats, probability in candidates], "oracle_rmse_db": 2.5, "baselines": {"log_distance": 9.0, "kriging": 3.1}}


def test_offsets_are_compared_relative_to_the_receiver_that_the_report_takes():
    hidden = {"name": "receiver_gain_offset", "in_catalogue": True, "receiver": "r1", "offset_db": 4.0}
    said = effect("receiver_gain_offset", **{"offset_db[r2]": -3.5})
    said["parameters"]["offset_db[r1]"] = {"value": 0.0, "low": 0.0, "high": 0.0, "unit": "dB"}
    (found,) = foreign.compared(hidden, [said], case(hidden))
    assert found["truth"] == -4.0 and found["value"] == -3.5 and foreign_table.holds(found)
    assert foreign.compared(hidden, [], case(hidden)) == []


def test_levels_are_compared_in_the_units_of_the_table_and_angles_around_the_circle():
    floor = {"name": "noise_floor_censoring", "in_catalogue": True, "receiver": "r1", "floor_db": -110.0}
    (found,) = foreign.compared(floor, [effect(floor["name"], **{"floor[r1]": -89.5})], case(floor))
    assert found["truth"] == -90.0
    sector = {"name": "antenna_pattern", "in_catalogue": True, "kind": "sector", "device": "d1", "azimuth_deg": 359.5,
              "downtilt_deg": 0.0, "beamwidth_deg": 60.0, "front_to_back_db": 20.0}
    said = effect("antenna_pattern", **{"azimuth_deg[d1]": 0.2})
    said["parameters"]["azimuth_deg[d1]"]["unit"] = "deg"
    (found,) = foreign.compared(sector, [said], case(sector))
    assert found["truth"] == pytest.approx(-0.5) and foreign_table.holds(found)


def test_a_building_that_the_map_lacks_by_mistake_is_no_false_name():
    near, far = effect("missing_obstacle", x_m=12.0, y_m=5.0), effect("missing_obstacle", x_m=80.0, y_m=5.0)
    assert foreign._by_mistake_of_the_map(near, case()) and not foreign._by_mistake_of_the_map(far, case())
    assert not foreign._by_mistake_of_the_map(effect("noise_floor_censoring"), case())
    assert foreign._is_true("none", case(), set()) and not foreign._is_true("foliage", case(), set())


def test_probabilities_are_those_of_the_first_step():
    listed = [{"name": "foliage", "probability": 0.7}, {"name": "none", "probability": 0.001}]
    assert list(foreign._first_posterior({"posterior": [{"step": 1, "probabilities": listed}]})) == [("foliage", 0.7)]
    assert list(foreign._first_posterior({"posterior": listed})) == [("foliage", 0.7)]
    assert list(foreign._first_posterior({})) == []


def test_the_table_counts_what_was_said():
    foliage = {"name": "foliage", "in_catalogue": True}
    held = {"name": "foliage", "parameter": "x_m", "truth": 1.0, "value": 1.5, "low": 0.5, "high": 2.0, "unit": "m",
            "determined": True}
    rows = pd.DataFrame([
        row("judge/a", [foliage], {"wall_reflection": 0.9, "foliage": 0.95, "interference": 0.6}, families=["foliage"],
            parameters=[held], statements=[["foliage", 0.95, True], ["interference", 0.6, False]],
            candidates=[("foliage", 90.0, 0.95), ("interference", 30.0, 0.6)], seen=[["foliage", 6.0, 4.0]]),
        row("judge/b", [], {"missing_obstacle": 0.97, "correlated_shadowing": None}, tolerated=["missing_obstacle"]),
        row("judge/c", [{"name": "warm_front", "in_catalogue": False}], {"excess_attenuation": None},
            families=["warm_front"]),
        row("judge/d", [{"name": "episode", "in_catalogue": True}], {}, families=["episode"], seen=[["episode", 7.0, 5.0]])])
    text = foreign_table.foreign_table(rows)
    for line in ("| right first, of cases of the catalogue | 1 of 2 |", "| false names a case of the catalogue | 0.50 |",
                 "| nulls that were given a cause | 0 of 1 |", "| not in the catalogue, given a cause with 0.9 and more | 1 of 1 |",
                 "| true parameters in their 90 % intervals | 1 of 1 |", "| error after / oracle, median | 1.20 |",
                 "| 0.9 to 0.97 | 100% of 1 |", "| named, of effects as large as would have been seen | 1 of 2 |", "| judge/d | `episode` | 7.0 | 5.0 |", "| `foliage` | 1 of 1 | 0 | 1 of 1 |",
                 "| `warm_front` | not in the catalogue | – | – |"):
        assert line in text, text
    assert set(foreign_figures.foreign_figures(rows)) == {"foreign"}


def test_effects_are_detected_at_the_false_alarms_that_the_others_give():
    foliage = [{"name": "foliage", "in_catalogue": True}]
    with_it = [row(f"judge/{i}", foliage, {}, candidates=[("foliage", 50.0 - 20 * i, 0.9 - 0.3 * i)]) for i in range(3)]
    without = [row(f"judge/n{i}", [], {}, candidates=[("foliage", 20.0, 0.5)] if i == 0 else []) for i in range(20)]
    table = foreign_roc.scored(pd.DataFrame(with_it + without), "probability")
    assert table["there"].sum() == 3 and np.isneginf(table["score"]).sum() == 19
    false, true = foreign_roc.curve(table["there"].to_numpy(), table["score"].to_numpy())
    assert false.tolist() == [0, 0, 0, 0.05, 0.05] and true.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 2 / 3, 1])
    assert foreign_roc.detection_rates(pd.DataFrame(with_it + without))["foliage"] == pytest.approx((2 / 3, 1, 2 / 3, 1))


def test_what_the_map_lacks_anyhow_is_neither_a_detection_nor_a_false_alarm():
    assert foreign_roc.undeclared_besides(NUISANCE) == {"missing_obstacle"}
    other = {"unmapped": 0, "gone": 1, "declared": "silent", "limit_db": [-100.0, -95.0]}
    assert foreign_roc.undeclared_besides(other) == {"removed_obstacle", "noise_floor_censoring"}
