"""Boxes that stand in the way of links, and where in a city they would explain what is missing."""

from typing import NamedTuple

import numpy as np

SAMPLES_M = 5.0  # along a link
CELL_M = 12.5
HEIGHTS_M = (6.0, 9.0, 12.0, 16.0, 22.0, 30.0, 40.0, 52.0, 66.0, 85.0, 110.0)
APART_M = 25.0
MISSES, DOF = 0.4, 4.0
CHUNK, MOST_POINTS = 2000, 4_000_000  # links, and points on them, a time: bounds memory


class Box(NamedTuple):
    """An upright box on the ground: centre, sides [m], height [m], and by how much it is turned [deg]."""

    x_m: float
    y_m: float
    length_m: float
    width_m: float
    height_m: float
    turn_deg: float


class Crossing(NamedTuple):
    """How n links cross a box; NaN where a link's ground track does not.

    Attributes:
        inside_m: length of the link within the box; 0 where it passes above.
        enter_over_m, leave_over_m: height of the roof above the link where it enters and where it leaves; negative
            where the link passes above.
        left_m, right_m: how far the box reaches across the link's track to each side.
        before_m, between_m, behind_m: distance along the ground from the first end to where the link enters, from there
            to where it leaves, and on to the second end.
    """

    inside_m: np.ndarray
    enter_over_m: np.ndarray
    leave_over_m: np.ndarray
    left_m: np.ndarray
    right_m: np.ndarray
    before_m: np.ndarray
    between_m: np.ndarray
    behind_m: np.ndarray


def cross(box: Box, a_m: np.ndarray, b_m: np.ndarray) -> Crossing:
    """How links cross a box.

    Args:
        a_m, b_m: (n, 3) ends [m].
    """
    turn = np.radians(box.turn_deg)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    half = 0.5 * np.array([box.length_m, box.width_m])
    start, end = ((point[:, :2] - (box.x_m, box.y_m)) @ axes.T for point in (a_m, b_m))
    step = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([(-half - start) / step, (half - start) / step])
    # A track along an axis: within the box all the way, or never.
    parallel = np.abs(step) < 1e-9
    within = np.abs(start) <= half
    low = np.where(parallel, np.where(within, -np.inf, np.inf), np.nanmin(np.where(parallel, np.inf, sides), axis=0))
    high = np.where(parallel, np.where(within, np.inf, -np.inf), np.nanmax(np.where(parallel, -np.inf, sides), axis=0))
    enter, leave = np.clip(low.max(axis=1), 0, 1), np.clip(high.min(axis=1), 0, 1)
    crosses = (leave > enter) & (low.max(axis=1) < 1) & (high.min(axis=1) > 0)
    length = np.linalg.norm(b_m - a_m, axis=1)
    rise = b_m[:, 2] - a_m[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        under = np.where(np.abs(rise) < 1e-9, np.where(a_m[:, 2] < box.height_m, np.inf, -np.inf),
                         (box.height_m - a_m[:, 2]) / rise)
    below = (np.where(rise > 0, np.minimum(leave, under), leave)
             - np.where(rise < 0, np.maximum(enter, under), enter))
    below = np.where((np.abs(rise) < 1e-9) & (a_m[:, 2] >= box.height_m), 0.0, below)
    track = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    unit = step / track[:, None]
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * half
    across = unit[:, 0, None] * (corners[None, :, 1] - start[:, 1, None]) \
        - unit[:, 1, None] * (corners[None, :, 0] - start[:, 0, None])
    values = (np.maximum(below, 0) * length, *(box.height_m - (a_m[:, 2] + at * rise) for at in (enter, leave)),
              across.max(axis=1), -across.min(axis=1), enter * track, (leave - enter) * track, (1 - leave) * track)
    return Crossing(np.where(crosses, values[0], 0.0), *(np.where(crosses, value, np.nan) for value in values[1:]))


def near_box(box: Box, a_m: np.ndarray, b_m: np.ndarray, within_m: float) -> np.ndarray:
    """(n,) bool, links whose ground tracks come that near to a box [m]."""
    larger = box._replace(length_m=box.length_m + 2 * within_m, width_m=box.width_m + 2 * within_m)
    return np.isfinite(cross(larger, a_m, b_m).left_m)


def lacks_nats(residual_db: np.ndarray, scale_db: np.ndarray, losses_db: tuple[float, ...]) -> np.ndarray:
    """(n,) how much likelier a residual is if something may be in the link's way than if nothing is [nats].

    "May": a cell of the search is not the box, and a link through it misses the box in `MISSES` of the cases; so a link
    that lacks nothing speaks against a box only a little.
    """
    def density(value_db):
        return (1 + (value_db / scale_db) ** 2 / DOF) ** (-0.5 * (DOF + 1))

    lossy = np.mean([density(residual_db + loss_db) for loss_db in losses_db], axis=0)
    return np.log(MISSES + (1 - MISSES) * lossy / density(residual_db))


def best_cells(centres_m: np.ndarray, total: np.ndarray, count: int) -> list[tuple[np.ndarray, int, float]]:
    """The best cells that are not neighbours: centre, index of the height, and nats."""
    found: list[tuple[np.ndarray, int, float]] = []
    for place in np.argsort(-total.max(axis=1)):
        if all(np.linalg.norm(centres_m[place] - other[0]) > APART_M for other in found):
            height = int(total[place].argmax())
            found.append((centres_m[place], height, float(total[place, height])))
        if len(found) == count:
            break
    return found


def back_project(a_m: np.ndarray, b_m: np.ndarray, gain: np.ndarray, ground_m: float = 0.0):
    """Where a box would cover the links that want one and leave out those that do not.

    Args:
        a_m, b_m: (n, 3) ends [m].
        gain: (n,) what is won if the link is crossed [nats]; negative where a box there would be wrong.

    Returns:
        (m, 2) centres of the cells [m], and (m, heights) the sum over links that pass each cell below each of
        `HEIGHTS_M`
    """
    low = np.floor(np.minimum(a_m, b_m)[:, :2].min(axis=0) / CELL_M).astype(int)
    shape = np.ceil(np.maximum(a_m, b_m)[:, :2].max(axis=0) / CELL_M).astype(int) - low + 1
    total = np.zeros((len(HEIGHTS_M), shape[0] * shape[1]))
    length_m = np.linalg.norm((b_m - a_m)[:, :2], axis=1)
    step = max(min(CHUNK, int(MOST_POINTS * SAMPLES_M / length_m.max(initial=1.0))), 1)
    for first in range(0, len(a_m), step):
        part = slice(first, first + step)
        share = np.linspace(0, 1, max(int(length_m[part].max(initial=1.0) / SAMPLES_M), 2))
        points = a_m[part, None] + share[:, None] * (b_m - a_m)[part, None]
        cell = np.floor(points[..., :2] / CELL_M).astype(int) - low
        flat = cell[..., 0] * shape[1] + cell[..., 1]
        link = np.broadcast_to(np.arange(len(points))[:, None], flat.shape)
        # Of each link and cell the lowest point.
        key = (link * total.shape[1] + flat).ravel()
        order = np.lexsort((points[..., 2].ravel(), key))
        lowest = order[np.r_[True, np.diff(key[order]) > 0]]
        height, cells = points[..., 2].ravel()[lowest] - ground_m, flat.ravel()[lowest]
        value = gain[part][link.ravel()[lowest]]
        for row, top in enumerate(HEIGHTS_M):
            under = height < top
            total[row] += np.bincount(cells[under], weights=value[under], minlength=total.shape[1])
    centres = (np.stack(np.unravel_index(np.arange(total.shape[1]), shape), axis=1) + low + 0.5) * CELL_M
    return centres, total.T


def knife_edge_db(height_m: np.ndarray, first_m: np.ndarray, second_m: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Loss over an edge that reaches `height_m` above the straight line (ITU-R P.526-15, Eq. 26 and 31) [dB]."""
    near, far = np.maximum(first_m, 1.0), np.maximum(second_m, 1.0)
    nu = height_m * np.sqrt(2 * (near + far) / (wavelength_m * near * far))
    shifted = np.maximum(nu, -0.78) - 0.1
    return np.where(nu > -0.78, 6.9 + 20 * np.log10(np.sqrt(shifted**2 + 1) + shifted), 0.0)


def two_edges_db(first_over_m: np.ndarray, second_over_m: np.ndarray, before_m: np.ndarray, between_m: np.ndarray,
                 behind_m: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Loss over two edges one behind the other, of which either may be the higher (ITU-R P.526-15, Sec. 4.4.1, second
    method, Eq. 37-42) [dB].

    Args:
        first_over_m, second_over_m: (n,) how far they reach above the straight line [m].
        before_m, between_m, behind_m: (n,) the three sections of the way [m].
    """
    a, b, c = np.maximum(before_m, 1.0), np.maximum(between_m, 0.1), np.maximum(behind_m, 1.0)
    whole = a + b + c
    first, second = (h * np.sqrt(2 * whole / (wavelength_m * near * (whole - near)))
                     for h, near in ((first_over_m, a), (second_over_m, a + b)))
    leads = first > second
    main_over_m, main_near = np.where(leads, first_over_m, second_over_m), np.where(leads, a, a + b)
    # The other edge, above the line from the main one to the end behind it.
    own, beyond = np.where(leads, second_over_m, first_over_m), np.where(leads, c, a)
    other_over_m = own - main_over_m * beyond / (b + beyond)
    loss_db = knife_edge_db(main_over_m, main_near, whole - main_near, wavelength_m)
    other_db = knife_edge_db(other_over_m, b, beyond, wavelength_m)
    p, q = np.maximum(first, second), np.minimum(first, second)
    alpha = np.arctan(np.sqrt(b * whole / (a * c)))
    with np.errstate(divide="ignore", invalid="ignore"):
        too_much_db = (12 - 20 * np.log10(2 / (1 - alpha / np.pi))) * np.maximum(q / p, 0.0) ** (2 * p)
    return loss_db + np.maximum(other_db - np.where((p > 0) & (q > 0), too_much_db, 0.0), 0.0)
