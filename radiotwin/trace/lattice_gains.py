"""Gains over a scene's lattice, part by part, each kept on disk as soon as it is solved."""

from collections.abc import Callable
from typing import Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.trace.batches import BatchStore
from radiotwin.trace.cell_gains import CellGains
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains

FINER = 10  # times the rays, for the estimate of the numerical noise
SHARE = 0.01  # of the positions are solved again for it
AT_LEAST = 8


def solve_lattice(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int]) -> np.ndarray:
    """Gains of every lattice position; only what the store lacks is solved.

    Args:
        scene: city, devices and lattice.
        settings: of the solver.
        store: of this scene and these settings.
        index: rows of `scene.config.devices`.

    Returns:
        (devices, positions) gain [dB], NaN where there is no path.

    Raises:
        BadInput: the scene cannot be read, or the store not written.
        RunFailed: no usable libLLVM.
    """
    if settings.solver == "paths":
        step, label = settings.batch_receivers, "batch"
    else:
        step, label = _plane(scene), "altitude"
    total = len(scene.lattice.positions_m)
    parts = [np.arange(start, min(start + step, total)) for start in range(0, total, step)]
    work = [(f"device-{device:03d}-{label}-{number:05d}", device, part)
            for device in index for number, part in enumerate(parts)]
    return np.concatenate(_solve(scene, settings, store, work, "tracing")).reshape(len(index), total)


def solve_finer(scene: Scene, settings: SolverSettings, store: BatchStore,
                index: list[int]) -> tuple[slice, np.ndarray, np.ndarray]:
    """Gains of a sample of links with ten times the rays, in the same memory.

    The sample is 1 % of the positions (at least 8; drawn by the settings' seed) for all devices. With the solver
    `map`, which solves whole altitudes, it is the lowest altitude for the first device.

    Returns:
        The rows and columns in what `solve_lattice` returns, and their gains (rows, columns) [dB].
    """
    total = len(scene.lattice.positions_m)
    if settings.solver == "paths":
        count = min(total, max(AT_LEAST, round(SHARE * total)))
        columns = np.sort(np.random.default_rng(settings.seed).choice(total, size=count, replace=False))
        rows, finer = slice(0, len(index)), settings.finer(FINER)
    else:
        columns, rows, finer = np.arange(_plane(scene)), slice(0, 1), settings.finer(FINER)
    work = [(f"device-{device:03d}-finer", device, columns) for device in index[rows]]
    return rows, columns, np.stack(_solve(scene, finer, store, work, "numerical noise"))


def _plane(scene: Scene) -> int:
    return len(scene.lattice.y_m) * len(scene.lattice.x_m)


def _solve(scene: Scene, settings: SolverSettings, store: BatchStore, work: list[tuple[str, int, np.ndarray]],
           description: str) -> list[np.ndarray]:
    """Gains of each (name in the store, device, positions)."""
    known: dict[str, Any] = {name: store.get(name, len(part)) for name, _, part in work}
    missing = [(name, device, part) for name, device, part in work if known[name] is None]
    if missing:
        solve = _open(scene, settings)
        with progress(description, total=sum(len(part) for _, _, part in missing)) as advance:
            for name, device, part in missing:
                known[name] = solve(device, scene.lattice.positions_m[part], advance)
                store.put(name, known[name])
    return [known[name] for name, _, _ in work]


def _open(scene: Scene, settings: SolverSettings) -> Callable[..., np.ndarray]:
    """A function of a device's row, positions and progress that gives gains by the solver that is asked for."""
    frequency_hz = scene.config.radio.frequency_hz
    if settings.solver == "paths":
        paths = PathGains(scene.xml_path, frequency_hz, settings)

        def by_paths(device, points_m, advance):
            gain_db, antennas = [], (scene.device_antennas[device], scene.uav_antenna)
            for part_db in paths.gains(scene.device_m[device], points_m, antennas):
                gain_db.append(part_db)
                advance(len(part_db))
            return np.concatenate(gain_db)

        return by_paths
    if any(antenna is not None for antenna in (*scene.device_antennas, scene.uav_antenna)):
        raise BadInput(f"{scene.folder / 'scene.toml'} declares antennas, which the solver 'map' does not know; use "
                       "the solver 'paths'")
    cells = CellGains(scene.xml_path, frequency_hz, settings, scene.lattice)

    def by_cells(device, points_m, advance):
        gain_db = cells.solve(scene.device_m[device], points_m[0, 2])
        advance(len(gain_db))
        return gain_db

    return by_cells
