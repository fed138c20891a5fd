"""The mission as a PettingZoo `ParallelEnv`: an agent for each UAV."""

from typing import Any

import numpy as np
from typing_extensions import override

from marl.environment import ACTION_COUNT, Environment, safe_actions
from marl.features import global_state, observation_size, observe, state_size
from marl.mission import NO_OP, Mission

try:
    from gymnasium.spaces import Box, Dict, Discrete
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError("marl.parallel_env needs PettingZoo; install it with "
                      "`pip install 'radiotwin[rl]'`") from error

Observation = dict[str, np.ndarray]


class HarvestEnv(ParallelEnv[str, Observation, int]):
    """One flight of all UAVs; the numbers are those of `marl.environment.Environment`.

    Observation: `observation`, float32 as in `marl.features.observe`, and `action_mask`, (6,) int8,
    which is also in `infos`. Actions: hover, north, west, south, east, no-op; one that is not
    feasible is replaced (`safe_actions`), and `infos[agent]["replaced"]` says so. Reward: data
    units that the UAV itself collected in the slot; the sum over UAVs is the team's reward. A UAV
    terminates with an empty battery, which is at its terminal.

    Args:
        mission: of `make_mission`.
        names: of the agents, one for each UAV [uav0, uav1, …].
    """

    metadata = {"name": "radiotwin_harvest_v0", "render_modes": []}

    def __init__(self, mission: Mission, names: list[str] | None = None) -> None:
        self.mission = mission
        self.possible_agents = list(names or [f"uav{u}" for u in range(mission.uavs)])
        if len(set(self.possible_agents)) != mission.uavs:
            raise ValueError(f"names = {names}: {mission.uavs} different names are needed, one for "
                             "each UAV")
        self.agents: list[str] = []
        space = Dict({
            "observation": Box(-np.inf, np.inf, (observation_size(mission),), np.float32),
            "action_mask": Box(0, 1, (ACTION_COUNT,), np.int8)})
        self.observation_spaces = {agent: Dict(space.spaces) for agent in self.possible_agents}
        self.action_spaces = {agent: Discrete(ACTION_COUNT) for agent in self.possible_agents}
        self.state_space = Box(-np.inf, np.inf, (state_size(mission),), np.float32)
        self._rng: np.random.Generator | None = None

    @override
    def observation_space(self, agent: str) -> Dict:
        return self.observation_spaces[agent]

    @override
    def action_space(self, agent: str) -> Discrete:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None,
              ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Take off; see `pettingzoo.ParallelEnv`.

        Args:
            seed: of the shadowing; None goes on with the random numbers of the flights before.
            options: not used.
        """
        if seed is not None or self._rng is None:
            self._rng = np.random.default_rng(seed)
        self._environment = Environment(self.mission, 1, self._rng)
        self._environment.reset()
        self.agents = self.possible_agents[:]
        return self._seen(self.agents, replaced=np.zeros(self.mission.uavs, dtype=bool))

    def step(self, actions: dict[str, int]) -> tuple[
            dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool],
            dict[str, dict[str, Any]]]:
        """Fly one slot; see `pettingzoo.ParallelEnv`.

        Args:
            actions: one for each agent that still flies.
        """
        flying = self.agents
        wanted = np.array([[actions[agent] if agent in flying else NO_OP
                            for agent in self.possible_agents]])
        action = safe_actions(wanted, observe(self.mission, self._environment.frame)[1])
        collected = self._environment.step(action)[0]
        landed = self._environment.frame.battery[0] == 0
        number = {agent: u for u, agent in enumerate(self.possible_agents)}
        rewards = {agent: float(collected[number[agent]]) for agent in flying}
        terminations = {agent: bool(landed[number[agent]]) for agent in flying}
        self.agents = [agent for agent in flying if not terminations[agent]]
        observations, infos = self._seen(flying, replaced=(action != wanted)[0])
        return observations, rewards, terminations, dict.fromkeys(flying, False), infos

    def state(self) -> np.ndarray:
        """Return the (state_size,) float32 state for a mixer."""
        return global_state(self.mission, self._environment.frame)[0]

    def _seen(self, agents: list[str], replaced: np.ndarray,
              ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        observation, mask = observe(self.mission, self._environment.frame)
        observations, infos = {}, {}
        for u, agent in enumerate(self.possible_agents):
            if agent in agents:
                observations[agent] = {"observation": observation[0, u],
                                       "action_mask": mask[0, u].astype(np.int8)}
                infos[agent] = {"action_mask": mask[0, u].astype(np.int8),
                                "replaced": bool(replaced[u])}
        return observations, infos
