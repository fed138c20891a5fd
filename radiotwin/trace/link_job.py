"""Tracing in pieces: what one call of the solver gets, and the function that solves it.

Gains averaged over the cells of a lattice, by Sionna RT's radio map solver.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.runtime.cuda import share_of_gpu
from radiotwin.runtime.execution import Job, Resources
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.city_files import CityShape, read_city
from radiotwin.scene.lattice import Lattice
from radiotwin.trace.batches import BatchStore
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.sionna_scene import City, import_sionna, load_city
from radiotwin.trace.solver import Antennas, PathGains, power_to_db
from radiotwin.trace.tiles import PackedCity, Tile, batches_by_place, longest_path_m, tile_of

GEOMETRY_COPIES = 3  # of a packed city in a worker: as received, unpacked, and a tile of it


class CellGains:
    """Gains from one device to the cells around lattice positions, one altitude at a time.

    A cell is a horizontal square of side `lattice.step_m`, centred on its position. Its gain is the
    power that all rays carry through it: an average over 400 m² where the step is 20 m, not the
    gain at a point. So the border of a shadow is blurred, and a link in it has no sharp LoS.

    Args:
        city: `city.xml` of a scene folder, or what `read_city` returns; None for free space.
        frequency_hz: Frequency [Hz].
        settings: Settings with solver `map`.
        lattice: Positions.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: No usable libLLVM.
    """

    def __init__(self, city: City, frequency_hz: float, settings: SolverSettings,
                 lattice: Lattice) -> None:
        self.settings = settings
        self.lattice = lattice
        self._city = load_city(city, frequency_hz, settings.compute_device)
        rt = import_sionna(settings.compute_device)
        self._solver = rt.RadioMapSolver()
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._city.add(self._transmitter)

    def solve(self, device_m: np.ndarray, z_m: float) -> np.ndarray:
        """Solve one altitude.

        Args:
            device_m: (3,) position [m].
            z_m: Altitude [m].

        Returns:
            (ny * nx,) gain [dB]; NaN where no ray came through.
        """
        import drjit

        settings, lattice = self.settings, self.lattice
        step_m = lattice.step_m
        self._transmitter.position = [float(value) for value in device_m]
        radio_map = self._solver(
            self._city,
            center=[float(np.mean(lattice.x_m)), float(np.mean(lattice.y_m)), float(z_m)],
            orientation=[0.0, 0.0, 0.0], cell_size=[step_m, step_m],
            size=[len(lattice.x_m) * step_m, len(lattice.y_m) * step_m],
            samples_per_tx=settings.samples_per_src, max_depth=settings.max_depth,
            refraction=settings.refraction, diffraction=settings.diffraction, seed=settings.seed)
        power = np.array(radio_map.path_gain, dtype=float).reshape(-1)
        del radio_map
        drjit.flush_malloc_cache()
        return power_to_db(power)


@dataclass(frozen=True, eq=False)
class Links:
    """Links from one device that are solved together: one piece of a trace.

    What a piece holds does not depend on the number of workers, as a gain depends, in rare cases,
    on the points that are solved with it.

    Attributes:
        name: In the store.
        device_m: (3,) position of the device [m].
        points_m: (n, 3) positions of the receivers [m].
        antennas: Of the device and of the receivers; None: isotropic.
        batch_receivers: As in `SolverSettings`.
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

    def halves(self) -> "tuple[Links, Links] | None":
        """Return two pieces that are solved in half the memory; None where it has one point."""
        if len(self) < 2 or self.batch_receivers < 2:
            return None
        middle, step = (len(self) + 1) // 2, (self.batch_receivers + 1) // 2
        return (replace(self, name=f"{self.name}-half-0", points_m=self.points_m[:middle],
                        batch_receivers=step),
                replace(self, name=f"{self.name}-half-1", points_m=self.points_m[middle:],
                        batch_receivers=step))


def link_pieces(scene: Scene, settings: SolverSettings,
                devices: Sequence[tuple[str, np.ndarray, Antenna | None]], points_m: np.ndarray,
                size: int | None = None) -> tuple[list[Links], np.ndarray]:
    """Return the links of some devices to the same points in pieces.

    Points are solved together in their order, or where there are tiles by place.

    Args:
        scene: City, UAVs' antenna and limit of detection.
        settings: Of the solver.
        devices: Name before those of its pieces, (3,) position [m] and antenna of each.
        points_m: (n, 3) positions of the receivers [m].
        size: Most points of a piece; None: those of a call of the solver `paths`.

    Returns:
        The pieces, device by device, and the (n,) index of the points in their order.
    """
    size = size or settings.batch_receivers
    if settings.is_tiled:
        batches = batches_by_place(points_m, size)
        longest_m = longest_path_m(scene)
    else:
        batches = [np.arange(start, min(start + size, len(points_m)))
                   for start in range(0, len(points_m), size)]
    pieces = []
    for name, device_m, antenna in devices:
        for number, batch in enumerate(batches):
            tile = None
            if settings.radius_m is not None and settings.is_tiled:
                tile = tile_of(device_m, points_m[batch], settings.radius_m, longest_m)
            pieces.append(Links(f"{name}-{number:05d}", device_m, points_m[batch],
                                (antenna, scene.uav_antenna), settings.batch_receivers, tile))
    return pieces, np.concatenate([np.zeros(0, dtype=int), *batches])


class _Solve:
    """Solves pieces; the solver, which takes seconds to make, is made with the first one.

    Sent to another process, it takes the geometry along, and reads no file there.
    """

    def __init__(self, scene: Scene, settings: SolverSettings) -> None:
        self._city: Path | Sequence[CityShape] | None = scene.xml_path
        self._frequency_hz, self._settings = scene.config.radio.frequency_hz, settings
        self._solver: Any = None

    def __getstate__(self) -> dict[str, Any]:
        city = read_city(self._city) if isinstance(self._city, Path) else self._city
        return self.__dict__ | {"_city": city, "_solver": None}


class SolveLinks(_Solve):
    """Gains along paths, see `PathGains`."""

    def __call__(self, piece: Links) -> np.ndarray:
        """Return (n,) gains [dB]."""
        if self._solver is None or self._solver.settings.batch_receivers != piece.batch_receivers:
            settings = replace(self._settings, batch_receivers=piece.batch_receivers)
            self._solver = PathGains(self._city, self._frequency_hz, settings)
        return self._solver.gains(piece.device_m, piece.points_m, piece.antennas)


class SolveTiles:
    """Gains along paths in the part of the city that a piece reaches.

    The solver of the last tile is kept, as neighbouring pieces may share it.

    Attributes:
        shapes: Number of shapes in that tile.
    """

    def __init__(self, scene: Scene, settings: SolverSettings) -> None:
        self._city = PackedCity.of(read_city(scene.xml_path))
        self._frequency_hz, self._settings = scene.config.radio.frequency_hz, settings
        self._solved: tuple[Tile | None, int] | None = None
        self._solver: Any = None
        self.shapes = 0

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_solved": None, "_solver": None}

    @property
    def geometry_bytes(self) -> int:
        """Memory that the geometry takes beside the solver's own."""
        return GEOMETRY_COPIES * self._city.nbytes

    def __call__(self, piece: Links) -> np.ndarray:
        """Return (n,) gains [dB]."""
        assert piece.tile is not None
        if self._solved != (piece.tile, piece.batch_receivers):
            self._solver = None  # frees the last one's memory first
            settings = replace(self._settings, batch_receivers=piece.batch_receivers)
            kept = self._city.near(piece.tile)
            self.shapes = int(kept.sum())
            part = self._city.part(kept)
            self._solver = PathGains(part or None, self._frequency_hz, settings)
            self._solved = piece.tile, piece.batch_receivers
        return self._solver.gains(piece.device_m, piece.points_m, piece.antennas)


class SolveCells(_Solve):
    """Gains averaged over cells, see `CellGains`; a piece is one altitude of the lattice."""

    def __init__(self, scene: Scene, settings: SolverSettings) -> None:
        super().__init__(scene, settings)
        self._lattice: Lattice = scene.lattice

    def __call__(self, piece: Links) -> np.ndarray:
        """Return (n,) gains [dB]."""
        if self._solver is None:
            self._solver = CellGains(self._city, self._frequency_hz, self._settings, self._lattice)
        return self._solver.solve(piece.device_m, piece.points_m[0, 2])


def link_job(scene: Scene, settings: SolverSettings, description: str) -> Job[Links, np.ndarray]:
    """Return the job that traces pieces.

    Args:
        scene: City and frequency.
        settings: Of the solver.
        description: Shown with the progress.

    Raises:
        BadInput: Antennas, which the solver `map` does not know.
    """
    if settings.is_tiled:
        solve = SolveTiles(scene, settings)
        return Job(description, solve, _resources(settings, solve.geometry_bytes), len,
                   Links.halves, lambda first, second: np.concatenate([first, second]))
    resources = _resources(settings)
    if settings.solver == "paths":
        return Job(description, SolveLinks(scene, settings), resources, len, Links.halves,
                   lambda first, second: np.concatenate([first, second]))
    if any(antenna is not None for antenna in (*scene.device_antennas, scene.uav_antenna)):
        raise BadInput(f"{scene.folder / 'scene.toml'} declares antennas, which the solver 'map' "
                       "does not know; use the solver 'paths'")
    return Job(description, SolveCells(scene, settings), resources, len)


def _resources(settings: SolverSettings, geometry_bytes: int = 0) -> Resources:
    memory_bytes = settings.memory_bytes() + geometry_bytes
    if settings.compute_device == "cpu":
        return Resources(memory_bytes)
    # It is the GPU's memory; that of the processor has not been measured.
    return Resources(memory_bytes, is_bound=False, gpu_share=share_of_gpu(memory_bytes))


@dataclass(frozen=True)
class KeptBatches:
    """The store of a trace's batches, as a job's cache."""

    store: BatchStore

    def get(self, piece: Links) -> tuple[np.ndarray] | None:
        """Return the gains of a piece in a tuple; None where they are not kept."""
        found = self.store.get(piece.name, len(piece))
        return None if found is None else (found,)

    def put(self, piece: Links, result: np.ndarray, messages: list[str], seconds: float) -> None:
        """Keep the gains of a piece."""
        self.store.put(piece.name, result)
