"""Lines of sight near walls: how probable they are, and what that is worth where walls are off."""

import numpy as np
import pytest
from scipy.stats import norm

from radiotwin.closeloop.crossfit import make_bases
from radiotwin.effects.catalogue import uncertain_sight
from radiotwin.effects.catalogue.uncertain_sight import UncertainSight
from radiotwin.twin.model.fitting import add_effect
from radiotwin.twin.model.model import Model
from tests.worlds import city_of_boxes

BEHIND_DB = 20.0


def city(walls_x_m=(-10.0, 10.0)):
    """A building of 30 m across the way from devices in the south to receivers in the north."""
    return city_of_boxes([[walls_x_m[0], -10, 0], [walls_x_m[1], 10, 30]], ground_m=600)


@pytest.fixture
def world(make_links):
    """Return links over a map; levels are those over another one."""
    def make(seed, true=None, links=800):
        rng = np.random.default_rng(seed)
        device_m = np.array([[0.0, -100.0, 10.0], [5.0, -60.0, 10.0]])
        receiver_m = np.column_stack([rng.uniform(-60, 60, links), rng.uniform(40, 150, links), np.full(links, 10.0)])
        plain = make_links(device_m, receiver_m, city=city())
        a_m, b_m = plain.device_m[plain.device], plain.receiver_m
        los = (true or city()).line_of_sight(a_m, b_m)
        level_db = -40 - 22 * np.log10(np.linalg.norm(b_m - a_m, axis=1)) - BEHIND_DB * ~los + rng.normal(0, 2, len(a_m))
        return make_links(device_m, receiver_m, city=city(), level_db=level_db)
    return make


def test_the_chance_is_that_of_a_wall_that_is_off(make_links, monkeypatch):
    monkeypatch.setattr(uncertain_sight, "MAPS", 150)
    clear_m = np.array([-4.0, -1.0, -0.3, 0.3, 1.0, 4.0])  # from the eastern wall, at its middle
    device_m = np.array([[10.0, -100.0, 10.0]])
    receiver_m = np.column_stack([10 + 2 * clear_m, np.full(6, 100.0), np.full(6, 10.0)])
    chance = UncertainSight()._chance(make_links(device_m, receiver_m, city=city()))
    # The way passes the wall's two corners at 0.9 and 1.1 of the clearance at its middle.
    corners = np.where(clear_m > 0, 0.9, 1.1) * clear_m
    assert chance == pytest.approx(norm.cdf(corners / uncertain_sight.WALL_SD_M), abs=0.09)


def fitted(links):
    twin = make_bases(None, 0)["twin"].fit(links)
    fit = Model.build(links, twin.channel, 8.0).fit()
    return fit, add_effect(fit, UncertainSight())


@pytest.mark.parametrize("seed", range(3))
def test_where_walls_are_off_links_beside_them_are_likelier_with_larger_errors(world, seed):
    links = world(seed, city((-8.5, 11.5)))
    fit, better = fitted(links)
    assert fit.objective - better.objective > 15
    chance = better.effects[-1]._chance(links)
    scale_db, sure = better.readings().scale_db, (chance == 0) | (chance == 1)
    assert scale_db[~sure].min() > 1.2 * scale_db[sure].max()
    assert better.effects[-1].params.contrast_db == pytest.approx(BEHIND_DB, rel=0.6)


def test_where_the_map_is_right_it_changes_next_to_nothing(world):
    links = world(0)
    fit, better = fitted(links)
    before, after = fit.readings(), better.readings()
    assert np.abs(after.mean_db - before.mean_db).max() < 3.0
    assert np.median(np.abs(after.scale_db / before.scale_db - 1)) < 0.05
