"""Folders of scenes: replaced, copied, published; and sources of cities.

The folder of a scene: what may be replaced in it, and a copy of it.

The published scenes, with their ray-traced radio maps: where they are on this machine.

Sources of a city: a file, or a scene inside the installed sionna-rt package.
"""

from __future__ import annotations

import filecmp
import os
import re
import shutil
import warnings
from collections.abc import Set
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_folder
from radiotwin.io.inputs import is_within, read_bytes, require_within
from radiotwin.scene.city_files import read_city, write_city
from radiotwin.scene.config import DeviceConfig, UavConfig, write_config
from radiotwin.scene.models import UP_AXES

if TYPE_CHECKING:
    from radiotwin.scene.scene import Scene

EARLIER = "scene.toml.old"  # the declarations that a new scene replaced
SCENE_FILES = frozenset({"scene.toml", EARLIER, "city.xml", "meshes", "preview.png",
                         "buildings.csv"})
COPIED = ("buildings.csv",)  # beside what is written anew
MAP_SUFFIXES = ".osm, .osm.pbf, .geojson, .gpkg, .parquet, .shp, .zip, .city.json, .gml"


def files_of(scene: Scene) -> list[Path]:
    """Return the files and folders that a scene is read from, and its tables."""
    ends: list[DeviceConfig | UavConfig] = [*scene.config.devices, *scene.config.uavs]
    names = SCENE_FILES | {end.antenna for end in ends if end.antenna is not None}
    return [scene.folder / name for name in sorted(names)]


def check_target(folder: Path, allowed: Set[str] = SCENE_FILES, source: Path | None = None) -> None:
    """Raise BadInput if writing the folder would erase something else.

    Args:
        folder: Folder to write.
        allowed: Names that it may hold.
        source: File that must not lie in it.
    """
    try:
        held = os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        held = []
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise BadInput(f"cannot write {folder}: {getattr(error, 'strerror', None) or error}; "
                       "choose another output folder") from None
    foreign = sorted(set(held) - allowed)
    if foreign:
        raise BadInput(f"{folder} holds {', '.join(foreign[:5])}, which the new content would "
                       "erase; move it away or choose another output folder")
    if source is not None and is_within(source, folder):
        raise BadInput(f"{source} lies in {folder}, which the new scene would replace; choose "
                       "another output folder")


def keep_declarations(folder: Path, new: Path) -> None:
    """Keep the `scene.toml` that a scene replaces, where it is another: it may have been edited.

    Args:
        folder: that is replaced.
        new: folder with the new `scene.toml`; gets the one before as `scene.toml.old`.

    Warns:
        There was another.
    """
    before = folder / "scene.toml"
    if before.is_file() and not filecmp.cmp(before, new / "scene.toml", shallow=False):
        shutil.copyfile(before, new / EARLIER)
        warnings.warn(f"{folder} held a scene with other declarations; its scene.toml is kept as "
                      f"{EARLIER}", stacklevel=3)
    elif (folder / EARLIER).is_file():
        shutil.copyfile(folder / EARLIER, new / EARLIER)


def copy_scene(scene: Scene, folder: Path) -> None:
    """Write a copy of a scene folder; see `Scene.save`.

    Its preview and what tracing left in it are not copied.

    Args:
        scene: to copy.
        folder: to write; a scene that is already in it is replaced.
    """
    if is_within(scene.folder, folder):
        raise BadInput(f"{folder} holds the scene itself, which the copy would replace; choose "
                       "another folder")
    ends: list[DeviceConfig | UavConfig] = [*scene.config.devices, *scene.config.uavs]
    antennas = {Path(end.antenna).parts[0] for end in ends if end.antenna is not None}
    check_target(folder, SCENE_FILES | antennas)
    with atomic_folder(folder) as temporary:
        write_city(temporary, read_city(scene.xml_path))
        scene.copy_antennas(temporary)
        write_config(scene.config, temporary / "scene.toml")
        for name in COPIED:
            path = scene.folder / name
            if path.is_file():
                require_within(scene.folder, path, str(scene.folder))
                (temporary / name).write_bytes(read_bytes(path, "file of a scene"))


def published_scene(name: str) -> Path:
    """Return the folder of a published scene.

    The scene in the folder `scenes` of the working directory comes first, then that of the source
    tree that the package was imported from, then the copy inside an installed package.

    Args:
        name: `rbm` or `rdm`.

    Returns:
        The first of these folders that exists; `scenes/NAME` where none does, so that the message
        of a missing scene names it.
    """
    package = Path(__file__).parents[1]
    here = Path("scenes") / name
    candidates = (here, package.parent / here, package / here)
    return next((folder for folder in candidates if (folder / "scene.toml").is_file()), here)


def sionna_scenes() -> dict[str, Path]:
    """Return the XML files of the scenes in sionna-rt by name, without importing it."""
    spec = find_spec("sionna")
    roots = [] if spec is None else spec.submodule_search_locations or []
    return {path.parent.name: path for root in roots
            for path in sorted((Path(root) / "rt" / "scenes").glob("*/*.xml"))
            if path.stem == path.parent.name}


def find_source(source: Path | str) -> Path:
    """Return the file of a source.

    Args:
        source: A path, or `sionna:NAME`.

    Raises:
        BadInput: Unknown name (the message lists the known ones), no such file, or neither XML nor
            a model.
    """
    text = str(source)
    if text.startswith("sionna:"):
        scenes = sionna_scenes()
        if not scenes:
            raise BadInput(f"{text}: no scenes of sionna-rt were found; install it with "
                           "`pip install sionna-rt`")
        name = text.removeprefix("sionna:")
        if name not in scenes:
            raise BadInput(f"{text}: sionna-rt has no scene {name!r}; it has: {', '.join(scenes)}")
        return scenes[name]
    path = Path(source)
    if not os.path.isfile(path):  # unlike Path, False for an impossible name, too
        raise BadInput(f"{path} is not a file; give a map, a Mitsuba or Sionna RT scene (.xml), a "
                       f"model ({', '.join(UP_AXES)}), or "
                       "sionna:NAME with one of: "
                       f"{', '.join(sionna_scenes()) or '(sionna-rt is not installed)'}")
    if path.suffix.lower() not in (".xml", *UP_AXES):
        raise BadInput(f"{path}: '{path.suffix}' is not read; give a map ({MAP_SUFFIXES}), a "
                       f"Mitsuba or Sionna RT scene (.xml), or a model ({', '.join(UP_AXES)})")
    return path


def scene_name(source: Path | str) -> str:
    """Return the name of a source's scene, in the characters that `scene.toml` allows.

    >>> scene_name("sionna:munich"), scene_name("data/My city.xml")
    ('munich', 'My_city')
    """
    text = str(source)
    name = text.removeprefix("sionna:") if text.startswith("sionna:") else Path(source).stem
    return re.sub(r"[^A-Za-z0-9_.+-]", "_", name).lstrip(".")[:64] or "city"


def source_text(source: Path | str) -> str:
    """Return a source for `scene.toml`, with an escape for each byte that is not UTF-8."""
    return str(source).encode("utf-8", "backslashreplace").decode("utf-8")
