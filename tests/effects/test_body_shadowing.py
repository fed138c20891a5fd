"""The body's shadow: never a gain, in azimuth and elevation, and found where it was put."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.body_shadowing import Body, BodyShadowing
from radiotwin.effects.params import Estimate
from tests.worlds import city_of_boxes


@pytest.fixture
def links(make_links):
    """Two receivers that turn on the spot at 40 m, above devices all around: all azimuths, many elevations."""
    rng = np.random.default_rng(0)
    device_m = np.column_stack([rng.uniform(-150, 150, (40, 2)), np.full(40, 1.5)])
    return make_links(device_m, np.tile([0.0, 0.0, 40.0], (60, 1)), receiver=np.repeat(np.arange(60) % 2, 40),
                      heading_deg=np.repeat(rng.uniform(0, 360, 60), 40))


def angle_deg(links, azimuth_deg, elevation_deg):
    """Angle between a link's arrival and a direction of a level body, by the spherical law of cosines."""
    east, north, up = (links.device_m[links.device] - links.receiver_m).T
    arrival = np.arctan2(up, np.hypot(east, north))
    apart = np.arctan2(east, north) - np.radians(links.heading_deg + azimuth_deg)
    cosine = np.sin(arrival) * np.sin(np.radians(elevation_deg)) \
        + np.cos(arrival) * np.cos(np.radians(elevation_deg)) * np.cos(apart)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("azimuth_deg, elevation_deg", [(60.0, 0.0), (200.0, 30.0), (0.0, 90.0)])
def test_it_takes_its_depth_in_its_middle_nothing_opposite_and_half_across(links, azimuth_deg, elevation_deg):
    body = Body(depth_db=8.0, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg)
    gain_db = BodyShadowing().with_params(BodyShadowing.Params(receivers={1: body})).gain_db(links)
    off_deg, mine = angle_deg(links, azimuth_deg, elevation_deg), links.receiver == 1
    expected_db = np.interp(np.cos(np.radians(off_deg)), [-1, 0, 1], [0, -4, -8])
    np.testing.assert_allclose(gain_db, np.where(mine, expected_db, 0.0), atol=1e-9)
    assert gain_db.max() <= 0



@pytest.mark.parametrize("width_deg", [60.0, 120.0, 240.0])
def test_half_is_lost_at_half_its_width(width_deg):
    """The nose is its middle; arrivals in the plane of the deck."""
    off = np.radians([0.0, width_deg / 2, -width_deg / 2, 180.0])
    loss_db = Body(depth_db=10.0, width_deg=width_deg).loss_db(np.column_stack([np.sin(off), np.cos(off), 0 * off]))
    np.testing.assert_allclose(loss_db, [10, 5, 5, 0], atol=1e-9)


@pytest.mark.parametrize(("width_deg", "share"), [
    (180, lambda off_deg: (1 + np.cos(np.radians(off_deg))) / 2),
    (60, lambda off_deg: 2.0 ** -(2 * off_deg / 70) ** 2)])  # 70° wide: the nearest of the trial widths is 60°
def test_a_pod_below_the_deck_of_one_receiver_is_proposed_with_its_direction_and_width(links, view, width_deg, share):
    rng, mean_db = np.random.default_rng(2), np.full(len(links), -80.0)
    loss_db = np.where(links.receiver == 1, 10 * share(angle_deg(links, 60.0, -40.0)), 0.0)
    links.level_db[:] = mean_db - loss_db + rng.normal(0, 2.0, len(links))
    (params,) = BodyShadowing().propose(view(links, mean_db, 2.0))
    body = params.receivers[1]
    assert body.depth_db == pytest.approx(10, abs=2.5)  # less, by the prior
    assert body.azimuth_deg == pytest.approx(60, abs=8) and body.elevation_deg == pytest.approx(-40, abs=12)
    assert body.width_deg == width_deg
    assert 0 not in params.receivers or params.receivers[0].depth_db < 1


def test_what_was_found_is_reported_for_each_receiver(links):
    params = BodyShadowing.Params(receivers={1: Body(depth_db=8.0, azimuth_deg=420.0, elevation_deg=5.0)})
    variation = BodyShadowing().with_params(params).variation()
    assert variation.effect(variation.values).params == params and len(variation.members) == 1
    found = BodyShadowing().with_params(params).parameters(links, Estimate(np.zeros(0), [np.zeros((0, 0))], np.ones((2, 4))))
    assert {name: parameter.value for name, parameter in found.items()} == {
        "body_depth_db[r1]": 8, "body_azimuth_deg[r1]": 60, "body_elevation_deg[r1]": 5,
        "body_width_deg[r1]": 180}


@pytest.mark.slow
def test_a_body_is_found_in_a_flight(open_ground, loop):
    """One receiver of two loses 9 dB behind, 0 in front; the other is clear."""
    world = open_ground.fly(31)
    bearing = np.arctan2(*(world.device_m[world.device] - world.receiver_m)[:, :2].T)
    flat = np.hypot(*world.offset_m[:, :2].T) / world.distance_m
    behind = np.cos(bearing - np.radians(world.heading_deg) - np.pi) * flat
    world.gain_db = world.gain_db - np.where(world.receiver == 1, 4.5 * (1 + behind), 0.0)
    found = loop(open_ground.measured(world))
    assert found.names[0] == "body_shadowing"
    assert found.first["body_depth_db[r1]"].value == pytest.approx(9, abs=1.5)
    assert abs(found.first["body_azimuth_deg[r1]"].value - 180) < 12


def test_over_a_map_each_path_has_the_loss_of_its_own_direction(make_links):
    """A screen hides the device in the north; the wall east of both, 99 m away, is what is heard, from ahead and abeam."""
    city = city_of_boxes([[-30, 49, 0], [30, 51, 80]], [[99, -400, 0], [101, 400, 80]])
    links = make_links([[0.0, 100, 10]], [[0.0, 0, 10]], city=city, heading_deg=np.zeros(1))
    wall_deg = np.degrees(np.arctan2(198, 100))
    for azimuth_deg in (0.0, wall_deg, 180.0):
        body = Body(depth_db=10.0, azimuth_deg=azimuth_deg, width_deg=60.0)
        gain_db = BodyShadowing().with_params(BodyShadowing.Params(receivers={0: body})).gain_db(links)
        off = np.radians(azimuth_deg - wall_deg)
        exponent = np.log(0.5) / np.log((1 + np.cos(np.radians(30))) / 2)
        assert gain_db[0] == pytest.approx(-10 * ((1 + np.cos(off)) / 2) ** exponent, abs=0.5)
