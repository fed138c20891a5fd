"""Gains over a scene's lattice, solved in parts, each kept on disk as soon as it is solved."""

from collections.abc import Callable

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.trace.batches import BatchStore
from radiotwin.trace.cell_gains import CellGains
from radiotwin.trace.settings import FINER, SolverSettings
from radiotwin.trace.solver import PathGains

# Solves one device (index), positions (n, 3) [m] and reports its progress
_Solve = Callable[[int, np.ndarray, Callable[..., None]], np.ndarray]


def solve_lattice(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int]
                  ) -> np.ndarray:
    """Return the gains of every lattice position; only what the store lacks is solved.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver.
        store: Store of this scene and these settings.
        index: Indices into `scene.config.devices`.

    Returns:
        (devices, positions) gain [dB], NaN where there is no path.

    Raises:
        BadInput: The scene cannot be read, or the store not written.
        RunFailed: No usable libLLVM.
    """
    if settings.solver == "paths":
        step, label = settings.batch_receivers, "batch"
    else:
        step, label = _plane(scene), "altitude"
    total = len(scene.lattice.positions_m)
    parts = [np.arange(start, min(start + step, total)) for start in range(0, total, step)]
    work = [(f"device-{device:03d}-{label}-{number:05d}", device, part)
            for device in index for number, part in enumerate(parts)]
    gains = _solve(scene, settings, store, work, "tracing")
    return np.concatenate(gains).reshape(len(index), total)


def solve_finer(scene: Scene, settings: SolverSettings, store: BatchStore, index: list[int]
                ) -> tuple[slice, np.ndarray, np.ndarray]:
    """Solve a sample of links with ten times the rays, in the same memory.

    The sample is 1 % of the positions (at least 8; drawn by the settings' seed) for all devices.
    With the solver `map`, which solves whole altitudes, it is the lowest altitude for the first
    device.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver.
        store: Store of this scene and these settings.
        index: Indices into `scene.config.devices`.

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
    work = [(f"device-{device:03d}-finer", device, columns) for device in index[rows]]
    gains = _solve(scene, settings.finer(FINER), store, work, "numerical noise")
    return rows, columns, np.stack(gains)


def _plane(scene: Scene) -> int:
    """Return the number of positions at one altitude."""
    return len(scene.lattice.y_m) * len(scene.lattice.x_m)


def _solve(scene: Scene, settings: SolverSettings, store: BatchStore,
           work: list[tuple[str, int, np.ndarray]], description: str) -> list[np.ndarray]:
    """Return the gains of each (name in the store, device, indices of positions)."""
    known = {name: store.get(name, len(part)) for name, _, part in work}
    missing = [(name, device, part) for name, device, part in work if known[name] is None]
    if missing:
        solve = _open(scene, settings)
        with progress(description, total=sum(len(part) for _, _, part in missing)) as advance:
            for name, device, part in missing:
                gain_db = solve(device, scene.lattice.positions_m[part], advance)
                store.put(name, gain_db)
                known[name] = gain_db
    return [gain_db for gain_db in known.values() if gain_db is not None]


def _open(scene: Scene, settings: SolverSettings) -> _Solve:
    frequency_hz = scene.config.radio.frequency_hz
    if settings.solver == "paths":
        paths = PathGains(scene.xml_path, frequency_hz, settings)
        return lambda device, points_m, advance: paths.gains(
            scene.device_m[device], points_m,
            (scene.device_antennas[device], scene.uav_antenna), advance)
    if any(antenna is not None for antenna in (*scene.device_antennas, scene.uav_antenna)):
        raise BadInput(f"{scene.folder / 'scene.toml'} declares antennas, which the solver 'map' "
                       "does not know; use the solver 'paths'")
    cells = CellGains(scene.xml_path, frequency_hz, settings, scene.lattice)

    def solve_cells(device: int, points_m: np.ndarray, advance: Callable[..., None]) -> np.ndarray:
        gain_db = cells.solve(scene.device_m[device], points_m[0, 2])
        advance(len(gain_db))
        return gain_db

    return solve_cells
