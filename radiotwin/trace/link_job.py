"""Tracing in batches of links: `LinkBatch`, the solvers of a batch, and the cache of their gains.

Each finished batch of a map is kept on disk, so that an interrupted trace can be resumed.

Large cities are traced by tiles: batches of links that lie close together, with only the geometry
around them. A path of length L between ends at the distance d stays within r = sqrt(L² - d²) / 2 of
their straight line (the foci of an ellipsoid). So geometry farther than a culling radius from the
line only matters for paths longer than a limit.
"""

import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_path
from radiotwin.io.inputs import read_bytes, require_within
from radiotwin.io.signals import note_finished
from radiotwin.runtime.cuda import share_of_gpu
from radiotwin.runtime.execution import Executor, Job, Resources
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.folder import CityShape, read_city
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.materials import Material
from radiotwin.trace.settings import FINER, SolverSettings
from radiotwin.trace.solver import Antennas, CellGains, PathGains

# Calls of the solver that estimate the effect of exchanging the ends of links: a tenth of the
# map's, within these bounds
MIN_EXCHANGED, MAX_EXCHANGED = 8, 50
GEOMETRY_COPIES = 3  # of a packed city in a worker's memory: received, unpacked, and its tile
MANY_SHAPES = 5_000
"""A city with more shapes is traced by tiles, unless the settings have a radius."""
RADIUS_M = 400.0
"""Default culling radius; its error is in docs/scale.md."""
OMITTED_DB = 20.0
"""Paths may be left out for their length if they are this far below the limit of detection: they
have 1 % of the power of the weakest detected link."""


@dataclass(frozen=True)
class Tile:
    """The part of a city that a batch of links is traced in.

    Attributes:
        hull_m: Corners (x, y) of the convex hull of the links' ends [m].
        radius_m: Shapes farther from the hull are left out [m].
    """

    hull_m: tuple[tuple[float, float], ...]
    radius_m: float


@dataclass(frozen=True, eq=False)
class PackedCity:
    """A city in a few arrays, which take no more memory than its triangles.

    Attributes:
        vertices_m: (v, 3) positions [m].
        faces: (f, 3) indices of vertices, shape by shape.
        first_face: (n + 1,) first face of each of n shapes.
        material: (n,) index of each shape's material.
        materials: All materials.
    """

    vertices_m: np.ndarray
    faces: np.ndarray
    first_face: np.ndarray
    material: np.ndarray
    materials: tuple[Material, ...]

    @classmethod
    def of(cls, shapes: Sequence[CityShape]) -> "PackedCity":
        """Pack the shapes of a city into common arrays of vertices, faces and materials."""
        starts = np.cumsum([0, *(len(shape.mesh.vertices) for shape in shapes)])
        row = {material: index for index, material in
               enumerate(dict.fromkeys(shape.material for shape in shapes))}
        return cls(np.concatenate([np.asarray(shape.mesh.vertices) for shape in shapes]),
                   np.concatenate([np.asarray(shape.mesh.faces) + start
                                   for shape, start in zip(shapes, starts)]),
                   np.cumsum([0, *(len(shape.mesh.faces) for shape in shapes)]),
                   np.array([row[shape.material] for shape in shapes]), tuple(row))

    def __len__(self) -> int:
        return len(self.material)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        return self.vertices_m.nbytes + self.faces.nbytes

    @cached_property
    def _boxes(self) -> Any:
        """(n,) bounding rectangles of the shapes in the plane."""
        import shapely

        corner_m = self.vertices_m[self.faces][..., :2]
        filled = np.diff(self.first_face) > 0
        bounds_m = np.full((len(self), 4), np.nan)  # of a shape without faces: near no tile
        starts = self.first_face[:-1][filled]
        bounds_m[filled, :2] = np.minimum.reduceat(corner_m.min(axis=1), starts)
        bounds_m[filled, 2:] = np.maximum.reduceat(corner_m.max(axis=1), starts)
        return shapely.box(*bounds_m.T)

    def near(self, tile: Tile) -> np.ndarray:
        """Return (n,) bool: shapes whose bounding rectangle is within a tile's radius of its hull.

        The ground, which extends everywhere, is always among them.
        """
        import shapely

        hull = shapely.MultiPoint(tile.hull_m).convex_hull
        shapely.prepare(hull)
        return shapely.dwithin(self._boxes, hull, tile.radius_m)

    def part(self, chosen: np.ndarray) -> list[CityShape]:
        """Return the shapes where `chosen` (n,) is True, joined to one shape per material."""
        import trimesh

        shape = np.repeat(np.arange(len(self)), np.diff(self.first_face))
        part = []
        for row, material in enumerate(self.materials):
            faces = self.faces[(chosen & (self.material == row))[shape]]
            if len(faces):
                used, renumbered = np.unique(faces, return_inverse=True)
                mesh = trimesh.Trimesh(self.vertices_m[used], renumbered.reshape(-1, 3),
                                       process=False)
                part.append(CityShape(f"part-{row}", mesh, material))
        return part


def with_radius(scene: Scene, settings: SolverSettings) -> SolverSettings:
    """Return settings with the culling radius `RADIUS_M` in a city of over `MANY_SHAPES` meshes.

    Geometry farther than the culling radius from the lines of sight is left out of tracing. A
    radius that is given stays; so do settings of the solver `map`.
    """
    if settings.solver != "paths" or settings.radius_m is not None:
        return settings
    folder = scene.folder / "meshes"
    shapes = sum(1 for _ in folder.iterdir()) if folder.is_dir() else 0
    return replace(settings, radius_m=RADIUS_M) if shapes > MANY_SHAPES else settings


def longest_path_m(scene: Scene) -> float:
    """Return the length beyond which a path is too weak to matter, and can be left out [m].

    A path of this length in free space, at the peaks of both antennas, is `OMITTED_DB` below the
    limit of detection; reflections and diffraction only weaken it.
    """
    peaks_dbi = [0.0 if antenna is None else antenna.pattern.peak_dbi
                 for antenna in scene.device_antennas]
    uav_dbi = 0.0 if scene.uav_antenna is None else scene.uav_antenna.pattern.peak_dbi
    budget_db = (OMITTED_DB - scene.config.gain_limit_db + max(peaks_dbi, default=0.0) + uav_dbi)
    wavelength_m = speed_of_light / scene.config.radio.frequency_hz
    return float(wavelength_m / (4 * np.pi) * 10 ** (budget_db / 20))


def tile_of(device_m: np.ndarray, points_m: np.ndarray, radius_m: float | None, longest_m: float
            ) -> Tile | None:
    """Return the tile, the part of a city to trace in, for links from a device to points (n, 3).

    Positions are in metres. Shapes farther than the tile's radius from the convex hull of device
    (3,) and points are left out. The radius is `radius_m`, or less if even paths of the length
    `longest_m` stay closer to the straight line between their ends. None: the whole city, if
    `radius_m` is None or infinite.
    """
    import shapely

    if radius_m is None or math.isinf(radius_m):
        return None
    nearest_m = np.linalg.norm(points_m - device_m, axis=1).min()
    aside_m = math.sqrt(max(longest_m**2 - nearest_m**2, 0.0)) / 2
    ends_m = np.vstack([device_m[:2], points_m[:, :2]])
    hull = shapely.MultiPoint(ends_m).convex_hull
    corners_m = tuple((float(x), float(y)) for x, y in shapely.get_coordinates(hull))
    return Tile(corners_m, min(radius_m, aside_m))


def batches_by_place(points_m: np.ndarray, size: int) -> list[np.ndarray]:
    """Split points (n, 3) into batches of neighbouring points, each of ascending indices.

    As for a k-d tree, the points are halved across their longer side, again and again. All batches
    but one are full: a batch takes the same time for any number of points.
    """
    def split(index: np.ndarray) -> list[np.ndarray]:
        batches = math.ceil(len(index) / size)
        if batches < 2:
            return [np.sort(index)]
        x_m, y_m, z_m = points_m[index].T
        long_m, short_m = (x_m, y_m) if np.ptp(x_m) >= np.ptp(y_m) else (y_m, x_m)
        index = index[np.lexsort((z_m, short_m, long_m))]
        return [*split(index[:batches // 2 * size]), *split(index[batches // 2 * size:])]

    return split(np.arange(len(points_m))) if len(points_m) else []


class BatchStore:
    """Cache of the gains of finished batches of one trace, as files in the scene folder.

    Args:
        scene_folder: Scene folder; the files are in `cache/trace-<hash>`.
        key: Everything that the gains depend on.

    Attributes:
        hash: SHA-256 of the key.
        folder: Folder of the files.
    """

    def __init__(self, scene_folder: Path, key: dict[str, Any]) -> None:
        text = json.dumps(key, sort_keys=True, indent=1)
        self.hash = hashlib.sha256(text.encode()).hexdigest()
        self.folder = require_within(scene_folder,
                                     scene_folder / "cache" / f"trace-{self.hash[:12]}",
                                     str(scene_folder))
        if not (self.folder / "key.json").is_file():
            with atomic_path(self.folder / "key.json") as temporary:
                temporary.write_text(text + "\n", encoding="utf-8")

    def get(self, piece: "LinkBatch") -> tuple[np.ndarray] | None:
        """Load the gains (n,) of a batch [dB] in a tuple of one; None if absent or damaged."""
        try:
            data = read_bytes(self.folder / f"{piece.name}.npy", "batch of a trace")
        except BadInput:
            return None
        if len(data) < 8 * len(piece):
            return None
        array = np.frombuffer(data[len(data) - 8 * len(piece):], dtype=float)
        if data != _file_content(array):  # another header than `put` writes
            return None
        note_finished()
        return (array,)

    def put(self, piece: "LinkBatch", result: np.ndarray, messages: list[str],
            seconds: float) -> None:
        """Save the gains of a batch, completely or not at all; messages and time are not kept."""
        with atomic_path(self.folder / f"{piece.name}.npy") as temporary:
            temporary.write_bytes(_file_content(result))
        note_finished()


def _file_content(array: np.ndarray) -> bytes:
    """Return the content of a `.npy` file of an array of floats."""
    file = io.BytesIO()
    np.save(file, np.asarray(array, dtype=float), allow_pickle=False)
    return file.getvalue()


@dataclass(frozen=True, eq=False)
class LinkBatch:
    """Links from one device that are solved together.

    Batches do not depend on the number of workers: in rare cases a gain depends on the points that
    are solved with it.

    Attributes:
        name: Name in the cache.
        device_m: (3,) position of the device [m].
        points_m: (n, 3) positions of the receivers [m].
        antennas: Antennas of the device and of the receivers; None: isotropic.
        batch_receivers: Number of receivers in a call, see `SolverSettings`.
        tile: Part of the city that they are solved in; None: all of it.
    """

    name: str
    device_m: np.ndarray
    points_m: np.ndarray
    antennas: Antennas
    batch_receivers: int
    tile: Tile | None = None

    def __len__(self) -> int:
        return len(self.points_m)

    def halves(self) -> "tuple[LinkBatch, LinkBatch] | None":
        """Split the batch into two of half the memory; None if it, or a call, has one point."""
        if len(self) < 2 or self.batch_receivers < 2:
            return None
        middle, step = (len(self) + 1) // 2, (self.batch_receivers + 1) // 2
        return (replace(self, name=f"{self.name}-half-0", points_m=self.points_m[:middle],
                        batch_receivers=step),
                replace(self, name=f"{self.name}-half-1", points_m=self.points_m[middle:],
                        batch_receivers=step))


def link_pieces(scene: Scene, settings: SolverSettings,
                devices: Sequence[tuple[str, np.ndarray, Antenna | None]], points_m: np.ndarray,
                size: int | None = None) -> tuple[list[LinkBatch], np.ndarray]:
    """Divide the links from several devices to the same points (n, 3) [m] into batches.

    Points are batched in their order; where only a part of the city (a tile) is traced, batches are
    of neighbouring points. Devices have a prefix of the batches' names, position (3,) [m] and
    antenna. Batches have up to `size` points; None: `settings.batch_receivers`. Also returns the
    indices (n,) of the points in the order in which each device's batches hold them.
    """
    size = size or settings.batch_receivers
    longest_m = longest_path_m(scene)
    if settings.is_tiled:
        batches = batches_by_place(points_m, size)
    else:
        batches = [np.arange(start, min(start + size, len(points_m)))
                   for start in range(0, len(points_m), size)]
    pieces = []
    for name, device_m, antenna in devices:
        for number, batch in enumerate(batches):
            tile = tile_of(device_m, points_m[batch], settings.radius_m, longest_m)
            pieces.append(LinkBatch(f"{name}-{number:05d}", device_m, points_m[batch],
                                    (antenna, scene.uav_antenna), settings.batch_receivers, tile))
    return pieces, np.concatenate([np.zeros(0, dtype=int), *batches])


class SolveBatch:
    """Computes the gains of a batch: along paths, in its tile or the whole city; or over cells.

    The solver takes seconds to construct: this is done for the first batch, and for another tile.
    Pickled, the object holds the geometry, so that another process reads no file.
    """

    def __init__(self, scene: Scene, settings: SolverSettings) -> None:
        self._city: Any = scene.xml_path  # or its shapes, when pickled; or a `PackedCity`
        self._frequency_hz, self._settings = scene.config.radio.frequency_hz, settings
        self._lattice: Lattice = scene.lattice
        self.geometry_bytes = 0  # memory of the geometry in addition to the solver's
        if settings.is_tiled:
            self._city = PackedCity.of(read_city(scene.xml_path))
            self.geometry_bytes = GEOMETRY_COPIES * self._city.nbytes
        self._solver: Any = None
        self._solved: tuple[Tile | None, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        city = read_city(self._city) if isinstance(self._city, Path) else self._city
        return self.__dict__ | {"_city": city, "_solver": None}

    def __call__(self, piece: LinkBatch) -> np.ndarray:
        """Return the gains (n,) of a batch [dB]; with the solver `map` it is one altitude."""
        if self._settings.solver == "map":
            self._solver = self._solver or CellGains(self._city, self._frequency_hz,
                                                     self._settings, self._lattice)
            return self._solver.solve(piece.device_m, piece.points_m[0, 2])
        if self._solver is None or self._solved != (piece.tile, piece.batch_receivers):
            self._solver = None  # frees the memory of the last tile first
            settings = replace(self._settings, batch_receivers=piece.batch_receivers)
            city = self._city
            if piece.tile is not None:
                city = city.part(city.near(piece.tile)) or None
            self._solver = PathGains(city, self._frequency_hz, settings)
            self._solved = piece.tile, piece.batch_receivers
        return self._solver.gains(piece.device_m, piece.points_m, piece.antennas)


def link_job(scene: Scene, settings: SolverSettings,
             description: str) -> Job[LinkBatch, np.ndarray]:
    """Return the job for an executor: the function that traces a batch, and the memory it needs.

    A batch of the solver `paths` that needs too much memory is halved. BadInput if the scene has
    antennas, and the solver is `map`.
    """
    if settings.solver == "map" and scene.has_antennas:
        raise BadInput(f"{scene.folder / 'scene.toml'} declares antennas, which the solver 'map' "
                       "does not know; use the solver 'paths'")
    solve = SolveBatch(scene, settings)
    memory_bytes = settings.memory_bytes() + solve.geometry_bytes
    resources = Resources(memory_bytes)
    if settings.compute_device != "cpu":
        # The GPU's memory; the use of main memory has not been measured
        resources = Resources(memory_bytes, is_bound=False, gpu_share=share_of_gpu(memory_bytes))
    if settings.solver == "map":
        return Job(description, solve, resources, len)
    return Job(description, solve, resources, len, LinkBatch.halves,
               lambda first, second: np.concatenate([first, second]))


def solve_lattice(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int],
                  executor: Executor, columns: np.ndarray | None = None, label: str = "",
                  description: str = "tracing") -> np.ndarray:
    """Trace the links from devices to lattice positions; batches in the cache are not solved again.

    `columns` are indices of positions, None: all; `label` is a part of the batches' names. Returns
    (devices, positions) gains [dB], NaN where there is no path, or `IMPOSSIBLE_DB`.
    """
    pieces, order = lattice_pieces(scene, settings, index, columns, label)
    job = link_job(scene, settings, description)
    solved_db = np.concatenate(executor.run(job, pieces, store))
    gain_db = np.empty((len(solved_db) // len(order), len(order)))
    gain_db[:, order] = solved_db.reshape(gain_db.shape)
    return gain_db


def solve_finer(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int],
                executor: Executor) -> tuple[slice, np.ndarray, np.ndarray]:
    """Trace a sample of a map's links with ten times the rays, to estimate the numerical noise.

    The sample is 1 % of the positions (at least 8; drawn by the settings' seed) for all devices.
    With the solver `map`, which solves whole altitudes, it is the lowest altitude for the first
    device. Returns rows (devices) and columns (positions) of the map, and their gains (rows,
    columns) [dB].
    """
    total = len(scene.lattice.positions_m)
    if settings.solver == "paths":
        rng = np.random.default_rng(settings.seed)
        columns = np.sort(rng.choice(total, size=sample_size(scene), replace=False))
        rows = slice(0, len(index))
    else:
        columns, rows = np.arange(scene.lattice.y_m.size * scene.lattice.x_m.size), slice(0, 1)
    return rows, columns, solve_lattice(scene, settings.finer(FINER), store, index[rows], executor,
                                        columns, "finer", "numerical noise")


def sample_size(scene: Scene) -> int:
    """Return the number of positions that `solve_finer` samples."""
    total = len(scene.lattice.positions_m)
    return min(total, max(8, round(0.01 * total)))


def exchanged_calls(scene: Scene, settings: SolverSettings, devices: int) -> int:
    """Return the most calls of `solve_exchanged`: 10 % of the map's, 8 to 50; ≤ `sample_size`."""
    batches = devices * -(-len(scene.lattice.positions_m) // settings.batch_receivers)
    return min(sample_size(scene), max(MIN_EXCHANGED, min(MAX_EXCHANGED, batches // 10)))


def solve_exchanged(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int],
                    executor: Executor, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trace links with their ends exchanged: rays start at the receivers (the solver `paths`).

    By reciprocity the gains should not change. The lattice positions are spread evenly over
    `columns`, as many as `exchanged_calls` allows. Returns their indices, and the gains (devices,
    positions) [dB] as `solve_lattice`.
    """
    by_antenna: dict[int, list[int]] = {}  # all points of a call have the same antenna
    for device in index:
        by_antenna.setdefault(id(scene.device_antennas[device]), []).append(device)
    size = settings.batch_receivers
    groups = [devices[start:start + size] for devices in by_antenna.values()
              for start in range(0, len(devices), size)]
    max_calls = exchanged_calls(scene, settings, len(index))
    columns = columns[::max(1, -(-len(columns) * len(groups) // max_calls))]
    longest_m = longest_path_m(scene)
    pieces = []
    for column in columns:
        point_m = scene.lattice.positions_m[column]
        for devices in groups:
            digest = hashlib.sha256(str(devices).encode()).hexdigest()[:12]
            devices_m = scene.device_m[devices]
            tile = tile_of(point_m, devices_m, settings.radius_m, longest_m)
            pieces.append(LinkBatch(f"exchanged-{column:07d}-{digest}", point_m, devices_m,
                                    (scene.uav_antenna, scene.device_antennas[devices[0]]),
                                    settings.batch_receivers, tile))
    solved = executor.run(link_job(scene, settings, "exchanged ends"), pieces, store)
    gain_db = np.empty((len(index), len(columns)))
    rows = [index.index(device) for devices in groups for device in devices]
    gain_db[rows] = np.concatenate([np.zeros(0), *solved]).reshape(len(columns), len(index)).T
    return columns, gain_db


def lattice_pieces(scene: Scene, settings: SolverSettings, index: list[int],
                   columns: np.ndarray | None = None, label: str = ""
                   ) -> tuple[list[LinkBatch], np.ndarray]:
    """Divide a map into batches; also return the order (n,) of the positions in them.

    `columns` are the indices of the positions to trace (None: all); `label` goes into the batches'
    names.
    """
    points_m = scene.lattice.positions_m if columns is None else scene.lattice.positions_m[columns]
    label = label or ("batch" if settings.solver == "paths" else "altitude")
    devices = [(f"device-{device:03d}-{label}", scene.device_m[device],
                scene.device_antennas[device]) for device in index]
    size = None if settings.solver == "paths" else scene.lattice.y_m.size * scene.lattice.x_m.size
    return link_pieces(scene, settings, devices, points_m, size)
