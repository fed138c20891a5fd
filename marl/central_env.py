"""The mission for one learner that decides for all UAVs, as Gymnasium environments."""

from typing import Any

import numpy as np
from typing_extensions import override

from marl.environment import ACTION_COUNT, Environment, safe_actions
from marl.features import global_state, observation_size, observe, state_size
from marl.mission import NO_OP, Mission

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict, MultiDiscrete
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("marl.central_env needs Gymnasium; install it with "
                      "`pip install 'radiotwin[rl]'`") from error

Seen = dict[str, np.ndarray]


def spaces(mission: Mission) -> tuple[Dict, MultiDiscrete]:
    """Return the spaces of one flight.

    The observation has `state`, and `observation` and `action_mask` of every UAV; the action is
    one for every UAV.
    """
    uavs, size = mission.uavs, observation_size(mission)
    return Dict({"state": Box(-np.inf, np.inf, (state_size(mission),), np.float32),
                 "observation": Box(-np.inf, np.inf, (uavs, size), np.float32),
                 "action_mask": Box(0, 1, (uavs, ACTION_COUNT), np.int8)}), \
        MultiDiscrete([ACTION_COUNT] * uavs)


class CentralVectorEnv(VectorEnv[Seen, np.ndarray, np.ndarray]):
    """E flights side by side; the numbers are those of `marl.environment.Environment`.

    Reward: data units that all UAVs of a flight collected in the slot. A flight terminates with
    all batteries empty; the step after that begins it anew, whatever the action
    (`AutoresetMode.NEXT_STEP`). Actions that are not feasible are replaced (`safe_actions`);
    `infos["replaced"]`, (E, U) bool, says which.

    Args:
        mission: of `make_mission`.
        num_envs: E.
    """

    def __init__(self, mission: Mission, num_envs: int = 1) -> None:
        self.mission, self.num_envs = mission, num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self.single_observation_space, self.single_action_space = spaces(mission)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[Seen, dict[str, Any]]:
        """Take off with all flights; see `gymnasium.vector.VectorEnv`.

        Args:
            seed: of the shadowing of all flights; None goes on with the random numbers of those
                before.
            options: not used.
        """
        if seed is not None or self._np_random is None:
            self._np_random, self._np_random_seed = np.random.default_rng(seed), seed
        self._environment = Environment(self.mission, self.num_envs, self._np_random)
        self._environment.reset()
        self._over = np.zeros(self.num_envs, dtype=bool)
        return self._seen()

    def step(self, actions: np.ndarray,
             ) -> tuple[Seen, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one slot with actions (E, U); see `gymnasium.vector.VectorEnv`."""
        environment, anew = self._environment, self._over
        wanted = np.where(anew[:, None], NO_OP, actions)
        action = safe_actions(wanted, observe(self.mission, environment.frame)[1])
        reward = environment.step(action).sum(axis=1, dtype=float)
        if anew.any():
            environment.reset(anew)
        self._over = environment.done
        seen, infos = self._seen()
        infos["replaced"] = action != wanted
        return seen, reward, self._over.copy(), np.zeros(self.num_envs, dtype=bool), infos

    def _seen(self) -> tuple[Seen, dict[str, Any]]:
        frame = self._environment.frame
        observation, mask = observe(self.mission, frame)
        mask = mask.astype(np.int8)
        return {"state": global_state(self.mission, frame), "observation": observation,
                "action_mask": mask}, {"action_mask": mask.copy()}


class CentralEnv(gymnasium.Env[Seen, np.ndarray]):
    """One flight; as `CentralVectorEnv`, but a flight that is over waits for `reset`.

    Args:
        mission: of `make_mission`.
    """

    metadata = {"render_modes": []}

    def __init__(self, mission: Mission) -> None:
        self._flights = CentralVectorEnv(mission)
        self.observation_space, self.action_space = spaces(mission)  # type: ignore[assignment]

    @override
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None,
              ) -> tuple[Seen, dict[str, Any]]:
        super().reset(seed=seed)
        # The generator that Gymnasium seeds is the one that is drawn from.
        self._flights._np_random = self.np_random
        seen, infos = self._flights.reset()
        return _first(seen), _first(infos)

    @override
    def step(self, action: np.ndarray) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        seen, reward, terminated, _, infos = self._flights.step(np.asarray(action)[None])
        return _first(seen), float(reward[0]), bool(terminated[0]), False, _first(infos)


def _first(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: value[0] for name, value in values.items()}
