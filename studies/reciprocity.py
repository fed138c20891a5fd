"""Links whose ends are exchanged, and links that the reciprocal wedge changes: `reciprocity`.

Devices stand at street level, as many within 4 m of a wall, 4 to 20 m and farther off; receivers
stand outdoors from 1.5 to 60 m. Each link is solved from its device and from its receiver, by
Sionna RT, as released and with the reciprocal wedge, and by the path engine. By reciprocity both
gains are equal.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import Any

import numpy as np
import pandas as pd
import trimesh

from radiotwin import Scene
from radiotwin.io.files import scratch_folder
from radiotwin.propagation.paths import path_powers
from radiotwin.scene.build import BuildOptions, build_scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import itu_material
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains, power_to_db
from studies.runner import Study
from studies.tables import markdown, number, scene_folder

WALLS_M = ((0.0, 4.0), (4.0, 20.0), (20.0, np.inf))  # distance of a device to the nearest wall
REACH_M = 300.0  # from the middle of a city to its links' ends
LIMIT_DB = -130.0  # links that are weaker in both directions are left out
DOUBT_DB = 6.0
FREQUENCY_HZ = 2.4e9
METHODS = {("Sionna RT", "sionna"): "Sionna RT, as released",
           ("Sionna RT", "reciprocal"): "Sionna RT, reciprocal",
           ("engine", "reciprocal"): "path engine"}

# Plots of a block along each side; the side of a plot, and the width of a street
PLOTS, PLOT_M, STREET_M = 3, 38.0, 20.0
PERIOD_M = PLOTS * PLOT_M + STREET_M


def city_footprints(buildings: int, seed: int) -> np.ndarray:
    """Draw the buildings of a square city, at most one a plot, none touching another.

    Args:
        buildings: number of them.
        seed: of all sides, places and heights.

    Returns:
        (n, 5) x_min, y_min, x_max, y_max, height [m]; the city's middle is at 0, 0. Sides are
        uniform from 15 to 30 m, heights above 4 m gamma distributed with the mean 15 m.
    """
    rng = np.random.default_rng(seed)
    blocks = math.ceil(math.sqrt(buildings / PLOTS**2))
    side = PLOTS * blocks
    plots = np.sort(rng.permutation(side**2)[:buildings])
    row, column = np.divmod(plots, side)
    low_m = np.column_stack([place // PLOTS * PERIOD_M + place % PLOTS * PLOT_M
                             for place in (column, row)]) - blocks * PERIOD_M / 2
    size_m = rng.uniform(15.0, 30.0, (buildings, 2))
    low_m = low_m + rng.uniform(1.0, PLOT_M - size_m - 1.0)
    height_m = np.clip(4.0 + rng.gamma(2.0, 5.5, buildings), 4.0, 60.0)
    return np.column_stack([low_m, low_m + size_m, height_m]).round(2)


def reciprocity_cases(seed: int) -> dict[str, dict]:
    """Return cities."""
    return {name: {"city": city, "devices": 18, "receivers": 24} for name, city in (
        ("Munich", "sionna:munich"), ("36 boxes", "boxes"), ("RBM", "rbm"), ("RDM", "rdm"))}


@contextmanager
def _city(name: str, seed: int) -> Iterator[tuple[Any, CityMap]]:
    """Yield the file of a city and its map."""
    with scratch_folder() as folder:
        if name == "boxes":
            corners_m = [(x, y, 0) for x, y in ((-600, -600), (600, -600), (600, 600), (-600, 600))]
            shapes = [CityShape("ground", trimesh.Trimesh(corners_m, [(0, 1, 2), (0, 2, 3)],
                                                          process=False), itu_material("concrete"))]
            for row, (x0, y0, x1, y1, top_m) in enumerate(city_footprints(36, seed)):
                box = trimesh.creation.box(bounds=[[x0, y0, 0], [x1, y1, top_m]])
                shapes.append(CityShape(f"box{row}", box, itu_material("concrete")))
            write_city(folder, shapes)
            yield folder / "city.xml", CityMap.from_xml(folder / "city.xml")
        elif name.startswith("sionna:"):
            build_scene(name, folder / "scene", BuildOptions(devices=1))
            scene = Scene.load(folder / "scene")
            yield scene.xml_path, scene.city
        else:
            scene = Scene.load(scene_folder(name))
            yield scene.xml_path, scene.city


def wall_distance_m(city: CityMap, points_m: np.ndarray) -> np.ndarray:
    """Return the horizontal distance (n,) from points (n, 3) to the nearest wall [m]."""
    turn = np.arange(90) * (2 * np.pi / 90)
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(90)])
    found = city.first_hits_towards(np.repeat(points_m, 90, axis=0),
                                    np.tile(around, (len(points_m), 1)))[0]
    return found.reshape(-1, 90).min(axis=1)


def _ends(city: CityMap, settings: dict, rng: np.random.Generator
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw devices (k, 3), their distances to walls (k,) and receivers (n, 3) outdoors [m]."""
    low, high = np.quantile(city.vertices[:, :2], [0.1, 0.9], axis=0)
    middle = (low + high) / 2
    low, high = np.maximum(low, middle - REACH_M), np.minimum(high, middle + REACH_M)
    points_m = np.column_stack([rng.uniform(low, high, (4000, 2)), np.full(4000, 1.5)])
    points_m = points_m[~city.inside(points_m)]
    apart_m = wall_distance_m(city, points_m)
    chosen = np.concatenate([np.flatnonzero((apart_m > near) & (apart_m <= far))
                             [:settings["devices"] // len(WALLS_M)] for near, far in WALLS_M])
    receiver_m = np.column_stack([rng.uniform(low, high, (4000, 2)), rng.uniform(1.5, 60, 4000)])
    receiver_m = receiver_m[~city.inside(receiver_m)][:settings["receivers"]]
    return points_m[chosen], apart_m[chosen], receiver_m


def measure_reciprocity(seed: int, settings: dict) -> dict:
    """Solve links both ways by each method; return differences and times."""
    rng = np.random.default_rng(seed)
    with _city(settings["city"], seed) as (xml_path, city):
        device_m, wall_m, receiver_m = _ends(city, settings, rng)
        los = np.stack([city.line_of_sight(each_m[None], receiver_m) for each_m in device_m])
        both: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        seconds = {}
        for (engine, wedge), name in METHODS.items():
            # A copy of the map, so that no method finds candidates that another has kept
            solve = _sionna(xml_path, wedge, settings) if engine == "Sionna RT" else \
                _engine(copy(city))
            solve(device_m[-1], receiver_m)  # compiles the kernels
            started = time.process_time()
            forward = np.stack([solve(each_m, receiver_m) for each_m in device_m])
            seconds[name] = (time.process_time() - started) / forward.size
            backward = np.stack([solve(each_m, device_m) for each_m in receiver_m]).T
            both[name] = forward, backward
    released, mended, ours = both.values()
    return {"exchanged": {name: {kind: _exchanged(*gains, of_kind) for kind, of_kind in
                                 (("LoS", los), ("NLoS", ~los))} for name, gains in both.items()},
            "changed": {"Sionna RT": _changed(released[0], mended[0], wall_m, los)},
            "engine_errors": _errors(ours[0], *mended, los),
            "link_ms": {name: 1e3 * taken for name, taken in seconds.items()}}


def _sionna(xml_path: Any, wedge: str, settings: dict) -> Callable[..., np.ndarray]:
    batch = max(settings["devices"], settings["receivers"])
    solver = PathGains(xml_path, FREQUENCY_HZ, SolverSettings(
        batch_receivers=batch, diffraction=wedge))  # type: ignore[arg-type]
    return solver.gains


def _engine(city: CityMap) -> Callable[..., np.ndarray]:
    return lambda end_m, ends_m: power_to_db(
        path_powers(city, end_m, ends_m, FREQUENCY_HZ).total)


def _exchanged(forward_db: np.ndarray, backward_db: np.ndarray, chosen: np.ndarray
               ) -> dict[str, float]:
    """Return how much gains (k, n) of chosen links change when their ends are exchanged."""
    strong = chosen & (np.fmax(forward_db, backward_db) >= LIMIT_DB)
    gap_db = (backward_db - forward_db)[strong]
    found = np.isfinite(gap_db)
    return {"links": int(strong.sum()), "one_way": 1 - found.mean(),
            "bias_db": gap_db[found].mean(), **_shares(np.abs(gap_db[found]))}


def _shares(gap_db: np.ndarray) -> dict[str, float]:
    return {"rms_db": np.sqrt(np.mean(gap_db**2)), "median_db": np.median(gap_db),
            **{f"above_{limit}_db": np.mean(gap_db > limit) for limit in (1, 3, 6, 10)}}


def _changed(before_db: np.ndarray, after_db: np.ndarray, wall_m: np.ndarray, los: np.ndarray
             ) -> dict[str, dict[str, float]]:
    """Return what the wedge changes on links without sight, by the device's distance to a wall."""
    out = {}
    for near, far in WALLS_M:
        rows = (wall_m > near) & (wall_m <= far)
        strong = rows[:, None] & ~los & (np.fmax(before_db, after_db) >= LIMIT_DB)
        gap_db = np.abs(after_db - before_db)[strong & np.isfinite(before_db + after_db)]
        out[f"{near:g} to {far:g} m" if np.isfinite(far) else f"above {near:g} m"] = {
            "links": len(gap_db), **_shares(gap_db)}
    return out


def _errors(engine_db: np.ndarray, forward_db: np.ndarray, backward_db: np.ndarray,
            los: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the engine's RMS difference from Sionna RT, over all links and without doubtful ones.

    Doubtful are links whose two ends differ by more than `DOUBT_DB` in Sionna RT, or that it finds
    from one end only.
    """
    out = {}
    for kind, of_kind in (("LoS", los), ("NLoS", ~los)):
        strong = of_kind & (forward_db >= LIMIT_DB) & np.isfinite(engine_db)
        sure = strong & (np.abs(forward_db - backward_db) <= DOUBT_DB)
        error_db = engine_db - forward_db
        out[kind] = {"links": int(strong.sum()), "doubtful": 1 - sure.sum() / strong.sum(),
                     "rms_db": np.sqrt(np.mean(error_db[strong] ** 2)),
                     "rms_without_doubtful_db": np.sqrt(np.mean(error_db[sure] ** 2))}
    return out


def reciprocity_table(rows: pd.DataFrame) -> str:
    """Return the tables of exchanged ends, of changed links, of errors and of times."""
    exchanged, changed, errors, times = [], [], [], []
    for _, row in rows.iterrows():
        for name, of_kind in row["exchanged"].items():
            for kind, found in of_kind.items():
                exchanged.append([row["name"], name, kind, f"{found['links']}",
                                  *(number(found[f"{key}_db"], 2)
                                    for key in ("rms", "median", "bias")),
                                  *(_percent(found[f"above_{limit}_db"]) for limit in (1, 3, 6)),
                                  _percent(found["one_way"])])
        for name, of_walls in row["changed"].items():
            changed += [[row["name"], name, walls, f"{found['links']}",
                         number(found["rms_db"], 2),
                         *(_percent(found[f"above_{limit}_db"]) for limit in (1, 3, 10))]
                        for walls, found in of_walls.items()]
        errors += [[row["name"], kind, f"{found['links']}", number(found["rms_db"], 2),
                    number(found["rms_without_doubtful_db"], 2), _percent(found["doubtful"])]
                   for kind, found in row["engine_errors"].items()]
        base = row["link_ms"][METHODS["engine", "reciprocal"]]
        times.append([row["name"], *(f"{taken / base:.2f}" for taken in row["link_ms"].values())])
    return "\n\n".join([
        markdown(["city", "method", "class", "links", "RMS [dB]", "median [dB]", "mean [dB]",
                  "> 1 dB", "> 3 dB", "> 6 dB", "found from one end only"], exchanged,
                 "Ends exchanged", f": rays from the receiver minus rays from the device; links "
                 f"above {LIMIT_DB:g} dB in one direction at least."),
        markdown(["city", "of", "device to the nearest wall", "links", "RMS [dB]", "> 1 dB",
                  "> 3 dB", "> 10 dB"], changed, "What the reciprocal wedge changes",
                 ": links without line of sight."),
        markdown(["city", "class", "links", "RMS [dB]", "without doubtful links", "doubtful"],
                 errors, "The path engine against Sionna RT",
                 f", both reciprocal; doubtful: its two ends differ by more than {DOUBT_DB:g} dB."),
        markdown(["city", *METHODS.values()], times, "Time a link",
                 ", processor time over that of the path engine.")])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


STUDIES = {"reciprocity": Study("Do gains change when the ends of a link are exchanged?",
                                measure_reciprocity, reciprocity_cases, reciprocity_table,
                                seeds=1)}
