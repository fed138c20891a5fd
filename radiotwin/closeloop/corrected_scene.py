"""The declared scene corrected by what the loop found.

Boxes are added, buildings taken out, roofs raised and lowered, anchors moved, antennas declared.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from radiotwin.cells import write_csv
from radiotwin.closeloop.corrected_antennas import ANTENNAS
from radiotwin.closeloop.corrected_antennas import with_antennas, write_antenna
from radiotwin.closeloop.corrected_buildings import corrected_buildings, stretch
from radiotwin.closeloop.run import Loop
from radiotwin.effects.boxes import Box
from radiotwin.effects.mapped_buildings import building_extents_m, buildings
from radiotwin.effects.missing_obstacle import MissingObstacle
from radiotwin.effects.position_errors import DevicePositionError
from radiotwin.effects.removed_obstacle import RemovedObstacle
from radiotwin.effects.roof_heights import Roof, RoofHeights, surely_off
from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder, require_writable
from radiotwin.inputs import is_within
from radiotwin.links import site_of
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import DeviceConfig, SceneConfig, write_config
from radiotwin.scene.folder import SCENE_FILES, check_target
from radiotwin.scene.materials import itu_material, traceable
from radiotwin.scene.names import unique_name
from radiotwin.scene.preview import draw_preview
from radiotwin.scene.reader import read_city
from radiotwin.scene.writer import CityShape, write_city

CONTENT = SCENE_FILES | {ANTENNAS}  # of a corrected scene
BOX_MATERIAL = "concrete"  # the likeliest of a building of unknown material
CLEARANCE_M = 0.5  # between walls and positions that are known to be outside [m]
MAX_SHIFT_M = 60.0  # by which a device is moved out of a building [m]


def check_corrected_target(folder: Path, scene: Scene | None, report_folder: Path) -> None:
    """Refuse, before the long work, a folder that no corrected scene can be written to.

    Args:
        folder: to write.
        scene: declared scene; None: there is none.
        report_folder: where the loop's report goes.

    Raises:
        BadInput: there is no scene, or the folder cannot be replaced.
    """
    if scene is None:
        raise BadInput("--write-scene corrects a declared scene, and none was given; give it with "
                       "--scene, or leave --write-scene out")
    for other, what in ((scene.folder, "the declared scene"),
                        (report_folder, "the report (--out)")):
        if is_within(other, folder):
            raise BadInput(f"--write-scene {folder}: {what} is in {other}, which the corrected "
                           "scene would replace; choose another folder")
    check_target(folder, CONTENT)
    require_writable(folder / "scene.toml")


def write_corrected_scene(loop: Loop, scene: Scene, folder: Path) -> list[str]:
    """Write a copy of the scene in which buildings, roofs, anchors and antennas are as found.

    Args:
        loop: whose accepted effects are the corrections.
        scene: declared scene that the loop was run with.
        folder: to write; a scene that is already in it is replaced.

    Returns:
        corrections, a sentence each; where there are none, nothing is written.

    Raises:
        BadInput: the folder cannot be written or holds something else, or the result is no scene.
    """
    effects = loop.after.whole.effects
    label, centres_m = buildings(scene.city)
    gone = [each.params.building for each in effects if isinstance(each.effect, RemovedObstacle)]
    keep = ~np.isin(label, gone)
    city = scene.city.without(~keep) if keep.any() else None
    config, moves = _moved(loop, scene, city)
    free_m = np.array([*((d.x_m, d.y_m, d.z_m) for d in config.devices),
                       *((x_m, y_m, scene.altitude_m(x_m, y_m, uav.altitude_m))
                         for uav in config.uavs
                         for x_m, y_m in ((uav.start_x_m, uav.start_y_m),
                                          (uav.terminal_x_m, uav.terminal_y_m)))])
    boxes = [_pulled_back(Box(*each.params.box), free_m.reshape(-1, 3) - [
                 0.0, 0.0, float(scene.city.ground_height_m(*each.params.box[:2]))])
             for each in effects if isinstance(each.effect, MissingObstacle)]
    changes = [f"a box of {box.length_m:.0f} x {box.width_m:.0f} m, {box.height_m:.0f} m high, "
               f"stands at ({box.x_m:.0f}, {box.y_m:.0f}) m" for box in boxes]
    above_m = centres_m[:, 2] - scene.city.ground_height_m(*centres_m[:, :2].T)
    changes += ["the building at ({:.0f}, {:.0f}) m, {:.0f} m high, is taken out".format(
        *centres_m[building, :2], above_m[building]) for building in gone]
    roofs = [roof for each in effects if isinstance(each.effect, RoofHeights)
             for roof in surely_off(each.params.roofs) if roof.building not in gone]
    changes += [f"the roof at ({roof.x_m:.0f}, {roof.y_m:.0f}) m is "
                f"{above_m[roof.building] + roof.true_offset_m:.1f} m high, and "
                f"{above_m[roof.building]:.1f} m on the map"
                for roof in roofs]
    config, antennas, found = with_antennas(config, loop, scene)
    changes += moves + found
    if not changes:
        return []
    check_target(folder, CONTENT)
    earlier = config.provenance.get("corrected")
    corrected = "; ".join(([earlier] if earlier else []) + changes)
    provenance = config.provenance | {"corrected": corrected}
    with atomic_folder(folder) as temporary:
        base_m = building_extents_m(scene.city, label)[0][:, 2]
        shapes_of, left = _write_city(scene, temporary, keep, boxes, roofs, base_m)
        table = corrected_buildings(scene, shapes_of, left, roofs, base_m)
        if table is not None:
            write_csv(table, temporary / "buildings.csv")
        scene.copy_antennas(temporary)
        for file, pattern in antennas.items():
            write_antenna(pattern, temporary / file)
        write_config(config.model_copy(update={"provenance": provenance}), temporary / "scene.toml")
        draw_preview(Scene.load(temporary), temporary / "preview.png")
    return changes


def _moved(loop: Loop, scene: Scene, city: CityMap | None) -> tuple[SceneConfig, list[str]]:
    """Return the configuration with anchors moved to the nearest free position, and the changes."""
    links = loop.after.whole.links
    found_m: dict[str, np.ndarray] = {}
    for each in loop.after.whole.effects:
        if isinstance(each.effect, DevicePositionError):
            for row in site_of(links, each.params.device):
                name = links.device_names[row]
                found_m[name] = found_m.get(name, links.device_m[row, :2]) + each.params.move_m
    devices, changes = [], []
    for device in scene.config.devices:
        if device.device in found_m:
            free_m = _free_position(found_m[device.device], device, scene, city)
            x_m, y_m = found_m[device.device] if free_m is None else free_m[:2]
            way = f"from ({device.x_m:.0f}, {device.y_m:.0f}) to ({x_m:.0f}, {y_m:.0f}) m"
            if free_m is None:
                changes.append(f"{device.device} is not moved {way}: there is no place outside of "
                               f"buildings within {MAX_SHIFT_M:.0f} m")
            else:
                changes.append(f"{device.device} is moved {way}")
                device = device.model_copy(update=dict(zip(("x_m", "y_m", "z_m"), free_m,
                                                           strict=True)))
        devices.append(device)
    return scene.config.model_copy(update={"devices": devices}), changes


def _free_position(position_m: np.ndarray, device: DeviceConfig, scene: Scene,
                   city: CityMap | None) -> tuple[float, float, float] | None:
    """Return the position nearest to one (2,) [m], within the extent and outside buildings.

    The device stays as high above the ground as it is. None where no such position is near.
    """
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    low_m, high_m = (x_min, y_min), (x_max, y_max)
    radius_m, angle = (axis.ravel() for axis in np.meshgrid(
        np.arange(0, MAX_SHIFT_M), np.radians(np.arange(0, 360, 10)), indexing="ij"))
    around_m = radius_m[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    tried_m = np.round(np.clip(np.clip(position_m, low_m, high_m) + around_m, low_m, high_m), 2)
    ground_m = scene.city.ground_height_m
    above_m = device.z_m - float(ground_m(device.x_m, device.y_m))
    z_m = np.round(above_m + ground_m(*tried_m.T), 3)
    free = z_m > 0  # as scene.toml has it
    if city is not None:
        for aside_m in CLEARANCE_M * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]):
            free &= ~city.inside(np.column_stack([tried_m + aside_m, z_m]))
    if not free.any():
        return None
    nearest = int(free.argmax())
    return float(tried_m[nearest, 0]), float(tried_m[nearest, 1]), float(z_m[nearest])


def _pulled_back(box: Box, points_m: np.ndarray) -> Box:
    """Shrink a box until no point (n, 3) [m] is inside, for each on the side that costs least."""
    turn = np.radians(box.turn_deg)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    high = np.array([0.5 * box.length_m, 0.5 * box.width_m, box.height_m])
    low = np.array([-high[0], -high[1], 0.0])
    for point in np.column_stack([(points_m[:, :2] - (box.x_m, box.y_m)) @ axes.T, points_m[:, 2]]):
        if (point <= low - CLEARANCE_M).any() or (point >= high + CLEARANCE_M).any():
            continue
        choices = []
        for axis, side in ((0, low), (0, high), (1, low), (1, high), (2, high)):  # the ground stays
            pulled = side.copy()
            pulled[axis] = point[axis] + (CLEARANCE_M if side is low else -CLEARANCE_M)
            choices.append((pulled, high) if side is low else (low, pulled))
        low, high = max(choices, key=lambda choice: np.prod(np.maximum(choice[1] - choice[0], 0.0)))
    x_m, y_m = 0.5 * (low + high)[:2] @ axes + (box.x_m, box.y_m)
    length_m, width_m = (high - low)[:2]
    return Box(x_m, y_m, length_m, width_m, high[2], box.turn_deg)


def _write_city(scene: Scene, folder: Path, keep: np.ndarray, boxes: list[Box],
                roofs: list[Roof], base_m: np.ndarray) -> tuple[dict[int, set[str]], set[str]]:
    """Write `city.xml` and `meshes/`: kept faces (f,) of the scene's map, roofs, and boxes.

    Returns the names of the shapes of each building, and of those that are left.
    """
    label, shapes, first = buildings(scene.city)[0], [], 0
    shapes_of: dict[int, set[str]] = {}
    for shape in read_city(scene.xml_path):
        part = slice(first, first + len(shape.mesh.faces))
        own, first = keep[part], part.stop
        for building in np.unique(label[part]).tolist():
            shapes_of.setdefault(building, set()).add(shape.name)
        shape = replace(shape, mesh=_with_roofs(shape.mesh, label[part], roofs, base_m))
        if own.all():
            shapes.append(shape)
        elif own.any():
            used, faces = np.unique(shape.mesh.faces[own], return_inverse=True)
            mesh = trimesh.Trimesh(shape.mesh.vertices[used], faces.reshape(-1, 3), process=False)
            shapes.append(replace(shape, mesh=mesh))
    taken = {name.lower() for shape in shapes for name in (shape.name, shape.material.name)}
    write_city(folder, [*shapes, *_box_shapes(scene, boxes, taken)])
    return shapes_of, {shape.name for shape in shapes}


def _with_roofs(mesh: trimesh.Trimesh, label: np.ndarray, roofs: list[Roof],
                base_m: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh whose buildings (f,) are stretched to the heights of their roofs.

    They stand on `base_m` (buildings,) [m]; a mesh may hold the roof of one, and not its walls.
    """
    vertices_m = np.array(mesh.vertices, dtype=float)
    for roof in roofs:
        mine = np.unique(mesh.faces[label == roof.building])
        if len(mine):
            own_m = float(base_m[roof.building])
            vertices_m[mine, 2] = own_m + stretch(roof, own_m) * (vertices_m[mine, 2] - own_m)
    return trimesh.Trimesh(vertices_m, mesh.faces, process=False)


def _box_shapes(scene: Scene, boxes: list[Box], taken: set[str]) -> list[CityShape]:
    """Return shapes from the lowest point of the map up, with names that are not `taken`."""
    name = unique_name(f"found_{BOX_MATERIAL}", taken)
    material = traceable(itu_material(BOX_MATERIAL, name=name), scene.config.radio.frequency_hz)
    bottom_m = min(float(scene.city.vertices[:, 2].min()), 0.0)
    shapes = []
    for box in boxes:
        turned = trimesh.transformations.rotation_matrix(np.radians(box.turn_deg), (0, 0, 1))
        top_m = float(scene.city.ground_height_m(box.x_m, box.y_m)) + box.height_m
        turned[:3, 3] = box.x_m, box.y_m, 0.5 * (bottom_m + top_m)
        mesh = trimesh.creation.box((box.length_m, box.width_m, top_m - bottom_m), turned)
        shapes.append(CityShape(unique_name("found_box", taken), mesh, material))
    return shapes
