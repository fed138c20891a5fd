"""Training: schedules, reproducibility, and a small mission learnt to near its optimum."""

import math

import numpy as np
import pytest
import torch

from marl.environment import Environment
from marl.flights import AgentPolicy, fly
from marl.mission import HOVER
from marl.settings import LearnerSettings
from marl.trainer import Trainer

SETTINGS = LearnerSettings(hidden=8, mixing_width=4, parallel=4, batch=4, replay=12, epsilon_slots=400)


def test_schedules_are_linear_and_counted_in_slots_and_episodes(tiny):
    trainer = Trainer(SETTINGS, tiny(0), 40, 0)
    assert trainer.epsilon == 1.0 and trainer.learning_rate == SETTINGS.learning_rate
    trainer.train(20)
    assert trainer.epsilon == pytest.approx(1.0 - 0.95 * min(trainer.slots / 400, 1))
    assert trainer.learning_rate == pytest.approx((2e-3 + 2e-4) / 2)
    trainer.train(40)
    assert trainer.learning_rate == pytest.approx(2e-4) and trainer.epsilon == pytest.approx(0.05)


def test_there_is_an_update_for_every_so_many_episodes_once_a_batch_is_there(tiny):
    trainer = Trainer(SETTINGS.model_copy(update={"parallel": 3, "batch": 4, "episodes_per_update": 2}), tiny(0), 40, 0)
    for episodes, updates in ((3, 0), (3, 2), (6, 5)):  # the first three flights are less than a batch
        trainer.train(episodes)
        assert trainer.learner.updates == updates
    trainer.train(1)  # fewer than fit side by side
    assert trainer.episodes == 13 and trainer.learner.updates == 5


@pytest.mark.parametrize("mix", [True, False])
def test_the_same_seed_learns_the_same_weights_and_another_replica_others(tiny, mix):
    settings, mission = SETTINGS.model_copy(update={"mix": mix}), tiny(0, sigma_db=1.0)
    trainers = [Trainer(settings, mission, 40, 0, number) for number in (0, 0, 1)]
    start = [parameter.detach().clone() for parameter in trainers[2].learner.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(start, trainers[0].learner.parameters()))
    records = [trainer.train(12) for trainer in trainers]
    assert records[0] == records[1] != records[2]
    one, same, other = (list(trainer.learner.parameters()) for trainer in trainers)
    assert all(torch.equal(a, b) for a, b in zip(one, same))
    assert any(not torch.equal(a, b) for a, b in zip(one, other))


def test_a_quarter_of_the_flights_follow_a_plan_and_the_help_for_the_others_fades(tiny):
    mission, plan = tiny(0), np.full((20, 2), HOVER)
    trainer = Trainer(SETTINGS, mission, 40, 0)
    trainer.enter(mission, plan)
    slots = np.array([trainer._follow(10) for _ in range(200)])
    assert (slots[:, :3] == 20).all()
    assert slots[:, 3:].min() == 0 and slots[:, 3:].max() == 20 and abs(slots[:, 3:].mean() - 10) < 1
    trainer.episodes = 30
    assert np.array([trainer._follow(10)[3:] for _ in range(200)]).max() == 5
    trainer.episodes = 40
    assert trainer._follow(1).tolist() == [20] and trainer._follow(10)[3:].max() == 0


def test_a_trainer_goes_on_from_its_state_to_the_bit(tiny):
    mission = tiny(0, sigma_db=1.0)
    unbroken, stopped, again = (Trainer(SETTINGS, mission, 40, seed) for seed in (0, 0, 3))
    unbroken.train(8)
    expected = unbroken.train(16)
    stopped.train(8)
    again.load_state(stopped.state())
    assert again.train(16) == expected
    for one, other in zip(unbroken.learner.parameters(), again.learner.parameters()):
        assert torch.equal(one, other)


def test_a_small_mission_is_learnt_to_95_percent_of_its_optimum(tiny):
    # Two devices in opposite corners, heard well in the corner and badly one cell beside it; both UAVs start in the
    # middle. There and back costs 16 of 24 hovers, so a UAV spends 8 hovers and the slot of its leaving in a corner,
    # and passes a cell beside it twice. More of a device than one UAV takes is never there to be had.
    snr_db = np.full((2, 2, 5, 5), -np.inf)
    for k, (corner, beside) in enumerate([((0, 0), [(0, 1), (1, 0)]), ((4, 4), [(4, 3), (3, 4)])]):
        snr_db[(slice(None), k, *corner)] = 25.0
        for cell in beside:
            snr_db[(slice(None), k, *cell)] = 10.0
    mission = tiny(0, devices=2, snr_db=snr_db, battery=(24, 24), data_units=[10_000.0, 10_000.0],
                   known_m=[[0, 0], [80, 80]])
    well, badly = (100 * math.log2(1 + 10 ** (snr_db / 10)) for snr_db in (25.0, 10.0))
    optimum = 2 * (9 * well + 2 * badly) / 20_000
    settings = LearnerSettings(hidden=32, mixing_width=16, epsilon_slots=30_000, target_every=20, replay=500,
                               episodes_per_update=2)
    trainer = Trainer(settings, mission, 3000, 0)
    trainer.train(3000)
    rng = np.random.default_rng(0)
    ratio = fly(Environment(mission, 1, rng), AgentPolicy(trainer.learner.agent)).ratio(mission)[0]
    assert 0.95 * optimum <= ratio <= optimum * (1 + 1e-6)


def test_exploration_begins_anew_in_a_new_map_and_fades_to_what_it_would_be(tiny):
    mission = tiny(0)
    settings = SETTINGS.model_copy(update={"epsilon_slots": 40, "restart_epsilon": 0.5, "restart_slots": 200})
    trainer = Trainer(settings, mission, 400, 0)
    trainer.enter(mission)
    assert trainer.epsilon == 1.0
    trainer.train(40)
    assert trainer.epsilon == pytest.approx(0.05)
    trainer.enter(mission)
    assert trainer.epsilon == 0.5
    before = trainer.slots
    trainer.train(4)
    assert trainer.epsilon == pytest.approx(0.5 * (1 - (trainer.slots - before) / 200))
    trainer.train(40)
    assert trainer.epsilon == pytest.approx(0.05)


def test_what_is_remembered_is_flown_again_in_a_new_map_only_where_that_is_asked_for(tiny):
    here = tiny(2)
    there = here._replace(snr_db=tiny(3).snr_db)
    for asked in (False, True):
        trainer = Trainer(SETTINGS.model_copy(update={"fly_again": asked}), here, 40, 0)
        trainer.train(12)
        before = trainer.replay.state()["collected"].copy()
        trainer.enter(there)
        assert (trainer.replay.state()["collected"] != before).any() == asked
