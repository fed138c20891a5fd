"""Kriging: interpolates what is smooth, knows where it knows nothing, and does not fill shadows."""

import numpy as np
import pytest

from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws import kriging as residual_field
from radiotwin.propagation.laws.kriging import RegressionKriging


def shadowing(links):
    """A smooth field [dB] over the receiver's position, another for each device."""
    x, y = links.receiver_m[:, 0], links.receiver_m[:, 1]
    return 6.0 * np.sin(x / 60.0 + links.device) * np.cos(y / 80.0 - 2.0 * links.device)


def test_interpolates_a_smooth_field(world):
    train, test = world(0, 1500), world(1, 3000)
    model = RegressionKriging().fit(train.links, train.level_db + shadowing(train.links), None, seed=0)
    truth_db = test.mean_db + shadowing(test.links)
    error_db = model.predict(test.links)[0] - truth_db
    trend_error_db = model.law.predict(test.links)[0] - truth_db
    assert np.sqrt(np.mean(error_db**2)) < 0.5 * np.sqrt(np.mean(trend_error_db**2))


def test_nine_in_ten_fall_within_their_interval(world):
    """Shadowing drawn from the exponential model, 6 dB and 80 m, on top of the law's own noise."""
    data = world(2, 2400)
    rng = np.random.default_rng(3)
    level_db = data.level_db.copy()
    for device in range(3):
        mine = data.links.device == device
        position_m = data.links.receiver_m[mine]
        apart_m = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
        root = np.linalg.cholesky(36.0 * np.exp(-apart_m / 80.0) + 1e-6 * np.eye(mine.sum()))
        level_db[mine] += root @ rng.standard_normal(mine.sum())
    train, test = slice(0, 1200), slice(1200, None)
    model = RegressionKriging().fit(data.links.select(train), level_db[train], None, seed=0)
    mean_db, sigma_db = model.predict(data.links.select(test))
    z = (level_db[test] - mean_db) / sigma_db
    assert np.mean(np.abs(z) < 1.645) == pytest.approx(0.9, abs=0.05)
    assert 30.0 < model.field.length_m < 200.0


def test_far_away_and_for_an_unmeasured_device_it_is_the_law(world):
    train = world(4, 900)
    model = RegressionKriging().fit(train.links, train.level_db + shadowing(train.links), None, seed=0)
    near, n = train.links.select(slice(0, 50)), 50
    far = LinkGeometry(near.device_m, near.receiver_m + [1e5, 0.0, 0.0], near.los, near.device)
    other = LinkGeometry(near.device_m, near.receiver_m, near.los, np.full(n, 9))
    for links in (far, other):
        assert np.allclose(model.predict(links), model.law.predict(links), atol=1e-6)
    assert (model.predict(near)[1] < model.law.predict(near)[1]).all()


def test_pure_noise_leaves_the_law_nearly_alone(world):
    train, test = world(5, 900), world(6, 3000)
    model = RegressionKriging().fit(train.links, train.level_db, None, seed=0)
    difference_db = model.predict(test.links)[0] - model.law.predict(test.links)[0]
    assert np.sqrt(np.mean(difference_db**2)) < 0.6


def test_batches_do_not_show(world):
    train, many = world(8, 300), world(9, 15_000).links
    model = RegressionKriging().fit(train.links, train.level_db + shadowing(train.links), None, seed=0)
    parts = [model.predict(many.select(slice(i, i + 3777))) for i in range(0, 15_000, 3777)]
    np.testing.assert_allclose(np.concatenate(parts, axis=1), np.array(model.predict(many)), atol=1e-9)


def test_a_shadow_that_was_not_detected_stays_dark(world):
    """A disc of 80 m in which nothing arrives: predicted below the law there, and lower than if left out."""
    train = world(7, 2400)

    def in_disc(links):
        return (links.device == 0) & (
            np.hypot(links.receiver_m[:, 0] - 300, links.receiver_m[:, 1] - 500) < 80
        )

    dark = in_disc(train.links)
    train.level_db[dark] = np.nan
    model = RegressionKriging().fit(train.links, train.level_db, -120.0, seed=0)
    without = RegressionKriging().fit(train.links.select(~dark), train.level_db[~dark], -120.0, seed=0)
    probe = train.links.select(dark)
    law_db = model.law.predict(probe)[0]
    assert (model.predict(probe)[0] - law_db).mean() < -4.0
    assert model.predict(probe)[0].mean() < without.predict(probe)[0].mean() - 4.0


def test_of_too_many_points_the_nearest_count(world, monkeypatch, tmp_path):
    data, probe = world(10, 900), world(13, 300).links
    level_db = data.level_db + shadowing(data.links)
    whole = RegressionKriging().fit(data.links, level_db, None, seed=1)
    for name, value in (("MAX_POINTS", 150), ("LOCAL_POINTS", 100), ("LOCAL_ROWS", 20)):
        monkeypatch.setattr(residual_field, name, value)
    local = RegressionKriging().fit(data.links, level_db, None, seed=1)
    assert sum(len(field.residual) for field in local.field.fields.values()) == 900
    assert all(len(factor) <= 150 for factor, _ in local.field._solved.values())
    np.testing.assert_allclose(local.predict(probe), whole.predict(probe), atol=0.5)
    again = RegressionKriging.from_state(*local.state()).predict(probe)
    np.testing.assert_allclose(again, local.predict(probe), atol=1e-9)
    alone = [local.predict(probe.select(slice(i, i + 1))) for i in range(20)]
    np.testing.assert_allclose(np.hstack(alone), np.array(local.predict(probe))[:, :20], atol=0.5)


def test_where_devices_move_each_receiver_has_a_field(world):
    """The ends are exchanged, and each link is of a device of its own: as well predicted as before, but for one receiver that moves."""
    data, probe = world(10, 400), world(13, 200)
    level_db = data.level_db + shadowing(data.links)

    def exchanged(links, moved=0):
        place_m = links.device_m + np.where(np.arange(len(links)) < moved, 50.0 * np.arange(len(links)), 0.0)[:, None]
        return LinkGeometry(links.receiver_m, place_m, links.los, np.arange(len(links)))
    here = RegressionKriging().fit(data.links, level_db, None, seed=1)
    there = RegressionKriging().fit(exchanged(data.links, moved=20), level_db, None, seed=1)
    again = RegressionKriging.from_state(*there.state())
    expected_db = here.predict(probe.links)[0]
    off_db = there.predict(exchanged(probe.links))[0] - expected_db
    assert np.sqrt(np.mean(off_db**2)) < 1.0 < np.abs(there.law.predict(exchanged(probe.links))[0] - expected_db).mean()
    np.testing.assert_allclose(again.predict(exchanged(probe.links)), there.predict(exchanged(probe.links)), atol=1e-9)
    assert len(there.field.fields) == len(there.fixed_m) + 1  # what moves has one together
    unmoved = RegressionKriging().fit(exchanged(data.links), level_db, None, seed=1)
    strange = exchanged(probe.links, moved=200)
    np.testing.assert_array_equal(unmoved.predict(strange)[0][1:], unmoved.law.predict(strange)[0][1:])


def test_one_position_only(world):
    data = world(12, 40)
    still = LinkGeometry(data.links.device_m, np.full((40, 3), 50.0), np.arange(40) % 2 == 0, data.links.device)
    model = RegressionKriging().fit(still, data.level_db, None, seed=0)
    assert np.isfinite(model.predict(data.links)).all()
