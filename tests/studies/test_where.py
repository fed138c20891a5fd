"""What the study `where` counts as right and as not there, on made-up groups; and that a pivot table finds a device."""

from types import SimpleNamespace

import numpy as np

from studies import where, where_pivot
from studies.where_truth import Truth, is_there, where_is_right

N = 400
DEVICE, FLIGHT = np.arange(N) % 4, np.arange(N) // 100
HEARD = np.ones(N, dtype=bool)


def group(family, rows, ranges=None, **members):
    return SimpleNamespace(family=family, rows=rows, ranges=ranges or {}, statistic="level", sight="all",
                           members={end: (name,) for end, name in members.items()})


def truth(name, acts, places=(), others=None, **ends):
    return Truth(name, {end: {its} for end, its in ends.items()}, np.array(places, dtype=float).reshape(-1, 4),
                 acts if ends else HEARD, acts, np.where(acts, -4.0, 0.0), 4.0, others or {})


def test_the_right_device_is_right_and_its_flights_together_are():
    its = DEVICE == 1
    one = truth("device_gain_offset", its, device="d1")
    whole = group("device", its, device="d1")
    flights = [group("device x flight", its & (FLIGHT == f), device="d1", flight=f"f{f}") for f in range(4)]
    assert where_is_right([whole], one, HEARD) and where_is_right(flights[:2], one, HEARD)
    assert is_there(flights[0], one, HEARD) and not where_is_right(flights[:1], one, HEARD)
    assert not is_there(group("device", DEVICE == 2, device="d2"), one, HEARD)
    drift = truth("device_drift", its, device="d1")
    assert where_is_right(flights[:1], drift, HEARD) and not where_is_right([group("flight", FLIGHT == 2)], drift, HEARD)
    assert not is_there(group("flight", FLIGHT == 2, flight="f2"), one, HEARD)


def test_of_two_receivers_the_other_one_is_the_same_statement():
    one = truth("receiver_gain_offset", DEVICE < 2, others={"receiver": {"r1", "r2"}}, receiver="r1")
    assert where_is_right([group("receiver", DEVICE >= 2, receiver="r2")], one, HEARD)


def test_a_place_is_right_near_it_and_a_group_is_there_that_is_mostly_acted_on():
    acts = (DEVICE == 0) & (FLIGHT < 3)
    one = truth("missing_obstacle", acts, [(100, 120, 200, 210)])
    near, far = (group("place", FLIGHT == 3, {"x_m": (x, x + 50), "y_m": (200, 250)}) for x in (140.0, 160.0))
    assert where_is_right([near], one, HEARD) and not is_there(far, one, HEARD)
    assert is_there(group("device", DEVICE == 0, device="d0"), one, HEARD)


def test_the_pivot_table_points_at_the_device_that_is_low_and_at_nothing_else():
    rng = np.random.default_rng(3)
    residual_db = rng.normal(0, 2, N) - 6.0 * (DEVICE == 1)
    ends = {"device": np.array([f"d{one}" for one in DEVICE], dtype=object), "receiver": np.full(N, "r", dtype=object),
            "flight": np.array([f"f{one}" for one in FLIGHT], dtype=object)}
    place_m = np.column_stack([np.arange(N) * 7.0 % 900, np.zeros(N)])
    found = where_pivot.shrunken(residual_db, ends, HEARD, place_m)
    assert found[0].members == {"device": ("d1",)} and found[0].shift < -5 and found[0].score > where_pivot.THRESHOLD
    assert where_pivot.robust_z(residual_db, ends, HEARD)[0].members["device"] == ("d1",)
    without = where_pivot.shrunken(residual_db + 6.0 * (DEVICE == 1), ends, HEARD, place_m)
    assert without[0].score < where_pivot.THRESHOLD


def test_the_halves_are_apart_and_older_cases_are_24():
    names = where.where_cases(0)
    assert sum(name.startswith("undeclared/") for name in names) == 24 and not where.where_cases(1)
    assert {name.partition("/")[0] for name in names} == {"calibrate", "judge", "undeclared"}
