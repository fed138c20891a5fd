"""PettingZoo's and Gymnasium's views of the mission: their own checks, and the batched environment's numbers."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="the extra rl is not installed")

import gymnasium  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402
from pettingzoo.test import parallel_api_test, parallel_seed_test  # noqa: E402

from marl.environment import Environment, global_state, observe, safe_actions  # noqa: E402
from marl.interfaces import CentralEnv, CentralVectorEnv, HarvestEnv  # noqa: E402
from marl.mission import NO_OP  # noqa: E402


def test_pettingzoos_own_tests_pass(city_mission):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(HarvestEnv(city_mission), num_cycles=300)
        parallel_seed_test(lambda: HarvestEnv(city_mission), num_cycles=100)


def test_gymnasiums_own_check_passes(city_mission):
    check_env(CentralEnv(city_mission), skip_render_check=True)


def test_each_agent_sees_and_collects_what_the_batched_environment_says(city_mission):
    env, batched = HarvestEnv(city_mission, ["a", "b"]), Environment(city_mission, 1, np.random.default_rng(7))
    observations, infos = env.reset(seed=7)
    batched.reset()
    rng, total = np.random.default_rng(1), 0.0
    while env.agents:
        seen, mask = observe(city_mission, batched.frame)
        for u, agent in enumerate(env.possible_agents):
            if agent in env.agents:
                np.testing.assert_array_equal(observations[agent]["observation"], seen[0, u])
                np.testing.assert_array_equal(observations[agent]["action_mask"], mask[0, u])
        np.testing.assert_array_equal(env.state(), global_state(city_mission, batched.frame)[0])
        action = np.where(mask, rng.random(mask.shape), -1).argmax(axis=-1)
        flying = env.agents
        observations, rewards, ended, cut, infos = env.step({agent: int(action[0, u]) for u, agent in
                                                             enumerate(env.possible_agents) if agent in flying})
        collected = batched.step(action)[0]
        assert rewards == {agent: float(collected[u]) for u, agent in enumerate(env.possible_agents) if agent in flying}
        assert ended == {agent: bool(batched.frame.battery[0, u] == 0) for u, agent in
                         enumerate(env.possible_agents) if agent in flying} and not any(cut.values())
        assert not any(info["replaced"] for info in infos.values())
        total += collected.sum()
    assert batched.done.all() and total > 0


def test_flights_of_the_vector_are_those_of_the_batched_environment(city_mission):
    env, batched = CentralVectorEnv(city_mission, 3), Environment(city_mission, 3, np.random.default_rng(5))
    seen, infos = env.reset(seed=5)
    batched.reset()
    rng, anew, resets = np.random.default_rng(2), np.zeros(3, dtype=bool), 0
    for _ in range(130):
        observation, mask = observe(city_mission, batched.frame)
        assert env.observation_space.contains(seen)
        for name, expected in (("observation", observation), ("action_mask", mask),
                               ("state", global_state(city_mission, batched.frame))):
            np.testing.assert_array_equal(seen[name], expected)
        action = np.where(mask, rng.random(mask.shape), -1).argmax(axis=-1)
        seen, reward, ended, cut, infos = env.step(action)
        collected = batched.step(action)
        if anew.any():
            batched.reset(anew)
            resets += 1
            assert (reward[anew] == 0).all() and (batched.frame.battery[anew] == city_mission.battery).all()
        anew = batched.done.copy()
        np.testing.assert_allclose(reward, collected.sum(axis=1), rtol=1e-6)
        np.testing.assert_array_equal(ended, anew)
        assert not cut.any() and not infos["replaced"].any()
    assert resets >= 3, "flights ended and began anew while others went on"


def test_infeasible_actions_are_replaced_and_every_uav_gets_home(city_mission):
    mask = np.array([[[True, False, True, False, False, False], [False, False, True, True, False, False],
                      [False] * 5 + [True]]])
    assert safe_actions(np.array([[2, 0, 1]]), mask).tolist() == [[2, 2, NO_OP]]
    env = HarvestEnv(city_mission)
    env.reset(seed=0)
    replaced = False
    while env.agents:  # always north: off the map before long
        infos = env.step(dict.fromkeys(env.agents, 1))[4]
        replaced |= any(info["replaced"] for info in infos.values())
    frame = env._environment.frame
    assert replaced and all(city_mission.steps_home[u, *frame.cell[0, u]] == 0 for u in range(city_mission.uavs))


def test_wrong_names_are_refused(city_mission):
    with pytest.raises(ValueError, match="2 different names"):
        HarvestEnv(city_mission, ["a", "a"])


@pytest.mark.parametrize("package", ["pettingzoo", "gymnasium"])
def test_without_the_extra_it_says_what_to_install(package):
    code = f"import sys; sys.modules[{package!r}] = None; import marl.interfaces"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 1 and "pip install 'radiotwin[rl]'" in result.stderr


def test_torchrl_wraps_the_environment_of_agents(tiny):
    """Its masks are in the observation alone: twice, and the wrapper fails."""
    pettingzoo = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed")
    env = pettingzoo.PettingZooWrapper(HarvestEnv(tiny()), use_mask=True)
    flown = env.rollout(100)
    assert flown["uav0", "action_mask"].shape[-1] == 6 and flown["uav1", "observation", "observation"].isfinite().all()


def test_maskable_ppo_trains_in_the_central_environment(tiny):
    env = CentralEnv(tiny())
    seen, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.action_masks(), seen["action_mask"].ravel())
    contrib = pytest.importorskip("sb3_contrib", reason="SB3-contrib is not installed")
    contrib.MaskablePPO("MultiInputPolicy", env, n_steps=32, batch_size=16, n_epochs=1).learn(64)


def test_gymnasium_makes_and_renders_a_flight(small_scene):
    env = gymnasium.make("radiotwin/Harvest-v0", scene=small_scene.folder, truth="segmented", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(3):
        env.step(env.action_space.sample())
    later = env.render()
    assert first.shape == later.shape and first.shape[2] == 3 and first.dtype == np.uint8
    assert (first != later).any() and (first == later).mean() > 0.8
    assert CentralEnv(env.unwrapped._flights.mission).render() is None
    with pytest.raises(ValueError, match="rgb_array"):
        CentralEnv(env.unwrapped._flights.mission, render_mode="rgb_array")
