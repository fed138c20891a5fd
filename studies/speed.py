"""How fast everything is on one core, with references within the same run: `speed`."""

import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import nn

from marl.environment import ACTION_COUNT, Environment
from marl.features import global_state, observe
from marl.flights import HeuristicPolicy, fly
from marl.heuristics import random_actions
from marl.learner import Learner
from marl.mission import Known, make_mission
from marl.replay import Replay
from marl.replicas import Replicas
from marl.settings import PRESETS
from marl.trainer import Trainer
from radiotwin import Scene, close_loop, fit_twin, fly_survey, segmented_truth
from radiotwin.channel import MODELS, Links, make_links
from radiotwin.channel.adam import Adam
from radiotwin.localize import LocalizeSettings, localize
from radiotwin.scene.presets import preset_boxes
from studies.runner import Study
from studies.tables import markdown, scene_folder
from tests.undeclared.cases import case

FLIGHTS, BATCH, HIDDEN = 150, 32, 64  # side by side; in an update; width of an agent
LIMIT_DB = -115.0  # of detection, of the synthetic levels


def speed_cases(seed: int) -> dict[str, dict]:
    """Return the parts."""
    sizes: dict[str, dict] = {
        "environment": {}, "update": {}, "replicas": {"episodes": 50},
        "line of sight": {"links": 2_000_000}, "localisation": {"flights": 5},
        "channel fit": {"links": 10_000, "predicted": 1_000_000}, "close-loop": {"world": 0}}
    return {name: {"scene": "rbm", "part": name} | size for name, size in sizes.items()}


def measure_speed(seed: int, settings: dict) -> dict:
    """Measure a `part`; return quantities, each with its unit."""
    scene = Scene.load(scene_folder(settings["scene"]))
    return {"quantities": PARTS[settings["part"]](np.random.default_rng(seed), scene, settings)}


def _seconds(function: Callable[[], Any], repeats: int, clock: Callable[[], float]) -> float:
    """Return the least seconds of some calls, because other work only ever adds time."""
    taken = []
    for _ in range(repeats):
        started = clock()
        function()
        taken.append(clock() - started)
    return min(taken)


_cpu_s = partial(_seconds, clock=time.process_time)
_wall_s = partial(_seconds, clock=time.perf_counter)


def _environment(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Step with random actions, observations and state included."""
    mission = make_mission(scene, segmented_truth(scene), Known.truth(scene))
    environment, slots = Environment(mission, FLIGHTS, rng), 50

    def episode() -> None:
        environment.reset()
        for _ in range(slots):
            observe(mission, environment.frame)
            global_state(mission, environment.frame)
            environment.step(random_actions(mission, environment.frame, rng))

    return {f"{FLIGHTS} flights side by side [slots/s]": FLIGHTS * slots / _cpu_s(episode, 20)}


class SlotBySlot(nn.Module):
    """The reference agent, walked slot by slot with encoder and head in the loop, as in PyMARL."""

    def __init__(self, observation_size: int, uavs: int) -> None:
        super().__init__()
        self.uavs = uavs
        self.encoder = nn.Linear(observation_size + ACTION_COUNT + uavs, HIDDEN)
        self.cell, self.head = nn.GRUCell(HIDDEN, HIDDEN), nn.Linear(HIDDEN, ACTION_COUNT)

    def forward(self, observation: torch.Tensor, last_action: torch.Tensor,
                memory: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the values (slots, flights, uavs, actions) and the memory at the end."""
        slots, flights = observation.shape[:2]
        one_hot = nn.functional.one_hot(last_action.clamp(min=0), ACTION_COUNT)
        own = torch.eye(self.uavs).expand(slots, flights, -1, -1)
        one_hot = (one_hot * (last_action >= 0).unsqueeze(-1)).float()
        inputs = torch.cat([observation, one_hot, own], -1)
        inputs = inputs.reshape(slots, flights * self.uavs, -1)
        memory, values = inputs.new_zeros(flights * self.uavs, HIDDEN), []
        for slot in range(slots):
            memory = self.cell(torch.relu(self.encoder(inputs[slot])), memory)
            values.append(self.head(memory))
        return torch.stack(values).reshape(slots, flights, self.uavs, ACTION_COUNT), memory


def _update(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    mission = make_mission(scene, segmented_truth(scene), Known.truth(scene))
    replay = Replay(BATCH, mission)
    replay.add(fly(Environment(mission, BATCH, rng), HeuristicPolicy("greedy", rng)))
    flights = replay.sample(BATCH, rng)
    ours, other = (Learner(PRESETS["paper"], mission, 0) for _ in range(2))
    size = observe(mission, Environment(mission, 1, rng).reset())[0].shape[-1]
    other.agent, other.target_agent = (SlotBySlot(size, mission.uavs) for _ in range(2))
    other.optimiser = Adam(other.parameters())
    ours_s, other_s = (_cpu_s(lambda learner=learner: learner.update(flights, mission, 5e-4), 15)
                       for learner in (ours, other))
    return {f"{BATCH} flights, mean length [slots]": float(flights.length.mean()),
            "update [ms]": 1e3 * ours_s, "slot by slot with GRUCell [ms]": 1e3 * other_s,
            "ratio": other_s / ours_s}


def _replicas(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Train three replicas of the preset `paper`: in turn, as threads, as processes."""
    mission = make_mission(scene, segmented_truth(scene), Known.truth(scene))
    preset, episodes, found = PRESETS["paper"], settings["episodes"], {}
    trainers = [Trainer(preset, mission, 10_000, 0, index) for index in range(3)]
    for trainer in trainers:
        trainer.train(40)
    for name, workers in (("one after the other", 1), ("three threads", 3)):
        with ThreadPoolExecutor(workers) as pool:
            found[name] = _wall_s(lambda pool=pool: list(
                pool.map(lambda trainer: trainer.train(episodes), trainers)), 1)
    with closing(Replicas(3, preset, mission, 10_000, 0)) as replicas:
        replicas.call("train", 40)
        found["three processes"] = _wall_s(lambda: replicas.call("train", episodes), 1)
    results = {}
    for name, taken_s in found.items():
        results[f"{name}, {episodes} episodes each [s]"] = taken_s
        results[f"{name}, ratio"] = found["one after the other"] / taken_s
    minutes = found["three processes"] / episodes * 30 * 1000 / 60
    return results | {"30 rounds of 1,000 episodes of three replicas [min]": minutes}


def _line_of_sight(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Query the 3D map, and test every box with slabs, on fewer links."""
    count, boxes = settings["links"], preset_boxes("rbm")
    xy_m = rng.uniform(0, [600, 800, 600, 800], (count, 4))
    a_m = np.column_stack([xy_m[:, :2], np.full(count, 1.5)])
    b_m = np.column_stack([xy_m[:, 2:], rng.choice([55.0, 60.0, 65.0], count)])
    few_a_m, few_b_m = a_m[:count // 20], b_m[:count // 20]

    def exact() -> np.ndarray:
        los, direction = np.ones(len(few_a_m), dtype=bool), few_b_m - few_a_m
        for x0, y0, x1, y1, height in boxes:
            near, far = ((np.array(corner) - few_a_m) / direction for corner in
                         ((x0, y0, 0.0), (x1, y1, height)))
            enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            los &= ~((enter < leave) & (leave > 0) & (enter < 1))
        return los

    map_s = _cpu_s(lambda: scene.city.line_of_sight(a_m, b_m), 2) / count
    box_s = _cpu_s(exact, 2) / len(few_a_m)
    differ = exact() != scene.city.line_of_sight(few_a_m, few_b_m)
    return {"3D map [million links/s]": 1e-6 / map_s, "exact boxes [million links/s]": 1e-6 / box_s,
            "ratio": box_s / map_s,
            "links whose answers differ [%]": 100 * differ[~scene.city.inside(few_a_m)].mean()}


def _published_db(links: Links, rng: np.random.Generator) -> np.ndarray:
    """Draw levels from the paper's law, NaN below the limit of detection."""
    mean_db = np.where(links.los, -30 - 25 * links.log_distance, -35 - 30.4 * links.log_distance)
    level_db = mean_db + np.where(links.los, 2**0.5, 5**0.5) * rng.standard_normal(len(links))
    return np.where(level_db < LIMIT_DB, np.nan, level_db)


def _channel_fit(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Fit and predict synthetic links of three devices by every channel model."""
    device_m = np.array([[60.0, 320.0, 1.5], [320.0, 120.0, 1.5], [580.0, 520.0, 1.5]])
    links, many = (Links(device_m[device], np.column_stack([
        rng.uniform(0, [600, 800], (len(device), 2)), rng.choice([55.0, 60.0, 65.0], len(device))]),
        rng.uniform(size=len(device)) < 0.4, device)
        for device in (rng.integers(0, 3, settings[key]) for key in ("links", "predicted")))
    level_db, found = _published_db(links, rng), {}
    many.log_distance  # computed once, for all models  # noqa: B018
    for name, kind in MODELS.items():
        model = kind()
        found[f"{name}, fit [s]"] = _wall_s(
            lambda model=model: model.fit(links, level_db, LIMIT_DB, seed=0), 3)
        sample = many.select(slice(0, 20_000)) if name == "regression_kriging" else many
        taken_s = _wall_s(lambda model=model, sample=sample: model.predict(sample), 3)
        found[f"{name}, prediction [million links/s]"] = 1e-6 * len(sample) / taken_s
    return found


def _localisation(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Locate the unknown devices as usual, and with an exhaustive first scan in steps of 1 m."""
    unknown = np.flatnonzero([device.role == "unknown" for device in scene.config.devices])
    flown = fly_survey(scene, segmented_truth(scene), flights=settings["flights"],
                       pattern="random-waypoint", seed=0)
    device, level_db, limit_db = flown.device_index, flown.level_db, scene.config.gain_limit_db
    anchor = ~np.isin(device, unknown)
    links = make_links(scene.device_m, flown.receiver_m, device, scene.city)
    channel = MODELS["segmented_nn"]().fit(links.select(anchor), level_db[anchor], limit_db, 0)
    found: dict[str, float] = {"devices": len(unknown), "links": int((~anchor).sum())}
    exhaustive = LocalizeSettings(scan_step_m=1.0, scan_links=10**10)
    for name, search in (("search", LocalizeSettings()), ("exhaustive 1 m scan", exhaustive)):
        started = time.perf_counter()
        estimates = localize(
            flown.receiver_m[~anchor], device[~anchor], level_db[~anchor], channel, devices=unknown,
            bounds=scene.config.extent.bounds, z_m=scene.device_m[unknown, 2], city=scene.city,
            limit_db=limit_db, seed=0, settings=search)
        found[f"{name} [s]"] = time.perf_counter() - started
        away_m = [(each.x_m, each.y_m) for each in estimates] - scene.device_m[unknown, :2]
        found[f"{name}, median error [m]"] = np.median(np.hypot(*away_m.T))
        found[f"{name}, worst error [m]"] = np.hypot(*away_m.T).max()
    return found | {"ratio": found["exhaustive 1 m scan [s]"] / found["search [s]"]}


def _close_loop(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Close the loop on a traced case; the reference is one fit of the base that it starts from."""
    hidden = case("nothing", settings["world"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        started = time.process_time()
        fit_twin(hidden.measurements, hidden.scene, model="raytrace", seed=0)
        fit_s = time.process_time() - started
        close_loop(hidden.measurements, hidden.scene)
        loop_s = time.process_time() - started - fit_s
    return {"links": len(hidden.measurements.table), "close-loop [CPU s]": loop_s,
            "one fit of the base raytrace [CPU s]": fit_s, "ratio": loop_s / fit_s}


PARTS = {"environment": _environment, "update": _update, "replicas": _replicas,
         "line of sight": _line_of_sight, "channel fit": _channel_fit,
         "localisation": _localisation, "close-loop": _close_loop}


def speed_table(rows: pd.DataFrame) -> str:
    """Return all quantities by part."""
    by_part = rows.set_index("name")["quantities"]
    lines = [[name if index == 0 else "", quantity,
              f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"]
             for name in PARTS if name in by_part.index
             for index, (quantity, value) in enumerate(by_part[name].items())]
    return ("Environment, update, line of sight and close-loop are of processor time; the others "
            "are of wall time and suffer from what else runs.\n\n"
            + markdown(["part", "quantity", "value"], lines))


STUDIES = {"speed": Study("What takes how long?", measure_speed, speed_cases, speed_table, seeds=1)}
