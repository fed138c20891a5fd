"""Box geometry: where links cross boxes, knife-edge losses, back-projection, buildings of a map."""

from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.effects.arrays import ends_above
from radiotwin.effects.params import Allowed, Length, Metres
from radiotwin.inference.student import DOF
from radiotwin.links import Links
from radiotwin.propagation import terrain
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import HEIGHT_SD_M, CityMap

SAMPLE_M = 5.0  # spacing of the points of a link in the back-projection
CELL_M = 12.5  # side of a cell of the back-projection
HEIGHTS_M = (6.0, 9.0, 12.0, 16.0, 22.0, 30.0, 40.0, 52.0, 66.0, 85.0, 110.0)  # trial heights
MIN_APART_M = 25.0  # least distance between the best cells
CHUNK, MAX_POINTS = 2000, 4_000_000  # links, and their points, per pass: bounds memory
P_MISS = 0.4  # probability that a link through a cell misses the box in it, which is smaller
MIN_SHARE = 0.1  # share of the links through a box below which they count as none
GRAZING_DB = 6.0  # loss at a knife edge that the ray just touches
NEAR_M = 25.0  # links whose ground tracks are farther away keep their level, also the exact one
SAME_PLACE_M = 10.0  # largest distance between devices of one mast
ESTIMATED_PLACES = ("only links of devices whose positions are estimated pass it: they may be "
                  "elsewhere")
WELD_M = 0.05  # vertices closer together belong to one building


class Box(NamedTuple):
    """An upright box on the ground.

    Attributes:
        x_m, y_m: centre [m].
        length_m, width_m, height_m: sides and height [m].
        turn_deg: angle of the length, counter-clockwise from east [deg].
    """

    x_m: Metres
    y_m: Metres
    length_m: Length
    width_m: Length
    height_m: Length
    turn_deg: Annotated[float, Field(ge=-3600, le=3600)]

    @staticmethod
    def allowed(field: str, low: float, high: float) -> Allowed:
        """Return the allowed values of a field; the turn has a period of 180°."""
        return Allowed(period=180.0) if field == "turn_deg" else Allowed(low, high)

    def straightened(self) -> "Box":
        """Return the same box with a turn within ±45°, sides exchanged if needed."""
        return self.like(self._replace(turn_deg=0.0))

    def turned_by(self, turn_deg: float) -> "Box":
        """Rotate the box counter-clockwise [deg]; its turn stays within ±90°."""
        return self._replace(turn_deg=(self.turn_deg + turn_deg + 90.0) % 180.0 - 90.0)

    def like(self, other: "Box") -> "Box":
        """Return the same box, turned by multiples of 90°, with the turn closest to another's."""
        quarter_turns = round((other.turn_deg - self.turn_deg) / 90.0)
        sides = (self.length_m, self.width_m)[::-1 if quarter_turns % 2 else 1]
        return self._replace(length_m=sides[0], width_m=sides[1],
                             turn_deg=self.turn_deg + 90.0 * quarter_turns)

    @property
    def axes(self) -> np.ndarray:
        """(2, 2) unit vectors along its length and along its width."""
        turn = np.radians(self.turn_deg)
        return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    @property
    def outline_m(self) -> np.ndarray:
        """(5, 2) x and y of the corners, the last one equal to the first [m]."""
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * 0.5 * (
            self.length_m, self.width_m)
        return corners @ self.axes + (self.x_m, self.y_m)


def grid_around(box: Box, margin_m: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lay a grid over a box's footprint plus a margin: x and y (count, count) of its points [m]."""
    turn, share = np.radians(box.turn_deg), (np.arange(count) + 0.5) / count - 0.5
    along_m, across_m = np.meshgrid(share * (box.length_m + 2 * margin_m),
                                     share * (box.width_m + 2 * margin_m))
    return (box.x_m + along_m * np.cos(turn) - across_m * np.sin(turn),
            box.y_m + along_m * np.sin(turn) + across_m * np.cos(turn))


def stands_on(box: Box, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Check which points x, y (any shape) are in the footprint of a box."""
    turn, east_m, north_m = np.radians(box.turn_deg), x_m - box.x_m, y_m - box.y_m
    along_m = east_m * np.cos(turn) + north_m * np.sin(turn)
    across_m = north_m * np.cos(turn) - east_m * np.sin(turn)
    return (np.abs(along_m) <= box.length_m / 2) & (np.abs(across_m) <= box.width_m / 2)


class Crossing(NamedTuple):
    """Geometry of n links that cross a box, (n,) each; NaN where the ground track misses it.

    Attributes:
        inside_m: length of the link within the box; 0, never NaN, if it passes above or beside.
        enter_over_m, leave_over_m: height of the roof above the link at entry and at exit;
            negative if the link passes above.
        left_m, right_m: lateral extent of the box to each side of the link's track.
        before_m, between_m, behind_m: ground distances from the first end to the entry, from entry
            to exit, and from the exit to the second end.
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
    """Compute where links cross a box; if the ground track misses it, all but `inside_m` is NaN.

    Args:
        box: box on the ground.
        a_m: (n, 3) first ends [m].
        b_m: (n, 3) second ends [m].
    """
    start, end = ((point[:, :2] - (box.x_m, box.y_m)) @ box.axes.T for point in (a_m, b_m))
    return Crossing(*_crossing(start, end, a_m[:, 2], b_m[:, 2],
                               np.linalg.norm(b_m - a_m, axis=1), 0.5 * box.length_m,
                               0.5 * box.width_m, box.height_m))


@njit(cache=True, nogil=True, error_model="numpy")
def _crossing(start: np.ndarray, end: np.ndarray, start_z_m: np.ndarray, end_z_m: np.ndarray,
              length_m: np.ndarray, half_length_m: float, half_width_m: float, height_m: float
              ) -> np.ndarray:
    """Compute where links cross a box: rows (8, n) are the fields of `Crossing`, in order [m].

    The ends, start and end (n, 2), are in axes along the box's sides, from its centre. Where the
    ground track misses the box, the length inside is 0 and the rest NaN.
    """
    found = np.full((8, len(start)), np.nan)
    found[0] = 0.0
    for i in range(len(start)):
        x_m, y_m = start[i]
        step_x, step_y = end[i, 0] - x_m, end[i, 1] - y_m
        low_x, high_x = _shares_within(x_m, step_x, half_length_m)
        low_y, high_y = _shares_within(y_m, step_y, half_width_m)
        low, high = max(low_x, low_y), min(high_x, high_y)
        enter, leave = min(max(low, 0.0), 1.0), min(max(high, 0.0), 1.0)
        if not (leave > enter and low < 1 and high > 0):
            continue
        track_m = max(np.sqrt(step_x * step_x + step_y * step_y), 1e-9)
        unit_x, unit_y = step_x / track_m, step_y / track_m
        most_m, least_m = -np.inf, np.inf
        for corner_x in (half_length_m, -half_length_m):
            for corner_y in (half_width_m, -half_width_m):
                across_m = unit_x * (corner_y - y_m) - unit_y * (corner_x - x_m)
                most_m, least_m = max(most_m, across_m), min(least_m, across_m)
        z_m, rise_m = start_z_m[i], end_z_m[i] - start_z_m[i]
        below = _share_below(z_m, rise_m, enter, leave, height_m)
        found[0, i] = max(below, 0.0) * length_m[i]
        found[1, i], found[2, i] = height_m - (z_m + enter * rise_m), \
            height_m - (z_m + leave * rise_m)
        found[3, i], found[4, i] = most_m, -least_m
        found[5, i], found[6, i] = enter * track_m, (leave - enter) * track_m
        found[7, i] = (1 - leave) * track_m
    return found


@njit(cache=True, error_model="numpy")
def _shares_within(start: float, step: float, half: float) -> tuple[float, float]:
    """Return from which to which fraction of a step a coordinate is in ±half; inf, -inf: never."""
    if abs(step) < 1e-9:  # at right angles to the axis: within all the way, or never
        return (-np.inf, np.inf) if abs(start) <= half else (np.inf, -np.inf)
    first, second = (-half - start) / step, (half - start) / step
    return min(first, second), max(first, second)


@njit(cache=True, error_model="numpy")
def _share_below(start_z_m: float, rise_m: float, enter: float, leave: float,
                 height_m: float) -> float:
    """Return the fraction of a link, from enter to leave, below a height; 0 or less: none."""
    if abs(rise_m) < 1e-9:
        return leave - enter if start_z_m < height_m else 0.0
    roof = (height_m - start_z_m) / rise_m
    return min(leave, roof) - enter if rise_m > 0 else leave - max(enter, roof)


def devices_through(box: Box, links: Links) -> np.ndarray:
    """Count the links of each device (k,) that pass through a box."""
    inside = cross(box, *ends_above(links, box[:2])).inside_m > 0
    return np.bincount(links.device[inside], minlength=len(links.device_m))


def is_seen_from_estimated_places(through: np.ndarray, links: Links) -> bool:
    """Check whether nearly all links through a box belong to devices of estimated position.

    Args:
        through: (k,) number of each device's links through the box.
        links: all links; their anchors are the devices of known position.
    """
    return bool(through[sorted(links.anchors)].sum() < MIN_SHARE * through.sum())


def is_seen_from_one_place(through: np.ndarray, links: Links) -> bool:
    """Check whether nearly all links through a box belong to devices at one place.

    Seen from one place, a large box far away hides the same links as a small one nearby. `through`
    (k,) is the number of each device's links through the box.
    """
    away_m = np.linalg.norm((links.device_m - links.device_m[through.argmax()])[:, :2], axis=1)
    return bool(through[away_m > SAME_PLACE_M].sum() < MIN_SHARE * through.sum())


def near_box(box: Box, a_m: np.ndarray, b_m: np.ndarray, within_m: float) -> np.ndarray:
    """Check which lines (n,) have a ground track within some distance of a box [m]."""
    larger = box._replace(length_m=box.length_m + 2 * within_m, width_m=box.width_m + 2 * within_m)
    return np.isfinite(cross(larger, a_m, b_m).left_m)


def links_near(box: Box, links: Links, within_m: float = NEAR_M) -> np.ndarray:
    """Check which links (n,) pass so near to a box that their paths may change."""
    return near_box(box, links.device_m[links.device], links.receiver_m, within_m)


def obstruction_nats(residual_db: np.ndarray, scale_db: np.ndarray,
                     losses_db: tuple[float, ...]) -> np.ndarray:
    """Compute the log-likelihood gain (n,) of residuals if a box may obstruct the link [nats].

    A cell of the search is larger than the box, so a link through the cell misses the box with
    probability `P_MISS`: a link without a loss is only weak evidence against a box.

    Args:
        residual_db: (n,) residuals [dB].
        scale_db: (n,) scale of the errors [dB].
        losses_db: losses behind a box, equally probable [dB].
    """
    def density(value_db: np.ndarray) -> np.ndarray:
        return (1 + (value_db / scale_db) ** 2 / DOF) ** (-0.5 * (DOF + 1))

    lossy = np.mean([density(residual_db + loss_db) for loss_db in losses_db], axis=0)
    return np.log(P_MISS + (1 - P_MISS) * lossy / density(residual_db))


def best_cells(centres_m: np.ndarray, total_nats: np.ndarray,
               count: int) -> list[tuple[np.ndarray, int, float]]:
    """Pick the ground cells with the highest log-likelihood gain, `MIN_APART_M` apart or more.

    Args:
        centres_m: (m, 2) centres of the cells [m].
        total_nats: (m, heights) gain of a box in each cell, by trial height [nats].
        count: largest number of cells.

    Returns:
        centre, index of the height and gain [nats] of each cell, best first.
    """
    found: list[tuple[np.ndarray, int, float]] = []
    for cell in np.argsort(-total_nats.max(axis=1)):
        if all(np.linalg.norm(centres_m[cell] - other[0]) > MIN_APART_M for other in found):
            height = int(total_nats[cell].argmax())
            found.append((centres_m[cell], height, float(total_nats[cell, height])))
        if len(found) == count:
            break
    return found


def back_project(a_m: np.ndarray, b_m: np.ndarray,
                 nats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum over each ground cell the log-likelihood gains of the links that pass through it.

    The sum is greatest where a box would obstruct the links with missing power and no others.

    Args:
        a_m: (n, 3) first ends [m].
        b_m: (n, 3) second ends [m].
        nats: (n,) log-likelihood gain if the link is obstructed, see `obstruction_nats`.

    Returns:
        (m, 2) centres of the cells [m], and (m, heights) sum over the links that cross each cell
        below each of `HEIGHTS_M` [nats].
    """
    low = np.floor(np.minimum(a_m, b_m)[:, :2].min(axis=0) / CELL_M).astype(int)
    shape = np.ceil(np.maximum(a_m, b_m)[:, :2].max(axis=0) / CELL_M).astype(int) - low + 1
    total = np.zeros((len(HEIGHTS_M), shape[0] * shape[1]))
    length_m = np.linalg.norm((b_m - a_m)[:, :2], axis=1)
    step = max(min(CHUNK, int(MAX_POINTS * SAMPLE_M / length_m.max(initial=1.0))), 1)
    for first in range(0, len(a_m), step):
        part = slice(first, first + step)
        share = np.linspace(0, 1, max(int(length_m[part].max(initial=1.0) / SAMPLE_M), 2))
        points = a_m[part, None] + share[:, None] * (b_m - a_m)[part, None]
        cell = np.floor(points[..., :2] / CELL_M).astype(int) - low
        flat = cell[..., 0] * shape[1] + cell[..., 1]
        link = np.broadcast_to(np.arange(len(points))[:, None], flat.shape)
        # Keep the lowest point of each link in each cell.
        key = (link * total.shape[1] + flat).ravel()
        height_m = points[..., 2].ravel()
        order = np.lexsort((height_m, key))
        lowest = order[np.r_[True, np.diff(key[order]) > 0]]
        height_m, cells = height_m[lowest], flat.ravel()[lowest]
        value = nats[part][link.ravel()[lowest]]
        for row, top_m in enumerate(HEIGHTS_M):
            under = height_m < top_m
            total[row] += np.bincount(cells[under], weights=value[under], minlength=total.shape[1])
    corners = np.stack(np.unravel_index(np.arange(total.shape[1]), shape), axis=1) + low
    return (corners + 0.5) * CELL_M, total.T


def knife_edge_db(over_m: np.ndarray, first_m: np.ndarray | float, second_m: np.ndarray | float,
                  wavelength_m: float) -> np.ndarray:
    """Compute the diffraction loss (n,) over a knife edge (ITU-R P.526-15, 4.1) [dB].

    Args:
        over_m: (n,) height of the edge above the straight line [m]; negative: below it.
        first_m: (n,) distance of the edge from the first end; at least 1 is used [m].
        second_m: (n,) distance from the second end; at least 1 is used [m].
        wavelength_m: wavelength [m].
    """
    d1_m, d2_m = np.maximum(first_m, 1.0), np.maximum(second_m, 1.0)
    return terrain.knife_edge_db(over_m * np.sqrt(2 * (d1_m + d2_m) / (wavelength_m * d1_m * d2_m)))


def two_edges_db(first_over_m: np.ndarray, second_over_m: np.ndarray,
                 before_m: np.ndarray | float, between_m: np.ndarray | float,
                 behind_m: np.ndarray | float, wavelength_m: float) -> np.ndarray:
    """Compute the diffraction loss (n,) over two knife edges in a row [dB].

    ITU-R P.526-15, Sec. 4.4.1, second method, Eq. 37-42.

    Args:
        first_over_m: (n,) height of the first edge above the straight line [m].
        second_over_m: (n,) height of the second edge above the straight line [m].
        before_m: (n,) distance from the first end to the first edge [m].
        between_m: (n,) distance between the edges [m].
        behind_m: (n,) distance from the second edge to the second end [m].
        wavelength_m: wavelength [m].
    """
    a, b, c = np.maximum(before_m, 1.0), np.maximum(between_m, 0.1), np.maximum(behind_m, 1.0)
    total = a + b + c
    first, second = (h * np.sqrt(2 * total / (wavelength_m * near * (total - near)))
                     for h, near in ((first_over_m, a), (second_over_m, a + b)))
    leads = first > second
    main_over_m = np.where(leads, first_over_m, second_over_m)
    main_near = np.where(leads, a, a + b)
    # Height of the other edge above the line from the top of the main edge to the end behind the
    # other edge; above the straight line if the main edge is below that.
    straight_m, beyond = np.where(leads, second_over_m, first_over_m), np.where(leads, c, a)
    other_over_m = straight_m - np.maximum(main_over_m, 0.0) * beyond / (b + beyond)
    loss_db = knife_edge_db(main_over_m, main_near, total - main_near, wavelength_m)
    other_db = knife_edge_db(other_over_m, b, beyond, wavelength_m)
    p, q = np.maximum(first, second), np.minimum(first, second)
    alpha = np.arctan(np.sqrt(b * total / (a * c)))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(q > 0, np.maximum(q / p, 0.0) ** (2 * p), 0.0)
    # Edges close together act as one, also if the ray passes just above both.
    share = np.where(p > 0, share, np.minimum(loss_db, other_db) / GRAZING_DB)
    correction_db = (12 - 20 * np.log10(2 / (1 - alpha / np.pi))) * share
    return loss_db + np.maximum(other_db - correction_db, 0.0)


@lru_cache(maxsize=4)
def buildings(city: CityMap) -> tuple[np.ndarray, np.ndarray]:
    """Find the buildings of a map: the connected components of its faces, ground included.

    Args:
        city: map with f faces.

    Returns:
        (f,) building of each face, and (buildings, 3) x and y of the centre, and z of the top [m];
        read-only, as they are cached.
    """
    welded = np.round(city.vertices / WELD_M).astype(np.int64)
    vertex = np.unique(welded, axis=0, return_inverse=True)[1].ravel()
    faces = vertex[city.faces]
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])),
                       shape=(vertex.max() + 1,) * 2)
    component = connected_components(graph, directed=False)[1]
    label = np.unique(component[faces[:, 0]], return_inverse=True)[1]
    low_m, high_m = building_extents_m(city, label)
    centre_m = np.column_stack([0.5 * (low_m + high_m)[:, :2], high_m[:, 2]])
    label.flags.writeable = centre_m.flags.writeable = False
    return label, centre_m


def building_extents_m(city: CityMap, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the least and greatest x, y, z (buildings, 3) over the faces (f,) of each label [m]."""
    corners_m = city.vertices[city.faces]
    low_m = np.full((label.max() + 1, 3), np.inf)
    high_m = -low_m
    np.minimum.at(low_m, label, corners_m.min(axis=1))
    np.maximum.at(high_m, label, corners_m.max(axis=1))
    return low_m, high_m


def building_height_sds_m(city: CityMap) -> np.ndarray:
    """Compute the standard deviation of the mapped height of each building (buildings,) [m].

    Mean of the map's values for its faces, at least `HEIGHT_SD_M` (a storey), the default.
    """
    label, centres_m = buildings(city)
    if city.height_sd_m is None:
        return np.full(len(centres_m), HEIGHT_SD_M)
    known = np.isfinite(city.height_sd_m)
    faces = np.bincount(label[known], minlength=len(centres_m))
    sums = np.bincount(label[known], weights=city.height_sd_m[known], minlength=len(centres_m))
    # If it were smaller, small errors of this height would be fitted to other shadows nearby.
    return np.maximum(sums / np.maximum(faces, 1), HEIGHT_SD_M)
