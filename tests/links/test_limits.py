"""Limits of detection by the readings, in links made by a law, shadowing and receivers of the test's own."""

import re

import numpy as np
import pytest

from radiotwin.links.limits import estimate_limits, with_usual_limits
from tests.worlds import synthetic_links

DEVICES, REACH_M, STEP_M, SHADOWING_M = 5, 1500.0, 10.0, 50.0
NEVER = -300.0
SEEDS = range(3)


def fly(seed, limits_db=(-110.0, -110.0), n=4000, soft_db=0.0, lost=0.0, step_db=0.0, odd=0, power_db=0.0):
    """Links of receivers with these limits: gain = -35 - 26 log10(d) + correlated shadowing (8 dB) + 1 dB."""
    rng = np.random.default_rng(seed)
    device_m = np.column_stack([rng.uniform(0, REACH_M, (DEVICES, 2)), np.full(DEVICES, 1.5)])
    each = n // (len(limits_db) * DEVICES)
    keep = np.exp(-STEP_M / SHADOWING_M)
    parts = []
    for receiver in range(len(limits_db)):
        turn = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.2, each))
        way_m = rng.uniform(0, REACH_M, 2) + STEP_M * np.cumsum(np.column_stack([np.sin(turn), np.cos(turn)]), axis=0)
        way_m = REACH_M - np.abs(way_m % (2 * REACH_M) - REACH_M)  # turns back at the edge
        receiver_m = np.column_stack([way_m, np.full(each, 40.0)])
        for device in range(DEVICES):
            shadow = rng.normal(size=each)
            for i in range(1, each):
                shadow[i] = keep * shadow[i - 1] + np.sqrt(1 - keep**2) * shadow[i]
            level_db = -35 - 26 * np.log10(np.linalg.norm(receiver_m - device_m[device], axis=1)) + 8 * shadow
            parts.append((receiver_m, np.full(each, device), np.full(each, receiver), level_db))
    receiver_m, device, receiver, level_db = (np.concatenate(part) for part in zip(*parts))
    level_db = level_db + rng.normal(0, 1, len(level_db)) + np.linspace(-1, 1, DEVICES)[device] * power_db
    limit_db = np.array(limits_db)[receiver] + soft_db * rng.normal(size=len(level_db))
    level_db[(level_db < limit_db) | (rng.random(len(level_db)) < lost)] = np.nan
    level_db[rng.choice(len(level_db), odd, replace=False)] = -150.0
    if step_db:
        level_db = np.round(level_db / step_db) * step_db
    return synthetic_links(device_m, device, receiver_m, level_db=level_db, receiver=receiver,
                           time_s=np.arange(len(level_db)))


def estimated(links, declared_db=None):
    limit_db, notes = estimate_limits(links, declared_db)
    return links.with_columns(limit_db=limit_db).receiver_limits_db, notes


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("given", "margin_db"), [
    ({}, 0.6), ({"limits_db": (-120.0, -112.0, -105.0)}, 1.0), ({"step_db": 1.0}, 0.8), ({"step_db": 2.0}, 1.0),
    ({"soft_db": 1.5}, 1.6), ({"soft_db": 3.0}, 2.0), ({"lost": 0.1}, 0.6), ({"lost": 0.3}, 0.8), ({"odd": 3}, 0.6),
    ({"power_db": 15.0}, 1.0), ({"n": 400}, 2.5), ({"limits_db": (-110.0,) * 12, "n": 720}, 3.0)],
    ids=lambda value: " ".join(value) or "plain" if isinstance(value, dict) else "")
def test_undeclared_limits_are_found(seed, given, margin_db):
    limits_db, _ = estimated(fly(seed, **given))
    np.testing.assert_allclose(limits_db, given.get("limits_db", (-110.0, -110.0)), atol=margin_db)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("off_db", [-10.0, 10.0])
def test_a_declared_limit_that_readings_contradict_is_overruled_and_told(seed, off_db):
    links = fly(seed)
    limits_db, (note,) = estimated(links, -110.0 + off_db)
    np.testing.assert_allclose(limits_db, -110.0, atol=0.6)
    below = int((links.level_db < -110.0 + off_db).sum())
    said = f"{below:,} of {np.isfinite(links.level_db).sum():,} readings" if off_db > 0 else "no reading lies near"
    assert f"declared limit of detection, {-110 + off_db:g} dB (sens" in note and said in note and "for r1" in note


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("given", [{}, {"step_db": 1.0}, {"lost": 0.3}, {"odd": 3}, {"n": 400}])
def test_a_declared_limit_that_readings_allow_stays_to_the_bit(seed, given):
    limits_db, notes = estimated(fly(seed, **given), -110.0)
    assert np.all(limits_db == -110.0) and notes == []


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("given", [{}, {"lost": 0.3}, {"odd": 1}])
def test_a_limit_far_below_all_readings_stands_for_none(seed, given):
    links = fly(seed, **given)
    limits_db, notes = estimated(links, -250.0)
    assert notes[0].startswith("the declared limit of detection, -250 dB (sensitivity_dbm less tx_power_dbm in scene.toml), is "
                               "not used: but for odd ones, the weakest")
    used_db = re.search(r"links are blank\. Used instead: (-[\d.]+) ± [\d.]+ dB for r0; ", notes[0])
    assert float(used_db[1]) == pytest.approx(limits_db[0], abs=0.06)
    np.testing.assert_array_equal(limits_db, estimated(links)[0])
    np.testing.assert_allclose(limits_db, -110.0, atol=0.8)


@pytest.mark.parametrize("declared_db", [None, -110.0])
def test_links_that_are_lost_at_any_level_show_no_limit(declared_db):
    for seed in SEEDS:
        limits_db, notes = estimated(fly(seed, (-110.0, NEVER), lost=0.15), declared_db)
        assert limits_db[0] == pytest.approx(-110.0, abs=0.8) and limits_db[1] == -np.inf
        assert "receiver r1 are blank at any level" in " ".join(notes)


def test_without_blanks_there_is_no_limit_unless_one_is_declared_below_the_readings():
    links = fly(0, (NEVER, NEVER))
    lowest_db = np.nanmin(links.level_db)
    assert np.all(np.isinf(estimated(links)[0]))
    assert np.all(estimated(links, lowest_db - 5)[0] == lowest_db - 5)
    limits_db, (note,) = estimated(links, lowest_db + 25)
    assert np.all(np.isinf(limits_db)) and "no blank shows one" in note and f"down to {lowest_db:g}" in note


def test_the_uncertainty_covers_the_error_as_often_as_it_says():
    from radiotwin.links.limits import _estimates

    z = []
    for seed in range(12):
        links = fly(seed, n=1000)
        rows = [np.flatnonzero(links.receiver == receiver) for receiver in range(2)]
        z += [(each.limit_db + 110.0) / each.sd_db for each in _estimates(links, rows, -np.inf)[0]]
    assert np.mean(np.abs(z) < 1.645) > 0.75


def test_effects_must_explain_a_deaf_receiver_and_lost_links_only():
    links = fly(1, (-112.0, -110.0, -111.0, -95.0), n=6000)
    links = links.with_columns(limit_db=estimate_limits(links, None)[0])
    before_db, after_db = links.receiver_limits_db, with_usual_limits(links).receiver_limits_db
    np.testing.assert_array_equal(before_db[:3], after_db[:3])
    assert before_db[3] == pytest.approx(-95.0, abs=1.0) and after_db[3] == pytest.approx(-111.0, abs=1.0)
    scattered = fly(2, (-120.0, -113.0, -106.0, -99.0), n=6000)
    scattered = scattered.with_columns(limit_db=estimate_limits(scattered, None)[0])
    np.testing.assert_array_equal(scattered.limit_db, with_usual_limits(scattered).limit_db)
