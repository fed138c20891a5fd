"""Tracing in pieces: what one call of the solver gets, and the function that solves it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.cuda import share_of_gpu
from radiotwin.errors import BadInput
from radiotwin.execution import Job, Resources
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.reader import read_city
from radiotwin.scene.writer import CityShape
from radiotwin.trace.batches import BatchStore
from radiotwin.trace.cell_gains import CellGains
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import Antennas, PathGains


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
    """

    name: str
    device_m: np.ndarray
    points_m: np.ndarray
    antennas: Antennas
    batch_receivers: int

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
    resources = _resources(settings)
    if settings.solver == "paths":
        return Job(description, SolveLinks(scene, settings), resources, len, Links.halves,
                   lambda first, second: np.concatenate([first, second]))
    if any(antenna is not None for antenna in (*scene.device_antennas, scene.uav_antenna)):
        raise BadInput(f"{scene.folder / 'scene.toml'} declares antennas, which the solver 'map' "
                       "does not know; use the solver 'paths'")
    return Job(description, SolveCells(scene, settings), resources, len)


def _resources(settings: SolverSettings) -> Resources:
    memory_bytes = settings.memory_bytes()
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
