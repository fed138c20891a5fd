"""Export of a scene's city: XML and PLY for Sionna RT and Mitsuba, glTF, OBJ."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trimesh

from radiotwin.errors import BadInput
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_folder, atomic_path
from radiotwin.scene import Scene
from radiotwin.scene.build import check_target
from radiotwin.scene.folder import CityShape, read_city, write_city
from radiotwin.scene.materials import Material

_MODEL_SUFFIXES = (".glb", ".gltf", ".obj")
# Axes of glTF 2.0 (section 3.4): y up
Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=float)
# RGB of ITU materials, as they look
_COLOURS = {"concrete": (178, 178, 178), "brick": (170, 90, 70), "wood": (160, 120, 75),
            "glass": (150, 195, 215), "metal": (120, 125, 135), "marble": (215, 205, 190),
            "asphalt_concrete": (95, 95, 95), "wet_ground": (100, 85, 60),
            "medium_dry_ground": (140, 120, 85), "very_dry_ground": (190, 170, 120)}


def export_scene(scene: Scene, out: Path | str) -> None:
    """Write a scene's city in the format of the output's suffix.

    A folder: `city.xml` and `meshes/*.ply`, which `sionna.rt.load_scene` loads, and `devices.csv`.
    `NAME.glb` or `NAME.gltf`: glTF 2.0, y up, with everything in one file. `NAME.obj`: z up, with
    its materials in `NAME.mtl`.

    Args:
        scene: Scene to export.
        out: Folder or file to write.

    Raises:
        BadInput: An unknown suffix, a folder that holds something else, or an output that cannot be
            written.
    """
    out = Path(out)
    if out.suffix.lower() in _MODEL_SUFFIXES:
        write = _write_obj if out.suffix.lower() == ".obj" else _write_gltf
        write(read_city(scene.xml_path), out)
        return
    if out.suffix:
        raise BadInput(f"{out}: unknown format {out.suffix!r}; allowed are a folder (XML and PLY), "
                       f"{', '.join('NAME' + suffix for suffix in _MODEL_SUFFIXES)}")
    check_target(out, {"city.xml", "meshes", "devices.csv"}, mark="devices.csv")
    shapes = read_city(scene.xml_path)
    with atomic_folder(out) as folder:
        write_city(folder, shapes)
        devices = pd.DataFrame([device.model_dump() for device in scene.config.devices],
                               columns=["device", "x_m", "y_m", "z_m", "role"])
        write_csv(devices, folder / "devices.csv")


def _colour(material: Material) -> tuple[int, int, int]:
    """Return the RGB colour of a material; grey if its ITU type has none."""
    itu = material.itu or material.name.removesuffix("-fixed").removeprefix("own-")
    return _COLOURS.get(itu, (165, 165, 165))


def _write_gltf(shapes: list[CityShape], path: Path) -> None:
    """Write glTF 2.0 (y up) with one coloured mesh per shape, and everything in one file."""
    model = trimesh.Scene()
    for shape in shapes:
        mesh = shape.mesh.copy()
        mesh.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(
            name=shape.material.name, baseColorFactor=[*_colour(shape.material), 255],
            metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True))
        mesh.apply_transform(Y_UP)
        model.add_geometry(mesh, node_name=shape.name, geom_name=shape.name)
    options: dict[str, Any] = {"include_normals": False, "tree_postprocessor": (
        lambda tree: tree["asset"].update(generator="radiotwin"))}
    if path.suffix.lower() == ".glb":
        data = trimesh.exchange.gltf.export_glb(model, **options)
    else:
        data = trimesh.exchange.gltf.export_gltf(model, embed_buffers=True, **options)["model.gltf"]
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _write_obj(shapes: list[CityShape], path: Path) -> None:
    """Write an OBJ file (z up) with one object per shape, and its colours as `.mtl`."""
    lines, first = ["# radiotwin", f"mtllib {path.stem}.mtl"], 1
    for shape in shapes:
        lines += [f"o {shape.name}", f"usemtl {shape.material.name}"]
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in shape.mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in shape.mesh.faces + first]
        first += len(shape.mesh.vertices)
    colours = {shape.material.name: _colour(shape.material) for shape in shapes}
    library = ["# radiotwin", *(line for name, rgb in colours.items()
               for line in (f"newmtl {name}",
                            "Kd " + " ".join(f"{value / 255:.3f}" for value in rgb), ""))]
    with atomic_path(path) as model, atomic_path(path.with_suffix(".mtl")) as colour_file:
        # Both are renamed only when both are written
        model.write_text("\n".join(lines) + "\n", encoding="utf-8")
        colour_file.write_text("\n".join(library) + "\n", encoding="utf-8")
