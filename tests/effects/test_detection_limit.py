"""A receiver that is deafer than declared, in data made by a law and a limit of its own."""

import numpy as np
import pytest

from radiotwin.effects.detection_limit import DetectionLimit

DECLARED_DB, SCALE_DB = -120.0, 3.0


@pytest.fixture
def seen(links, view):
    """Makes a view of two receivers' links of which those below each receiver's limit are blank."""
    def make(limits_db, lost=0.0):
        rng = np.random.default_rng(0)
        receiver_m = np.column_stack([rng.uniform(0, 900, (600, 2)), np.full(600, 40.0)])
        records = links([[100.0, 100, 1.5], [500, 300, 1.5]], receiver_m, limit_db=DECLARED_DB,
                        receiver=np.repeat(np.arange(600) % 2, 2))
        mean_db = -40 - 28 * np.log10(records.distance_m)
        level_db = mean_db + rng.normal(0, SCALE_DB, len(records))
        level_db[level_db < np.array(limits_db)[records.receiver]] = np.nan
        level_db[rng.random(len(records)) < lost] = np.nan
        records.level_db[:] = level_db
        return view(records, mean_db, SCALE_DB)
    return make


def test_the_deaf_one_is_found_with_its_limit(seen):
    given = seen([DECLARED_DB, -108.0])
    (setting,) = DetectionLimit().propose(given)
    assert list(setting["receivers"]) == ["1"]
    limits_db = DetectionLimit().limits_db(given.records, setting)
    assert np.all(limits_db[given.records.receiver == 0] == -np.inf)
    parameter = DetectionLimit().parameters(given.records, setting, None)["limit[r1]"]
    assert parameter.low <= -108.0 <= parameter.high and parameter.high - parameter.low < 2
    assert parameter.value == pytest.approx(-108.0, abs=0.5)


@pytest.mark.parametrize("limits_db, lost", [([DECLARED_DB] * 2, 0.0), ([DECLARED_DB] * 2, 0.1)])
def test_receivers_as_declared_are_left_alone_even_if_they_lose_links(seen, limits_db, lost):
    assert DetectionLimit().propose(seen(limits_db, lost)) == []


def test_the_loop_names_it(open_ground, loop):
    """Receiver r1 is 12 dB deafer than r0, and the file says nothing of either's limit."""
    world = open_ground.fly(3, limit_db=-500.0)
    measurements = open_ground.measured(world)
    level_db = measurements.table["gain_db"]
    deaf = (measurements.table["receiver"] == "r1").to_numpy()
    low_db, high_db = np.nanquantile(level_db, [0.05, 0.35])
    measurements.table["gain_db"] = level_db.where(level_db >= np.where(deaf, high_db, low_db))
    report = loop(measurements)
    assert report.names == ["noise_floor_censoring"]
    assert report.first["limit[r1]"].value == pytest.approx(high_db, abs=0.5)
