"""Gains over a scene's lattice, solved in parts, each kept on disk as soon as it is solved."""

import numpy as np

from radiotwin.runtime.execution import Executor
from radiotwin.scene import Scene
from radiotwin.trace.batches import BatchStore
from radiotwin.trace.link_job import KeptBatches, Links, link_job, link_pieces
from radiotwin.trace.settings import FINER, SolverSettings


def solve_lattice(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int],
                  executor: Executor) -> np.ndarray:
    """Return the gains of every lattice position; only what the store lacks is solved.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver.
        store: Store of this scene and these settings.
        index: Indices into `scene.config.devices`.
        executor: Where it runs.

    Returns:
        (devices, positions) gain [dB], NaN where there is no path.

    Raises:
        BadInput: The scene cannot be read, or the store not written.
        RunFailed: No usable libLLVM.
    """
    pieces = lattice_pieces(scene, settings, index)
    return _solve(scene, settings, store, pieces, executor, "tracing")


def solve_finer(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int],
                executor: Executor) -> tuple[slice, np.ndarray, np.ndarray]:
    """Solve a sample of links with ten times the rays, in the same memory.

    The sample is 1 % of the positions (at least 8; drawn by the settings' seed) for all devices.
    With the solver `map`, which solves whole altitudes, it is the lowest altitude for the first
    device.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver.
        store: Store of this scene and these settings.
        index: Indices into `scene.config.devices`.
        executor: Where it runs.

    Returns:
        Rows and columns in the result of `solve_lattice`, and their gains (rows, columns) [dB].

    Raises:
        BadInput: The scene cannot be read, or the store not written.
        RunFailed: No usable libLLVM.
    """
    total = len(scene.lattice.positions_m)
    if settings.solver == "paths":
        count = min(total, max(8, round(0.01 * total)))
        rng = np.random.default_rng(settings.seed)
        columns = np.sort(rng.choice(total, size=count, replace=False))
        rows = slice(0, len(index))
    else:
        columns, rows = np.arange(_plane(scene)), slice(0, 1)
    finer = settings.finer(FINER)
    pieces = lattice_pieces(scene, finer, index[rows], columns, "finer")
    gain_db = _solve(scene, finer, store, pieces, executor, "numerical noise")
    return rows, columns, gain_db


def _plane(scene: Scene) -> int:
    """Return the number of positions at one altitude."""
    return len(scene.lattice.y_m) * len(scene.lattice.x_m)


def lattice_pieces(scene: Scene, settings: SolverSettings, index: list[int],
                   columns: np.ndarray | None = None, label: str = ""
                   ) -> tuple[list[Links], np.ndarray]:
    """Return the pieces that a map is traced in, and the order of the positions in them.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver.
        index: Indices into `scene.config.devices`.
        columns: Indices of positions; None: all.
        label: Of their names; empty: that of a map's own.
    """
    points_m = scene.lattice.positions_m if columns is None else scene.lattice.positions_m[columns]
    label = label or ("batch" if settings.solver == "paths" else "altitude")
    devices = [(f"device-{device:03d}-{label}", scene.device_m[device],
                scene.device_antennas[device]) for device in index]
    size = settings.batch_receivers if settings.solver == "paths" else _plane(scene)
    return link_pieces(scene, settings, devices, points_m, size)


def _solve(scene: Scene, settings: SolverSettings, store: BatchStore,
           traced: tuple[list[Links], np.ndarray], executor: Executor, description: str
           ) -> np.ndarray:
    """Return the (devices, positions) gains of all pieces [dB]."""
    pieces, order = traced
    job = link_job(scene, settings, description)
    solved_db = np.concatenate(executor.run(job, pieces, KeptBatches(store)))
    gain_db = np.empty((len(solved_db) // len(order), len(order)))
    gain_db[:, order] = solved_db.reshape(gain_db.shape)
    return gain_db
