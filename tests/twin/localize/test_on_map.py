import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.twin.localize import LocalizeSettings, likelihood, localize, posterior
from radiotwin.twin.localize.on_map import CONSTRICTION

QUICK = LocalizeSettings(scan_step_m=10.0, swarms=3, particles=8, iterations=12)
BOUNDS = (0.0, 400.0, 0.0, 400.0)


def free_space_levels(xy_m, receiver_m, rng, sigma_db=2.0, z_m=1.5):
    distance = np.linalg.norm(receiver_m - [*xy_m, z_m], axis=1)
    return -40 - 20 * np.log10(distance) + sigma_db * rng.standard_normal(len(receiver_m))


def all_over(n, rng):
    return np.column_stack([rng.uniform(0, 400, (n, 2)), np.full(n, 60.0)])


def one(receiver_m, level_db, channel, **others):
    others = {"bounds": BOUNDS, "z_m": 1.5, "seed": 0, "settings": QUICK, "devices": {0: "d"}} | others
    return localize(receiver_m, np.zeros(len(level_db), int), level_db, channel, **others)[0]


def test_free_space_without_map_or_anchors(free_space):
    """Two devices, each with a name of its own, at heights of their own, 200 links of 0.3 dB: good to 2 m."""
    rng = np.random.default_rng(0)
    receiver_m = all_over(200, rng)
    truth = {7: (310.0, 95.0, 1.5), 3: (120.0, 250.0, 20.0)}
    levels = [free_space_levels(at[:2], receiver_m, rng, 0.3, at[2]) for at in truth.values()]
    found = localize(
        np.tile(receiver_m, (2, 1)), np.repeat([7, 3], 200), np.concatenate(levels), free_space,
        devices={7: "near", 3: "high"}, bounds=BOUNDS, z_m=[1.5, 20.0], seed=0, settings=QUICK,
    )  # fmt: skip
    assert [e.device for e in found] == ["near", "high"]
    assert [e.z_m for e in found] == [1.5, 20.0]
    for estimate, at in zip(found, truth.values()):
        assert np.hypot(estimate.x_m - at[0], estimate.y_m - at[1]) < 2.0
        assert estimate.located and estimate.second_mode is None


def test_mirror_image_is_a_second_mode(free_space):
    """Receivers on a straight line cannot distinguish its two sides: both, each with half of the posterior."""
    rng = np.random.default_rng(1)
    line = np.column_stack([np.full(40, 200.0), np.linspace(0, 400, 40), np.full(40, 60.0)])
    estimate = one(line, free_space_levels((120, 150), line, rng, 0.5), free_space)
    assert abs(abs(estimate.x_m - 200) - 80) < 8 and abs(estimate.y_m - 150) < 8
    x_m, y_m, weight = estimate.second_mode
    assert abs(x_m - (400 - estimate.x_m)) < 8 and abs(y_m - 150) < 8
    assert 0.3 < weight <= 0.5
    assert estimate.credible_radius_m > 150, "90 % are not on one side"


def test_what_was_not_detected_rules_out_a_mode(free_space):
    """The same line, and a few positions on the wrong side where the device should have been heard."""
    rng = np.random.default_rng(1)
    line = np.column_stack([np.full(40, 200.0), np.linspace(0, 400, 40), np.full(40, 60.0)])
    deaf = np.column_stack([rng.uniform([260, 120], [300, 180], (8, 2)), np.full(8, 60.0)])
    receiver_m = np.vstack([line, deaf])
    level = np.concatenate([free_space_levels((120, 150), line, rng, 0.5), np.full(8, np.nan)])
    limit_db = -40 - 20 * np.log10(140.0)
    level[:40][level[:40] < limit_db] = np.nan
    with_them = one(receiver_m, level, free_space, limit_db=limit_db)
    assert with_them.second_mode is None
    assert np.hypot(with_them.x_m - 120, with_them.y_m - 150) < min(25, with_them.credible_radius_m)
    assert one(receiver_m, level, free_space).second_mode is not None, "left out without a limit"


def test_repeats_of_independent_noise_average_but_repeats_of_model_error_do_not(free_space):
    """25 repeats at each of 30 positions: fresh noise narrows the radius about fivefold, equal levels do not."""
    rng = np.random.default_rng(3)
    places = all_over(30, rng)
    once = one(places, free_space_levels((150, 220), places, rng), free_space)
    repeated = np.repeat(places, 25, axis=0)
    fresh = one(repeated, free_space_levels((150, 220), repeated, rng), free_space)
    same = one(repeated, np.repeat(free_space_levels((150, 220), places, rng), 25), free_space)
    assert fresh.credible_radius_m < 0.4 * once.credible_radius_m
    assert 0.5 < same.credible_radius_m / once.credible_radius_m < 2.0


def test_one_wrong_link_does_not_outvote_the_others(free_space):
    rng = np.random.default_rng(4)
    receiver_m = all_over(60, rng)
    level = free_space_levels((150, 220), receiver_m, rng)
    clean = one(receiver_m, level, free_space)
    level[np.argmin(np.linalg.norm(receiver_m[:, :2] - (150, 220), axis=1))] -= 40.0
    wrong = one(receiver_m, level, free_space)
    assert np.hypot(wrong.x_m - clean.x_m, wrong.y_m - clean.y_m) < clean.credible_radius_m


def test_never_inside_a_building_unless_allowed(one_block, published_law):
    rng = np.random.default_rng(5)
    receiver_m = np.column_stack([rng.uniform(0, 200, (150, 2)), np.full(150, 60.0)])
    for seed in range(3):
        level = free_space_levels((119.0, 100.0), receiver_m, rng) + 9
        kept = one(receiver_m, level, published_law, city=one_block, bounds=(0, 200, 0, 200), seed=seed)
        assert not one_block.inside(np.array([[kept.x_m, kept.y_m, kept.z_m]]))[0]
    allowed = LocalizeSettings(scan_step_m=10.0, allow_indoor=True)
    indoors = (82.0, 118.0, 82.0, 118.0)
    estimate = one(receiver_m, level, published_law, city=one_block, bounds=indoors, settings=allowed)
    assert one_block.inside(np.array([[estimate.x_m, estimate.y_m, estimate.z_m]]))[0]
    with pytest.raises(BadInput, match="all of it is inside buildings"):
        one(receiver_m, level, published_law, city=one_block, bounds=indoors)


def test_a_start_helps_a_search_that_is_too_coarse(
    city, flown, measured, on_free_ground, published_law, monkeypatch
):
    """A map scanned in cells of 80 m, of which only the best is looked into, with one swarm that hardly flies: from
    an earlier estimate 2 m off it ends near the device; without one it does not, or the test shows nothing."""
    monkeypatch.setattr(posterior, "MAX_SPLIT_CELLS", 1)
    rng = np.random.default_rng(6)
    xy_m = on_free_ground(20, rng)
    data = measured(xy_m, flown(rng)[::4], rng)

    def worst_m(start_m):
        found = localize(
            *data, published_law,
            devices={row: f"d{row}" for row in range(20)}, bounds=(0, 600, 0, 800), z_m=1.5, city=city, limit_db=-120.0, seed=0,
            start_m=start_m,
            settings=LocalizeSettings(scan_step_m=80.0, swarms=1, particles=3, iterations=2),
        )  # fmt: skip
        return max(np.hypot(e.x_m - x, e.y_m - y) for e, (x, y) in zip(found, xy_m))

    assert worst_m(xy_m + [1.5, -1.5]) < 10.0
    assert worst_m(None) > 20.0


def test_same_seed_same_estimates_whatever_the_chunks(city, flown, measured, published_law, monkeypatch):
    rng = np.random.default_rng(7)
    data = measured([[460.0, 200.0], [20.0, 200.0]], flown(rng)[::6], rng)

    def run(chunk_links):
        monkeypatch.setattr(likelihood, "CHUNK_LINKS", chunk_links)
        settings = LocalizeSettings(scan_step_m=20.0, swarms=2, iterations=5)
        return localize(
            *data, published_law,
            devices={0: "a", 1: "b"}, bounds=(0, 600, 0, 800), z_m=1.5, city=city, limit_db=-120.0, seed=3, settings=settings,
        )  # fmt: skip

    assert run(1 << 18) == run(1 << 18) == run(1000)


def test_a_channel_that_differs_between_devices(free_space):
    """Device 1 is 15 dB weaker, and the gain depends on the azimuth: no table can hold that."""

    class Directional:
        def predict(self, links):
            mean, sigma = free_space.predict(links)
            east, north = (links.receiver_m - links.device_m)[:, :2].T
            return mean - 15.0 * (links.device == 1) + 6.0 * np.cos(np.arctan2(east, north)), sigma

    rng = np.random.default_rng(8)
    receiver_m = all_over(120, rng)
    levels = []
    for device, xy_m in enumerate([(100.0, 300.0), (300.0, 150.0)]):
        azimuth = np.arctan2(*(receiver_m[:, :2] - xy_m).T)
        levels.append(free_space_levels(xy_m, receiver_m, rng, 1.0) - 15.0 * device + 6.0 * np.cos(azimuth))
    found = localize(
        np.tile(receiver_m, (2, 1)), np.repeat([0, 1], 120), np.concatenate(levels), Directional(),
        devices={0: "a", 1: "b"}, bounds=BOUNDS, z_m=1.5, seed=0, settings=QUICK,
    )  # fmt: skip
    assert np.hypot(found[0].x_m - 100, found[0].y_m - 300) < 6
    assert np.hypot(found[1].x_m - 300, found[1].y_m - 150) < 6


def test_never_detected_is_not_located(free_space):
    """Without a limit nothing can be said; with one, the circle about every deaf receiver is ruled out, no more."""
    receiver_m = np.array([[100.0, 100.0, 60.0], [110.0, 100.0, 60.0]])
    blank = np.full(2, np.nan)
    silent = one(receiver_m, blank, free_space)
    assert not silent.located and np.isnan(silent.x_m) and np.isinf(silent.credible_radius_m)
    vague = one(receiver_m, blank, free_space, limit_db=-80.0)
    assert not vague.located and vague.credible_radius_m > 150
    nothing = one(np.empty((0, 3)), np.empty(0), free_space)
    assert not nothing.located


def test_one_link_is_too_little(free_space):
    class Vague:
        def predict(self, links):
            return free_space.predict(links)[0], np.full(len(links), 30.0)

    estimate = one(np.array([[200.0, 200.0, 60.0]]), np.array([-85.0]), Vague())
    assert not estimate.located


def test_constriction():
    """Clerc and Kennedy's published value for phi = 4.1."""
    assert np.isclose(CONSTRICTION, 0.7298, atol=1e-4)
