"""Vegetation that a scene declares, as prisms up to the tree tops, and path lengths through it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from pydantic import Field, field_validator
from shapely.geometry.base import BaseGeometry

from radiotwin.geo import GroundHeight
from radiotwin.io.budgets import VEGETATION_CORNERS, VEGETATION_MEETINGS
from radiotwin.io.forms import Metres, Number, Table

KINDS = ("wood", "park", "tree_row")
SAMPLE_M = 2.0  # spacing of samples along links over terrain
# These bound the memory: samples, sides of outlines, links times corners of outlines
SAMPLES_AT_ONCE, SIDES_AT_ONCE, WORK_AT_ONCE = 1_000_000, 64, 5_000_000


class VegetationConfig(Table):
    """One area of vegetation, declared in `scene.toml`.

    Attributes:
        name: name in the map.
        kind: one of `KINDS`.
        height_m: height of the tree tops above the ground [m].
        rings_m: x, y of the corners of the outline, then of each clearing [m].
    """

    name: str = Field(min_length=1, max_length=200)
    kind: str
    height_m: Number = Field(gt=0, le=150)
    rings_m: list[list[tuple[Metres, Metres]]] = Field(min_length=1)

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in KINDS:
            raise ValueError(f"is {kind!r}; allowed are {', '.join(KINDS)}")
        return kind

    @field_validator("rings_m")
    @classmethod
    def _rings(cls, rings_m: list) -> list:
        if any(len(ring) < 3 for ring in rings_m):
            raise ValueError("a ring has fewer than 3 corners")
        return rings_m


@dataclass(frozen=True, eq=False)
class Vegetation:
    """Areas of vegetation that do not overlap.

    Attributes:
        areas: (k,) polygons [m]; where declared ones overlap, the higher one is kept.
        height_m: (k,) heights of the tree tops above the ground [m].
        kind: (k,) kinds, of `KINDS`.
    """

    areas: np.ndarray
    height_m: np.ndarray
    kind: np.ndarray

    @classmethod
    def of(cls, declared: Sequence[VegetationConfig]) -> "Vegetation":
        """Make areas without overlaps from declared ones; self-crossing outlines are repaired.

        Where two overlap, the higher one is kept.

        Raises:
            BadInput: the outlines have too many corners, or meet too often.
        """
        _require_few_meetings([ring for config in declared for ring in config.rings_m])
        areas, heights_m, kinds = [], [], []
        covered: BaseGeometry = shapely.MultiPolygon()
        for config in sorted(declared, key=lambda one: -one.height_m):
            outline, *holes = config.rings_m
            area = shapely.make_valid(shapely.Polygon(outline, holes))
            parts = [part for part in shapely.get_parts(shapely.get_parts(
                shapely.difference(area, covered))) if part.geom_type == "Polygon"]
            covered = shapely.union(covered, area)
            areas += parts
            heights_m += [config.height_m] * len(parts)
            kinds += [config.kind] * len(parts)
        return cls(np.array(areas, dtype=object), np.array(heights_m, dtype=float),
                   np.array(kinds, dtype=str))

    def __len__(self) -> int:
        """Return the number of areas."""
        return len(self.areas)

    def state(self) -> tuple[list[bytes], np.ndarray, list[str]]:
        """Return areas, heights and kinds, for a hash."""
        return [area.wkb for area in self.areas], self.height_m, self.kind.tolist()

    def of_kind(self, kind: str) -> "Vegetation":
        """Return the areas of one kind."""
        is_kind = self.kind == kind
        return Vegetation(self.areas[is_kind], self.height_m[is_kind], self.kind[is_kind])

    def metres_through(self, a_m: np.ndarray, b_m: np.ndarray,
                       ground: GroundHeight | None = None) -> np.ndarray:
        """Return the length of straight links inside vegetation, above the ground.

        Args:
            a_m: (n, 3) one end of each link [m].
            b_m: (n, 3) other end [m].
            ground: Function of x and y (p,) that returns the height (p,) of a terrain [m]; links
                are then sampled every `SAMPLE_M`. None: flat ground at z = 0.

        Returns:
            (n,) lengths [m]
        """
        if ground is not None:
            return self._metres_on_terrain(a_m, b_m, ground)
        through_m = np.zeros(len(a_m))
        for height_m in np.unique(self.height_m):
            areas = self.areas[self.height_m == height_m]
            rows, low_a_m, low_b_m = _cut_to_height(a_m, b_m, height_m)
            tree = shapely.STRtree(areas)
            step = max(1, WORK_AT_ONCE // int(shapely.get_num_coordinates(areas).sum()))
            for start in range(0, len(rows), step):
                part = slice(start, start + step)
                plan = np.asarray(shapely.linestrings(
                    np.stack([low_a_m[part, :2], low_b_m[part, :2]], axis=1)))
                link, area = tree.query(plan, predicate="intersects")
                inside_m = shapely.length(shapely.intersection(plan[link], areas[area]))
                plan_m = shapely.length(plan[link])
                slant_m = np.linalg.norm(low_b_m[part] - low_a_m[part], axis=1)[link]
                share = np.where(plan_m > 1e-6, inside_m / np.maximum(plan_m, 1e-6), 1.0)
                np.add.at(through_m, rows[part][link], share * slant_m)
        return through_m

    def _metres_on_terrain(self, a_m: np.ndarray, b_m: np.ndarray,
                           ground: GroundHeight) -> np.ndarray:
        """Return the length (n,) of links through vegetation on terrain [m], from samples."""
        through_m = np.zeros(len(a_m))
        if not len(self.areas):
            return through_m
        tree = shapely.STRtree(self.areas)
        length_m = np.linalg.norm(b_m - a_m, axis=1)
        plan = shapely.linestrings(np.stack([a_m[:, :2], b_m[:, :2]], axis=1))
        links = np.unique(tree.query(plan, predicate="intersects")[0])
        samples = np.maximum(np.ceil(length_m[links] / SAMPLE_M), 1).astype(int)
        parts = np.split(np.arange(len(links)), np.flatnonzero(
            np.diff(np.cumsum(samples) // SAMPLES_AT_ONCE)) + 1)
        for part in parts:
            row = np.repeat(part, samples[part])
            first = np.cumsum(samples[part]) - samples[part]
            share = (np.arange(len(row)) - np.repeat(first, samples[part]) + 0.5) / samples[row]
            link = links[row]
            sample_m = a_m[link] + share[:, None] * (b_m[link] - a_m[link])
            above_m = sample_m[:, 2] - ground(sample_m[:, 0], sample_m[:, 1])
            low = np.flatnonzero((above_m >= 0) & (above_m <= self.height_m.max()))
            point, area = tree.query(shapely.points(sample_m[low, :2]), predicate="intersects")
            inside = above_m[low[point]] <= self.height_m[area]
            hit = np.unique(low[point[inside]])  # on the border of two areas: once
            np.add.at(through_m, link[hit], (length_m[links] / samples)[row[hit]])
        return through_m


def _require_few_meetings(rings: list) -> None:
    """Raise BadInput if rings have too many corners, or too many of their sides cross or touch.

    Otherwise shapely would take too much time and memory to repair them.
    """
    corners = sum(map(len, rings))
    VEGETATION_CORNERS.check(corners, "the vegetation")
    if not corners:
        return
    sides = np.asarray(shapely.linestrings(np.concatenate(
        [np.stack([ring, [*ring[1:], ring[0]]], axis=1) for ring in rings])))
    count_meetings(sides, SIDES_AT_ONCE,
                   lambda count: VEGETATION_MEETINGS.check(count, "the vegetation"))


def count_meetings(sides: np.ndarray, at_once: int, check: Callable[[int], None]) -> int:
    """Count the pairs of sides of polygons' rings that cross or touch, except neighbours on a ring.

    Args:
        sides: (n,) lines.
        at_once: Number of sides that are queried at once; bounds the memory.
        check: Called with the count so far; may raise an exception to stop.
    """
    tree, found = shapely.STRtree(sides), 0
    for start in range(0, len(sides), at_once):
        part = sides[start:start + at_once]
        # A side meets itself and its two neighbours; a pair is found from both sides
        found += max(tree.query(part, predicate="intersects").shape[1] - 3 * len(part), 0)
        check(found // 2)
    return found // 2


def _cut_to_height(a_m: np.ndarray, b_m: np.ndarray,
                   height_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows (m,) and ends (m, 3) of the parts of links (a, b) from z = 0 to a height [m]."""
    rise_m = b_m[:, 2] - a_m[:, 2]
    flat = np.abs(rise_m) < 1e-9
    slope = np.where(flat, 1.0, rise_m)
    at_top, at_ground = (height_m - a_m[:, 2]) / slope, -a_m[:, 2] / slope
    first = np.where(flat, 0.0, np.clip(np.minimum(at_top, at_ground), 0.0, 1.0))
    last = np.where(flat, 1.0, np.clip(np.maximum(at_top, at_ground), 0.0, 1.0))
    level = flat & (a_m[:, 2] >= 0) & (a_m[:, 2] <= height_m)
    rows = np.flatnonzero(np.where(flat, level, last > first))
    link_m = (b_m - a_m)[rows]
    return rows, a_m[rows] + first[rows, None] * link_m, a_m[rows] + last[rows, None] * link_m
