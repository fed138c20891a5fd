"""Log-distance laws of one line and of two, and a class that was hardly measured."""


import numpy as np
import pytest

from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance


def test_recovers_both_lines_under_heavy_censoring(world, laws):
    data = world(4, 4000, limit_db=-108.0)
    assert 0.15 < np.isnan(data.level_db).mean() < 0.6
    model = SegmentedLogDistance().fit(data.links, data.level_db, -108.0)
    assert model.borrowed is None
    for line, los in ((model.los, True), (model.nlos, False)):
        intercept_db, exponent, sigma_db = laws["parameters"][los]
        assert line.exponent == pytest.approx(exponent, abs=0.2)
        assert line.intercept_db == pytest.approx(intercept_db, abs=5.0)
        assert line.sd_db == pytest.approx(sigma_db, rel=0.09)


def test_nine_in_ten_fall_within_their_interval(world):
    data, fresh = world(5, 2000), world(6, 20_000)
    mean_db, sigma_db = SegmentedLogDistance().fit(data.links, data.level_db, None).predict(fresh.links)
    z = (fresh.level_db - mean_db) / sigma_db
    for los in (True, False):
        assert np.mean(np.abs(z[fresh.links.los == los]) < 1.645) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize(("kept", "poor"), [(True, "nlos"), (False, "los")])
def test_class_without_data_borrows_the_other_line(world, kept, poor):
    data = world(7, 800)
    mask = data.links.los == kept
    with pytest.warns(UserWarning, match="only 0 detected"):
        model = SegmentedLogDistance().fit(data.links.select(mask), data.level_db[mask], None)
    assert model.borrowed == poor
    assert model.state()[1] == {"borrowed": poor}
    assert model.los.exponent == model.nlos.exponent
    assert model.los.intercept_db - model.nlos.intercept_db == pytest.approx(20.0, abs=0.1)
    assert getattr(model, poor).sd_db == 8.0
    assert getattr(model, "los" if kept else "nlos").sd_db < 3.0


def test_a_few_links_move_a_borrowed_line(world):
    data = world(8, 800)
    for level_db in (data.mean_db, data.level_db):
        level_db[~data.links.los] -= 12.0
    nlos = np.flatnonzero(~data.links.los)[:15]
    rows = np.concatenate([np.flatnonzero(data.links.los), nlos])
    with pytest.warns(UserWarning, match="only 15 detected NLoS links"):
        model = SegmentedLogDistance().fit(data.links.select(rows), data.level_db[rows], None)
    error_db = model.predict(data.links.select(nlos))[0] - data.mean_db[nlos]
    assert abs(error_db.mean()) < 2.0
    # The prior alone is off by much more.
    prior_db = model.los.mean_db(data.links.log_distance[nlos]) - 20.0
    assert abs((prior_db - data.mean_db[nlos]).mean()) > 8.0


def test_one_line_recovers_its_own_law(world):
    def law(distance_m, los, elevation_rad):
        return -33.0 - 28.0 * np.log10(distance_m)

    data = world(0, 4000, limit_db=-105.0, law=law, los_range_m=1e-3)
    model = LogDistance().fit(data.links, data.level_db, -105.0)
    assert model.line.exponent == pytest.approx(2.8, abs=0.06)
    assert model.line.sd_db == pytest.approx(5.0**0.5, rel=0.05)
    mean_db, sigma_db = model.predict(data.links)
    assert np.sqrt(np.mean((mean_db - data.mean_db) ** 2)) < 0.25
    assert sigma_db.shape == (4000,)
