"""Short links with line of sight in dense cities: does any carry more power than its paths can?

The cities are made here, not by the package: blocks on a turned and jittered grid, narrow streets,
courtyards, and houses wall to wall. Devices stand near walls, receivers within 100 m.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from shapely import affinity, box

from radiotwin import SolverSettings
from radiotwin.io.files import scratch_folder
from radiotwin.scene.build import build_scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import itu_material
from radiotwin.trace.solver import Antennas, PathGains
from studies.runner import Study
from studies.tables import markdown, scene_folder

FREQUENCY_HZ, SPEED_OF_LIGHT = 2.4e9, 299_792_458.0
DEVICES = 13  # a row, with a batch of receivers each
NEAR_M = 100.0  # longest link
CITIES = [*(f"dense {number}" for number in range(10)), "sionna:munich", "rbm", "rdm"]
STEPS_DB = (1, 3, 6)


def dense_city(number: int, side_m: float = 360.0) -> list[CityShape]:
    """Return one of the dense cities, in concrete on a concrete ground."""
    rng = np.random.default_rng([23, number])
    street_m, pitch_m, turn_deg = rng.uniform(4, 12), rng.uniform(22, 45), rng.uniform(0, 90)
    terraced = number % 3 == 2  # houses that share walls
    solids: list[trimesh.Trimesh] = []
    count = int(side_m / pitch_m)
    for row, column in np.ndindex(count, count):
        x_m, y_m = (np.array([row, column]) - (count - 1) / 2) * pitch_m
        wide_m, deep_m = pitch_m - street_m - rng.uniform(0, 3, 2)
        parts = 3 if terraced else 1
        for part in range(parts):
            left_m = x_m - wide_m / 2 + part * wide_m / parts
            house = box(left_m, y_m - deep_m / 2, left_m + wide_m / parts, y_m + deep_m / 2)
            if parts == 1 and min(wide_m, deep_m) > 16 and rng.random() < 0.4:
                house -= affinity.scale(house, 0.5, 0.5)  # a courtyard
            turned_deg = turn_deg + (0 if terraced else rng.normal(0, 2))
            house = affinity.rotate(house, turned_deg, origin=(0, 0))
            solids.append(trimesh.creation.extrude_polygon(house, rng.uniform(6, 30)))
    corners = [(x, y, 0) for x, y in ((-300, -300), (300, -300), (300, 300), (-300, 300))]
    ground = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)
    concrete = itu_material("concrete")
    houses = trimesh.Trimesh(*trimesh.util.append_faces(
        [each.vertices for each in solids], [each.faces for each in solids]), process=False)
    return [CityShape("houses", houses, concrete),
            CityShape("ground", ground, concrete)]


@contextmanager
def city_file(name: str) -> Iterator[Path]:
    """Yield `city.xml` of a city."""
    with scratch_folder() as folder:
        if name.startswith("dense"):
            write_city(folder, dense_city(int(name.split()[1])))
        elif name.startswith("sionna:"):
            build_scene(name, folder / "scene")
            folder = folder / "scene"
        else:
            folder = scene_folder(name)
        yield folder / "city.xml"


def draw_device(city: CityMap, rng: np.random.Generator) -> np.ndarray:
    """Draw a position outdoors, 0.1 to 2 m from a wall."""
    low_m, high_m = city.vertices.min(axis=0), city.vertices.max(axis=0)
    while True:
        at_m = np.append(rng.uniform(low_m + 0.3 * (high_m - low_m),
                                     high_m - 0.3 * (high_m - low_m))[:2], rng.uniform(1.5, 10))
        angle_rad = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(angle_rad), np.sin(angle_rad), 0])
        reach_m = _free_way(city, at_m, way, 60.0) - rng.uniform(0.1, 2.0)
        if 0 < reach_m < 58 and not city.inside(at_m[None])[0]:
            return at_m + reach_m * way


def _free_way(city: CityMap, at_m: np.ndarray, way: np.ndarray, longest_m: float) -> float:
    """Return the distance to the first surface, by halving [m]."""
    short, long = 0.0, longest_m
    if city.line_of_sight(at_m[None], (at_m + long * way)[None])[0]:
        return long
    while long - short > 0.005:
        middle = (short + long) / 2
        free = city.line_of_sight(at_m[None], (at_m + middle * way)[None])[0]
        short, long = (middle, long) if free else (short, middle)
    return short


def draw_receivers(city: CityMap, device_m: np.ndarray, count: int, rng: np.random.Generator
                   ) -> np.ndarray:
    """Draw (count, 3) positions that see a device, 1 to 100 m from it; fewer in a narrow place."""
    offset_m = rng.normal(0, 1, (40_000, 3)) * [1, 1, 0.3]
    offset_m *= (rng.uniform(1, NEAR_M, 40_000) / np.linalg.norm(offset_m, axis=1))[:, None]
    points_m = device_m + offset_m
    points_m = points_m[points_m[:, 2] > 0.5]
    seen = city.line_of_sight(device_m[None], points_m) & ~city.inside(points_m)
    return points_m[seen][:count]


class Counting(PathGains):
    """Notes what the sums were before paths counted once, and what was solved again.

    Attributes:
        raw: Power of each receiver with every path that Sionna RT returned.
        bound: Highest power that its distinct paths can carry.
        paths: Number of its distinct paths.
        again: Links that were solved a second time.
    """

    again = 0

    def _solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas, seed: int
               ) -> np.ndarray:
        self.again += int(seed != self.settings.seed)
        return super()._solve(device_m, points_m, antennas, seed)

    def _combine(self, paths: Any, antennas: Antennas) -> tuple[np.ndarray, np.ndarray]:
        power, bound = super()._combine(paths, antennas)
        real, imaginary = (np.array(part, dtype=float).reshape(len(power), -1) for part in paths.a)
        strength = real**2 + imaginary**2
        self.raw, self.bound = strength.sum(axis=1), bound
        return power, bound

    def _counted(self, paths: Any, strength: np.ndarray, cos_turn: np.ndarray) -> np.ndarray:
        counted = super()._counted(paths, strength, cos_turn)
        self.paths = counted.sum(axis=1)
        return counted


def impossible_cases(seed: int) -> dict[str, dict]:
    """Return the cities."""
    return {name: {"city": name, "devices": DEVICES, "quality": "default"} for name in CITIES}


def count_impossible(seed: int, settings: dict) -> dict:
    """Trace links and compare their gains with free space, and with what their paths can carry.

    Returns:
        Numbers of links: all; above free space by more than some steps; above their bound by more
        than these, each before and after paths counted once; solved again; left as impossible;
        changed by more than 0.1 dB. Highest levels above free space [dB]. Numbers of paths of the
        links more than 6 dB above free space.
    """
    solver_settings = SolverSettings.of_quality(settings["quality"], seed=seed + 1)
    rng, tables = np.random.default_rng([CITIES.index(settings["city"]), seed]), []
    with city_file(settings["city"]) as path:
        city, solver = CityMap.from_xml(path), Counting(path, FREQUENCY_HZ, solver_settings)
        for _ in range(settings["devices"]):
            device_m = draw_device(city, rng)
            points_m = draw_receivers(city, device_m, solver_settings.batch_receivers, rng)
            if len(points_m):
                tables.append(_links(solver, device_m, points_m))
    links, again = pd.concat(tables, ignore_index=True), solver.again
    counts = {f"{when}_above_{what}_{step}": int((links[f"{when}_{what}"] > step).sum())
              for when in ("before", "after") for what in ("free", "bound") for step in STEPS_DB}
    strong = links[links["after_free"] > max(STEPS_DB)]
    return counts | {
        "links": len(links), "again": again, "impossible": int(np.isinf(links["after_free"]).sum()),
        "changed": int(((links["before_free"] - links["after_free"]).abs() > 0.1).sum()),
        "before_highest_db": links["before_free"].max(),
        "after_highest_db": links["after_free"].max(), "strong_paths": strong["paths"].tolist()}


def _links(solver: Counting, device_m: np.ndarray, points_m: np.ndarray) -> pd.DataFrame:
    """Return each link's level above free space and above its bound [dB], before and after."""
    again = solver.again
    gain_db = solver.solve(device_m, points_m)
    if solver.again > again:  # the sums are those of the second solution
        solver._solve(device_m, points_m, (None, None), solver.settings.seed)
    with np.errstate(divide="ignore"):
        raw_db, bound_db = (10 * np.log10(sums[:len(points_m)])
                            for sums in (solver.raw, solver.bound))
    distance_m = np.linalg.norm(points_m - device_m, axis=1)
    free_db = -20 * np.log10(4 * np.pi * distance_m * FREQUENCY_HZ / SPEED_OF_LIGHT)
    return pd.DataFrame({
        "before_free": raw_db - free_db, "after_free": gain_db - free_db,
        "before_bound": raw_db - bound_db, "after_bound": gain_db - bound_db,
        "paths": solver.paths[:len(points_m)]})


def impossible_table(rows: pd.DataFrame) -> str:
    """Return links above free space, and above what their paths can carry, by city."""
    dense = rows["name"].str.startswith("dense")
    groups = [("ten dense cities", rows[dense]),
              *((name, rows[rows["name"] == name]) for name in CITIES[10:]), ("all", rows)]
    heads = ["cities", "links", "more than 1, 3, 6 dB above what their paths carry: before",
             "after", "more than 6 dB above free space: before", "after", "highest before [dB]",
             "after [dB]", "changed by 0.1 dB", "solved again", "left out"]
    cells = []
    for name, part in groups:
        if len(part):
            bounds = [", ".join(str(part[f"{when}_above_bound_{step}"].sum()) for step in STEPS_DB)
                      for when in ("before", "after")]
            cells.append([name, f"{part['links'].sum():,}", *bounds,
                          *(str(part[f"{when}_above_free_6"].sum())
                            for when in ("before", "after")),
                          *(f"{part[f'{when}_highest_db'].max():.1f}"
                            for when in ("before", "after")),
                          *(str(part[name].sum()) for name in ("changed", "again", "impossible"))])
    paths = [count for each in rows["strong_paths"] for count in each]
    note = (f"\n\nThe {len(paths)} links that stay more than 6 dB above free space have "
            f"{min(paths)} to {max(paths)} paths each (median {np.median(paths):.0f})."
            if paths else "")
    return markdown(heads, cells) + note


STUDIES = {"impossible": Study("Does a link carry more power than its paths can?",
                               count_impossible, impossible_cases, impossible_table)}
