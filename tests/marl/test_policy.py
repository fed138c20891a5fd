"""The policy that ships: what it sees, that it knows no order, and that it flies worlds that it was not trained in."""

import numpy as np
import pytest
import torch

from marl.environment import Environment
from marl.flights import evaluate, fly
from marl.heuristics import HeuristicPolicy
from marl.policy import (
    PRICES,
    WEIGHTS,
    EntityPolicy,
    Outlook,
    demonstrations,
    imitate,
    read_network,
)
from studies.generated import generated_mission, redrawn


@pytest.fixture(scope="module")
def network():
    return read_network(WEIGHTS)


def test_the_weights_are_small():
    assert WEIGHTS.stat().st_size < 2e6


def test_an_outlook_counts_steps_and_what_a_worse_rate_costs(city):
    seen = Outlook.of(city)
    rate = seen.rate[1, 2].astype(float)
    cells = np.argwhere(rate > 0)
    cost = -np.log(rate[rate > 0])
    for row, column in ((0, 0), (7, 11), (15, 20)):
        steps = np.abs(cells - (row, column)).sum(axis=1)
        expected = [min((steps + price * cost).min(), 200.0) for price in PRICES]
        np.testing.assert_allclose(seen.away[1, 2, row, column], expected, rtol=1e-4, atol=1e-3)
    at = tuple(seen.peak[1, 2])
    assert rate[at] == rate.max()
    np.testing.assert_allclose(seen.heard[1, 2], seen.rate[1][(slice(None), *at)])


def test_neither_the_order_of_devices_nor_other_flights_change_a_decision(city, network):
    order = np.random.default_rng(0).permutation(city.devices)
    turned = city._replace(snr_db=city.snr_db[:, order], sigma_db=city.sigma_db[:, order],
                           data_units=city.data_units[order], known_m=city.known_m[order])
    rng = np.random.default_rng(1)
    environment = Environment(city, 2, rng)
    environment.reset()
    policies = [EntityPolicy(network, mission) for mission in (city, city, turned)]
    for policy, flights in zip(policies, (2, 1, 1)):
        policy.start(city, flights)
    for _ in range(20):
        frame = environment.frame
        one = type(frame)(*(array[:1] for array in frame))
        back = np.append(np.argsort(order), -1)
        other = one._replace(snr_db=one.snr_db[..., order], data_units=one.data_units[:, order],
                             assigned=back[one.assigned].astype(np.int16))
        actions = [policy.act(each) for policy, each in zip(policies, (frame, one, other))]
        np.testing.assert_array_equal(actions[0][:1], actions[1])
        np.testing.assert_array_equal(actions[1], actions[2])
        environment.step(actions[0])


@pytest.mark.parametrize("uavs, devices", [(1, 1), (7, 20)])
def test_it_flies_any_number_of_uavs_and_devices_home(network, uavs, devices):
    mission = generated_mission(11, uavs=uavs, devices=devices, side_m=(400.0, 400.0))
    environment = Environment(mission, 2, np.random.default_rng(0))
    flown = fly(environment, EntityPolicy(network, mission))
    assert (environment.frame.battery == 0).all()
    cell = environment.frame.cell
    assert not any(mission.steps_home[u][tuple(cell[:, u].T)].any() for u in range(uavs))
    assert flown.ratio(mission).min() > 0.1


def test_it_collects_more_than_greedy_in_worlds_that_it_has_not_seen(network):
    gains = []
    for seed in range(6):
        mission = generated_mission(seed)
        shares = [evaluate(mission, policy, 2, np.random.default_rng(1)).ratio(mission).mean() for policy in
                  (EntityPolicy(network, mission), HeuristicPolicy("greedy", np.random.default_rng(0)))]
        gains.append(shares[0] / shares[1])
    assert np.mean(gains) > 1.05


def test_imitation_learns_the_moves_that_it_is_shown(city):
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    shown = demonstrations([redrawn(city, rng) for _ in range(6)], 300, rng)
    *seen, move = shown
    assert seen[5].gather(1, move[:, None]).all()  # each move is feasible
    before, after = (imitate(shown, updates, 0, batch=256)(*seen) for updates in (0, 120))
    loss = [float(torch.nn.functional.cross_entropy(score, move)) for score in (before, after)]
    assert loss[1] < 0.7 * loss[0]
