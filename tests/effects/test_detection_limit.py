"""A receiver less sensitive than declared, in links made by a law and a limit of its own."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.detection_limit import DetectionLimit

DECLARED_DB, SCALE_DB = -120.0, 3.0


@pytest.fixture
def seen(make_links, view):
    """Make the view of two receivers' links of which those below each receiver's limit are blank."""
    def make(limits_db, dropout_probability=0.0):
        rng = np.random.default_rng(0)
        receiver_m = np.column_stack([rng.uniform(0, 900, (600, 2)), np.full(600, 40.0)])
        links = make_links([[100.0, 100, 1.5], [500, 300, 1.5]], receiver_m, limit_db=DECLARED_DB,
                           receiver=np.repeat(np.arange(600) % 2, 2))
        mean_db = -40 - 28 * np.log10(links.distance_m)
        level_db = mean_db + rng.normal(0, SCALE_DB, len(links))
        level_db[level_db < np.array(limits_db)[links.receiver]] = np.nan
        level_db[rng.random(len(links)) < dropout_probability] = np.nan
        links.level_db[:] = level_db
        return view(links, mean_db, SCALE_DB)
    return make


def test_the_less_sensitive_receiver_is_found_with_its_limit(seen):
    given = seen([DECLARED_DB, -108.0])
    (params,) = DetectionLimit().propose(given)
    assert list(params.receivers) == [1]
    limits_db = DetectionLimit().with_params(params).limits_db(given.links)
    assert np.all(limits_db[given.links.receiver == 0] == -np.inf)
    parameter = DetectionLimit().with_params(params).parameters(given.links, None)["limit[r1]"]
    assert parameter.low <= -108.0 <= parameter.high and parameter.high - parameter.low < 2
    assert parameter.value == pytest.approx(-108.0, abs=0.5)


@pytest.mark.parametrize("dropout_probability", [0.0, 0.1])
def test_no_limit_is_proposed_for_receivers_as_declared_even_if_they_lose_links(seen, dropout_probability):
    assert DetectionLimit().propose(seen([DECLARED_DB] * 2, dropout_probability)) == []


def test_a_receiver_that_reads_far_weaker_levels_has_no_such_limit(seen):
    """As where no way leads to what is blank: 6 of some hundred weak links are read, down to 10 dB below."""
    given = seen([-400.0, -400.0])
    links = given.links
    weak = np.flatnonzero((links.receiver == 1) & (links.level_db < -108.0))
    links.level_db[np.random.default_rng(1).permutation(weak)[6:]] = np.nan
    assert np.nanmin(links.level_db[links.receiver == 1]) < -113.0 and len(weak) > 60
    assert DetectionLimit().propose(given) == []


@pytest.mark.slow
def test_close_loop_finds_it(open_ground, loop):
    """Receiver r1 is less sensitive than r0, and the file declares neither's limit."""
    world = open_ground.fly(3, limit_db=-500.0)
    measurements = open_ground.measured(world)
    level_db = measurements.table["gain_db"]
    deaf = (measurements.table["receiver"] == "r1").to_numpy()
    low_db, high_db = np.nanquantile(level_db, [0.05, 0.35])
    measurements.table["gain_db"] = level_db.where(level_db >= np.where(deaf, high_db, low_db))
    report = loop(measurements)
    assert report.names == ["noise_floor_censoring"]
    assert report.first["limit[r1]"].value == pytest.approx(high_db, abs=0.5)
