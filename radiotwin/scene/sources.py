"""Sources of a city: a file, or a scene inside the installed sionna-rt package."""

import os
import re
from importlib.util import find_spec
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.scene.models import UP_AXES

MAP_SUFFIXES = ".osm, .osm.pbf, .geojson, .gpkg, .parquet, .shp, .zip, .city.json, .gml"


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
