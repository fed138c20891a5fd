"""The folder of a scene: what may be replaced in it, and a copy of it."""

from __future__ import annotations

import filecmp
import os
import shutil
import warnings
from collections.abc import Set
from pathlib import Path
from typing import TYPE_CHECKING

from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder
from radiotwin.inputs import is_within, read_bytes, require_within
from radiotwin.scene.config import DeviceConfig, UavConfig, write_config
from radiotwin.scene.reader import read_city
from radiotwin.scene.writer import write_city

if TYPE_CHECKING:
    from radiotwin.scene.scene import Scene

EARLIER = "scene.toml.old"  # the declarations that a new scene replaced
SCENE_FILES = frozenset({"scene.toml", EARLIER, "city.xml", "meshes", "preview.png",
                         "buildings.csv"})
COPIED = ("buildings.csv",)  # beside what is written anew


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
