"""Findings about a city, and the checks of its geometry: axis, units, ground, open meshes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from radiotwin.scene.surfaces import Surfaces

Severity = Literal["error", "warning", "fixed"]
# No city has a median above it (San Francisco's centre 11 m, Munich's 16 m), but 60 feet are six
# storeys. Low-rise cities in feet stay below and are not noticed.
MAX_MEDIAN_M = 60.0  # of heights
HIGH_M = 10.0  # above z = 0: the lowest point of a city that is not raised on purpose is lower
_TO_Z_UP = {  # rotation that makes the axis point up
    "x": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=float),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float),
    "z": np.eye(3),
}


@dataclass(frozen=True)
class Problem:
    """One finding.

    Attributes:
        severity: `error`: tracing would fail; `warning`: tracing works, but the result may not be
            the intended one; `fixed`: corrected in the scene that is written.
        shape: Name of the shape or material concerned, or "" for the whole city.
        message: What was found, and what to do or what was done.
    """

    severity: Severity
    shape: str
    message: str


def error(message: str, shape: str = "") -> Problem:
    """Return a finding that makes tracing fail."""
    return Problem("error", shape, message)


def warning(message: str, shape: str = "") -> Problem:
    """Return a finding that leaves the scene traceable but may not be intended."""
    return Problem("warning", shape, message)


def fixed(message: str, shape: str = "") -> Problem:
    """Return a finding that has been corrected."""
    return Problem("fixed", shape, message)


def listed(names: Sequence[str]) -> str:
    """Return `'a', 'b', 'c' and 7 more`: names for a message about many shapes at once."""
    text = ", ".join(map(repr, names[:3]))
    return text if len(names) <= 3 else f"{text} and {len(names) - 3} more"


def upright(vertices: np.ndarray, up: str) -> np.ndarray:
    """Return coordinates (v, 3) rotated so that the axis x, y or z becomes z; x stays if it can."""
    return vertices @ _TO_Z_UP[up].T


def check_up_axis(surfaces: Surfaces, ground: np.ndarray) -> list[Problem]:
    """Return an error if there is no ground (f,) with z up, but there is one with another axis up.

    Without any ground, the city seems to lie on its side if five or more parts are much taller than
    the whole city is wide in one direction.
    """
    if ground.any():
        return []
    size = np.ptp(surfaces.vertices, axis=0)
    for index, axis in ((1, "y"), (0, "x")):
        turned = Surfaces([(upright(surfaces.vertices, axis), surfaces.faces)])
        on_side = surfaces.parts >= 5 and size[index] < 0.5 * np.delete(size, index).min()
        if on_side or _has_ground_below(turned):
            return [error(f"the axis {axis} seems to point up, not z (the city measures "
                          f"{size[0]:.4g} × {size[1]:.4g} × {size[2]:.4g} along x, y, z); turn it "
                          f"with --up {axis}, or keep it as it is with --up z")]
    return []


def _has_ground_below(surfaces: Surfaces) -> bool:
    """Return whether ground covers most of the plane below all else; a screen in a room is none."""
    ground = surfaces.ground_faces()
    size = np.ptp(surfaces.vertices, axis=0)
    covered = np.abs(surfaces.area_vectors[ground, 2]).sum()
    if covered < 0.8 * size[0] * size[1] or not ground.any():
        return False
    lowest = surfaces.vertices[:, 2].min()
    ground_lowest = surfaces.vertices[surfaces.faces[ground], 2].min()
    return (ground_lowest <= lowest + 0.02 * size[2]
            and surfaces.level_m(ground) < lowest + 0.4 * size[2])


def check_units(surfaces: Surfaces) -> list[Problem]:
    """Return warnings if sizes look like feet or kilometres, an error if no unit makes sense."""
    low, high = surfaces.part_bounds()
    heights = (high - low)[surfaces.wall_share > 0.1, 2]  # of parts that have walls
    width = float(np.ptp(surfaces.vertices[:, :2], axis=0).max())
    if width > 100e3:  # wider than any city
        return [error(f"the city is {width / 1000:.4g} km wide if its unit is the metre; a shape "
                      "may lie far away from the others, or the unit is smaller (millimetres: "
                      "--scale 0.001)")]
    if len(heights) == 0:
        return []
    median, tallest = float(np.median(heights)), float(heights.max())
    # In kilometres the tallest building that exists is 0.83, in metres no building is that low
    if tallest < 1.0 and width < 100.0:
        return [warning(f"the tallest building is {tallest:.3g} m and the city {width:.3g} m wide; "
                        "if that is kilometres, convert with --scale 1000, if it is right say "
                        "--scale 1")]
    if median > MAX_MEDIAN_M and len(heights) > 1:
        unit, metres = next((unit, metres) for unit, metres, least_m in (
            ("millimetres", 0.001, 3000), ("centimetres", 0.01, 500), ("feet", 0.3048, 0))
            if median > least_m)
        return [warning(f"half of the buildings are taller than {median:.0f} m; if that is {unit}, "
                        f"convert with --scale {metres}, if it is right say --scale 1")]
    return []


def check_ground(ground: np.ndarray, surfaces: Surfaces) -> list[Problem]:
    """Return a warning if no face (f,) is ground."""
    if ground.any():
        return []
    lowest_m = surfaces.vertices[:, 2].min()
    high = (", so that buildings hang in the air: if heights are elevations, subtract the ground's"
            if lowest_m > HIGH_M else "")
    return [warning("there is no ground: no ground reflections will be traced, and z = 0 is taken "
                    f"as the ground datum (the lowest point is at {lowest_m:.2f} m{high}); add a "
                    "plane to the file")]


def check_closed(surfaces: Surfaces, ground: np.ndarray, names: Sequence[str]) -> list[Problem]:
    """Return a warning about open meshes beside the ground, and about roofs apart from walls."""
    found = []
    opened = np.zeros(surfaces.shapes, dtype=bool)
    opened[surfaces.shape[surfaces.free_edges[1]]] = True
    opened[surfaces.shape[ground]] = False
    if opened.any():
        leaky = [names[int(index)] for index in np.flatnonzero(opened)]
        found.append(warning(
            f"{len(leaky)} of {surfaces.shapes} meshes are not watertight ({listed(leaky)}). Open "
            "bottoms, and roofs apart from walls, do no harm: what is inside is found by looking "
            "upwards. Holes in walls or roofs let rays in"))
    seams = np.unique(surfaces.seams())
    if len(seams):
        which = listed([names[int(index)] for index in seams])
        found.append(warning(
            f"{len(seams)} meshes are roofs and walls of different materials that meet in an edge "
            f"({which}). Sionna RT takes such an edge for two free edges of thin sheets: nothing "
            "diffracts there, or, with its edge diffraction on, as over a knife edge instead of a "
            "corner. With one material, for example --material metal=itu_marble, they are joined "
            "and diffract correctly"))
    return found
