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
from typing_extensions import override

from marl.environment import ACTION_COUNT, Environment, global_state, observe
from marl.flights import fly
from marl.heuristics import HeuristicPolicy, random_actions
from marl.mission import Known, Mission, make_mission
from marl.qmix import Agent, QNetworks, Trainer
from marl.replicas import Replicas
from marl.settings import PRESETS
from marl.training import Replay
from radiotwin import Scene, close_loop, fit_twin, fly_survey, segmented_truth
from radiotwin.links import LinkGeometry, link_geometry
from radiotwin.propagation.laws import channel_named
from radiotwin.scene.presets import preset_boxes
from radiotwin.twin.localize import LocalizeSettings, localize
from studies.runner import Study
from studies.tables import markdown, scene_folder
from tests.undeclared.cases import case

FLIGHTS, BATCH = 150, 32  # side by side; in an update
LIMIT_DB = -115.0  # of detection, of the synthetic levels
MODELS = ("log_distance", "segmented_log_distance", "segmented_nn", "kriging")


def measure_speed(seed: int, settings: dict) -> dict:
    """Measure a `part`; return quantities, each with its unit."""
    scene = Scene.load(scene_folder(settings["scene"]))
    return {"quantities": PARTS[settings["part"]][0](np.random.default_rng(seed), scene, settings)}


def _seconds(repeats: int, function: Callable[..., Any], *arguments: Any,
             clock: Callable[[], float] = time.process_time) -> float:
    """Return the least seconds of some calls, because other work only ever adds time."""
    taken = []
    for _ in range(repeats):
        started = clock()
        function(*arguments)
        taken.append(clock() - started)
    return min(taken)


_wall_s = partial(_seconds, clock=time.perf_counter)


def _mission(scene: Scene) -> Mission:
    return make_mission(scene, segmented_truth(scene), Known.truth(scene))


def _environment(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Step with random actions, observations and state included."""
    mission, slots = _mission(scene), 50
    environment = Environment(mission, FLIGHTS, rng)

    def episode() -> None:
        environment.reset()
        for _ in range(slots):
            observe(mission, environment.frame)
            global_state(mission, environment.frame)
            environment.step(random_actions(mission, environment.frame, rng))

    return {f"{FLIGHTS} flights side by side [slots/s]": FLIGHTS * slots / _seconds(20, episode)}


class SlotBySlot(Agent):
    """The agent, walked slot by slot with encoder and head in the loop, as in PyMARL."""

    @override
    def forward(self, observation: torch.Tensor, last_action: torch.Tensor, sizes: np.ndarray,
                memory: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        one_hot = nn.functional.one_hot(last_action.clamp(min=0), ACTION_COUNT)
        own = torch.eye(self.uavs).expand(len(observation), -1, -1)
        one_hot = (one_hot * (last_action >= 0).unsqueeze(-1)).float()
        inputs = torch.cat([observation, one_hot, own], -1).flatten(0, 1)
        remembered, values = inputs.new_zeros(int(sizes[0]) * self.uavs, self.hidden), []
        for rows in inputs.split((self.uavs * sizes).tolist()):
            encoded = torch.relu(self.encoder(rows))
            remembered = torch.gru_cell(encoded, remembered[:len(rows)],
                                        *self.memory.parameters())
            values.append(self.head(remembered))
        return torch.cat(values).unflatten(0, (-1, self.uavs)), remembered


def _update(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    mission = _mission(scene)
    replay = Replay(BATCH, mission)
    replay.add(fly(Environment(mission, BATCH, rng), HeuristicPolicy("greedy", rng)))
    flights = replay.sample(BATCH, rng)
    ours, other = (QNetworks(PRESETS["paper"], mission, 0) for _ in range(2))
    for agent in (other.agent, other.targets["agent"]):
        agent.__class__ = SlotBySlot
    ours_s, other_s = (_seconds(15, networks.update, flights, mission, 5e-4)
                       for networks in (ours, other))
    return {f"{BATCH} flights, mean length [slots]": float(flights.length.mean()),
            "update [ms]": 1e3 * ours_s, "slot by slot with GRUCell [ms]": 1e3 * other_s,
            "ratio": other_s / ours_s}


def _replicas(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Train three replicas of the preset `paper`: in turn, as threads, as processes."""
    episodes, found = settings["episodes"], {}
    arguments = [(QNetworks, PRESETS["paper"], _mission(scene), 10_000, 0, i) for i in range(3)]
    trainers = [Trainer(*each) for each in arguments]
    for trainer in trainers:
        trainer.train(40)
    for name, workers in (("one after the other", 1), ("three threads", 3)):
        with ThreadPoolExecutor(workers) as pool:
            found[name] = _wall_s(1, lambda pool: list(pool.map(
                Trainer.train, trainers, [episodes] * 3)), pool)
    with closing(Replicas(Trainer, arguments)) as replicas:
        replicas.call("train", 40)
        found["three processes"] = _wall_s(1, replicas.call, "train", episodes)
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

    map_s = _seconds(2, scene.city.line_of_sight, a_m, b_m) / count
    box_s = _seconds(2, exact) / len(few_a_m)
    differ = exact() != scene.city.line_of_sight(few_a_m, few_b_m)
    return {"3D map [million links/s]": 1e-6 / map_s, "exact boxes [million links/s]": 1e-6 / box_s,
            "ratio": box_s / map_s,
            "links whose answers differ [%]": 100 * differ[~scene.city.inside(few_a_m)].mean()}


def _channel_fit(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Fit and predict synthetic links of three devices by every channel model."""
    device_m = np.array([[60.0, 320.0, 1.5], [320.0, 120.0, 1.5], [580.0, 520.0, 1.5]])
    links, many = (LinkGeometry(device_m[device], np.column_stack([
        rng.uniform(0, [600, 800], (len(device), 2)), rng.choice([55.0, 60.0, 65.0], len(device))]),
        rng.uniform(size=len(device)) < 0.4, device)
        for device in (rng.integers(0, 3, settings[key]) for key in ("links", "predicted")))
    # Levels of the paper's law.
    level_db = np.where(links.los, -30 - 25 * links.log_distance, -35 - 30.4 * links.log_distance)
    level_db += np.where(links.los, 2**0.5, 5**0.5) * rng.standard_normal(len(links))
    level_db[level_db < LIMIT_DB] = np.nan
    many.log_distance  # computed once, for all models  # noqa: B018
    found = {}
    for name in MODELS:
        model = channel_named(name)()
        found[f"{name}, fit [s]"] = _wall_s(3, model.fit, links, level_db, LIMIT_DB, 0)
        sample = many.select(slice(0, 20_000)) if name == "kriging" else many
        taken_s = _wall_s(3, model.predict, sample)
        found[f"{name}, prediction [million links/s]"] = 1e-6 * len(sample) / taken_s
    return found


def _localisation(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Locate the unknown devices as usual, and with an exhaustive first scan in steps of 1 m."""
    unknown = np.flatnonzero([device.role == "unknown" for device in scene.config.devices])
    flown = fly_survey(scene, segmented_truth(scene), flights=settings["flights"],
                       pattern="random-waypoint", seed=0)
    device, level_db, limit_db = flown.device_index, flown.level_db, scene.config.gain_limit_db
    anchor = ~np.isin(device, unknown)
    links = link_geometry(scene.device_m, flown.receiver_m, device, scene.city)
    channel = channel_named("segmented_nn")().fit(links.select(anchor), level_db[anchor], limit_db,
                                                  0)
    found: dict[str, float] = {"devices": len(unknown), "links": int((~anchor).sum())}
    exhaustive = LocalizeSettings(scan_step_m=1.0, scan_links=10**10)
    for name, search in (("search", LocalizeSettings()), ("exhaustive 1 m scan", exhaustive)):
        started = time.perf_counter()
        estimates = localize(
            flown.receiver_m[~anchor], device[~anchor], level_db[~anchor], channel,
            devices={int(row): scene.config.devices[row].device for row in unknown},
            bounds=scene.config.extent.bounds, z_m=scene.device_m[unknown, 2], city=scene.city,
            limit_db=limit_db, seed=0, settings=search)
        found[f"{name} [s]"] = time.perf_counter() - started
        away_m = [(each.x_m, each.y_m) for each in estimates] - scene.device_m[unknown, :2]
        found[f"{name}, median error [m]"] = float(np.median(np.hypot(*away_m.T)))
        found[f"{name}, worst error [m]"] = float(np.hypot(*away_m.T).max())
    return found | {"ratio": found["exhaustive 1 m scan [s]"] / found["search [s]"]}


def _close_loop(rng: np.random.Generator, scene: Scene, settings: dict) -> dict[str, float]:
    """Close the loop on a traced case; the reference is one fit of the base that it starts from."""
    hidden = case("nothing", settings["world"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit_s = _seconds(1, partial(fit_twin, model="paths", seed=0), hidden.measurements,
                         hidden.scene)
        loop_s = _seconds(1, close_loop, hidden.measurements, hidden.scene)
    return {"links": len(hidden.measurements.table), "close-loop [CPU s]": loop_s,
            "one fit of the model paths [CPU s]": fit_s, "ratio": loop_s / fit_s}


PARTS: dict[str, tuple[Callable[..., dict[str, float]], dict[str, int]]] = {
    "environment": (_environment, {}), "update": (_update, {}),
    "replicas": (_replicas, {"episodes": 50}),
    "line of sight": (_line_of_sight, {"links": 2_000_000}),
    "channel fit": (_channel_fit, {"links": 10_000, "predicted": 1_000_000}),
    "localisation": (_localisation, {"flights": 5}), "close-loop": (_close_loop, {"world": 0})}
"""Name of a part -> function and sizes."""


def speed_cases(seed: int) -> dict[str, dict]:
    """Return the parts."""
    return {name: {"scene": "rbm", "part": name, **sizes} for name, (_, sizes) in PARTS.items()}


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
