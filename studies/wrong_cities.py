"""Cities for the study `maps`, and maps of them that are wrong.

Nothing here is shared with the package's generator of scenes, nor with the maps with errors that
it makes itself (`radiotwin.scene.citymap`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
from shapely import Polygon, affinity, box

from radiotwin import Scene
from radiotwin.io.files import scratch_folder
from radiotwin.scene.config import Extent, LatticeConfig, RadioConfig, SceneConfig, write_config
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import Material, itu_material

SIDE_M = 400.0  # of the square that is flown over, and that devices stand in
GROUNDS = ("asphalt_concrete", "medium_dry_ground", "concrete", "wet_ground", "asphalt_concrete")
"""Ground of each city."""
THICKNESS_M = {"concrete": 0.3, "brick": 0.24, "glass": 0.02, "wood": 0.08}
SHARES = (0.5, 0.2, 0.2, 0.1)  # of buildings, in that order of materials
LOWEST_M = 3.0  # building in a map, whatever the error of its height
LEFT_SHARE = 0.3  # of a building's area, at least, whatever the errors of its walls


@dataclass(frozen=True)
class Building:
    """A building of a city.

    Attributes:
        outline: without courtyards [m].
        height_m: of its flat roof.
        material: key of the ITU table.
    """

    outline: Polygon
    height_m: float
    material: str


def true_city(number: int) -> list[Building]:
    """Return the buildings of one of the cities: blocks, some turned, L shapes, and rows."""
    rng = np.random.default_rng([23, 3, number])
    plots = int(rng.integers(5, 7))
    pitch_m, street_m = SIDE_M / plots, rng.uniform(10, 25)
    turn_deg = rng.choice([0.0, rng.uniform(5, 40)])
    found = []
    for row, column in np.ndindex(plots, plots):
        kind = rng.choice(["park", "block", "turned", "L", "row"], p=[0.1, 0.3, 0.2, 0.2, 0.2])
        wide_m, deep_m = (pitch_m - street_m) * rng.uniform(0.65, 1, 2)
        x_m, y_m = (np.array([row, column]) + 0.5) * pitch_m + rng.uniform(-2, 2, 2)
        plot = box(x_m - wide_m / 2, y_m - deep_m / 2, x_m + wide_m / 2, y_m + deep_m / 2)
        outlines = {"park": [], "row": _row(plot, int(rng.integers(2, 4)))}.get(kind, [plot])
        if kind == "L":
            corner_m = plot.bounds[2:] - rng.uniform(0.4, 0.55, 2) * [wide_m, deep_m]
            outlines = [plot - box(*corner_m, *plot.bounds[2:])]
        if kind == "turned":  # and as small as fits
            outlines = [affinity.rotate(affinity.scale(plot, 0.75, 0.75), rng.uniform(10, 80))]
        for outline in outlines:
            turned = affinity.rotate(outline, turn_deg, origin=(SIDE_M / 2, SIDE_M / 2))
            material = str(rng.choice(list(THICKNESS_M), p=SHARES))
            found.append(Building(turned, rng.uniform(8, 35), material))
    return found


def _row(plot: Polygon, houses: int) -> list[Polygon]:
    """Return the outlines of houses wall to wall."""
    west_m, south_m, east_m, north_m = plot.bounds
    ends_m = np.linspace(west_m, east_m, houses + 1)
    return [box(start_m, south_m, end_m, north_m)
            for start_m, end_m in zip(ends_m[:-1], ends_m[1:], strict=True)]


def wrong_map(true: list[Building], wrong: dict[str, Any], rng: np.random.Generator
              ) -> list[Building]:
    """Return the buildings of a map with errors.

    Args:
        true: buildings of the city.
        wrong: what is wrong: `wall_m`, `height_m` (standard deviation of each wall's and roof's
            error), `frame_m` (shift of all), `missing` (number of buildings), `metal` (whether
            it is declared for concrete).
        rng: of the errors.
    """
    found = list(true)
    if "wall_m" in wrong:
        found = [replace(each, outline=with_moved_walls(each.outline, wrong["wall_m"], rng))
                 for each in found]
    if "height_m" in wrong:
        heights_m = [each.height_m + rng.normal(0, wrong["height_m"]) for each in found]
        found = [replace(each, height_m=max(height_m, LOWEST_M))
                 for each, height_m in zip(found, heights_m, strict=True)]
    if "frame_m" in wrong:
        angle_rad = rng.uniform(0, 2 * np.pi)
        shift_m = wrong["frame_m"] * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        found = [replace(each, outline=affinity.translate(each.outline, *shift_m))
                 for each in found]
    if "missing" in wrong:
        gone = set(rng.choice(len(found), wrong["missing"], replace=False).tolist())
        found = [each for number, each in enumerate(found) if number not in gone]
    if wrong.get("metal"):
        found = [replace(each, material="metal") if each.material == "concrete" else each
                 for each in found]
    return found


def with_moved_walls(outline: Polygon, sd_m: float, rng: np.random.Generator) -> Polygon:
    """Return an outline, each wall moved along its normal by a normal error of its own [m]."""
    corners_m = np.array(outline.exterior.coords)[:-1]
    along = np.roll(corners_m, -1, axis=0) - corners_m
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    while True:
        at_m = (normal * corners_m).sum(axis=1) + rng.normal(0, sd_m, len(corners_m))
        pairs = np.stack([np.roll(normal, 1, axis=0), normal], axis=1)
        moved = Polygon(np.linalg.solve(
            pairs, np.stack([np.roll(at_m, 1), at_m], axis=1)[..., None])[..., 0])
        if moved.is_valid and moved.area > LEFT_SHARE * outline.area \
                and moved.exterior.is_ccw == outline.exterior.is_ccw:
            return moved


def city_shapes(buildings: list[Building], ground: str) -> list[CityShape]:
    """Return the bodies of buildings, and the ground."""
    materials = {name: Material(name, itu=name, thickness_m=thickness_m)
                 for name, thickness_m in THICKNESS_M.items()} | {"metal": itu_material("metal")}
    low_m, high_m = -0.4 * SIDE_M, 1.4 * SIDE_M
    corners = [(low_m, low_m, 0), (high_m, low_m, 0), (high_m, high_m, 0), (low_m, high_m, 0)]
    flat = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)
    return [CityShape("plane", flat, materials.get(ground, itu_material(ground)))] + [
        CityShape(f"building_{index:02}",
                  trimesh.creation.extrude_polygon(each.outline, each.height_m),
                  materials[each.material]) for index, each in enumerate(buildings)]


@contextmanager
def city_scene(buildings: list[Building], settings: dict) -> Iterator[Scene]:
    """Yield a scene without devices over a map of a city."""
    with scratch_folder() as folder:
        write_city(folder, city_shapes(buildings, GROUNDS[settings["city"]]))
        write_config(SceneConfig(
            name=f"city{settings['city']}",
            radio=RadioConfig(frequency_hz=settings["frequency_hz"]),
            extent=Extent(x_min_m=0, x_max_m=SIDE_M, y_min_m=0, y_max_m=SIDE_M),
            lattice=LatticeConfig(step_m=20, altitudes_m=[50.0])), folder / "scene.toml")
        yield Scene.load(folder)
