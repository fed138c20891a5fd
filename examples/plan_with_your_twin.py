# %% [markdown]
# # Plan with your own twin
# A twin's map is all that a planner needs: a flight is planned in the twin and flown in the truth.

# %%
import numpy as np

import radiotwin as rt
from marl.flights import evaluate
from marl.heuristics import HeuristicPolicy
from marl.mission import Known, make_mission

rt.build_preset("small", "plan/scene")
scene = rt.Scene.load("plan/scene")
truth = rt.segmented_truth(scene)
measurements = rt.fly_survey(scene, truth, flights=2, pattern="random-waypoint", seed=0,
                             noise_db=0.0)
twin = rt.fit_twin(measurements, scene, model="segmented_log_distance", seed=0)

# %% [markdown]
# The mission in the twin, with devices at the positions that the twin estimates, and the same in
# the truth.

# %%
known = Known.of(twin.devices)
in_twin = make_mission(scene, twin.radio_map(scene), known)
in_truth = make_mission(scene, truth, known)
for name in ("greedy", "random"):
    for where, mission in (("twin", in_twin), ("truth", in_truth)):
        rng = np.random.default_rng(0)
        ratio = evaluate(mission, HeuristicPolicy(name, rng), 32, rng).ratio(mission)
        print(f"{name} flights collect {ratio.mean():.0%} of all data in the {where}")

# %% [markdown]
# A learner of your own sees the same mission as a PettingZoo or Gymnasium environment (extra `rl`).

# %%
try:
    from marl.interfaces import HarvestEnv
except ImportError as error:
    print(error)
else:
    env = HarvestEnv(in_twin, [uav.uav for uav in scene.config.uavs])
    observations, _ = env.reset(seed=0)
    collected = 0.0
    while env.agents:
        # The first action that is allowed: to hover, as long as the battery lasts.
        actions = {agent: int(observations[agent]["action_mask"].argmax()) for agent in env.agents}
        observations, rewards, _, _, _ = env.step(actions)
        collected += sum(rewards.values())
    print(f"hovering at the start collects {collected / in_twin.data_units.sum():.0%} in the twin")
