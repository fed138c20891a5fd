"""Gains at any points in space."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.geo import to_local
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import as_numbers, listed, read_cells, write_csv
from radiotwin.io.files import atomic_path, require_suffix, require_writable
from radiotwin.io.forms import MAX_COORDINATE_M, Origin
from radiotwin.runtime.execution import Executor
from radiotwin.runtime.pieces import KeptParts
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.citymap import CityMap
from radiotwin.trace.link_job import LinkBatch, link_job, link_pieces
from radiotwin.trace.run import device_indices, warn_of_terrain
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import IMPOSSIBLE_DB
from radiotwin.trace.tiles import with_radius

MAX_APART_M = 1.0  # two positions of a point in a file, rounded to 1e-5 degrees


def trace_gains(scene: Scene, device_m: np.ndarray, points_m: np.ndarray, settings: SolverSettings,
                antennas: list[Antenna | None] | None = None,
                executor: Executor | None = None) -> np.ndarray:
    """Trace the gains between positions; receivers have the antenna of the scene's UAVs.

    Within `keep_pieces` each finished batch is kept.

    Args:
        scene: City and frequency.
        device_m: (k, 3) positions of transmitters [m].
        points_m: (n, 3) positions of receivers [m].
        settings: Settings with solver `paths`.
        antennas: Antennas of the k transmitters; None: isotropic.
        executor: Where it runs; None: in this process.

    Returns:
        (k, n) gain [dB]; NaN where there is no path, infinite where the tracer found more power
        than the link's paths can carry, with a second seed, too.

    Raises:
        BadInput: Settings for another solver, or a scene that cannot be read.
        RunFailed: No usable libLLVM.
    """
    if settings.solver != "paths":
        raise BadInput(f"the solver {settings.solver!r} averages over lattice cells; points need "
                       "the solver 'paths'")
    settings = with_radius(scene, settings)
    pieces, order = link_pieces(scene, settings, [("", *each) for each in zip(
        device_m, antennas or [None] * len(device_m))], points_m)
    decided_by = scene.content_hash()

    def inputs(piece: LinkBatch) -> tuple:
        own = replace(settings, batch_receivers=piece.batch_receivers)
        return (decided_by, own.attributes(), piece.device_m, piece.points_m, piece.antennas,
                *([] if piece.tile is None else [piece.tile]))

    gains = (executor or Executor()).run(
        link_job(scene, settings, "tracing"), pieces,
        KeptParts("gains", inputs, lambda found: ({"gain_db": found}, len(found)),
                  lambda arrays, count: arrays["gain_db"].reshape(count)))
    gain_db = np.empty((len(device_m), len(points_m)))
    gain_db[:, order] = np.concatenate([np.zeros(0), *gains]).reshape(gain_db.shape)
    return gain_db


def trace_points(scene: Scene, points_m: np.ndarray, settings: SolverSettings | None = None,
                 out_path: Path | str | None = None, devices: list[str] | None = None,
                 executor: Executor | None = None) -> pd.DataFrame:
    """Trace the gains from a scene's devices to any points.

    Args:
        scene: City, devices and radio.
        points_m: (n, 3) positions [m].
        settings: Settings with solver `paths`; None: those of quality `default`.
        out_path: CSV file (.csv or .csv.gz); None writes nothing.
        devices: Names; None: all devices of the scene.
        executor: Where it runs; None: in this process.

    Returns:
        One row per link: device, x_m, y_m, z_m, gain_db (NaN: not detected), los, and reason:
        empty, or why there is no gain: below the ground, inside a building, within a wavelength
        (no far field, and Sionna RT drops the direct path at a centimetre), no path, impossible
        gain (more power than the link's paths can carry, with a second seed, too), or below
        sensitivity.

    Raises:
        BadInput: An unknown device, settings for another solver, too many links, or an output that
            cannot be written.
        RunFailed: No usable libLLVM.
    """
    if out_path is not None:
        require_suffix(out_path, ".csv", ".csv.gz")
        require_writable(out_path)
    settings = settings or SolverSettings.of_quality()
    points_m = np.asarray(points_m, dtype=float).reshape(-1, 3)
    index = device_indices(scene, devices)
    ROWS.check(len(index) * len(points_m), "points times devices")
    inside, below = scene.city.inside(points_m), scene.city.below_ground(points_m)
    wavelength_m = speed_of_light / scene.config.radio.frequency_hz
    antennas = [scene.device_antennas[device] for device in index]
    gain_db = trace_gains(scene, scene.device_m[index], points_m, settings, antennas,
                          executor)
    warn_of_terrain(scene.city, scene.device_m[index], points_m, np.isnan(gain_db) & ~inside)
    tables = []
    for row, device in enumerate(index):
        device_m = scene.device_m[device]
        near = np.linalg.norm(points_m - device_m, axis=1) < wavelength_m
        reason = np.select(
            [inside & below, inside, near, np.isnan(gain_db[row]),
             gain_db[row] == IMPOSSIBLE_DB, gain_db[row] < scene.config.gain_limit_db],
            ["below the ground", "inside a building", "within a wavelength", "no path",
             "impossible gain", "below sensitivity"], default="")
        tables.append(pd.DataFrame({
            "device": scene.config.devices[device].device,
            "x_m": points_m[:, 0], "y_m": points_m[:, 1], "z_m": points_m[:, 2],
            "gain_db": np.where(reason == "", gain_db[row], np.nan),
            "los": scene.city.line_of_sight(device_m[None], points_m), "reason": reason}))
    table = pd.concat(tables, ignore_index=True)
    if out_path is not None:
        with atomic_path(out_path) as temporary:
            write_csv(table, temporary)
    return table


def read_points(path: Path | str, origin: Origin | None = None,
                city: CityMap | None = None) -> np.ndarray:
    """Read points from a CSV file; columns other than those of the position are ignored.

    Args:
        path: File with the columns x_m, y_m and z_m, or latitude_deg, longitude_deg and z_m (above
            the ground datum); above_ground_m may stand for z_m.
        origin: Origin of the local frame, which latitude and longitude need.
        city: 3D map with the ground; None: the ground is at z = 0.

    Returns:
        (n, 3) positions [m].

    Raises:
        BadInput: No such file, a missing column, no rows, a cell that is not a number or more than
            1000 km away, or latitudes where there is no origin.
    """
    path = Path(path)
    raw = read_cells(path)
    geographic = "x_m" not in raw and "latitude_deg" in raw
    height = "above_ground_m" if "above_ground_m" in raw and "z_m" not in raw else "z_m"
    columns = (["latitude_deg", "longitude_deg", height] if geographic else ["x_m", "y_m", height])
    missing = [name for name in columns if name not in raw]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; it needs {', '.join(columns)}, "
                       f"it has {listed(raw.columns)}")
    if raw.empty:
        raise BadInput(f"{path}: has no rows; it needs at least one point")
    points = np.column_stack([_numbers(path, raw, name) for name in columns])
    if origin is not None and not geographic and {"latitude_deg", "longitude_deg"} <= set(raw):
        _check_agreement(path, raw, points, origin)
    if geographic:
        if origin is None:
            raise BadInput(f"{path} gives latitude and longitude, and the scene has no [origin] in "
                           "scene.toml; add one, or give x_m and y_m")
        points[:, :2] = np.column_stack(to_local(origin, points[:, 1], points[:, 0]))
    if height == "above_ground_m" and city is not None:
        points[:, 2] += city.ground_height_m(*points[:, :2].T)
    far = ~(np.abs(points) <= MAX_COORDINATE_M).all(axis=1)
    if far.any():
        row = int(np.flatnonzero(far)[0])
        position = ", ".join(f"{value:g}" for value in points[row])
        raise BadInput(f"{path}: row {row + 2}: ({position}) m lies too far from the origin of the "
                       f"local frame; allowed are {-MAX_COORDINATE_M:g} to {MAX_COORDINATE_M:g} m")
    return points


def _check_agreement(path: Path, raw: pd.DataFrame, points: np.ndarray, origin: Origin) -> None:
    """Raise BadInput where x, y (n, 3) are not where latitude and longitude are."""
    latitude_deg, longitude_deg = (as_numbers(raw[name].astype(str).str.strip())
                                   for name in ("latitude_deg", "longitude_deg"))
    known = np.flatnonzero((np.abs(latitude_deg) <= 90) & (np.abs(longitude_deg) <= 360))
    other_m = np.column_stack(to_local(origin, longitude_deg[known], latitude_deg[known]))
    apart_m = np.linalg.norm(points[known, :2] - other_m, axis=1)
    if (apart_m > MAX_APART_M).any():
        i = int(np.argmax(apart_m > MAX_APART_M))
        raise BadInput(
            f"{path}: row {known[i] + 2}: x_m, y_m = {points[known[i], 0]:g}, "
            f"{points[known[i], 1]:g} is {apart_m[i]:,.0f} m from latitude_deg, longitude_deg = "
            f"{latitude_deg[known[i]]:g}, {longitude_deg[known[i]]:g} about the scene's origin "
            f"({(apart_m > MAX_APART_M).sum()} such rows); leave out the wrong two columns")


def _numbers(path: Path, raw: pd.DataFrame, name: str) -> np.ndarray:
    """Return the (n,) finite numbers of a column; degrees within their range."""
    values = as_numbers(raw[name].astype(str).str.strip())
    limit = {"latitude_deg": 90, "longitude_deg": 180}.get(name, np.inf)
    bad = ~np.isfinite(values) | (np.abs(values) > limit)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        allowed = ("a finite number [m]" if np.isinf(limit) else
                   f"a number from -{limit} to {limit} [degrees]")
        raise BadInput(f"{path}: row {row + 2}, column {name}: {raw[name][row]!r} is not {allowed}")
    return values
