"""Gains at any points in space."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import read_cells, write_csv
from radiotwin.io.files import atomic_path, require_suffix, require_writable
from radiotwin.io.forms import MAX_COORDINATE_M, Origin
from radiotwin.links.site_table import read_site_table
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
    """Read points from a CSV file.

    Args:
        path: File with x and y, or latitude and longitude, and a height, see
            `radiotwin.links.site_table`.
        origin: Origin of the local frame, which latitude and longitude need.
        city: 3D map with the ground; None: the ground is at z = 0.

    Returns:
        (n, 3) positions [m].

    Warns:
        A column is not used.

    Raises:
        BadInput: No such file, a missing column, no rows, a cell that is not a number or more than
            1000 km away, or latitudes where there is no origin.
    """
    path = Path(path)
    sites = read_site_table(path, read_cells(path), lambda row: f"row {row + 2}", None)
    for note in sites.notes:
        warnings.warn(note, stacklevel=2)
    points = sites.local_m(origin, None, "the scene")
    sites.refuse_rows(np.isnan(points[:, :2]).any(axis=1), lambda row: "has no position")
    if "above_ground_m" in sites.values:
        above_m = sites.values["above_ground_m"].to_numpy()
        ground_m = city.ground_height_m(*points[:, :2].T) if city is not None else 0.0
        points[:, 2] = np.where(np.isnan(above_m), points[:, 2], above_m + ground_m)
    sites.refuse_rows(np.isnan(points[:, 2]), lambda row: (
        "has no height; give it in a column z_m (above the datum), above_ground_m or altitude_m"))
    sites.refuse_rows(~(np.abs(points) <= MAX_COORDINATE_M).all(axis=1), lambda row: (
        f"({', '.join(f'{value:g}' for value in points[row])}) m lies too far from the origin of "
        f"the local frame; allowed are {-MAX_COORDINATE_M:g} to {MAX_COORDINATE_M:g} m"))
    return points
