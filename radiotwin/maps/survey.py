"""Simulate a measurement campaign: UAVs fly through a truth map and read levels.

The truth is a traced map, any other radio map, or the statistical one of Chen et al. 2023: a
log-distance law for each class of line of sight, and shadowing. Flights follow the model of that
paper (Sec. II): a lattice step north, west, south or east costs 1 battery unit, a hover 0.5. A UAV
stays on the map and keeps enough battery to reach its terminal. A flight pattern is a function of
the grid of an altitude, start, battery and random generator; it returns a cell (row, column) for
each slot.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.io.budgets import ROWS
from radiotwin.io.inputs import require_within
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.runtime.console import progress
from radiotwin.scene import Scene
from radiotwin.scene.config import UavConfig

MOVES = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])  # north, west, south, east as (row, column)
MOVE_COST = 1.0  # battery units
HOVER_COST = 0.5  # battery units
UNREACHABLE = np.iinfo(np.int64).max // 4  # number of moves; small enough to add a few
Cell = tuple[int, int]
_MAX_FLIGHTS = 100_000  # more is taken for a typing error
_MAX_NOISE_DB = 50.0  # likewise: receivers' errors are a few decibels


class FlightGrid:
    """Cells of one altitude, with the number of moves between them.

    Args:
        allowed: (ny, nx) bool; False inside buildings.
        terminal: (row, column) where a flight must end.
    """

    def __init__(self, allowed: np.ndarray, terminal: Cell) -> None:
        self.allowed = allowed
        self.terminal = terminal
        self._steps: dict[Cell, np.ndarray] = {}

    def steps_to(self, cell: Cell) -> np.ndarray:
        """Count the moves from every cell (ny, nx) to `cell`; UNREACHABLE if there is no way."""
        cell = (int(cell[0]), int(cell[1]))
        if cell not in self._steps:
            steps = np.full(self.allowed.shape, UNREACHABLE)
            front, distance = np.zeros_like(self.allowed), 0
            front[cell] = self.allowed[cell]
            while front.any():
                steps[front] = distance
                spread = np.zeros_like(front)
                spread[1:] |= front[:-1]
                spread[:-1] |= front[1:]
                spread[:, 1:] |= front[:, :-1]
                spread[:, :-1] |= front[:, 1:]
                front, distance = spread & self.allowed & (steps == UNREACHABLE), distance + 1
            self._steps[cell] = steps
        return self._steps[cell]

    def steps_home(self, cell: Cell) -> int:
        """Count the moves from a cell to the terminal."""
        return int(self.steps_to(self.terminal)[tuple(cell)])

    def neighbours(self, cell: Cell) -> list[Cell]:
        """Return the allowed cells one move away."""
        rows, columns = self.allowed.shape
        cells = [(int(row), int(column)) for row, column in np.asarray(cell) + MOVES]
        return [(row, column) for row, column in cells
                if 0 <= row < rows and 0 <= column < columns and self.allowed[row, column]]

    def path(self, start: Cell, end: Cell, rng: np.random.Generator) -> list[Cell]:
        """Choose a shortest path at random; return its cells after `start`. There must be one."""
        steps, cells, cell = self.steps_to(end), [], start
        while steps[tuple(cell)] > 0:
            nearer = [n for n in self.neighbours(cell) if steps[n] < steps[tuple(cell)]]
            cell = nearer[rng.integers(len(nearer))]
            cells.append(cell)
        return cells


# Parameters of Chen et al. 2023
LOS_LAW = LogDistanceLine(-30.0, 2.5, 2**0.5)
NLOS_LAW = LogDistanceLine(-35.0, 3.04, 5**0.5)


def segmented_truth(scene: Scene | Path | str) -> RadioMap:
    """Compute a scene's statistical truth: log-distance laws with and without LoS, and shadowing.

    Mean gains include the antennas. They are not censored at the sensitivity, since a survey draws
    the shadowing before it decides what is detected.

    Args:
        scene: city, devices and lattice.

    Returns:
        A radio map with the shadowing's standard deviation as `sigma_db` [dB].
    """
    scene = Scene.of(scene)
    receiver_m = scene.lattice.positions_m
    gain_db, sigma_db, los = [], [], []
    for device_m, antenna in zip(scene.device_m, scene.device_antennas):
        seen = scene.city.line_of_sight(receiver_m, device_m[None])
        distance_m = np.sqrt(((receiver_m - device_m) ** 2).sum(axis=1))
        log_distance = np.log10(np.maximum(distance_m, 1.0))  # the law begins at 1 m
        mean_db = np.where(seen, LOS_LAW.mean_db(log_distance), NLOS_LAW.mean_db(log_distance))
        for each, direction_m in ((antenna, receiver_m - device_m),
                           (scene.uav_antenna, device_m - receiver_m)):
            mean_db = mean_db if each is None else mean_db + each.gain_dbi(direction_m)
        gain_db.append(mean_db)
        sigma_db.append(np.where(seen, LOS_LAW.sd_db, NLOS_LAW.sd_db))
        los.append(seen)
    return RadioMap.build(
        [device.device for device in scene.config.devices], scene.lattice, np.array(gain_db),
        np.array(los), np.array(sigma_db),
        {"source": "segmented", "frequency_hz": scene.config.radio.frequency_hz,
         "gain_limit_db": scene.config.gain_limit_db, "scene_hash": scene.content_hash()}
    ).with_origin(scene.config.origin)


def read_truth(scene: Scene, truth: str = "traced") -> RadioMap:
    """Read the radio map that the option `--truth` names.

    Args:
        scene: to fly in.
        truth: `traced` (SCENE/truth.nc), `segmented` (statistical), or the path of a radio map.

    Raises:
        BadInput: the scene was not traced, or the file is not a radio map.
    """
    if truth == "segmented":
        return segmented_truth(scene)
    if truth == "traced":
        path = scene.folder / "truth.nc"
        if not path.is_file():
            raise BadInput(f"{path} does not exist; run `radiotwin trace {scene.folder}` first, or "
                           "use --truth segmented")
        return RadioMap.load(require_within(scene.folder, path, str(scene.folder)))
    return RadioMap.load(truth)


# In a street, two walls and the ground give at most 16 paths of up to four reflections, each weaker
# than the direct one: 9 off the walls alone, 7 also off the ground.
_MAX_PATHS = 16


def _require_possible(scene: Scene, truth: RadioMap) -> None:
    """Raise BadInput if a traced link with line of sight is far above free space.

    The bound is the free-space gain (ITU-R P.525-4, eq. 4) between the antennas' peaks plus 12 dB,
    or 24 dB if fields were added: 16 paths as strong as the direct one. Statistical truths, and
    maps of the solver `map`, which averages over cells, are not checked.
    """
    attributes = truth.dataset.attrs
    if attributes.get("source") != "raytrace" or attributes.get("solver") != "paths":
        return
    coherent = attributes.get("combining") == "coherent"
    bound_db = (20 if coherent else 10) * np.log10(_MAX_PATHS)
    positions_m, frequency_hz = scene.lattice.positions_m, scene.config.radio.frequency_hz
    for device, site_m, antenna in zip(scene.config.devices, scene.device_m, scene.device_antennas):
        row = truth.devices.index(device.device)
        distance_m = np.maximum(np.linalg.norm(positions_m - site_m, axis=1), 0.01)
        above_db = (truth.gain_db[row].ravel() - sum(
            end.pattern.peak_dbi for end in (antenna, scene.uav_antenna) if end is not None)
            - 20 * np.log10(speed_of_light / (4 * np.pi * frequency_hz * distance_m)))
        wrong = truth.los[row].ravel() & (above_db > bound_db)
        if wrong.any():
            worst = int(np.where(wrong, above_db, -np.inf).argmax())
            position = ", ".join(f"{value:g}" for value in positions_m[worst])
            raise BadInput(
                f"{wrong.sum()} links with line of sight of {device.device} lie more than "
                f"{bound_db:.0f} dB above free space (at {position} m {above_db[worst]:+.1f} dB), "
                "which no reflections bring; versions that counted a direct path several times "
                "made such maps: run `radiotwin trace` again")


def random_waypoint(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator
                    ) -> list[Cell]:
    """Return the cells of a flight to random cells and home, as far as the battery allows."""
    cells = [start]
    while True:
        charge = battery - MOVE_COST * (len(cells) - 1)
        steps = grid.steps_to(cells[-1]) + grid.steps_to(grid.terminal)
        reachable = steps <= charge / MOVE_COST
        reachable[cells[-1]] = False
        if not reachable.any():
            return cells + grid.path(cells[-1], grid.terminal, rng)
        row, column = rng.choice(np.argwhere(reachable))
        cells += grid.path(cells[-1], (int(row), int(column)), rng)


def lawnmower(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator
              ) -> list[Cell]:
    """Return the cells of a flight in parallel lanes, as close as the battery allows.

    Ends of lanes from which the terminal cannot be reached are skipped.
    """
    cells = [start]
    for corner in _lane_ends(grid.allowed.shape, battery, rng):
        if grid.steps_home(corner) == UNREACHABLE:
            continue
        for cell in grid.path(cells[-1], corner, rng):
            if MOVE_COST * (len(cells) + grid.steps_home(cell)) > battery:
                return cells + grid.path(cells[-1], grid.terminal, rng)
            cells.append(cell)
    return cells + grid.path(cells[-1], grid.terminal, rng)


def _lane_ends(shape: tuple[int, ...], battery: float, rng: np.random.Generator) -> list[Cell]:
    """Return the end cells of a lawnmower's lanes, in the order of the flight.

    Direction, offset and order of the lanes are random; the battery decides how many there are.
    """
    along = int(rng.integers(2))  # axis that lanes run along
    lane_length, width = shape[along], shape[1 - along]
    lanes_affordable = max(int(battery / MOVE_COST // lane_length), 2)
    spacing = max(int(np.ceil(width / lanes_affordable)), 1)
    lanes = np.arange(rng.integers(spacing), width, spacing)
    if rng.integers(2):
        lanes = lanes[::-1]
    ends = []
    for number, lane in enumerate(lanes):
        far, near = (lane_length - 1, 0) if number % 2 else (0, lane_length - 1)
        ends += [(far, lane), (near, lane)]
    return [(int(a), int(b)) if along == 0 else (int(b), int(a)) for a, b in ends]


def random_walk(grid: FlightGrid, start: Cell, battery: float, rng: np.random.Generator
                ) -> list[Cell]:
    """Return cells of moves and hovers, equally probable, while the terminal stays in reach."""
    cells, charge = [start], battery
    while True:
        options = [(cell, MOVE_COST) for cell in grid.neighbours(cells[-1])]
        options.append((cells[-1], HOVER_COST))
        safe = [(cell, cost) for cell, cost in options
                if grid.steps_home(cell) * MOVE_COST <= charge - cost]
        if not safe:
            return cells
        cell, cost = safe[rng.integers(len(safe))]
        cells.append(cell)
        charge -= cost


PATTERNS = {"random-waypoint": random_waypoint, "lawnmower": lawnmower, "random-walk": random_walk}


def fly_survey(scene: Scene | Path | str, truth: RadioMap | str = "traced", *, flights: int = 5,
               pattern: str = "random-waypoint", seed: int = 0, noise_db: float | None = None
               ) -> Measurements:
    """Simulate flights of a scene's UAVs through a truth map, and the levels they measure.

    Args:
        scene: UAVs, devices and sensitivity.
        truth: map over the scene's lattice, or an argument of `read_truth`; if it has `sigma_db`,
            shadowing is drawn anew for every link.
        flights: number of flights; in each, every UAV of the scene flies once.
        pattern: key of `PATTERNS`.
        seed: of paths and noise; the n-th flight does not depend on the number of flights.
        noise_db: standard deviation of the receivers' measurement error [dB]; None: 1, or 0 if the
            truth has shadowing (`sigma_db`).

    Returns:
        The measurements; unknown devices have no x and y.

    Raises:
        BadInput: an unknown pattern, no flight, no UAV, more rows than a table may have, a map of
            another scene, or gains that are physically impossible.
    """
    scene = Scene.of(scene)
    if isinstance(truth, str):
        truth = read_truth(scene, truth)
    if noise_db is None:
        noise_db = 0.0 if "sigma_db" in truth.dataset else 1.0
    _check(scene, truth, flights, pattern, noise_db)
    limit_db = scene.config.gain_limit_db
    row_of = {name: row for row, name in enumerate(truth.devices)}
    rows = [row_of[device.device] for device in scene.config.devices]
    gain_db = truth.gain_db[rows].reshape(len(rows), -1).astype(float)
    shadowing_sd_db = None
    if "sigma_db" in truth.dataset:
        shadowing_sd_db = truth.dataset["sigma_db"].values[rows].reshape(gain_db.shape)
    slot_s, start_s, tables = scene.config.mission.slot_s, 0.0, []
    with progress("flying", total=flights) as advance:
        for flight in range(flights):
            longest = 0
            for number, uav in enumerate(scene.config.uavs):
                rng = np.random.default_rng([seed, flight, number])
                cells = fly(scene, uav, pattern, rng)
                index = np.ravel_multi_index((_level(scene, uav), *cells.T), scene.lattice.shape)
                # NumPy refuses -0.0 for a standard deviation.
                error_db = rng.normal(0, abs(noise_db), (len(gain_db), len(index)))
                level_db = gain_db[:, index] + error_db
                if shadowing_sd_db is not None:
                    level_db += rng.normal(0, 1, level_db.shape) * shadowing_sd_db[:, index]
                level_db[level_db < limit_db] = np.nan
                time_s = start_s + slot_s * np.arange(len(index))
                tables.append(link_table(scene, f"f{flight}", uav.uav, index, level_db, time_s,
                                         heading_deg(cells)))
                longest = max(longest, len(index))
            start_s += slot_s * longest
            advance(1)
    return Measurements(pd.concat(tables, ignore_index=True), declared_devices(scene),
                        scene.config.origin)


def declared_devices(scene: Scene) -> pd.DataFrame:
    """Return a scene's devices as rows of `devices.csv`; of unknown ones only the height."""
    rows = [(device.device,
             *((device.x_m, device.y_m) if device.role == "anchor" else (np.nan, np.nan)),
             device.z_m, device.role)
            for device in scene.config.devices]
    return pd.DataFrame(rows, columns=["device", "x_m", "y_m", "z_m", "role"])


def fly(scene: Scene, uav: UavConfig, pattern: str, rng: np.random.Generator) -> np.ndarray:
    """Simulate one flight of a UAV; return its cells (slots, 2) from start to terminal.

    BadInput if the battery does not reach from start to terminal.
    """
    lattice = scene.lattice
    start, terminal = ((round((y_m - lattice.y_m[0]) / lattice.step_m),
                        round((x_m - lattice.x_m[0]) / lattice.step_m))
                       for x_m, y_m in ((uav.start_x_m, uav.start_y_m),
                                        (uav.terminal_x_m, uav.terminal_y_m)))
    grid = FlightGrid(~scene.blocked[_level(scene, uav)], terminal)
    needed = grid.steps_home(start) * MOVE_COST
    if needed > uav.battery:
        raise BadInput(f"uav {uav.uav!r}: battery = {uav.battery:g} does not reach from its start "
                       f"to its terminal ({needed:g} moves are needed); raise it in "
                       f"{scene.folder / 'scene.toml'}")
    return np.array(PATTERNS[pattern](grid, start, uav.battery, rng))


def _level(scene: Scene, uav: UavConfig) -> int:
    """Return the index of the lattice altitude nearest to a UAV's."""
    return int(np.abs(scene.lattice.z_m - uav.altitude_m).argmin())


def heading_deg(cells: np.ndarray) -> np.ndarray:
    """Return the heading (slots,) [degrees clockwise from north] along cells (slots, 2).

    It is that of the last move; before the first move that of the first; 0 without any move.
    """
    moves = np.diff(cells, axis=0)
    heading = pd.Series(np.full(len(cells), np.nan))
    moved = np.flatnonzero(moves.any(axis=1))
    heading[moved + 1] = np.degrees(np.arctan2(moves[moved, 1], moves[moved, 0])) % 360
    return heading.ffill().bfill().fillna(0.0).to_numpy()


def link_table(scene: Scene, flight: str, receiver: str, index: np.ndarray, level_db: np.ndarray,
               time_s: np.ndarray, heading_deg: np.ndarray) -> pd.DataFrame:
    """Return the measurements of one receiver on one flight as rows of `Measurements.table`.

    The receiver was at the flat lattice indices (slots,), and read channel gains `level_db`
    (devices, slots) [dB], NaN if not detected; they are rounded to 0.001 dB.
    """
    devices, slots = len(level_db), len(index)
    position_m = scene.lattice.positions_m[index]
    return pd.DataFrame({
        "time_s": np.repeat(time_s, devices), "flight": flight, "receiver": receiver,
        **{f"receiver_{axis}_m": np.repeat(position_m[:, i], devices)
           for i, axis in enumerate("xyz")},
        "device": np.tile([device.device for device in scene.config.devices], slots),
        "gain_db": level_db.T.ravel().round(3), "heading_deg": np.repeat(heading_deg, devices),
    })


def _check(scene: Scene, truth: RadioMap, flights: int, pattern: str, noise_db: float) -> None:
    """Raise BadInput for arguments of `fly_survey` that cannot be flown."""
    path = scene.folder / "scene.toml"
    if pattern not in PATTERNS:
        raise BadInput(f"pattern {pattern!r} is unknown; allowed are {', '.join(PATTERNS)}")
    if not 1 <= flights <= _MAX_FLIGHTS:
        raise BadInput(f"flights = {flights}: allowed is 1 to {_MAX_FLIGHTS}")
    if not 0 <= noise_db <= _MAX_NOISE_DB:
        raise BadInput(f"noise_db = {noise_db}: allowed is 0 to {_MAX_NOISE_DB:g} dB, the standard "
                       "deviation of a receiver's error")
    if not scene.config.uavs:
        raise BadInput(f"{path}: declares no UAV; add at least one [[uavs]] table, or build the "
                       "scene with --uavs N")
    if not scene.config.devices:
        raise BadInput(f"{path}: declares no device; add some, each as a table\n\n"
                       "[[devices]]\ndevice = 'd0'\nx_m = 10.0\ny_m = 20.0\nz_m = 1.5\n"
                       "role = 'anchor'\n\nor build the scene with --devices N")
    slot_cost = HOVER_COST if pattern == "random-walk" else MOVE_COST  # only that pattern hovers
    slots = flights * sum(uav.battery // slot_cost + 1 for uav in scene.config.uavs)
    ROWS.check(slots * len(scene.config.devices), f"{path}: {flights} flights, as far as the "
               "batteries of its UAVs go")
    truth.require_made_for(scene)
    _require_possible(scene, truth)
