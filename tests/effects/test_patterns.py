"""Antennas and receivers against closed forms."""


import numpy as np
import pytest
from pydantic import ValidationError

from radiotwin.effects.antennas import SectorPattern, sector_pattern_db
from radiotwin.effects.catalogue.noise_floor import NoiseFloor
from radiotwin.effects.catalogue.receiver_saturation import ReceiverSaturation, _compress
from radiotwin.effects.catalogue.sector_antenna import SectorAntenna
from radiotwin.effects.catalogue.tilted_dipole import dipole_gain
from tests.worlds import city_of_boxes


def test_the_sector_loses_3_db_at_half_its_beamwidths_and_no_more_than_its_front_to_back_ratio():
    pattern = SectorPattern(azimuth_deg=40.0, beamwidth_deg=65.0, front_to_back_db=25.0)
    azimuth_deg = np.array([40.0, 72.5, 7.5, 220.0, 400.0])
    np.testing.assert_allclose(sector_pattern_db(azimuth_deg, np.zeros(5), pattern), [0, -3, -3, -25, 0], atol=1e-9)
    tilted = SectorPattern(front_to_back_db=30.0, tilt_deg=-6.0, vertical_beamwidth_deg=10.0)
    elevation_deg = np.array([-6.0, -1.0, -11.0, 40.0])
    np.testing.assert_allclose(sector_pattern_db(np.zeros(4), elevation_deg, tilted), [0, -3, -3, -30], atol=1e-9)


@pytest.mark.parametrize("boresight_deg", [90.0, 30.0])
def test_a_hidden_receiver_hears_the_antenna_in_the_direction_of_the_reflection(make_links, boresight_deg):
    """A screen north of the device blocks the link, a long wall east of it reflects: all paths leave to the wall."""
    city = city_of_boxes([[-15, 19, 0], [15, 21, 60]], [[29, -200, 0], [31, 200, 60]])
    links = make_links([[0.0, 0, 10]], [[0.0, 40, 10]], city=city)
    pattern = SectorPattern(azimuth_deg=boresight_deg, beamwidth_deg=30.0, front_to_back_db=30.0, scattered_db=-80.0)
    added_db = SectorAntenna().with_params(SectorAntenna.Params(devices={0: pattern})).term(links, None).offset_db
    off_deg = abs(boresight_deg - np.degrees(np.arctan2(29, 20)))  # the wall's face is 29 m away
    assert not links.los[0]
    assert added_db[0] == pytest.approx(-min(12 * (off_deg / 30) ** 2, 30), abs=1.5)


@pytest.mark.parametrize("wrong", [{"scattered_db": np.nan}, {"beamwidth_deg": 500}, {"beamwidth": 65}, [40, 65, 25]])
def test_a_pattern_in_a_file_that_is_none_is_refused(wrong):
    with pytest.raises(ValidationError):
        SectorAntenna.Params.model_validate({"devices": {"3": wrong}})


def test_patterns_are_refined_each_by_itself():
    devices = {3: SectorPattern(azimuth_deg=40), 7: SectorPattern(azimuth_deg=160)}
    variation = SectorAntenna().with_params(SectorAntenna.Params(devices=devices)).variation()
    numbers = variation.values.copy()
    numbers[variation.members[1][0]] += 5
    assert variation.effect(numbers).params.devices == {3: devices[3], 7: SectorPattern(azimuth_deg=165)}


def towards(azimuth_deg, elevation_deg):
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], -1)


def upright_db(elevation_deg):
    """A half-wave dipole of directivity 2.15 dBi, as textbooks write it over the angle from its axis."""
    theta = np.pi / 2 - np.radians(elevation_deg)
    return 2.15 + 20 * np.log10(np.cos(np.pi / 2 * np.cos(theta)) / np.sin(theta))


@pytest.mark.parametrize("lean_deg", [0.0, 25.0])
@pytest.mark.parametrize("elevation_deg", [0.0, 20.0, 45.0])
def test_a_dipole_that_leans_towards_the_device_has_the_textbooks_pattern_of_the_smaller_angle(elevation_deg, lean_deg):
    """Leaning in the plane of the link turns the pattern and leaves the polarisation in that plane."""
    gain = dipole_gain(towards(90.0, elevation_deg), towards(90.0, 90.0 - lean_deg))
    assert 10 * np.log10(gain) == pytest.approx(upright_db(elevation_deg + lean_deg), abs=0.01)


def test_a_dipole_that_leans_across_loses_the_polarisation_only():
    gain = dipole_gain(towards(np.array([0.0, 180.0]), np.zeros(2)), towards(90.0, 60.0))
    np.testing.assert_allclose(10 * np.log10(gain), 2.15 + 20 * np.log10(np.cos(np.radians(30))), atol=0.01)


def test_the_body_turns_with_heading_pitch_and_roll(make_links):
    """Flying east, nose 10° up; flying north, right wing 20° down."""
    links = make_links([[0.0, 0, 1.5]], np.ones((2, 3)), heading_deg=np.array([90.0, 0.0]))
    links = links.with_columns(pitch_deg=np.array([10.0, 0.0]), roll_deg=np.array([0.0, 20.0]))
    right, nose, top = np.moveaxis(links.receiver_axes, 1, 0)
    np.testing.assert_allclose(right, [towards(180, 0), towards(90, -20)], atol=1e-9)
    np.testing.assert_allclose(nose, [towards(90, 10), towards(0, 0)], atol=1e-9)
    np.testing.assert_allclose(top, [towards(270, 80), towards(90, 70)], atol=1e-9)


def test_compression_follows_rapp_and_knows_its_slope():
    level_db = np.linspace(-120, -30, 500)
    read_db, slope = _compress(level_db, -60.0, 2.0)
    amplitude, limit = 10 ** (level_db / 20), 10 ** (-60.0 / 20)
    expected_db = 20 * np.log10(amplitude / (1 + (amplitude / limit) ** 4) ** 0.25)
    np.testing.assert_allclose(read_db, expected_db, atol=1e-9)
    np.testing.assert_allclose(slope, np.gradient(read_db, level_db), atol=2e-3)



@pytest.mark.parametrize("effect, params, expected_db", [
    (NoiseFloor(), NoiseFloor.Params(receivers={1: -80.0}), 10 * np.log10(1e-8 + 1e-8)),
    (ReceiverSaturation(), ReceiverSaturation.Params(receivers={1: (-80.0, 1.0)}), -80 - 10 * np.log10(2)),
])
def test_a_receivers_fault_is_in_its_own_readings(make_links, effect, params, expected_db):
    """At the floor the reading is twice the power, at the level of saturation with smoothness 1 half of it."""
    links = make_links([[0.0, 0, 1.5]], np.ones((4, 3)), receiver=np.array([0, 1, 0, 1]))
    found = effect.with_params(params)
    read_db, slope = found.response(np.full(4, -80.0), found.inputs(links))
    np.testing.assert_allclose(read_db, [-80, expected_db, -80, expected_db])
    np.testing.assert_allclose(slope, [1, 0.5, 1, 0.5])


@pytest.mark.parametrize("smoothness", [1.0, 3.0, 8.0])
def test_however_strong_a_signal_is_a_saturated_receiver_reads_its_level_of_saturation(smoothness):
    level_db = np.array([-60.0, -20.0, 100.0])
    read_db, slope = _compress(level_db, -80.0, smoothness)
    np.testing.assert_allclose(read_db, -80.0, atol=0.05)
    around_db = [_compress(level_db + step_db, -80.0, smoothness)[0] for step_db in (0.5, -0.5)]
    np.testing.assert_allclose(slope, around_db[0] - around_db[1], atol=2e-3)
    assert (slope > 0).all()  # residuals are divided by it


@pytest.mark.parametrize("straight", [True, False])
def test_directions_are_those_of_the_paths_or_the_straight_line_whichever_explains_more(make_links, view, straight):
    """Receivers behind a screen: a real antenna is heard off the wall, or, over a map that is wrong, straight."""
    city = city_of_boxes([[-60, 19, 0], [60, 21, 60]], [[99, -200, 0], [101, 200, 60]])
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-60, 80, 600), rng.uniform(30, 150, 600), np.full(600, 10.0)])
    links = make_links([[0.0, 0, 10]], receiver_m, city=city)
    x, y = receiver_m[:, 0], receiver_m[:, 1]
    heard = np.degrees(np.arctan2(x, y)) if straight else np.degrees(np.arctan2(198 - x, y))  # mirrored at x = 99
    off_deg = (heard - 20 + 180) % 360 - 180
    level_db = rng.normal(0, 1, 600) - np.minimum(12 * (off_deg / 65) ** 2, 20)
    heard = links.with_columns(level_db=level_db - level_db.mean())
    (params,) = SectorAntenna().propose(view(heard, np.zeros(600), 1.5))
    assert params.straight is straight
    if straight:  # off the wall they leave within 40 degrees, which does not tell an azimuth
        assert abs((params.devices[0].azimuth_deg - 20 + 180) % 360 - 180) <= 15
