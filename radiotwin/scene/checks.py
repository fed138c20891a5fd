"""What about a city's geometry looks wrong: axis, units, ground, open meshes."""

from collections.abc import Sequence

import numpy as np

from radiotwin.scene.problems import Problem, listed
from radiotwin.scene.surfaces import Surfaces

# A median building above 60 m is found in no city (San Francisco's centre 11 m, Munich's 16 m), but 60 feet
# are six storeys. Low-rise cities in feet stay below and are not noticed.
FEET_MEDIAN_HEIGHT = 60.0
# In kilometres the tallest building that exists is 0.83, in metres no building is that low.
KILOMETRE_TALLEST = 1.0
KILOMETRE_EXTENT = 100.0
ABSURD_EXTENT_M = 100e3

_AXES = {  # rotation that makes the axis point up
    "x": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=float),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float),
    "z": np.eye(3),
}


def upright(vertices: np.ndarray, up: str) -> np.ndarray:
    """Turn (v, 3) coordinates so that the axis `up` becomes z; x stays x where it can."""
    return vertices @ _AXES[up].T


def building_heights(surfaces: Surfaces) -> np.ndarray:
    """Height of each part that has walls, from its lowest to its highest point."""
    low, high = surfaces.part_bounds()
    return (high - low)[surfaces.wall_share > 0.1, 2]


def check_up_axis(surfaces: Surfaces, ground: np.ndarray) -> list[Problem]:
    """An error when there is no ground with z up, but there is one with another axis up.

    Without any ground: when five or more parts are much taller than the whole city is wide one way, as when a
    city lies on its side.
    """
    if ground.any():
        return []
    size = np.ptp(surfaces.vertices, axis=0)
    for index, axis in ((1, "y"), (0, "x")):
        turned = Surfaces([(upright(surfaces.vertices, axis), surfaces.faces)])
        lies = surfaces.parts >= 5 and size[index] < 0.5 * np.delete(size, index).min()
        if lies or _has_ground_below(turned):
            return [
                Problem(
                    "error",
                    "",
                    f"the axis {axis} seems to point up, not z (the city measures {size[0]:.4g} × "
                    f"{size[1]:.4g} × {size[2]:.4g} along x, y, z); turn it with --up {axis}, or keep it as "
                    "it is with --up z",
                )
            ]
    return []


def _has_ground_below(surfaces: Surfaces) -> bool:
    """Whether there is ground over most of the plane, below all else; a screen in a room is none."""
    ground = surfaces.ground_faces()
    size = np.ptp(surfaces.vertices, axis=0)
    if np.abs(surfaces.area_vectors[ground, 2]).sum() < 0.8 * size[0] * size[1] or not ground.any():
        return False
    lowest = surfaces.vertices[:, 2].min()
    ground_lowest = surfaces.vertices[surfaces.faces[ground], 2].min()
    return ground_lowest <= lowest + 0.02 * size[2] and surfaces.level_m(ground) < lowest + 0.4 * size[2]


def check_units(surfaces: Surfaces) -> list[Problem]:
    """Warnings where heights and extent look like feet or kilometres, an error where no unit makes sense."""
    heights = building_heights(surfaces)
    width = float(np.ptp(surfaces.vertices[:, :2], axis=0).max())
    if width > ABSURD_EXTENT_M:
        return [
            Problem(
                "error",
                "",
                f"the city is {width / 1000:.4g} km wide if its unit is the metre; a shape may "
                "lie far away from the others, or the unit is smaller (millimetres: --scale 0.001)",
            )
        ]
    if len(heights) == 0:
        return []
    middle, tallest = float(np.median(heights)), float(heights.max())
    if tallest < KILOMETRE_TALLEST and width < KILOMETRE_EXTENT:
        return [
            Problem(
                "warning",
                "",
                f"the tallest building is {tallest:.3g} m and the city {width:.3g} m wide; if "
                "that is kilometres, convert with --scale 1000, if it is right say --scale 1",
            )
        ]
    if middle > FEET_MEDIAN_HEIGHT and len(heights) > 1:
        return [
            Problem(
                "warning",
                "",
                f"half of the buildings are taller than {middle:.0f} m; if that is feet, convert "
                "with --scale 0.3048, if it is right say --scale 1",
            )
        ]
    return []


def check_ground(ground: np.ndarray, surfaces: Surfaces) -> list[Problem]:
    """A warning when there is no ground."""
    if ground.any():
        return []
    lowest_m = surfaces.vertices[:, 2].min()
    return [
        Problem(
            "warning",
            "",
            "there is no ground: no ground reflections will be traced, and z = 0 is taken as the "
            f"ground datum (the lowest point is at {lowest_m:.2f} m); add a plane to the file",
        )
    ]


def check_closed(surfaces: Surfaces, ground: np.ndarray, names: Sequence[str]) -> list[Problem]:
    """One warning about all meshes that are not watertight, one about roofs apart from their walls."""
    problems = []
    opened = np.zeros(surfaces.shapes, dtype=bool)
    opened[surfaces.shape[surfaces.free_edges[1]]] = True
    opened[surfaces.shape[ground]] = False
    if opened.any():
        leaky = [names[int(index)] for index in np.flatnonzero(opened)]
        problems.append(
            Problem(
                "warning",
                "",
                f"{len(leaky)} of {surfaces.shapes} meshes are not watertight "
                f"({listed(leaky)}). Open bottoms, and roofs apart from walls, do no harm: what is inside is "
                "found by looking upwards. Holes in walls or roofs let rays in",
            )
        )
    seams = np.unique(surfaces.seams())
    if len(seams):
        which = listed([names[int(index)] for index in seams])
        message = (
            f"{len(seams)} meshes are roofs and walls of different materials that meet in an edge ({which}). "
            "Sionna RT takes such an edge for two free edges of thin sheets: nothing diffracts there, or, with "
            "its edge diffraction on, as over a knife edge instead of a corner. With one material, for example "
            "--material metal=itu_marble, they are joined and diffract rightly"
        )
        problems.append(Problem("warning", "", message))
    return problems
