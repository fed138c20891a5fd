"""Checks of measured data: implausible levels, names, units, positions and heights.

A height may be measured from another zero: the sea level, or the ground. Satellite positions are
off by metres, so a receiver close to a wall is inside the building with a probability.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.geo import is_same_frame, origin_text
from radiotwin.io.texts import percent
from radiotwin.links.links import Links
from radiotwin.links.measurements import Measurements
from radiotwin.links.plausible import HIGH_M, MAX_APART_M
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.footing import MAX_SDS, WALL_SD_M, footing

MAX_FLOWN_M = 500.0  # above the ground: more than three times what UAVs may (120 m, EU 2019/947)
_NEARLY_ALL = 0.95  # share of the receivers
POSITION_SD_M = 4.0
"""Standard deviation of a phone's position, in x and in y: 4.9 m under open sky (van Diggelen and
Enge 2015, 'The world's first GPS MOOC and worldwide laboratory using smartphones', ION GNSS+)."""
RINGS, DIRECTIONS = 4, 8  # of sample points around a position, equally probable
SURE = 0.9  # probability above which a receiver counts as inside
MIN_LINKS = 60  # of a campaign; at least half of them detected
MIN_LINKS_OF_RECEIVER = 5
CLOSE_M, MIN_POSITIONS = 0.1, 3  # so many positions within so few metres are in another unit
MIN_HEAP, HEAP_RATIO = 10, 5  # equal levels, and their ratio to the next values, beyond any tail
MAX_OUTSIDE = 0.5  # largest share of links with the receiver off the map
ELSEWHERE_M = 50_000.0  # between receivers and map: the map is of another place
GROUND_M, ROOFS = 0.5, 0.95  # height [m] above which a vertex is built; quantile of roof heights
BURIED = "its height, or that of the map's ground, is off; z counts from the scene's datum"
COPIED = "they are in the file twice"
INDOORS = "it was indoors (see building_entry), or its position or the wall is off by metres"


def height_notes(receiver_m: np.ndarray, scene: Scene) -> list[str]:
    """Note heights that seem to be measured from another zero than the datum of the scene.

    A note is made if most receivers would be below the ground, or nearly all of them more than
    `HIGH_M` above it. Receivers are (n, 3) [m], with z above that datum; NaN: unknown.
    """
    known = np.isfinite(receiver_m).all(axis=1)
    if not known.any():
        return []
    z_m = receiver_m[known, 2]
    clearance_m = z_m - scene.city.ground_height_m(*receiver_m[known, :2].T)
    origin = scene.config.origin
    datum_m = 0.0 if origin is None else origin.altitude_m
    if np.mean(clearance_m < 0) > 0.5:
        for raised_m, remedy in (
                (z_m, "the scene's z counts from its datum, so add the ground's height"),
                (z_m + datum_m, "import them as height, not as altitude")):
            if np.mean((raised_m >= 0) & (raised_m <= MAX_FLOWN_M)) >= _NEARLY_ALL:
                low_m, high_m = raised_m.min(), raised_m.max()
                return [f"most receivers are below the ground; {low_m:.0f} to {high_m:.0f} m would "
                        f"be plausible as heights above the ground: if they are, {remedy}"]
        return ["most receivers are below the ground, by up to "
                f"{-clearance_m.min():.0f} m: is the altitude of the ground right (--origin "
                "LAT,LON,ALT), and is it above the same zero (the sea's level and the ellipsoid "
                "are tens of metres apart)?"]
    lowest_m = float(np.quantile(clearance_m, 1 - _NEARLY_ALL))
    if lowest_m > HIGH_M:
        return [f"receivers are {lowest_m:.0f} m and more above the ground: if those are altitudes "
                "above the sea, import them as altitude, with the ground's in --origin LAT,LON,ALT"]
    return []


def chance_inside(city: CityMap, position_m: np.ndarray,
                  sd_m: float = POSITION_SD_M) -> np.ndarray:
    """Return the probability (n,) that each position is really inside a building of the map.

    The true position scatters about the reported one (n, 3) [m], normally, with `sd_m` in x and in
    y; it is sampled on circles of equal probability.
    """
    places_m, place = np.unique(position_m, axis=0, return_inverse=True)
    probability = (np.arange(RINGS) + 0.5) / RINGS
    radius_m = sd_m * np.sqrt(-2 * np.log1p(-probability))  # quantiles of the Rayleigh distribution
    low = np.flatnonzero(places_m[:, 2] < city.vertices[:, 2].max(initial=-np.inf))
    chance = np.zeros(len(places_m))
    for ring in range(RINGS):
        for angle in (np.arange(DIRECTIONS) + ring / RINGS) * (2 * np.pi / DIRECTIONS):
            shift_m = radius_m[ring] * np.array([np.cos(angle), np.sin(angle), 0.0])
            chance[low] += city.inside(places_m[low] + shift_m)
    return chance[place.ravel()] / (RINGS * DIRECTIONS)


def refuse_empty_levels(level_db: np.ndarray, column: str) -> None:
    """Raise BadInput if no level (n,) is detected, or > `MIN_LINKS_OF_RECEIVER` are all equal."""
    if not np.isfinite(level_db).any():
        raise BadInput(f"nothing was detected: {column} is empty in all {len(level_db):,} rows, "
                       f"and at least {MIN_LINKS // 2} links need a level. Check that column, and "
                       "that devices were in range")
    if len(level_db) > MIN_LINKS_OF_RECEIVER and np.nanmin(level_db) == np.nanmax(level_db):
        raise BadInput(f"all levels are {np.nanmin(level_db):g}, so there is nothing to explain; "
                       f"check the column {column}")


def copied_rows(table: pd.DataFrame) -> np.ndarray:
    """Return which rows (n,) with a time repeat an earlier row: the data was joined twice."""
    if "time_s" not in table:
        return np.zeros(len(table), dtype=bool)
    return table.duplicated().to_numpy() & table["time_s"].notna().to_numpy()


def require_one_frame(measurements: Measurements, scene: Scene | None) -> None:
    """Raise BadInput if measurements and scene have different origins; an unknown one passes."""
    origin, of_scene = measurements.origin, None if scene is None else scene.config.origin
    if origin is not None and of_scene is not None and not is_same_frame(origin, of_scene):
        raise BadInput(f"the measurements are in the frame about {origin_text(origin)}, the scene "
                       f"is in that about {origin_text(of_scene)}; convert them with "
                       "radiotwin.links.alignment.in_scene_frame")


def check_names(measurements: Measurements) -> list[str]:
    """Note names that differ in upper and lower case only, and devices without a link."""
    notes = []
    for what, names in (("receivers", measurements.table["receiver"].unique()),
                        ("devices", measurements.devices["device"]),
                        ("flights", measurements.flights)):
        names = pd.Series(names, dtype=str)
        alike = names[names.str.casefold().duplicated(keep=False)]
        if len(alike):
            notes.append(f"{what} {some(alike)} differ in upper and lower case only; they "
                         "are taken for different ones")
    used = np.isin(np.arange(len(measurements.devices)), measurements.device_index)
    idle = measurements.devices["device"][~used]
    if len(idle):
        notes.append(f"no link is to {_named('device', idle)}")
    return notes


def check_positions(receiver_m: np.ndarray, device_m: np.ndarray,
                    scene: Scene | None) -> list[str]:
    """Note positions that all lie within `CLOSE_M` (wrong unit), and with a scene `receiver_notes`.

    Receivers are (n, 3), devices (k, 3) [m], compared in x and y; fewer than `MIN_POSITIONS` pass.
    BadInput if all of both lie within `CLOSE_M`, or most receivers are outside the map.
    """
    both = "receivers and devices"
    notes = {}
    for what, position_m in (("receivers", receiver_m), ("devices", device_m),
                             (both, np.vstack([receiver_m, device_m]))):
        known = np.isfinite(position_m[:, :2]).all(axis=1)
        different = np.unique(position_m[known, :2], axis=0)
        if len(different) >= MIN_POSITIONS and np.ptp(different, axis=0).max() < CLOSE_M:
            notes[what] = (f"all {len(different):,} positions of {what} lie within "
                           f"{np.ptp(different, axis=0).max():.2g} m: positions are to be in "
                           "metres; degrees are not converted")
    if both in notes:
        raise BadInput(notes[both])
    if scene is None:
        return list(notes.values())
    require_on_map(receiver_m, scene)
    return [*notes.values(), *receiver_notes(receiver_m, scene)]


def require_on_map(receiver_m: np.ndarray, scene: Scene, remedy: str = "") -> np.ndarray:
    """Return which receivers (n, 3) [m] are outside the 3D map, (n,) bool; BadInput if most are.

    The message ends with `remedy`. By default it says that the map is of another place if it is
    more than `ELSEWHERE_M` away, else that positions are in another frame.
    """
    outside = outside_map(receiver_m, scene)
    if outside.sum() > MAX_OUTSIDE * len(outside):
        low_m, high_m = map_corners_m(scene)
        apart_m = np.hypot(*(np.nanmedian(receiver_m[:, :2], axis=0) - (low_m + high_m) / 2))
        remedy = remedy or (
            f"they are {apart_m / 1000:,.0f} km from it, so it is a map of another place, or an "
            "origin is wrong: give the scene of the place of the measurements"
            if apart_m > ELSEWHERE_M else "give measurements and scene in one frame, in metres; "
            "feet and degrees are not converted")
        raise BadInput(
            f"{outside.sum():,} of {len(outside):,} links have their receiver outside the 3D map, "
            f"which goes from ({low_m[0]:.0f}, {low_m[1]:.0f}) to ({high_m[0]:.0f}, "
            f"{high_m[1]:.0f}) m: {remedy}")
    return outside


def unmapped_ends(receiver_m: np.ndarray, device_m: np.ndarray, scene: Scene) -> np.ndarray:
    """Return which links (n,) have an end that is beside the 3D map and below its roofs.

    Whether such a link has line of sight is unknown, since what stands around that end is not
    mapped; an end above the roofs needs no map around it. Both ends are (n, 3) [m]; NaN: unknown.
    """
    low_m, high_m = map_corners_m(scene)
    roof_m = _roof_m(scene)
    return np.any([((end_m[:, :2] < low_m) | (end_m[:, :2] > high_m)).any(axis=1)
                   & (end_m[:, 2] < roof_m) for end_m in (receiver_m, device_m)], axis=0)


def map_corners_m(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the south-west and the north-east corner of the 3D map, (2,) each [m]."""
    corners_m = scene.city.vertices[:, :2]
    return corners_m.min(axis=0), corners_m.max(axis=0)


def _roof_m(scene: Scene) -> float:
    """Return the `ROOFS` quantile of z [m] of the map's building vertices; 0 without buildings."""
    vertices_m = scene.city.vertices
    built_m = vertices_m[vertices_m[:, 2] > GROUND_M, 2]
    if scene.city.terrain is not None:
        built_m = vertices_m[np.unique(scene.city.faces[~scene.city.terrain]), 2]
    return float(np.quantile(built_m, ROOFS)) if len(built_m) else 0.0


def outside_map(receiver_m: np.ndarray, scene: Scene) -> np.ndarray:
    """Return which receivers (n, 3) [m] are outside the 3D map, (n,) bool; NaN is not."""
    low, high = map_corners_m(scene)
    return np.any((receiver_m[:, :2] < low) | (receiver_m[:, :2] > high), axis=1)


def receiver_notes(receiver_m: np.ndarray, scene: Scene) -> list[str]:
    """Note receivers (n, 3) [m] inside buildings, below the ground, or implausibly high."""
    known = np.isfinite(receiver_m).all(axis=1)
    inside, below = np.zeros((2, len(receiver_m)), dtype=bool)
    inside[known] = scene.city.inside(receiver_m[known])
    below[known] = inside[known] & scene.city.below_ground(receiver_m[known])
    inside &= ~below
    surely = inside.copy()
    surely[inside] = chance_inside(scene.city, receiver_m[inside]) >= SURE
    sure = f"{surely.sum():,} of them surely, with positions off by {POSITION_SD_M:g} m"
    return [f"{rows.sum():,} of {len(rows):,} links have their receiver {where}"
            for rows, where in ((inside, f"inside a building ({sure}): {INDOORS}"),
                                (below, f"below the ground: {BURIED}"))
            if rows.any()] + height_notes(receiver_m, scene)


def move_anchors_out(links: Links, scene: Scene, refuse: bool = True) -> Links:
    """Move anchors (devices of declared position) out of buildings and above the map's ground.

    An anchor is moved only by as much as a map may be wrong (`radiotwin.scene.footing`), with a
    note. BadInput if one is far from the receivers, or too deep (without `refuse`, it stays there).
    """
    anchors = np.array(sorted(links.anchors), dtype=int)
    anchors = anchors[np.isfinite(links.device_m[anchors]).all(axis=1)]
    apart_m = np.abs(links.device_m[anchors, :2] - np.median(links.receiver_m[:, :2], axis=0))
    for index in anchors[(apart_m > MAX_APART_M).any(axis=1)]:
        raise BadInput(f"devices, row {index + 2}: anchor {links.device_names[index]!r} is more "
                       f"than {MAX_APART_M / 1000:g} km from the middle of the receivers; both "
                       "need one frame, in metres")
    device_m = links.device_m.copy()
    moved: dict[str, list[str]] = {}  # by what was done: sectors of a mast move together
    misplaced = scene.city.misplaced(device_m[anchors])
    for index, where in zip(anchors[misplaced != ""], misplaced[misplaced != ""]):
        name, (x_m, y_m, z_m) = links.device_names[index], device_m[index]
        found = footing(scene.city, device_m[index])
        if found is not None:
            device_m[index] = found.point_m
            moved.setdefault(found.move, []).append(name)
        elif refuse:
            top_m = float(scene.city.height_at(x_m, y_m))
            raise BadInput(
                f"devices, row {index + 2}: anchor {name!r} at ({x_m:g}, {y_m:g}, {z_m:g}) m is "
                f"{where} of the scene, {top_m - z_m:.1f} m below what is highest there, and more "
                f"than {MAX_SDS * WALL_SD_M:g} m from the outside: more than {MAX_SDS:g} standard "
                "deviations of a map's errors. Correct its position, or the scene's frame; or set "
                "its role to unknown, and it is located")
    if not moved:
        return links
    return links.with_devices(device_m).with_notes(*(
        f"{_named('device', names)} would be inside a building of the map or below its ground, by "
        f"no more than a map is off: moved {move}" for move, names in moved.items()))


def uninformative_receivers(table: pd.DataFrame, level_db: np.ndarray,
                      keep: np.ndarray) -> list[tuple[np.ndarray, str]]:
    """Find receivers that detect nothing, always read one level, or have few links that are used.

    `level_db` [dB] and `keep` (bool: used so far) are (n,), of the rows of `table`. The result has
    for each of the three faults a mask (n,) of such receivers' links, used or not, and the reason.
    """
    receiver, names = pd.factorize(table["receiver"], sort=True)
    links = np.bincount(receiver[keep], minlength=len(names))
    detected = keep & np.isfinite(level_db)
    low_db, high_db = np.full(len(names), np.inf), np.full(len(names), -np.inf)
    np.minimum.at(low_db, receiver[detected], level_db[detected])
    np.maximum.at(high_db, receiver[detected], level_db[detected])
    detections = np.bincount(receiver[detected], minlength=len(names))
    dead = (links > 0) & np.isinf(low_db)
    stuck = (detections > MIN_LINKS_OF_RECEIVER) & (low_db == high_db)  # not one that heard once
    few = (links > 0) & (links < MIN_LINKS_OF_RECEIVER) & ~dead
    has = "has {} only" if few.sum() < 2 else "have {} at most"
    reads = "reads" if stuck.sum() < 2 else "read"
    values = some([f"{value:g}" for value in low_db[stuck]])
    return [(dead[receiver], f"{_named('receiver', names[dead])} never detected anything"),
            (stuck[receiver], f"{_named('receiver', names[stuck])} always {reads} {values}"),
            (few[receiver], f"{_named('receiver', names[few])} "
             f"{has.format(links[few].max(initial=0))}; {MIN_LINKS_OF_RECEIVER} are needed")]


def unheard_devices(table: pd.DataFrame, level_db: np.ndarray,
                    keep: np.ndarray) -> tuple[np.ndarray, str]:
    """Find devices that were never detected on `MIN_LINKS` or more links, as if switched off.

    One with fewer links may be a position of a moving device, where silence is information.
    Arguments are as of `uninformative_receivers`, and so is the result, for one fault.
    """
    device, names = pd.factorize(table["device"], sort=True)
    links, detections = (np.bincount(device[rows], minlength=len(names))
                         for rows in (keep, keep & np.isfinite(level_db)))
    dead = (links >= MIN_LINKS) & (detections == 0)
    was, on = ("was", "is it") if dead.sum() < 2 else ("were", "are they")
    return dead[device], (f"{_named('device', names[dead])} {was} never detected; {on} on, and in "
                          "range?")


def find_fill_value(level_db: np.ndarray) -> tuple[float | None, float]:
    """Find the level that receivers write for "not detected"; return it and its share of readings.

    It is the lowest of `level_db` (n,), if far more frequent than the next ones, or three times and
    far below (by 3 dB and ten usual steps). (None, 0): none, or fewer than `MIN_LINKS` readings.
    """
    read_db = level_db[np.isfinite(level_db)]
    if len(read_db) < MIN_LINKS:
        return None, 0.0
    values, counts = np.unique(read_db, return_counts=True)
    if len(values) < 3:
        return None, 0.0
    steps = np.diff(values)
    gap = counts[0] >= 3 and steps[0] > 10 * np.median(steps[:20]) and steps[0] > 3.0
    return (float(values[0]), counts[0] / len(read_db)) if gap or _is_heap(counts) else (None, 0.0)


def ceiling_notes(receiver: np.ndarray, names: Sequence[str], level_db: np.ndarray) -> list[str]:
    """Note receivers that saturate: their highest level is far more frequent than the next ones.

    `receiver` (n,) is an index into `names`, levels (n,); below `MIN_LINKS` readings, no note.
    """
    found = []
    for number, levels in pd.Series(level_db).dropna().groupby(receiver[np.isfinite(level_db)]):
        values, counts = np.unique(levels, return_counts=True)
        if len(levels) >= MIN_LINKS and len(values) > HEAP_RATIO and _is_heap(counts[::-1]):
            found.append(f"{names[number]} ({percent(counts[-1] / len(levels))} at {values[-1]:g})")
    if not found:
        return []
    return [f"readings are heaped at the highest value of {_named('receiver', found)}: nothing "
            "higher is read, and what was stronger is taken for just that"]


def _is_heap(counts: np.ndarray) -> bool:
    """Return whether the first value is far more frequent than each of the next five, by counts."""
    return bool(counts[0] >= MIN_HEAP and counts[0] > HEAP_RATIO * counts[1:6].max())


def _named(noun: str, names: Sequence[object] | np.ndarray | pd.Series) -> str:
    """Return a noun with names: receiver a, receivers a, b."""
    return f"{noun}{'s' if len(names) > 1 else ''} {some(names)}"
