"""What UAVs believe, against Bayes' rule by hand and against simulated flights."""

import numpy as np
import pytest
from scipy.stats import norm

from marl.belief import NOISE_DB, TEMPER, Belief, Prior
from marl.planner import expected_data

FAR = np.array([-1000.0, 0.0])


def two_places(tiny, **options):
    """A mission, and a prior with two candidates of one device: heard in the west, or in the east, of one row."""
    mission = tiny(0, rows=1, columns=8, uavs=1, devices=1, battery=(30,), snr_db=np.zeros((1, 1, 1, 8)),
                   data_units=np.array([1000.0]), detection_db=options.pop("limit_db", -20.0))
    west = 30.0 - 4.0 * np.arange(8)
    maps = np.array([west, west[::-1]], dtype=np.float32).reshape(1, 2, 1, 1, 8)
    prior = Prior(maps, np.full_like(maps, options.pop("sd_db", 3.0)), np.full((1, 2), 0.5), np.zeros(1), 0.0,
                  np.array([options.pop("silent", 0.0)]), 0.0, options.pop("share", 0.0), 50.0)
    return mission, prior


def test_independent_readings_weigh_candidates_as_bayes_does(tiny):
    """Close to the expected level a Student distribution is nearly normal, and the power is the declared one."""
    mission, prior = two_places(tiny)
    belief, sd_db, readings = Belief(prior, mission), np.hypot(3.0, NOISE_DB), [(2, 20.5), (3, 16.0), (4, 16.0)]
    log_odds = 0.0
    for column, snr_db in readings:
        belief.hear(0, np.array([0, column]), np.array([snr_db]))
        log_odds += norm.logpdf(snr_db, 30.0 - 4.0 * column, sd_db) - norm.logpdf(snr_db, 2.0 + 4.0 * column, sd_db)
    found = np.log(belief.weight[0, 0] / belief.weight[0, 1])
    assert 0.5 * TEMPER * log_odds < found < 1.2 * TEMPER * log_odds


def test_what_is_not_heard_weighs_by_its_probability(tiny):
    mission, prior = two_places(tiny, limit_db=10.0, sd_db=4.0)
    belief, sd_db = Belief(prior, mission), np.hypot(4.0, NOISE_DB)
    belief.hear(0, np.array([0, 1]), np.array([-np.inf]))
    log_odds = TEMPER * (norm.logcdf(10.0, 26.0, sd_db) - norm.logcdf(10.0, 6.0, sd_db))
    np.testing.assert_allclose(np.log(belief.weight[0, 0] / belief.weight[0, 1]), log_odds, rtol=1e-6)


def test_silence_where_it_should_be_heard_is_a_silent_device(tiny):
    mission, prior = two_places(tiny, silent=0.3, limit_db=0.0)
    near, nowhere = Belief(prior, mission), Belief(prior._replace(snr_db=prior.snr_db - 200.0), mission)
    for column in range(8):
        for belief in (near, nowhere):
            belief.hear(0, np.array([0, column]), np.array([-np.inf]))
    assert near.silent[0] > 0.95
    np.testing.assert_allclose(nowhere.silent[0], 0.3, atol=0.02)
    near.hear(0, np.array([0, 0]), np.array([25.0]))
    assert near.silent[0] == 0.0


def test_errors_that_last_count_once(tiny):
    """Hovering brings no more than one reading where the error stays; moving on does."""
    mission, prior = two_places(tiny, share=0.95, sd_db=6.0)
    staying, moving, independent = Belief(prior, mission), Belief(prior, mission), \
        Belief(prior._replace(share=0.0), mission)
    for number in range(6):
        staying.hear(0, np.array([0, 2]), np.array([20.0]))
        independent.hear(0, np.array([0, 2]), np.array([20.0]))
        column = (0, 7, 0, 7, 0, 7)[number]
        moving.hear(0, np.array([0, column]), np.array([28.0 - 3.6 * column]))
    odds = [np.log(each.weight[0, 0] / each.weight[0, 1]) for each in (staying, moving, independent)]
    assert 0 < odds[0] < 0.35 * odds[2] and odds[0] < 0.5 * odds[1]


def test_a_level_that_is_off_is_learnt_for_everywhere(tiny):
    mission, prior = two_places(tiny, sd_db=1.0)
    prior = prior._replace(level_sd_db=np.array([8.0]), weight=np.array([[1.0, 0.0]]))
    belief = Belief(prior, mission)
    before = belief.expected_data()[0, 0, 0]
    for column in range(4):
        belief.hear(0, np.array([0, column]), np.array([30.0 - 4.0 * column - 10.0]))
    lower = mission._replace(snr_db=prior.snr_db[:, 0] - 10.0, sigma_db=np.full((1, 1, 1, 8), 1.0, np.float32))
    np.testing.assert_allclose(belief.expected_data()[0, 0, 0, :3], expected_data(lower)[0, 0, 0, :3], rtol=0.1)
    assert (belief.expected_data()[0, 0, 0, :6] < before[:6]).all()


def test_before_any_reading_one_candidate_is_the_map(tiny):
    mission = tiny(3, sigma_db=2.5)
    belief = Belief(Prior.of_mission(mission), mission)
    np.testing.assert_allclose(belief.expected_data(), expected_data(mission)[mission.level], atol=1.5)
    assert belief.silent.max() == 0.0


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_what_it_is_sure_of_is_so(tiny, share):
    """Flights past a device at one of two places, errors drawn here: of nine in ten, nine are right."""
    mission, prior = two_places(tiny, share=share, sd_db=6.0)
    rng, sure, right = np.random.default_rng(1), 0, 0
    kept = np.exp(-mission.step_m / prior.length_m)
    for _ in range(300):
        at, belief, error = rng.integers(2), Belief(prior, mission), rng.normal()
        for column in range(8):
            error = kept * error + np.sqrt(1 - kept**2) * rng.normal()
            off_db = 6.0 * (np.sqrt(share) * error + np.sqrt(1 - share) * rng.normal())
            belief.hear(0, np.array([0, column]), prior.snr_db[0, at, 0, 0, column] + off_db + np.zeros(1))
        if belief.weight[0].max() > 0.9:
            sure, right = sure + 1, right + (belief.weight[0].argmax() == at)
    assert sure > 50 and right >= 0.9 * sure
