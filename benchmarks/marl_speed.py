"""Speed of the planning part: environment, update, replicas; ratios within this run, CPU seconds, medians.

    python benchmarks/marl_speed.py [--scene scenes/rbm]

The reference for the update is a recurrent agent walked slot by slot with `torch.nn.GRUCell`, encoder and head in the
loop, as PyMARL does it; everything else of the update is the same. Statistical truth, one thread.
"""

import argparse
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import torch
from torch import nn

from marl.environment import ACTION_COUNT, Environment
from marl.features import global_state, observe
from marl.flights import fly
from marl.heuristics import HeuristicPolicy, random_actions
from marl.mission import Known, make_mission
from marl.qmix import QNetworks
from marl.replicas import Replicas
from marl.settings import PRESETS
from marl.threads import keep_memory, limit_threads
from marl.training import Replay, Trainer
from radiotwin.channel.adam import Adam
from radiotwin.scene import Scene
from radiotwin.survey import segmented_truth

FLIGHTS, BATCH = 150, 32


class SlotBySlot(nn.Module):
    """The reference agent."""

    def __init__(self, observation_size: int, uavs: int, hidden: int):
        super().__init__()
        self.uavs, self.hidden = uavs, hidden
        self.encoder = nn.Linear(observation_size + ACTION_COUNT + uavs, hidden)
        self.cell = nn.GRUCell(hidden, hidden)
        self.head = nn.Linear(hidden, ACTION_COUNT)

    def forward(self, observation, last_action, memory=None):
        slots, flights = observation.shape[:2]
        one_hot = nn.functional.one_hot(last_action.clamp(min=0), ACTION_COUNT) * (last_action >= 0).unsqueeze(-1)
        own = torch.eye(self.uavs).expand(slots, flights, -1, -1)
        inputs = torch.cat([observation, one_hot.float(), own], dim=-1).reshape(slots, flights * self.uavs, -1)
        memory, values = inputs.new_zeros(flights * self.uavs, self.hidden), []
        for slot in range(slots):
            memory = self.cell(torch.relu(self.encoder(inputs[slot])), memory)
            values.append(self.head(memory))
        return torch.stack(values).reshape(slots, flights, self.uavs, ACTION_COUNT), memory


def cpu_seconds(function, repeats: int) -> float:
    """Median CPU seconds of a call."""
    function()
    taken = []
    for _ in range(repeats):
        started = time.process_time()
        function()
        taken.append(time.process_time() - started)
    return statistics.median(taken)


def environment_steps(mission) -> float:
    """Slots a second, observations and state included, with random actions."""
    rng = np.random.default_rng(0)
    environment, slots = Environment(mission, FLIGHTS, rng), 50

    def episode():
        environment.reset()
        for _ in range(slots):
            observe(mission, environment.frame)
            global_state(mission, environment.frame)
            environment.step(random_actions(mission, environment.frame, rng))

    return FLIGHTS * slots / cpu_seconds(episode, 20)


def updates(mission) -> tuple[float, float, float]:
    """CPU seconds of an update, the same with the reference agent, and the mean slots of the batch."""
    rng = np.random.default_rng(0)
    replay = Replay(BATCH, mission)
    replay.add(fly(Environment(mission, BATCH, rng), HeuristicPolicy("greedy", rng)))
    flights = replay.sample(BATCH, rng)
    ours = QNetworks(PRESETS["paper"], mission, 0)
    reference = QNetworks(PRESETS["paper"], mission, 0)
    size, uavs, hidden = observe(mission, Environment(mission, 1, rng).reset())[0].shape[-1], mission.uavs, 64
    reference.agent = reference.modules["agent"] = SlotBySlot(size, uavs, hidden)
    reference.targets["agent"] = SlotBySlot(size, uavs, hidden)
    reference.optimiser = Adam(reference.parameters())
    taken = [cpu_seconds(lambda: learner.update(flights, mission, 5e-4), 15) for learner in (ours, reference)]
    return *taken, float(flights.length.mean())


def replicas_wall_s(mission, episodes: int) -> dict[str, float]:
    """Wall seconds for three replicas of the preset `paper` to train: one after the other, as threads, as processes."""
    settings, walls = PRESETS["paper"], {}
    arguments = [(QNetworks, settings, mission, 10_000, 0, number) for number in range(3)]
    trainers = [Trainer(*each) for each in arguments]
    for trainer in trainers:
        trainer.train(40)
    for name, workers in (("one after the other", 1), ("three threads", 3)):
        with ThreadPoolExecutor(workers) as pool:
            started = time.perf_counter()
            list(pool.map(lambda trainer: trainer.train(episodes), trainers))
            walls[name] = time.perf_counter() - started
    with closing(Replicas(arguments)) as replicas:
        replicas.call("train", 40)
        started = time.perf_counter()
        replicas.call("train", episodes)
        walls["three processes"] = time.perf_counter() - started
    return walls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="scenes/rbm")
    arguments = parser.parse_args()
    limit_threads(1)
    keep_memory()
    scene = Scene.load(arguments.scene)
    mission = make_mission(scene, segmented_truth(scene), Known.truth(scene))
    print(f"environment, {FLIGHTS} flights side by side: {environment_steps(mission):,.0f} slots a second")
    ours, reference, slots = updates(mission)
    print(f"update, {BATCH} flights of {slots:.0f} slots: {ours * 1e3:.1f} ms; slot by slot {reference * 1e3:.1f} ms; "
          f"ratio {reference / ours:.2f}")
    episodes = 50
    walls = replicas_wall_s(mission, episodes)
    for name, wall in walls.items():
        print(f"three replicas, {name}: {wall:.2f} s for {episodes} episodes each; "
              f"ratio {walls['one after the other'] / wall:.2f}")
    projected = walls["three processes"] / episodes * 30 * 1000 / 60
    print(f"so 30 rounds of 1,000 episodes of three replicas, preset paper, take {projected:.0f} minutes of training")


if __name__ == "__main__":
    main()
