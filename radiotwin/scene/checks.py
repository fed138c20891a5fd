"""Checks of a city's geometry (up axis, units, ground, open meshes), and `Problem`s they report."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from radiotwin.scene.surfaces import Surfaces

Severity = Literal["error", "warning", "fixed"]
# Median building height [m] above which the unit is doubted: no city reaches it (San Francisco's
# centre 11 m, Munich 16 m), but a city of six storeys has 60 feet. Lower cities in feet pass.
MAX_MEDIAN_M = 60.0
HIGH_M = 10.0  # [m]: if a city without ground lies higher than this, its z may be elevations
_TO_Z_UP = {  # rotation that makes the axis point up
    "x": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=float),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float),
    "z": np.eye(3),
}


@dataclass(frozen=True)
class Problem:
    """A problem of a city, with its remedy.

    Attributes:
        severity: `error`: tracing would fail; `warning`: tracing works, but the result may not be
            the intended one; `fixed`: corrected in the scene that is written.
        message: The problem, and what to do or what was done about it.
        shape: Name of the shape or material concerned, or "" for the whole city.
    """

    severity: Severity
    message: str
    shape: str = ""


error = partial(Problem, "error")
warning = partial(Problem, "warning")
fixed = partial(Problem, "fixed")


def listed(names: Sequence[str]) -> str:
    """Format names for a message: all of up to three, else `'a', 'b', 'c' and 7 more`."""
    text = ", ".join(map(repr, names[:3]))
    return text if len(names) <= 3 else f"{text} and {len(names) - 3} more"


def upright(vertices: np.ndarray, up: str) -> np.ndarray:
    """Rotate coordinates (v, 3) so that the axis `up` (x, y or z) becomes z."""
    return vertices @ _TO_Z_UP[up].T


def check_up_axis(surfaces: Surfaces, ground: np.ndarray) -> list[Problem]:
    """Return an error if the axis x or y seems to point up instead of z.

    This is so if no face is ground (`ground`, (f,) bool), but some would be with the other axis up;
    or if the city has five or more parts and is less than half as wide along that axis as along
    both others.
    """
    if ground.any():
        return []
    sides = np.ptp(surfaces.vertices, axis=0)
    for index, axis in ((1, "y"), (0, "x")):
        turned = Surfaces([(upright(surfaces.vertices, axis), surfaces.faces)])
        on_side = surfaces.parts >= 5 and sides[index] < 0.5 * np.delete(sides, index).min()
        if on_side or _has_ground_below(turned):
            return [error(f"the axis {axis} seems to point up, not z (the city measures "
                          f"{sides[0]:.4g} × {sides[1]:.4g} × {sides[2]:.4g} along x, y, z); "
                          f"turn it with --up {axis}, or keep it as it is with --up z")]
    return []


def _has_ground_below(surfaces: Surfaces) -> bool:
    """Return whether ground covers 80 % of the city's plan and lies at its lowest level.

    The level distinguishes ground from a flat surface high up, such as a screen in a room.
    """
    ground = surfaces.ground_faces()
    sides = np.ptp(surfaces.vertices, axis=0)
    covered = np.abs(surfaces.area_vectors[ground, 2]).sum()
    if covered < 0.8 * sides[0] * sides[1] or not ground.any():
        return False
    lowest = surfaces.vertices[:, 2].min()
    ground_lowest = surfaces.vertices[surfaces.faces[ground], 2].min()
    return (ground_lowest <= lowest + 0.02 * sides[2]
            and surfaces.level_m(ground) < lowest + 0.4 * sides[2])


def check_units(surfaces: Surfaces) -> list[Problem]:
    """Return an error if a city is wider than 100 km, a warning if it seems not to be in metres.

    Only parts with walls count. It looks like kilometres if none is 1 m tall and the city narrower
    than 100 m; like feet, centimetres or millimetres if half of them are taller than
    `MAX_MEDIAN_M`.
    """
    low, high = surfaces.part_bounds()
    heights = (high - low)[surfaces.wall_share > 0.1, 2]  # of parts with walls
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
    """Return a warning if no face is ground (`ground`, (f,) bool)."""
    if ground.any():
        return []
    lowest_m = surfaces.vertices[:, 2].min()
    high = (", so that buildings hang in the air: if heights are elevations, subtract the ground's"
            if lowest_m > HIGH_M else "")
    return [warning("there is no ground: no ground reflections will be traced, and z = 0 is taken "
                    f"as the ground datum (the lowest point is at {lowest_m:.2f} m{high}); add a "
                    "plane to the file")]


def check_closed(surfaces: Surfaces, ground: np.ndarray, names: Sequence[str]) -> list[Problem]:
    """Return warnings about meshes with holes, and about roofs not joined to their walls.

    The ground may be open: `ground`, (f,) bool, are its faces.
    """
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
