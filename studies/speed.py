"""How fast everything is on one core, with references within the same run: `speed`; the tracer has a study."""

import platform
import re
import statistics
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
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
from marl.mission import Known, Mission, make_mission
from marl.replay import Replay
from marl.replicas import Replicas
from marl.settings import PRESETS
from marl.threads import usable_cores
from marl.trainer import Trainer
from radiotwin import Scene, close_loop, fit_twin, fly_survey, segmented_truth
from radiotwin.channel import MODELS, Links, make_links
from radiotwin.channel.adam import Adam
from radiotwin.localize import LocalizeSettings, localize
from radiotwin.scene.presets import preset_boxes
from studies.runner import Study
from studies.tables import markdown, scene_folder

FLIGHTS, BATCH, HIDDEN = 150, 32, 64  # side by side; in an update; width of an agent
LIBRARIES = ("numpy", "numba", "torch", "sionna-rt", "drjit")


def speed_cases(seed: int) -> dict[str, dict]:
    """Return the parts; all but channel fit and close-loop are of `scenes/rbm`."""
    sizes: dict[str, dict[str, Any]] = {
        "environment": {}, "update": {}, "replicas": {"episodes": 50}, "line of sight": {"links": 2_000_000},
        "channel fit": {"links": 10_000, "predicted": 1_000_000}, "localisation": {"flights": 5},
        "close-loop": {"family": "nothing", "world": 0}}
    return {name: {"scene": "rbm", "part": name} | size for name, size in sizes.items()}


def measure_speed(seed: int, settings: dict) -> dict:
    """Measure a part.

    Args:
        seed: of everything random.
        settings: `part`, `scene` and the part's own.

    Returns:
        Quantities, each with its unit; and the machine.
    """
    results = PARTS[settings["part"]](np.random.default_rng(seed), settings)
    return {"quantities": results, "surroundings": _surroundings()}


def _surroundings() -> str:
    memory = ""
    if Path("/proc/meminfo").is_file():
        kib = int(re.findall(r"MemTotal:\s+(\d+)", Path("/proc/meminfo").read_text(encoding="utf-8"))[0])
        memory = f", {kib / 2**20:.0f} GiB"
    return (f"{usable_cores()} cores{memory}, {platform.system()} {platform.release()}, Python "
            f"{platform.python_version()}, {', '.join(f'{name} {version(name)}' for name in LIBRARIES)}")


def _cpu_s(function: Callable[[], Any], repeats: int) -> float:
    """Return the median processor seconds of a call, the first one left out."""
    function()
    taken = []
    for _ in range(repeats):
        started = time.process_time()
        function()
        taken.append(time.process_time() - started)
    return statistics.median(taken)


def _wall_s(function: Callable[[], Any], repeats: int = 1) -> float:
    """Return the least wall seconds of some calls, because other processes only ever add time."""
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        function()
        taken.append(time.perf_counter() - started)
    return min(taken)


def _mission(settings: dict) -> Mission:
    scene = Scene.load(scene_folder(settings["scene"]))
    return make_mission(scene, segmented_truth(scene), Known.truth(scene))


def _environment(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    """Slots a second with random actions, observations and state included."""
    mission = _mission(settings)
    environment, slots = Environment(mission, FLIGHTS, rng), 50

    def episode() -> None:
        environment.reset()
        for _ in range(slots):
            observe(mission, environment.frame)
            global_state(mission, environment.frame)
            environment.step(random_actions(mission, environment.frame, rng))

    return {f"{FLIGHTS} flights side by side [slots/s]": FLIGHTS * slots / _cpu_s(episode, 20)}


class SlotBySlot(nn.Module):
    """The reference agent, walked slot by slot with encoder and head in the loop, as PyMARL does it."""

    def __init__(self, observation_size: int, uavs: int, hidden: int):
        super().__init__()
        self.uavs, self.hidden = uavs, hidden
        self.encoder = nn.Linear(observation_size + ACTION_COUNT + uavs, hidden)
        self.cell = nn.GRUCell(hidden, hidden)
        self.head = nn.Linear(hidden, ACTION_COUNT)

    def forward(self, observation: torch.Tensor, last_action: torch.Tensor,
                memory: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the values (slots, flights, uavs, actions) and the memory at the end."""
        slots, flights = observation.shape[:2]
        one_hot = nn.functional.one_hot(last_action.clamp(min=0), ACTION_COUNT) * (last_action >= 0).unsqueeze(-1)
        own = torch.eye(self.uavs).expand(slots, flights, -1, -1)
        inputs = torch.cat([observation, one_hot.float(), own], dim=-1).reshape(slots, flights * self.uavs, -1)
        memory, values = inputs.new_zeros(flights * self.uavs, self.hidden), []
        for slot in range(slots):
            memory = self.cell(torch.relu(self.encoder(inputs[slot])), memory)
            values.append(self.head(memory))
        return torch.stack(values).reshape(slots, flights, self.uavs, ACTION_COUNT), memory


def _update(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    mission = _mission(settings)
    replay = Replay(BATCH, mission)
    replay.add(fly(Environment(mission, BATCH, rng), HeuristicPolicy("greedy", rng)))
    flights = replay.sample(BATCH, rng)
    ours, reference = (Learner(PRESETS["paper"], mission, 0) for _ in range(2))
    size = observe(mission, Environment(mission, 1, rng).reset())[0].shape[-1]
    reference.agent, reference.target_agent = (SlotBySlot(size, mission.uavs, HIDDEN) for _ in range(2))
    reference.optimiser = Adam(reference.parameters())
    ours_s, reference_s = (_cpu_s(lambda learner=learner: learner.update(flights, mission, 5e-4), 15)
                           for learner in (ours, reference))
    return {f"{BATCH} flights, mean length [slots]": float(flights.length.mean()), "update [ms]": 1e3 * ours_s,
            "slot by slot with GRUCell [ms]": 1e3 * reference_s, "ratio": reference_s / ours_s}


def _replicas(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    """Wall seconds of three replicas of the preset `paper`: in turn, as threads, as processes."""
    mission, preset, episodes, found = _mission(settings), PRESETS["paper"], settings["episodes"], {}
    trainers = [Trainer(preset, mission, 10_000, 0, index) for index in range(3)]
    for trainer in trainers:
        trainer.train(40)
    for name, workers in (("one after the other", 1), ("three threads", 3)):
        with ThreadPoolExecutor(workers) as pool:
            found[name] = _wall_s(lambda pool=pool: list(pool.map(lambda each: each.train(episodes), trainers)))
    with closing(Replicas(3, preset, mission, 10_000, 0)) as replicas:
        replicas.call("train", 40)
        found["three processes"] = _wall_s(lambda: replicas.call("train", episodes))
    ratios = {f"{name}, ratio": found["one after the other"] / taken for name, taken in found.items()}
    return {f"{name}, {episodes} episodes each [s]": taken for name, taken in found.items()} | ratios | {
        "30 rounds of 1,000 episodes [min]": found["three processes"] / episodes * 30 * 1000 / 60}


def _line_of_sight(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    """Queries of the 3D map, and a vectorised slab test against every box, on fewer links."""
    scene, count = Scene.load(scene_folder(settings["scene"])), settings["links"]
    few = slice(0, count // 20)
    xy_m = rng.uniform(0, [600, 800, 600, 800], (count, 4))
    a_m = np.column_stack([xy_m[:, :2], np.full(count, 1.5)])
    b_m = np.column_stack([xy_m[:, 2:], rng.choice([55.0, 60.0, 65.0], count)])
    los = scene.city.line_of_sight(a_m, b_m)
    map_s = _cpu_s(lambda: scene.city.line_of_sight(a_m, b_m), 1) / count
    boxes = preset_boxes("rbm")
    box_s = _cpu_s(lambda: _exact_los(a_m[few], b_m[few], boxes), 1) / len(a_m[few])
    differ = (los[few] != _exact_los(a_m[few], b_m[few], boxes))[~scene.city.inside(a_m[few])].mean()
    return {"3D map [million links/s]": 1e-6 / map_s, "exact boxes [million links/s]": 1e-6 / box_s,
            "ratio": box_s / map_s, "links whose answers differ [%]": 100 * differ}


def _exact_los(a_m: np.ndarray, b_m: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    los = np.ones(len(a_m), dtype=bool)
    direction = b_m - a_m
    for x0, y0, x1, y1, height in boxes:
        near, far = (np.array([x0, y0, 0.0]) - a_m) / direction, (np.array([x1, y1, height]) - a_m) / direction
        enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
        los &= ~((enter < leave) & (leave > 0) & (enter < 1))
    return los


def _channel_fit(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    """Fit and predict synthetic links of three devices by every channel model."""
    device_m = np.array([[60.0, 320.0, 1.5], [320.0, 120.0, 1.5], [580.0, 520.0, 1.5]])

    def draw(count: int) -> Links:
        device = rng.integers(0, len(device_m), count)
        receiver_m = np.column_stack([rng.uniform(0, 600, count), rng.uniform(0, 800, count),
                                      rng.choice([55.0, 60.0, 65.0], count)])
        return Links(device_m[device], receiver_m, rng.uniform(size=count) < 0.4, device)

    links, many, found = draw(settings["links"]), draw(settings["predicted"]), {}
    level_db = _published_db(links, rng, -115.0)
    many.log_distance  # computed once, for all models  # noqa: B018
    for name, kind in MODELS.items():
        fit_s = _wall_s(lambda kind=kind: kind().fit(links, level_db, -115.0, seed=0), 3)
        model = kind().fit(links, level_db, -115.0, seed=0)
        sample = many.select(slice(0, 20_000)) if name == "regression_kriging" else many
        found |= {f"{name}, fit [s]": fit_s, f"{name}, prediction [million links/s]":
                  1e-6 * len(sample) / _wall_s(lambda model=model, sample=sample: model.predict(sample), 3)}
    return found


def _published_db(links: Links, rng: np.random.Generator, limit_db: float) -> np.ndarray:
    """Draw levels from the paper's law, NaN below the limit of detection."""
    mean_db = np.where(links.los, -30 - 25 * links.log_distance, -35 - 30.4 * links.log_distance)
    level_db = mean_db + np.where(links.los, 2**0.5, 5**0.5) * rng.standard_normal(len(links))
    return np.where(level_db < limit_db, np.nan, level_db)


def _localisation(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    """Locate the unknown devices as usual, and with an exhaustive first scan in steps of 1 m."""
    scene, limit_db = Scene.load(scene_folder(settings["scene"])), -120.0
    roles = np.array([device.role for device in scene.config.devices])
    unknown = np.flatnonzero(roles == "unknown")
    flown = fly_survey(scene, segmented_truth(scene), flights=settings["flights"], pattern="random-waypoint", seed=0)
    links = make_links(scene.device_m, flown.receiver_m, flown.device_index, scene.city)
    level_db = _published_db(links, rng, limit_db)
    anchor = roles[links.device] == "anchor"
    channel = MODELS["segmented_nn"]().fit(links.select(anchor), level_db[anchor], limit_db, 0)
    found: dict[str, float] = {"devices": len(unknown), "receiver positions": len(flown.receiver_m) / len(roles)}
    for name, search in (("search", LocalizeSettings()),
                         ("exhaustive 1 m scan", LocalizeSettings(scan_step_m=1.0, scan_links=10**10))):
        estimates: list = []
        found[f"{name} [s]"] = _wall_s(lambda search=search, estimates=estimates: estimates.extend(localize(
            flown.receiver_m, flown.device_index, level_db, channel, devices=unknown,
            bounds=scene.config.extent.bounds, z_m=float(scene.device_m[unknown[0], 2]), city=scene.city,
            limit_db=limit_db, seed=0, settings=search)))
        error_m = np.linalg.norm([(each.x_m, each.y_m) for each in estimates] - scene.device_m[unknown, :2], axis=1)
        found |= {f"{name}, median error [m]": np.median(error_m), f"{name}, worst error [m]": error_m.max()}
    return found | {"ratio": found["exhaustive 1 m scan [s]"] / found["search [s]"]}


def _close_loop(rng: np.random.Generator, settings: dict) -> dict[str, float]:
    """Close the loop on a traced case; the reference is one fit of the base that it starts from."""
    from tests.undeclared.cases import case

    hidden = case(settings["family"], settings["world"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        started = time.process_time()
        fit_twin(hidden.measurements, hidden.scene, model="raytrace", seed=0)
        fit_s = time.process_time() - started
        close_loop(hidden.measurements, hidden.scene)
        loop_s = time.process_time() - started - fit_s
    return {"links": len(hidden.measurements.table), "close-loop [CPU s]": loop_s,
            "one fit of the base raytrace [CPU s]": fit_s, "ratio": loop_s / fit_s}


PARTS = {"environment": _environment, "update": _update, "replicas": _replicas, "line of sight": _line_of_sight,
         "channel fit": _channel_fit, "localisation": _localisation, "close-loop": _close_loop}


def speed_table(rows: pd.DataFrame) -> str:
    """Return all quantities by part."""
    by_part = rows.set_index("name")
    lines = [[name if index == 0 else "", quantity, _short(value)] for name in PARTS if name in by_part.index
             for index, (quantity, value) in enumerate(by_part.loc[name, "quantities"].items())]
    return (f"{'; '.join(sorted(set(rows['surroundings'])))}.\n\nEnvironment, update, line of sight and close-loop are "
            "of processor time; the others are of wall time and suffer from what else runs.\n\n"
            + markdown(["part", "quantity", "value"], lines))


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


STUDIES = {"speed": Study("What takes how long?", measure_speed, speed_cases, speed_table, seeds=1)}
