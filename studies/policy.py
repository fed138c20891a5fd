"""Train the policy that `--algorithm policy` flies, and judge it in worlds that it has never seen.

    python -m studies.policy train marl/policy.safetensors
    python -m studies.policy judge docs/results/policy.json

It is trained in 300 generated cities with their 15 devices, each drawn again a few times. It is
judged on other generated missions, those of `studies.heuristic`, and on the published cities.

The weights in the package are those of the first command: 704 plans, 3,000 updates, 160 CPU
seconds. Another processor may round otherwise; weights that differ must be judged again.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from marl.environment import Environment, ManyWorlds
from marl.flights import Policy
from marl.heuristics import HeuristicPolicy
from marl.mission import HOVER, Known, Mission, make_mission
from marl.planner import PlanPolicy, plan
from marl.policy import WEIGHTS, EntityPolicy, demonstrations, imitate, read_network
from radiotwin.io.files import atomic_path
from radiotwin.maps.survey import read_truth
from radiotwin.runtime.console import progress
from radiotwin.scene import Scene
from radiotwin.scene.folder import published_scene
from studies.generated import generated_mission, redrawn
from studies.heuristic import drawn_mission, share

CITIES, FIRST_CITY, DEVICES = 300, 100_000, 15
ROUNDS, WORLDS, TRIES, UPDATES = 11, 64, 5000, 3000
JUDGED, FIRST_JUDGED = 24, 500


def train(path: Path) -> None:
    """Train a network, and write its weights."""
    rng = np.random.default_rng(0)
    with progress("cities", total=CITIES, lines=True) as advance:
        cities = []
        for number in range(CITIES):
            cities.append(generated_mission(FIRST_CITY + number, devices=DEVICES))
            advance(1)
    parts = []
    with progress("plans", total=ROUNDS * WORLDS, lines=True) as advance:
        for _ in range(ROUNDS):
            missions = [redrawn(cities[rng.integers(CITIES)], rng) for _ in range(WORLDS)]
            parts.append(demonstrations(missions, TRIES, rng))
            advance(WORLDS)
    with progress("imitating", total=UPDATES, lines=True) as advance:
        network = imitate([torch.cat(each) for each in zip(*parts)], UPDATES, 0,
                          on_progress=advance)
    with atomic_path(path) as temporary:
        save_file(network.state_dict(), temporary)


def judge(path: Path) -> None:
    """Write shares of the policy, the planner, the heuristic and greedy, and times."""
    missions = {f"generated {seed}": drawn_mission(seed)
                for seed in range(FIRST_JUDGED, FIRST_JUDGED + JUDGED)}
    for name in ("rbm", "rdm"):
        scene = Scene.load(published_scene(name))
        for truth in ("traced", "segmented"):
            missions[f"{name} {truth}"] = make_mission(scene, read_truth(scene, truth),
                                                       Known.truth(scene))
    rows: list[dict[str, Any]] = []
    for name, mission in missions.items():
        network = read_network(WEIGHTS)
        policies: dict[str, Policy] = {
            **{each: HeuristicPolicy(each, np.random.default_rng(0))
               for each in ("greedy", "heuristic")},
            "policy": EntityPolicy(network, mission)}
        decision_ms = {each: _decision_ms(policy, mission) for each, policy in policies.items()}
        began = time.process_time()
        policies["planner"] = PlanPolicy(plan(mission, 20_000, 0).actions)
        rows.append({"world": name, "uavs": mission.uavs, "devices": mission.devices,
                     "decision_ms": decision_ms, "plan_s": time.process_time() - began,
                     **{each: share(policy, mission) for each, policy in policies.items()}})
    path.write_text(json.dumps({"command": "python -m studies.policy judge", "rows": rows,
                                "slots_a_second": _slots_a_second()}, indent=1) + "\n")
    greedy = np.array([row["greedy"] for row in rows[:JUDGED]])
    for each in ("greedy", "heuristic", "policy", "planner"):
        shares = np.array([row[each] for row in rows[:JUDGED]])
        print(f"{each}: {shares.mean():.3f}, {(shares / greedy).mean():.3f} x greedy")
    for row in rows[JUDGED:]:
        print(row)
    print({each: float(np.median([row["decision_ms"][each] for row in rows]))
           for each in rows[0]["decision_ms"]}, np.median([row["plan_s"] for row in rows]))


def _decision_ms(policy: Policy, mission: Mission) -> float:
    """Return the CPU time of deciding for all UAVs in a slot."""
    frame = Environment(mission, 1, np.random.default_rng(0)).reset()
    policy.start(mission, 1)
    policy.act(frame)
    began = time.process_time()
    for _ in range(50):
        policy.act(frame)
    return 1000 * (time.process_time() - began) / 50


def _slots_a_second() -> float:
    """Return how many slots `ManyWorlds` flies in a second of one core, all UAVs hovering."""
    rng = np.random.default_rng(0)
    city = generated_mission(FIRST_CITY, devices=DEVICES)
    worlds = ManyWorlds([redrawn(city, rng) for _ in range(WORLDS)], 5, rng)
    action = np.full(worlds.battery.shape, HOVER)
    worlds.step(action)
    began, slots = time.process_time(), 60
    for _ in range(slots):
        worlds.step(action)
    return slots * WORLDS / (time.process_time() - began)


if __name__ == "__main__":
    torch.set_num_threads(1)
    {"train": train, "judge": judge}[sys.argv[1]](Path(sys.argv[2]))
