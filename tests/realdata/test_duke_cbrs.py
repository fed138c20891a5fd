"""Sectors of an LTE network whose antennas nobody declared: which way they look, on ground that is held out."""

import numpy as np
import pytest

from radiotwin.closeloop.run import close_loop
from radiotwin.closeloop.search import Model, rmse_db
from radiotwin.effects.sector_antenna import SectorAntenna

AZIMUTHS_DEG = {"A": 212, "B": 212, "C": 30, "D": 30, "E": 216, "F": 216}  # clockwise from north, as published


@pytest.fixture(scope="module")
def loop(duke):
    return close_loop(duke, None, "log-distance", 0, lambda text: None, "block")


def everywhere(loop) -> np.ndarray:
    return np.ones(len(loop.records), dtype=bool)


def test_antennas_are_named_first_and_look_where_they_do(loop):
    parts = loop.after.whole.parts
    assert parts[0].effect.name == "antenna_pattern"
    found_deg = {loop.records.device_names[int(device)]: pattern[0] for part in parts
                 if isinstance(part.effect, SectorAntenna) for device, pattern in part.setting["devices"].items()}
    off_deg = {name: abs((deg - AZIMUTHS_DEG[name] + 180) % 360 - 180) for name, deg in found_deg.items()}
    assert set(off_deg) == set(AZIMUTHS_DEG) and max(off_deg.values()) <= 20


def test_named_effects_take_a_quarter_of_the_error_and_interpolation_more_of_the_rest(loop):
    rows = everywhere(loop)
    assert 11.0 < rmse_db(loop.before, rows) < 13.5
    assert rmse_db(loop.search.explained, rows) <= 8.9
    assert rmse_db(loop.after, rows) <= 6.4


def test_with_boresights_turned_round_the_gain_is_gone(loop):
    sides, fits = [], []
    for side in loop.search.explained.sides:
        turned = [side.part(part.effect, {"devices": {device: [pattern[0] + 180.0, *pattern[1:]] for device, pattern in
                                                      part.setting["devices"].items()}})
                  if isinstance(part.effect, SectorAntenna) else part for part in side.parts]
        sides.append(side.with_parts(turned))
        fits.append(sides[-1].fit())
    model = Model(sides[0], sides[1:], fits, loop.after.index)
    assert rmse_db(model, everywhere(loop)) > rmse_db(loop.before, everywhere(loop)) - 1.0


def test_of_permuted_levels_only_what_the_permutation_leaves_is_named(duke, permuted):
    """Each sector keeps its mean level, and the sectors differ by ten decibels; nothing else is left."""
    loop = close_loop(permuted(duke, 0), None, "log-distance", 0, lambda text: None, "block")
    assert [part.effect.name for part in loop.after.whole.parts] == ["device_gain_offset"]
