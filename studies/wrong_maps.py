"""Accuracy of predictions and radii over wrong 3D maps: `maps`.

The twins are given maps with errors of cities (`studies.wrong_cities`) whose truth is Sionna RT's,
over the true city, deeper and with more rays than the package traces by default.
"""

import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from shapely import distance, points, union_all

from marl.figures import COLOURS
from radiotwin import Measurements, Scene, SolverSettings, Twin, fit_twin
from radiotwin.inference.gaussian import mean_if_detected
from radiotwin.io.files import atomic_path, scratch_folder
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.runtime.pieces import keep_pieces
from radiotwin.trace import trace_gains
from studies import tables
from studies.runner import Study
from studies.tables import markdown, number
from studies.wrong_cities import SIDE_M, Building, city_scene, true_city, wrong_map

CITIES = range(5)
CLEAR_M = {"anchor": 6.0, "unknown": 1.0}  # from walls; no surveyor has an anchor in a house
STEP_M = 6.0  # of the flight
SIMPLE = ("paths", "segmented_nn", "kriging")
COMBINED = "path_kriging"
CLASSES = ("all", "LoS", "NLoS")
SDS = 1.645  # about the mean, that hold 90 % of a normal distribution
CACHE = Path("runs/maps")  # keeps the truths, each of which takes minutes
LINES: dict[str, dict[str, Any]] = {
    "exact": {}, "walls-1m": {"wall_m": 1.0}, "walls-2m": {"wall_m": 2.0},
    "frame-3m": {"frame_m": 3.0}, "heights-3m": {"height_m": 3.0},
    "walls-heights": {"wall_m": 1.5, "height_m": 3.0}, "missing": {"missing": 4},
    "metal": {"metal": True}}
TITLES = {"exact": "exact", "walls-1m": "walls off by 1 m", "walls-2m": "walls off by 2 m",
          "frame-3m": "frame shifted by 3 m", "heights-3m": "heights off by 3 m",
          "walls-heights": "walls by 1.5 m and heights by 3 m", "missing": "4 buildings missing",
          "metal": "metal for concrete"}


@dataclass(frozen=True, eq=False)
class World:
    """What is true of a city and a seed.

    Attributes:
        roles: of k devices.
        device_m: (k, 3).
        flight_m: (f, 3) positions that were measured at.
        held_m: (h, 3) positions that are predicted.
        gain_db: (k, f + h) without noise; NaN below sensitivity.
        los: (k, f + h) in the true city.
    """

    roles: list[str]
    device_m: np.ndarray
    flight_m: np.ndarray
    held_m: np.ndarray
    gain_db: np.ndarray
    los: np.ndarray

    @property
    def names(self) -> list[str]:
        """Names of the devices."""
        return [f"d{index}" for index in range(len(self.roles))]

    def measurements(self, noise_db: float, limit_db: float, rng: np.random.Generator
                     ) -> Measurements:
        """Return the flight's levels, with noise."""
        count = len(self.flight_m)
        clean_db = self.gain_db[:, :count]
        level_db = clean_db + rng.normal(0, noise_db, clean_db.shape)
        level_db[level_db < limit_db] = np.nan
        links = pd.DataFrame({
            "time_s": np.repeat(np.arange(count), len(self.roles)), "flight": "f0",
            "receiver": "uav0", "device": np.tile(self.names, count),
            "gain_db": level_db.T.ravel()})
        position_m = np.repeat(self.flight_m, len(self.roles), axis=0)
        links[[f"receiver_{axis}_m" for axis in "xyz"]] = position_m
        known = np.array(self.roles) == "anchor"
        devices = pd.DataFrame({"device": self.names, "role": self.roles})
        devices[["x_m", "y_m", "z_m"]] = self.device_m
        devices.loc[~known, ["x_m", "y_m"]] = np.nan
        return Measurements(links, devices)


def true_world(seed: int, settings: dict) -> World:
    """Draw devices and receivers, and trace them over the true city, or read what was traced."""
    rng = np.random.default_rng([23, 4, settings["city"], seed])
    buildings = true_city(settings["city"])
    roles = ["anchor"] * settings["anchors"] + ["unknown"] * settings["unknown"]
    device_m = draw_devices(buildings, roles, rng)
    height_m = rng.uniform(50, 60)
    flight_m = np.column_stack([random_waypoints(settings["flown"], rng),
                                np.full(settings["flown"], height_m)])
    held_m = np.column_stack([rng.uniform(0, SIDE_M, (settings["held_out"], 2)),
                              np.full(settings["held_out"], height_m)])
    points_m = np.vstack([flight_m, held_m])
    with city_scene(buildings, settings) as scene:
        los = np.stack([scene.city.line_of_sight(one_m[None], points_m) for one_m in device_m])
        gain_db = _traced(scene, device_m, points_m, seed, settings)
        gain_db[~np.isfinite(gain_db) | (gain_db < scene.config.gain_limit_db)] = np.nan
    return World(roles, device_m, flight_m, held_m, gain_db, los)


def _traced(scene: Scene, device_m: np.ndarray, points_m: np.ndarray, seed: int, settings: dict
            ) -> np.ndarray:
    """Return gains (k, n) of a world, which all lines of mismatch share."""
    solver = SolverSettings(max_depth=settings["depth"], samples_per_src=settings["samples"],
                            batch_receivers=settings["batch"], seed=1000 + seed)
    decided_by = json.dumps([scene.content_hash(), solver.attributes()])
    path = CACHE / f"city{settings['city']}-seed{seed}.npz"
    if path.is_file():
        with np.load(path) as kept:
            if str(kept["decided_by"]) == decided_by \
                    and np.array_equal(kept["device_m"], device_m) \
                    and np.array_equal(kept["points_m"], points_m):
                return kept["gain_db"]
    with keep_pieces(CACHE / "pieces"):  # a killed trace goes on
        gain_db = trace_gains(scene, device_m, points_m, solver)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, gain_db=gain_db, device_m=device_m, points_m=points_m,
                 decided_by=decided_by)
    return gain_db


def draw_devices(buildings: list[Building], roles: list[str], rng: np.random.Generator
                 ) -> np.ndarray:
    """Draw positions (k, 3) outdoors, 1 to 3 m above the ground [m]."""
    built, found = union_all([each.outline for each in buildings]), []
    for role in roles:
        at_m = rng.uniform(10, SIDE_M - 10, 2)
        while distance(built, points(at_m)) < CLEAR_M[role]:
            at_m = rng.uniform(10, SIDE_M - 10, 2)
        found.append([*at_m, rng.uniform(1, 3)])
    return np.array(found)


def random_waypoints(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return positions (n, 2) every `STEP_M` on the way from one random point to another [m]."""
    corners_m, length_m = [rng.uniform(0, SIDE_M, 2)], [0.0]
    while length_m[-1] < count * STEP_M:
        corners_m.append(rng.uniform(0, SIDE_M, 2))
        length_m.append(length_m[-1] + float(np.linalg.norm(corners_m[-1] - corners_m[-2])))
    at_m = np.arange(count) * STEP_M
    return np.column_stack([np.interp(at_m, length_m, axis) for axis in np.transpose(corners_m)])


def maps_cases(seed: int) -> dict[str, dict]:
    """Return all lines of mismatch of a city, and then of the next."""
    return {f"city{city}-{line}": {
        "city": city, "wrong": wrong, "anchors": 3, "unknown": 8, "flown": 250, "held_out": 300,
        "noise_db": 1.0, "frequency_hz": 2.4e9, "depth": 5, "samples": 200_000, "batch": 50}
        for city in CITIES for line, wrong in LINES.items()}


def judge_map(seed: int, settings: dict) -> dict:
    """Fit twins to one flight over a map with errors, and compare them with the truth.

    Returns:
        For each model its errors at held-out receivers, its devices, warnings, and seconds; the
        map's error as found; numbers of links.
    """
    world = true_world(seed, settings)
    rng = np.random.default_rng([23, 5, settings["city"], seed])
    buildings = anchors_outdoors(world, settings, rng)
    held = np.isfinite(world.gain_db[:, len(world.flight_m):])
    los = world.los[:, len(world.flight_m):]
    row: dict[str, Any] = {"buildings": len(buildings), "links": {
        "LoS": int((held & los).sum()), "NLoS": int((held & ~los).sum()),
        "not detected": int((~held).sum())}}
    with city_scene(buildings, settings) as scene, scratch_folder() as parts, keep_pieces(parts):
        measured = world.measurements(settings["noise_db"], scene.config.gain_limit_db,
                                      np.random.default_rng([23, 6, settings["city"], seed]))
        twins = {}
        for model in (*SIMPLE, COMBINED):  # the last takes the positions of the first
            started = time.process_time()
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                twins[model] = fit_twin(measured, scene, model=model, seed=seed)
            row[model] = {"fit_s": time.process_time() - started,
                          "warnings": sorted({str(each.message) for each in caught}),
                          "devices": _located(twins[model], world)}
        everywhere = np.all([np.isfinite(twin.device_m).all(axis=1) for twin in twins.values()],
                            axis=0)
        for model, twin in twins.items():
            started = time.process_time()
            row[model] |= _errors(twin, scene, world, everywhere)
            row[model]["predict_s"] = time.process_time() - started
    channel = twins[COMBINED].channel
    assert isinstance(channel, PathKriging)
    row["map_error"] = channel.map_error.state()
    return row


def anchors_outdoors(world: World, settings: dict, rng: np.random.Generator) -> list[Building]:
    """Draw a wrong map without an anchor inside a building, which a user would have noticed."""
    anchors = points(world.device_m[np.array(world.roles) == "anchor", :2])
    while True:
        found = wrong_map(true_city(settings["city"]), settings["wrong"], rng)
        if (distance(union_all([each.outline for each in found]), anchors) > 0).all():
            return found


def _located(twin: Twin, world: World) -> dict[str, list]:
    """Return errors and radii [m] of the unknown devices."""
    unknown = [index for index, role in enumerate(world.roles) if role == "unknown"]
    error_m = np.linalg.norm(twin.device_m[unknown, :2] - world.device_m[unknown, :2], axis=1)
    found = [twin.devices[index] for index in unknown]
    return {"error_m": error_m.tolist(), "radius_m": [each.credible_radius_m for each in found],
            "located": [each.located for each in found]}


def _errors(twin: Twin, scene: Scene, world: World, devices: np.ndarray) -> dict[str, Any]:
    """Return RMSE, bias, coverage of 90 % intervals and median standard deviation.

    Each is of a class of links at held-out receivers: all, with and without line of sight, and
    those of anchors.

    Args:
        twin: to be judged.
        scene: its map.
        world: the truth.
        devices: (k,) bool that are judged: those that every twin has a position of.
    """
    device, receiver = np.nonzero(
        np.isfinite(world.gain_db[:, len(world.flight_m):]) & devices[:, None])
    true_db = world.gain_db[:, len(world.flight_m):][device, receiver]
    los = world.los[:, len(world.flight_m):][device, receiver]
    found = twin.predict(twin.links(world.held_m[receiver], device, scene))
    error_db = mean_if_detected(found.mean_db, found.sd_db, scene.config.gain_limit_db) - true_db
    held = np.abs(found.mean_db - true_db) <= SDS * found.sd_db
    parts = dict(zip(CLASSES, (np.ones(len(los), dtype=bool), los, ~los), strict=True))
    parts["anchors"] = np.array(world.roles)[device] == "anchor"  # without errors of positions
    return {"rmse_db": {name: np.sqrt(np.mean(error_db[part]**2)) for name, part in parts.items()},
            "bias_db": {name: np.mean(error_db[part]) for name, part in parts.items()},
            "coverage": {name: np.mean(held[part]) for name, part in parts.items()},
            "sd_db": {name: np.median(found.sd_db[part]) for name, part in parts.items()}}


def maps_table(rows: pd.DataFrame) -> str:
    """Return errors, coverage, and radii of the devices, by line of mismatch."""
    line = rows["name"].str.split("-", n=1).str[1]
    lines = [(title, rows[line == name]) for name, title in TITLES.items() if (line == name).any()]
    errors = markdown(
        ["map", "worlds", "RMSE of paths [dB]", "network", "kriging", "all combined",
         "worlds where that is no worse than the best", "its bias, LoS / NLoS [dB]",
         "within 90 %, LoS / NLoS", "its RMSE on anchors' links [dB]", "walls seem off by [m]",
         "heights [m]", "shift [m]", "reflections [dB]", "worlds with a warning of the map"],
        [[title, str(len(part)), *(number(_rmse(part, model), 2) for model in (*SIMPLE, COMBINED)),
          str(_wins(part)), " / ".join(number(_mean(part, "bias_db", each), 2)
                                      for each in CLASSES[1:]),
          " / ".join(f"{100 * _mean(part, 'coverage', each):.0f} %" for each in CLASSES[1:]),
          number(float(np.sqrt(np.mean([each["rmse_db"]["anchors"]**2
                                        for each in part[COMBINED]]))), 2),
          *(number(float(np.median([value(each) for each in part["map_error"]])), 1)
            for value in FOUND),
          str(sum(any("map" in text for text in each["warnings"]) for each in part[COMBINED]))]
         for title, part in lines],
        "RMSE over held-out links, root mean square over worlds")
    located = []
    for title, part in lines:
        for model in (COMBINED, "paths", "kriging"):
            error_m, radius_m = (np.array([value for each in part[model]
                                           for value in each["devices"][key]], dtype=float)
                                 for key in ("error_m", "radius_m"))
            known = np.isfinite(error_m) & np.isfinite(radius_m)
            relied = sum(sum(each["devices"]["located"]) for each in part[model])
            located.append([title, f"`{model}`", str(len(error_m)), str(relied),
                            f"{100 * np.mean(error_m[known] <= radius_m[known]):.0f} %",
                            *(number(float(np.median(each[known])), 1)
                              for each in (error_m, radius_m))])
    return errors + "\n\n" + markdown(
        ["map", "twin", "unknown devices", "located", "within 90 % radius", "median error [m]",
         "median radius [m]"], located, "Unknown devices")


def maps_figures(rows: pd.DataFrame) -> dict[str, Figure]:
    """Draw errors of the twins, and the share of devices within their radii, by line."""
    line = rows["name"].str.split("-", n=1).str[1]
    lines = [(title, rows[line == name]) for name, title in TITLES.items() if (line == name).any()]
    figure, panels = tables.make_panels(2, 1, 3.4)
    for index, (model, label) in enumerate(BARS.items()):
        at = np.arange(len(lines)) + (index - 1.5) * 0.2
        panels[0].bar(at, [_rmse(part, model) for _, part in lines], 0.18, color=COLOURS[index],
                      label=label)
        if model in WITH_RADII:
            panels[1].bar(at, [_held(part, model) for _, part in lines], 0.18,
                          color=COLOURS[index], label=label)
    panels[0].set(ylabel="RMSE over held-out links [dB]")
    panels[1].set(ylabel="devices within their 90 % radius", ylim=(0, 1.02))
    panels[1].axhspan(0.8, 0.97, color="black", alpha=0.1, linewidth=0, zorder=0,
                      label="80 to 97 %")
    for axes in panels:
        axes.set_xticks(range(len(lines)), [fill(title, 13) for title, _ in lines],
                        fontsize="small")
        axes.grid(alpha=0.3, axis="y")
    return {"maps": tables.with_legend(figure, panels, 5)}


BARS = {"paths": "paths alone", "segmented_nn": "network", "kriging": "kriging",
        COMBINED: "path_kriging"}
WITH_RADII = ("paths", COMBINED)


def _held(rows: pd.DataFrame, model: str) -> float:
    """Return the share of located devices whose position is within its radius."""
    inside = [error_m <= radius_m for each in rows[model]
              for error_m, radius_m in zip(each["devices"]["error_m"], each["devices"]["radius_m"],
                                           strict=True) if error_m is not None]
    return float(np.mean(inside)) if inside else np.nan


FOUND = [lambda error: error["wall_m"][0], lambda error: error["height_m"][0],
         lambda error: np.hypot(*error["shift_m"][:2]), lambda error: error["offsets_db"][0]]
"""What the table has of a map's error as found."""


def _rmse(rows: pd.DataFrame, model: str) -> float:
    return float(np.sqrt(np.mean([each["rmse_db"]["all"]**2 for each in rows[model]])))


def _wins(rows: pd.DataFrame) -> int:
    """Count the worlds in which the combined twin's error is the least."""
    return sum(row[COMBINED]["rmse_db"]["all"] <= min(row[each]["rmse_db"]["all"]
                                                     for each in SIMPLE)
               for _, row in rows.iterrows())


def _mean(rows: pd.DataFrame, what: str, links: str) -> float:
    return float(np.mean([each[what][links] for each in rows[COMBINED]]))


STUDIES = {"maps": Study("How good are predictions and radii where the map is wrong?", judge_map,
                         maps_cases, maps_table, maps_figures)}
