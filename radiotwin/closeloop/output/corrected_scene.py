"""Write the declared scene as corrected by the loop's effects.

Boxes are added, buildings removed, roofs raised or lowered, anchors moved, antennas declared.
`buildings.csv` lists the remaining buildings with their estimated heights.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import trimesh
from pydantic import ValidationError

from radiotwin.closeloop.run import Loop
from radiotwin.effects.boxes import Box, building_extents_m, buildings
from radiotwin.effects.places import Correction, FoundAntenna, Roof
from radiotwin.errors import BadInput
from radiotwin.io.cells import as_numbers, read_cells, write_csv
from radiotwin.io.files import atomic_folder, require_writable
from radiotwin.io.inputs import is_within, require_within
from radiotwin.links import Links
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import DeviceConfig, SceneConfig, write_config
from radiotwin.scene.folder import SCENE_FILES, CityShape, check_target, read_city, write_city
from radiotwin.scene.materials import Names, itu_material, safe_name, traceable
from radiotwin.scene.plot import draw_preview
from radiotwin.scene.streets import STREETS

ANTENNAS = "antennas"
AZIMUTH_DEG, ELEVATION_DEG = np.arange(0.0, 360.0, 5.0), np.arange(-90.0, 91.0, 2.0)
DECIMALS = 2  # decimals of a gain [dBi] and an azimuth [degree]
SOURCE = "close-loop"  # value of `height_from` for estimated heights
MIN_SD_M = 0.1  # least standard deviation written for a height [m]
CONTENT = SCENE_FILES | {ANTENNAS}  # files and folders of a corrected scene
BOX_MATERIAL = "concrete"  # most common building material
CLEARANCE_M = 0.5  # between walls and positions that are known to be outside [m]
MAX_SHIFT_M = 60.0  # largest distance by which a device is moved out of a building [m]


def with_antennas(config: SceneConfig, found: Sequence[Correction], links: Links,
                  scene: Scene) -> tuple[SceneConfig, dict[str, FoundAntenna], list[str]]:
    """Declare the antennas that were found in a scene's configuration.

    An anchor of the measurements that the scene lacks is added, if it is within the extent and
    outside buildings.

    Args:
        config: configuration to change.
        found: corrections by the loop's effects.
        links: links of the loop.
        scene: declared scene of the loop.

    Returns:
        the configuration; antennas by their file in the scene's folder; a sentence for each.
    """
    devices = {each.device: each for each in config.devices}
    antennas = {links.device_names[device]: antenna for each in found
                for device, antenna in each.antennas.items()}
    bounds, files, changes = config.extent.bounds, {}, []
    for name, antenna in antennas.items():
        x_m, y_m, z_m = links.device_m[links.device_names.index(name)].tolist()
        device = devices.get(name)
        if device is None:
            within = bounds[0] <= x_m <= bounds[1] and bounds[2] <= y_m <= bounds[3]
            if not within or scene.city.inside(np.array([[x_m, y_m, z_m]]))[0]:
                changes.append(f"{name} has a {antenna.kind}, and is not in the scene: it stands "
                               "outside the extent or in a building")
                continue
            try:
                device = DeviceConfig(device=name, x_m=round(x_m, 2), y_m=round(y_m, 2),
                                      z_m=round(z_m, 2), role="anchor")
            except ValidationError:  # names and heights in measurements are not restricted
                changes.append(f"{name!r} has a {antenna.kind}, and is not in the scene: scene.toml"
                               " has devices above z = 0, whose names are of letters, digits and "
                               "_.+-")
                continue
        others = Names(Path(each.antenna).stem.lower() for each in devices.values()
                       if each.antenna is not None and each.device != name)
        file = f"{ANTENNAS}/{others.unique(f'found_{safe_name(name)}')}.csv"
        azimuth_deg = round(antenna.azimuth_deg % 360, DECIMALS)
        devices[name] = device.model_copy(update={
            "antenna": file, "azimuth_deg": azimuth_deg, "tilt_deg": None})
        files[file] = antenna
        changes.append(f"{name} has a {antenna.kind} that looks to {azimuth_deg:.0f}° and is "
                       f"{antenna.beamwidth_deg:.0f}° wide")
    return config.model_copy(update={"devices": list(devices.values())}), files, changes


def _write_antenna(antenna: FoundAntenna, path: Path) -> None:
    """Write an antenna pattern relative to its boresight, normalised to a mean power gain of 1."""
    elevation, azimuth = (axis.ravel() for axis in np.meshgrid(ELEVATION_DEG, AZIMUTH_DEG,
                                                               indexing="ij"))
    gain_db = antenna.gain_db(azimuth, elevation)
    weight = np.cos(np.radians(elevation))
    mean = (weight @ 10 ** (gain_db / 10)) / weight.sum()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(pd.DataFrame({
        "azimuth_deg": azimuth, "elevation_deg": elevation,
        "gain_dbi": np.round(gain_db - 10 * np.log10(mean), DECIMALS)}), path)


def _stretch(roof: Roof, base_m: float) -> float:
    """Return the ratio of a building's corrected height over its base [m] to that on the map."""
    return 1.0 + roof.true_offset_m / max(roof.height_m - base_m, abs(roof.true_offset_m))


def _corrected_buildings(scene: Scene, shapes_of: dict[int, set[str]], left: set[str],
                        roofs: list[Roof], base_m: np.ndarray) -> pd.DataFrame | None:
    """Return the corrected `buildings.csv` of a scene, as texts; None if the scene has none.

    Rows of shapes that are not `left` in the corrected scene are dropped.
    """
    path = scene.folder / "buildings.csv"
    if not path.is_file():
        return None
    table = read_cells(require_within(scene.folder, path, str(scene.folder)))
    if "shape" not in table:
        return table
    table = table[table["shape"].isin(left)].reset_index(drop=True)
    if not {"top_m", "height_from", "height_sd_m"} <= set(table.columns):
        return table
    top_m = as_numbers(table["top_m"])
    for roof in roofs:
        foot_m = float(base_m[roof.building])
        for row in np.flatnonzero(table["shape"].isin(shapes_of[roof.building])):
            raised_m = foot_m + _stretch(roof, foot_m) * (top_m[row] - foot_m)
            table.loc[row, ["top_m", "height_from", "height_sd_m"]] = [
                f"{raised_m:.3f}", SOURCE, f"{max(roof.offset_sd_m, MIN_SD_M):.1f}"]
    return table


def check_corrected_target(folder: Path, scene: Scene | None, report_folder: Path) -> None:
    """Check, before the loop runs, that a corrected scene can be written to a folder.

    Args:
        folder: folder of the corrected scene.
        scene: declared scene; None if none was given.
        report_folder: folder of the loop's report.

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
    """Write a copy of the scene with buildings, roofs, anchors and antennas as the loop found them.

    Args:
        loop: loop with its effects.
        scene: declared scene of the loop.
        folder: folder to write; a scene in it is replaced.

    Returns:
        a sentence for each correction; without corrections nothing is written.

    Raises:
        BadInput: the folder cannot be written or holds something else, or the result is no scene.
    """
    links = loop.after.whole.links
    found = [each.correction(links) for each in loop.after.whole.effects]
    label, centres_m = buildings(scene.city)
    gone = [building for each in found for building in each.gone]
    keep = ~np.isin(label, gone)
    city = scene.city.without(~keep) if keep.any() else None
    config, moves = _moved(found, links, scene, city)
    free_m = np.array([*((d.x_m, d.y_m, d.z_m) for d in config.devices),
                       *((x_m, y_m, scene.altitude_m(x_m, y_m, uav.altitude_m))
                         for uav in config.uavs
                         for x_m, y_m in ((uav.start_x_m, uav.start_y_m),
                                          (uav.terminal_x_m, uav.terminal_y_m)))])
    boxes = [_pulled_back(box, free_m.reshape(-1, 3) - [
                 0.0, 0.0, float(scene.city.ground_height_m(*box[:2]))])
             for each in found for box in each.boxes]
    changes = [f"a box of {box.length_m:.0f} x {box.width_m:.0f} m, {box.height_m:.0f} m high, "
               f"stands at ({box.x_m:.0f}, {box.y_m:.0f}) m" for box in boxes]
    above_m = centres_m[:, 2] - scene.city.ground_height_m(*centres_m[:, :2].T)
    changes += ["the building at ({:.0f}, {:.0f}) m, {:.0f} m high, is taken out".format(
        *centres_m[building, :2], above_m[building]) for building in gone]
    roofs = [roof for each in found for roof in each.roofs if roof.building not in gone]
    changes += [f"the roof at ({roof.x_m:.0f}, {roof.y_m:.0f}) m is "
                f"{above_m[roof.building] + roof.true_offset_m:.1f} m high, and "
                f"{above_m[roof.building]:.1f} m on the map"
                for roof in roofs]
    config, antennas, declared = with_antennas(config, found, links, scene)
    changes += moves + declared
    if not changes:
        return []
    check_target(folder, CONTENT)
    earlier = config.provenance.get("corrected")
    corrected = "; ".join(([earlier] if earlier else []) + changes)
    provenance = config.provenance | {"corrected": corrected}
    with atomic_folder(folder) as temporary:
        base_m = building_extents_m(scene.city, label)[0][:, 2]
        shapes_of, left = _write_city(scene, temporary, keep, boxes, roofs, base_m)
        table = _corrected_buildings(scene, shapes_of, left, roofs, base_m)
        if table is not None:
            write_csv(table, temporary / "buildings.csv")
        scene.copy_antennas(temporary)
        scene.copy(STREETS, temporary)
        for file, antenna in antennas.items():
            _write_antenna(antenna, temporary / file)
        write_config(config.model_copy(update={"provenance": provenance}), temporary / "scene.toml")
        draw_preview(Scene.load(temporary), temporary / "preview.png")
    return changes


def _moved(found: Sequence[Correction], links: Links, scene: Scene,
           city: CityMap | None) -> tuple[SceneConfig, list[str]]:
    """Move anchors to their corrected positions, or the nearest ones outside of buildings."""
    found_m: dict[str, np.ndarray] = {}
    for each in found:
        for row, move_m in each.moves_m.items():
            name = links.device_names[row]
            found_m[name] = found_m.get(name, links.device_m[row, :2]) + move_m
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
    """Return the position within the extent and outside buildings nearest to a position (2,) [m].

    The device keeps its height above ground. None if there is none within `MAX_SHIFT_M`.
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
    free = z_m > 0  # scene.toml requires it
    if city is not None:
        for aside_m in CLEARANCE_M * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]):
            free &= ~city.inside(np.column_stack([tried_m + aside_m, z_m]))
    if not free.any():
        return None
    nearest = int(free.argmax())
    return float(tried_m[nearest, 0]), float(tried_m[nearest, 1]), float(z_m[nearest])


def _pulled_back(box: Box, points_m: np.ndarray) -> Box:
    """Shrink a box until no point (n, 3) is within `CLEARANCE_M` of it [m].

    For each point the side is moved that costs the least volume, never the bottom.
    """
    axes = box.axes
    high = np.array([0.5 * box.length_m, 0.5 * box.width_m, box.height_m])
    low = np.array([-high[0], -high[1], 0.0])
    for point in np.column_stack([(points_m[:, :2] - (box.x_m, box.y_m)) @ axes.T, points_m[:, 2]]):
        if (point <= low - CLEARANCE_M).any() or (point >= high + CLEARANCE_M).any():
            continue
        choices = []
        for axis, side in ((0, low), (0, high), (1, low), (1, high), (2, high)):  # not the bottom
            pulled = side.copy()
            pulled[axis] = point[axis] + (CLEARANCE_M if side is low else -CLEARANCE_M)
            choices.append((pulled, high) if side is low else (low, pulled))
        low, high = max(choices, key=lambda choice: np.prod(np.maximum(choice[1] - choice[0], 0.0)))
    x_m, y_m = 0.5 * (low + high)[:2] @ axes + (box.x_m, box.y_m)
    length_m, width_m = (high - low)[:2]
    return Box(x_m, y_m, length_m, width_m, high[2], box.turn_deg)


def _write_city(scene: Scene, folder: Path, keep: np.ndarray, boxes: list[Box],
                roofs: list[Roof], base_m: np.ndarray) -> tuple[dict[int, set[str]], set[str]]:
    """Write `city.xml` and `meshes/` with the faces `keep` (f,), corrected roofs and added boxes.

    Returns:
        names of the declared shapes by building; names of those that still have a face.
    """
    label, shapes, first = buildings(scene.city)[0], [], 0
    shapes_of: dict[int, set[str]] = {}
    for shape in read_city(scene.xml_path):
        part = slice(first, first + len(shape.mesh.faces))
        kept, first = keep[part], part.stop
        for building in np.unique(label[part]).tolist():
            shapes_of.setdefault(building, set()).add(shape.name)
        shape = replace(shape, mesh=_with_roofs(shape.mesh, label[part], roofs, base_m))
        if kept.all():
            shapes.append(shape)
        elif kept.any():
            used, faces = np.unique(shape.mesh.faces[kept], return_inverse=True)
            mesh = trimesh.Trimesh(shape.mesh.vertices[used], faces.reshape(-1, 3), process=False)
            shapes.append(replace(shape, mesh=mesh))
    taken = Names(name.lower() for shape in shapes for name in (shape.name, shape.material.name))
    write_city(folder, [*shapes, *_box_shapes(scene, boxes, taken)])
    return shapes_of, {shape.name for shape in shapes}


def _with_roofs(mesh: trimesh.Trimesh, label: np.ndarray, roofs: list[Roof],
                base_m: np.ndarray) -> trimesh.Trimesh:
    """Stretch the buildings of a mesh vertically to their corrected roof heights.

    The mesh may have a building's roof without its walls; `label` (f,) is the building of a face.
    """
    vertices_m = np.array(mesh.vertices, dtype=float)
    for roof in roofs:
        rows = np.unique(mesh.faces[label == roof.building])
        if len(rows):
            foot_m = float(base_m[roof.building])
            vertices_m[rows, 2] = foot_m + _stretch(roof, foot_m) * (vertices_m[rows, 2] - foot_m)
    return trimesh.Trimesh(vertices_m, mesh.faces, process=False)


def _box_shapes(scene: Scene, boxes: list[Box], taken: Names) -> list[CityShape]:
    """Return shapes of boxes, from the map's lowest point up; their names are not in `taken`."""
    name = taken.unique(f"found_{BOX_MATERIAL}")
    material = traceable(itu_material(BOX_MATERIAL, name=name), scene.config.radio.frequency_hz)
    bottom_m = min(float(scene.city.vertices[:, 2].min()), 0.0)
    shapes = []
    for box in boxes:
        turned = trimesh.transformations.rotation_matrix(np.radians(box.turn_deg), (0, 0, 1))
        top_m = float(scene.city.ground_height_m(box.x_m, box.y_m)) + box.height_m
        turned[:3, 3] = box.x_m, box.y_m, 0.5 * (bottom_m + top_m)
        mesh = trimesh.creation.box((box.length_m, box.width_m, top_m - bottom_m), turned)
        shapes.append(CityShape(taken.unique("found_box"), mesh, material))
    return shapes
