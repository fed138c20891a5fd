"""Adapters of the environment for PettingZoo and Gymnasium.

`HarvestEnv` has an agent for each UAV; in `CentralEnv` and `CentralVectorEnv` one agent controls
all UAVs.
"""

from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import override

from marl.environment import (
    ACTION_COUNT,
    Environment,
    Frame,
    global_state,
    observation_size,
    observe,
    safe_actions,
    state_size,
)
from marl.figures import FlightPicture
from marl.mission import NO_OP, Known, Mission, make_mission
from radiotwin.maps.survey import read_truth
from radiotwin.scene import Scene

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError("marl.interfaces needs Gymnasium and PettingZoo; install them with "
                      "`pip install 'radiotwin[rl]'`") from error

Arrays = dict[str, np.ndarray]


class HarvestEnv(ParallelEnv[str, Arrays, int]):
    """PettingZoo environment of one flight, with `marl.environment.Environment` inside.

    Observation: `observation`, float32 as in `marl.environment.observe`, and `action_mask`, (6,)
    int8. Actions: hover, north, west, south, east, no-op; an infeasible action is replaced
    (`safe_actions`), and `infos[agent]["replaced"]` is true. Reward: data units that the UAV
    collected in the slot; the sum over UAVs is the team's reward. A UAV terminates with an empty
    battery, which is at its terminal.

    Args:
        mission: mission made by `make_mission`.
        names: names of the agents, one for each UAV [uav0, uav1, …].
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
              ) -> tuple[dict[str, Arrays], dict[str, dict[str, Any]]]:
        """Start a flight; see `pettingzoo.ParallelEnv`.

        Without a seed the random generator continues; options are not used.
        """
        if seed is not None or self._rng is None:
            self._rng = np.random.default_rng(seed)
        self._environment = Environment(self.mission, 1, self._rng)
        self._environment.reset()
        self.agents = self.possible_agents[:]
        return self._observations_and_infos(
            self.agents, replaced=np.zeros(self.mission.uavs, dtype=bool))

    def step(self, actions: dict[str, int]) -> tuple[
            dict[str, Arrays], dict[str, float], dict[str, bool], dict[str, bool],
            dict[str, dict[str, Any]]]:
        """Fly one slot with an action for each flying agent; see `pettingzoo.ParallelEnv`."""
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
        observations, infos = self._observations_and_infos(flying, replaced=(action != wanted)[0])
        return observations, rewards, terminations, dict.fromkeys(flying, False), infos

    def state(self) -> np.ndarray:
        """Return the global state (state_size,) float32, see `marl.environment.global_state`."""
        return global_state(self.mission, self._environment.frame)[0]

    def _observations_and_infos(self, agents: list[str], replaced: np.ndarray,
                                ) -> tuple[dict[str, Arrays], dict[str, dict[str, Any]]]:
        """Return observations and infos of agents; `replaced` (U,) marks infeasible actions."""
        observation, mask = observe(self.mission, self._environment.frame)
        observations, infos = {}, {}
        for u, agent in enumerate(self.possible_agents):
            if agent in agents:
                observations[agent] = {"observation": observation[0, u],
                                       "action_mask": mask[0, u].astype(np.int8)}
                infos[agent] = {"replaced": bool(replaced[u])}
        return observations, infos


def spaces(mission: Mission) -> tuple[Dict, MultiDiscrete]:
    """Return the observation and action spaces of one flight under central control.

    An observation has `state`, and `observation` and `action_mask` of every UAV; an action has an
    entry for every UAV.
    """
    uavs, size = mission.uavs, observation_size(mission)
    return Dict({"state": Box(-np.inf, np.inf, (state_size(mission),), np.float32),
                 "observation": Box(-np.inf, np.inf, (uavs, size), np.float32),
                 "action_mask": Box(0, 1, (uavs, ACTION_COUNT), np.int8)}), \
        MultiDiscrete([ACTION_COUNT] * uavs)


class CentralVectorEnv(VectorEnv[Arrays, np.ndarray, np.ndarray]):
    """Gymnasium vector environment of E parallel flights under central control.

    Reward: data units that all UAVs of a flight collected in the slot. A flight terminates when all
    batteries are empty; the next step restarts it, whatever the action
    (`AutoresetMode.NEXT_STEP`). Infeasible actions are replaced (`safe_actions`) and marked in
    `infos["replaced"]`, (E, U) bool.

    Args:
        mission: mission made by `make_mission`.
        num_envs: number of flights E.
    """

    def __init__(self, mission: Mission, num_envs: int = 1) -> None:
        self.mission, self.num_envs = mission, num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self.single_observation_space, self.single_action_space = spaces(mission)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[Arrays, dict[str, Any]]:
        """Start all flights; see `gymnasium.vector.VectorEnv`.

        Without a seed the random generator continues; options are not used.
        """
        if seed is not None or self._np_random is None:
            self._np_random, self._np_random_seed = np.random.default_rng(seed), seed
        self._environment = Environment(self.mission, self.num_envs, self._np_random)
        self._environment.reset()
        self._finished = np.zeros(self.num_envs, dtype=bool)
        return self._observations_and_infos()

    def step(self, actions: np.ndarray,
             ) -> tuple[Arrays, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one slot with actions (E, U), infeasible ones replaced; see Gymnasium."""
        environment, restarts = self._environment, self._finished
        wanted = np.where(restarts[:, None], NO_OP, actions)
        action = safe_actions(wanted, observe(self.mission, environment.frame)[1])
        reward = environment.step(action).sum(axis=1, dtype=float)
        if restarts.any():
            environment.reset(restarts)
        self._finished = environment.done
        seen, infos = self._observations_and_infos()
        infos["replaced"] = action != wanted
        return seen, reward, self._finished.copy(), np.zeros(self.num_envs, dtype=bool), infos

    @property
    def frame(self) -> Frame:
        """Present state of all flights."""
        return self._environment.frame

    def _observations_and_infos(self) -> tuple[Arrays, dict[str, Any]]:
        """Return observations and infos of all flights."""
        frame = self.frame
        observation, mask = observe(self.mission, frame)
        mask = mask.astype(np.int8)
        return {"state": global_state(self.mission, frame), "observation": observation,
                "action_mask": mask}, {"action_mask": mask.copy()}


class CentralEnv(gymnasium.Env[Arrays, np.ndarray]):
    """Gymnasium environment of one flight under central control, without automatic reset.

    Args:
        mission: mission made by `make_mission`.
        scene: scene of the mission, for `render`.
        render_mode: `rgb_array`, or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(self, mission: Mission, scene: Scene | None = None,
                 render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array") or (render_mode and scene is None):
            raise ValueError(f"render_mode = {render_mode}: None is allowed, and with a scene "
                             "rgb_array")
        self.render_mode, self._scene = render_mode, scene
        self._picture: FlightPicture | None = None
        self._cells: list[np.ndarray] = []  # cells (U, 2) in the slots so far
        self._flights = CentralVectorEnv(mission)
        self.observation_space, self.action_space = spaces(mission)  # type: ignore[assignment]

    @override
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[Arrays, dict[str, Any]]:
        super().reset(seed=seed)
        # Use the generator that Gymnasium has seeded.
        self._flights._np_random = self.np_random
        seen, infos = self._flights.reset()
        self._cells = [self._flights.frame.cell[0].astype(int)]
        return _first(seen), _first(infos)

    @override
    def step(self, action: np.ndarray) -> tuple[Arrays, float, bool, bool, dict[str, Any]]:
        seen, reward, terminated, _, infos = self._flights.step(np.asarray(action)[None])
        self._cells.append(self._flights.frame.cell[0].astype(int))
        return _first(seen), float(reward[0]), bool(terminated[0]), False, _first(infos)

    @override
    def render(self) -> np.ndarray | None:  # type: ignore[override]
        if self.render_mode is None or self._scene is None:
            return None
        if self._picture is None:
            self._picture = FlightPicture(self._scene, self._flights.mission)
        frame = self._flights.frame
        return self._picture.image(np.array(self._cells), frame.assigned[0], frame.data_units[0])

    def action_masks(self) -> np.ndarray:
        """Return the mask (U * 6,) of feasible actions, for SB3-contrib's `MaskablePPO`."""
        return observe(self._flights.mission, self._flights.frame)[1][0].ravel()


def _first(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the values of the first flight."""
    return {name: value[0] for name, value in values.items()}


def central_env(scene: Path | str, truth: str = "traced", assignment: str = "matching",
                render_mode: str | None = None) -> CentralEnv:
    """Make a `CentralEnv`; the entry point of `gymnasium.make("radiotwin/Harvest-v0", scene=…)`.

    Args:
        scene: scene folder.
        truth: map to fly in, `traced` or `segmented`; all device positions are known.
        assignment: see `make_mission`.
        render_mode: see `CentralEnv`.
    """
    loaded = Scene.load(scene)
    mission = make_mission(loaded, read_truth(loaded, truth), Known.truth(loaded), assignment)
    return CentralEnv(mission, loaded, render_mode)


gymnasium.register("radiotwin/Harvest-v0", entry_point="marl.interfaces:central_env")
