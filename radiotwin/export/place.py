"""Whether a radio map is of a scene's place."""

import warnings
from typing import Any

from radiotwin.errors import BadInput
from radiotwin.scene import Scene

MAX_ORIGIN_DIFFERENCE = 1e-6  # [degrees, or metres of altitude] of one place, after rounding


def check_map_place(name: str, attributes: dict[str, Any], scene: Scene) -> None:
    """Refuse a map of another city, which would get the outlines and the origin of this one.

    Args:
        name: of the map in messages.
        attributes: of the map.
        scene: that is given with it.

    Raises:
        BadInput: their origins differ.
    """
    origin = scene.config.origin
    for key, value in ({} if origin is None else origin.model_dump()).items():
        of_map = attributes.get(f"origin_{key}", value)
        if abs(of_map - value) > MAX_ORIGIN_DIFFERENCE:
            raise BadInput(f"{name} is a map of another place: its origin's {key} is {of_map:g}, "
                           f"that of {scene.folder} is {value:g}; give the scene that it was made "
                           "for, or trace again")
    if attributes.get("scene_hash") not in (None, scene.content_hash()):
        warnings.warn(f"{name} was made for another scene than {scene.folder}, or that has changed "
                      "since: outlines, devices and the origin are those of the scene",
                      stacklevel=3)
