"""Probabilities of causes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses, _Family
from radiotwin.closeloop.verdict.posterior import NONE, OTHER, features, judge, probability_of
from radiotwin.closeloop.verdict.sensitivity import needed_nats
from radiotwin.effects.catalogue.clock_offset import ReceiverClockOffset
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.catalogue.position_errors import DevicePositionError
from radiotwin.inference.correlated_evidence import Columns
from radiotwin.twin.model.fitting import add_effect
from tests.closeloop.looking import based, looked_at

CRITERIA = SelectionCriteria()


def test_evidence_for_an_offset_that_is_there_and_none_for_one_that_is_not(open_ground):
    def louder(world):
        world.gain_db[world.receiver == 1] += 5.0

    for change, low, high in ((louder, 15.0, np.inf), (lambda world: None, -np.inf, 0.0)):
        model, hypotheses = looked_at(open_ground, 2, change)
        found = add_effect(model.whole, ReceiverGainOffset())
        assert low < hypotheses.effect_evidence_nats(found) < high


def test_an_end_that_is_off_does_not_pay_for_those_that_are_not(open_ground, monkeypatch):
    def weaker(world):
        world.gain_db[world.device == 1] -= 5.0

    model, hypotheses = looked_at(open_ground, 2, weaker)
    found = add_effect(model.whole, DeviceGainOffset())
    few_nats = hypotheses.effect_evidence_nats(found)
    monkeypatch.setattr(DeviceGainOffset, "sparse", False)
    assert few_nats > hypotheses.effect_evidence_nats(found) + 2.0
    monkeypatch.undo()
    model, hypotheses = looked_at(open_ground, 2)
    assert hypotheses.effect_evidence_nats(add_effect(model.whole, DeviceGainOffset())) < 0


def test_no_further_cause_is_no_evidence_wherever_the_variances_are(open_ground):
    model, hypotheses = looked_at(open_ground, 2)
    nothing = Columns(np.zeros((len(hypotheses.links), 0)), np.zeros(0))
    for scale in (0.1, 1.0, 30.0):  # the search of the variances starts near 1
        scaled = replace(hypotheses, base_z=scale * hypotheses.base_z)
        assert abs(scaled.gain_nats(scaled.base_z, nothing)) < 0.2


def sd_of_levels_db(hypotheses):
    """Return the tolerances of five devices, two receivers and twelve tracks, which are the last columns."""
    devices, receivers, tracks = np.split(hypotheses.nuisance.prior_sd[-19:], [5, 7])
    return devices[0], receivers[0], tracks[0]


def scattered(label, sd_db, rng):
    """Each end of a kind is off by a number of its own."""
    return rng.normal(0, sd_db, label.max() + 1)[label]


def test_the_scatter_of_flights_is_learnt_and_what_all_share_is_none(open_ground):
    found_db = []
    for seed in range(3):
        def flights_differ(world, rng=np.random.default_rng(seed)):
            world.gain_db += 10.0 + scattered(2 * world.flight + world.receiver, 2.0, rng)

        found_db.append(sd_of_levels_db(looked_at(open_ground, seed, flights_differ)[1]))
    devices_db, _, tracks_db = np.sqrt(np.mean(np.square(found_db), axis=0))
    assert 1.0 < tracks_db < 3.0 and devices_db < 0.6  # robust, and drawn to 0.5 dB


@pytest.mark.seconds
def test_with_many_tracks_the_scatter_of_flights_is_learnt(open_ground):
    world = open_ground.fly(0, flights=24, slots=20)
    world.gain_db += scattered(world.flight, 3.0, np.random.default_rng(0))
    hypotheses = Hypotheses.of(based(open_ground.measured(world))[0].whole, 0)
    assert 1.8 < hypotheses.nuisance.prior_sd[-1] < 4.2 and len(set(hypotheses.nuisance.prior_sd[-24:])) == 1


def test_the_scatter_of_devices_is_learnt(open_ground):
    found_db = []
    for seed in range(3):
        def devices_differ(world, rng=np.random.default_rng(seed)):
            world.gain_db += scattered(world.device, 3.0, rng)

        found_db.append(sd_of_levels_db(looked_at(open_ground, seed, devices_differ)[1]))
    devices_db, _, tracks_db = np.sqrt(np.mean(np.square(found_db), axis=0))
    assert 1.2 < devices_db < 4.0 and tracks_db < 0.6


FAULTS = {
    "a flight": lambda world: 8.0 * (world.flight == 3), "a receiver": lambda world: 8.0 * (world.receiver == 1),
    "a step": lambda world: 8.0 * ((world.receiver == 1) & (world.flight > 2)),
    "a device": lambda world: 8.0 * (world.device == 2), "ageing": lambda world: 4.0 * world.flight * (world.receiver == 0),
    "ageing of both": lambda world: 1.5 * world.flight}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_a_single_fault_does_not_widen_the_tolerance(open_ground, fault):
    def faulty(world):
        world.gain_db += fault(world)

    devices_db, _, tracks_db = sd_of_levels_db(looked_at(open_ground, 2, faulty)[1])
    assert devices_db < 0.5 and tracks_db < 0.5


CAMPAIGNS = [  # receivers, flights of each, receivers with one flight more, ends without a reading, variance found of 1
    (1, 5, 0, 0, (0.6, 1.2)), (1, 6, 0, 0, (0.5, 1.1)), (2, 6, 0, 0, (0.55, 1.05)), (3, 3, 0, 0, (0.3, 0.9)),
    (10, 3, 0, 0, (0.25, 0.6)), (1, 40, 0, 0, (0.75, 1.1)), (2, 9, 21, 0, (0.55, 1.05)), (1, 6, 0, 1, (0.45, 1.2)),
    (2, 6, 0, 2, (0.5, 1.05))]


@pytest.mark.parametrize(("receivers", "flights", "single", "empty", "within"), CAMPAIGNS)
@pytest.mark.parametrize("timed", [True, False])
def test_the_variance_of_levels_is_found_whoever_is_alone_or_blank(receivers, flights, single, empty, within, timed):
    group = np.concatenate([np.repeat(np.arange(receivers), flights), receivers + np.arange(single)])
    rng, k = np.random.default_rng(1), len(group)
    start_s = rng.permutation(k).astype(float) if timed else np.full(k, np.nan)
    covariance = 0.01 * np.eye(k) + 30.0  # what all share is not known
    seen = np.arange(k) >= empty
    covariance[~seen, ~seen] = 400.0
    found = []
    for _ in range(800):
        level_db = 50.0 * group + rng.normal(0, np.sqrt(1.01), k) + rng.normal(0, 5)
        level_db[~seen] = 0.0
        variance, freedom = _Family(slice(0, k), group, start_s).usual_variance(level_db, covariance, seen)
        assert freedom == receivers * flights - empty - receivers - 1
        found.append(variance)
    low, high = within
    assert low < np.mean(found) < (high if timed else 1.7 * high)


def late(world):
    """Write the levels of receiver 1 beside the positions of three seconds before."""
    mine = np.flatnonzero((world.receiver == 1) & (world.slot >= 3))
    world.receiver_m[mine] = world.receiver_m[mine - 3 * len(world.device_m)].copy()


def moved(world):
    """Declare an anchor 25 m from where it is."""
    world.device_m[1, 0] += 25.0


@pytest.mark.parametrize("effect, change", [(ReceiverClockOffset(), late), (DevicePositionError(), moved)])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))])
def test_evidence_is_that_of_all_numbers_an_effect_may_have(open_ground, monkeypatch, effect, change, seed):
    model, hypotheses = looked_at(open_ground, seed, change)
    found = add_effect(model.whole, effect)
    by_laplace = hypotheses.effect_evidence_nats(found)
    monkeypatch.setattr("radiotwin.closeloop.verdict.hypotheses._slopes",
                        lambda fit: Columns(np.zeros((int(fit.train.sum()), 0)), np.zeros(0)))
    varied = found.effects[-1].variation()

    def nats(numbers):
        return hypotheses.effect_evidence_nats(found.with_effects([varied.effect(numbers)]))

    # Of a uniform prior: the sum over a grid around the best, wide enough to hold what is likely.
    best, reach = nats(varied.values), []
    for axis in np.eye(len(varied.values)):
        sizes = varied.steps @ axis * np.geomspace(0.02, 12.0, 30)
        reach.append(next(size for size in sizes if all(
            nats(varied.values + sign * size * axis) < best - 6 for sign in (-1, 1))))
    axes = [value + side * np.linspace(-1, 1, 15) for value, side in zip(varied.values, reach)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    cell = np.prod([axis[1] - axis[0] for axis in axes]) / np.prod(varied.high - varied.low)
    assert by_laplace == pytest.approx(logsumexp([nats(each) for each in grid]) + np.log(cell), abs=3.0)


def test_what_depends_on_time_alone_is_more_likely_without_a_name(open_ground):
    def wander(world):
        world.gain_db += 4.0 * np.sin(world.time_s / 60.0)

    _, hypotheses = looked_at(open_ground, 3, wander)
    unnamed = hypotheses.unnamed_nats
    assert max(unnamed, key=unnamed.get).startswith("time") and max(unnamed.values()) > 50
    assert max(looked_at(open_ground, 3)[1].unnamed_nats.values()) < 5


def test_noise_is_told_from_a_rest_that_belongs_to_places(open_ground):
    rest_db, noise_db = looked_at(open_ground, 4)[1].rest_and_noise_db
    assert rest_db < 1.0 and noise_db == pytest.approx(2.0, rel=0.15)


def test_probabilities_sum_to_one_and_a_weak_candidate_is_refused(open_ground):
    model, hypotheses = looked_at(open_ground, 5)
    scores = [Trial(name, passed=True, nll_gain=10 * nats, rmse_db=model.rmse_db() * 0.99, evidence_nats=nats,
                             gain_by_fold=np.full(4, nats / 4)) for name, nats in (("foliage", 3.0), ("interference", 2.0))]
    judged, step = judge(scores, model, hypotheses, CRITERIA)
    assert set(step.probabilities) == {"foliage", "interference", NONE, OTHER}
    assert sum(step.probabilities.values()) == pytest.approx(1.0) and min(step.probabilities.values()) >= 0
    for score in judged:
        refused = score.probability < CRITERIA.min_probability
        assert refused == ("is not probable enough" in score.reason)


def test_what_makes_links_blank_has_no_rival_among_what_changes_levels(open_ground):
    """Its evidence is of held-out links only, as no residual of a level shows it."""
    model, hypotheses = looked_at(open_ground, 5)
    lost, offset = (Trial(name, passed=True, nll_gain=nats, rmse_db=model.rmse_db(), evidence_nats=evidence,
                                   gain_by_fold=np.full(4, nats / 4))
                    for name, nats, evidence in (("lock_loss", 30.0, np.nan), ("foliage", 90.0, 80.0)))
    alone, beside = (judge(scores, model, hypotheses, CRITERIA)[0][0] for scores in ([lost], [lost, offset]))
    assert beside.probability == pytest.approx(alone.probability) and beside.features[0] == beside.features[1]
    (weaker,) = (score for score in judge([lost, offset, lost], model, hypotheses, CRITERIA)[0] if score.name == "foliage")
    assert weaker.features[2] < judge([offset], model, hypotheses, CRITERIA)[0][0].features[2]


def test_evidence_makes_probable_and_a_rest_of_places_or_another_effect_makes_it_worth_less():
    def chances(nats=(40.0,), ratios=(1.0,), beside=(False,)):
        return [probability_of("foliage", features((each,) * 3, ratio, there))
                for each in nats for ratio in ratios for there in beside]

    assert np.all(np.diff(chances(nats=np.arange(0.0, 300.0, 10.0))) > 0)
    assert np.all(np.diff(chances(ratios=(0.3, 1.0, 3.0, 9.0))) < 0)
    alone, beside = chances(beside=(False, True))
    assert beside < 0.8 * alone
    assert needed_nats("foliage", 0.5, 1.0, True) > needed_nats("foliage", 0.5, 1.0)
