"""`trace_map` (all lattice positions, resumable) and `trace_points`: traced, checked gains.

A map is only written if its gains are possible by physics. Its numerical noise is estimated from
the change of gains with ten times the rays, and with the ends of links exchanged.
"""

import hashlib
import math
import warnings
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.budgets import MAP_VALUES, ROWS
from radiotwin.io.cells import read_cells, write_csv
from radiotwin.io.files import atomic_path, require_suffix, require_writable
from radiotwin.io.forms import MAX_COORDINATE_M, Origin
from radiotwin.io.inputs import require_within
from radiotwin.io.texts import percent
from radiotwin.links.site_table import read_site_table
from radiotwin.maps.file import check_target
from radiotwin.maps.radiomap import RadioMap
from radiotwin.runtime.execution import Executor
from radiotwin.runtime.pieces import ResultCache
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.citymap import FAR_M, CityMap
from radiotwin.trace.link_job import (
    BatchStore,
    LinkBatch,
    link_job,
    link_pieces,
    solve_exchanged,
    solve_finer,
    solve_lattice,
    with_radius,
)
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import IMPOSSIBLE_DB, library_versions

# Bounds by physics for LoS links, relative to free space. The power of an LoS link is that of the
# direct path plus those of reflected and diffracted ones. Each of these is weaker than the direct
# path, as it is longer and loses power at every interaction; over a city, rarely more than the
# ground and two walls come close. So the median LoS link lies 0 to 3 dB above free space. The
# 0.5 dB below allow for numerical noise. The bound of a single link depends on its paths:
# `PathGains.solve` checks it.
MEDIAN_EXCESS_DB = (-0.5, 3.0)  # lowest and highest
MIN_EXCESS_DB = -0.5  # of a link that the tracer sees in LoS
# Where a ray grazes an edge, the tracer and the 3D map may differ in LoS: this share of LoS links,
# and this number in a small map, may lie below.
MAX_DARK_SHARE, MAX_DARK_LINKS = 0.005, 3
DOUBT_DB = 6.0  # a link is doubtful if exchanging its ends changes its gain by more
MAX_STEM = 100  # characters of a file's name


def free_space_gain_db(distance_m: np.ndarray, frequency_hz: float) -> np.ndarray:
    """Return the free-space gain between isotropic antennas (ITU-R P.525-4, eq. 4) [dB]."""
    return 20 * np.log10(speed_of_light / (4 * np.pi * frequency_hz * np.asarray(distance_m)))


def check_gains(gain_db: np.ndarray, los: np.ndarray, distance_m: np.ndarray, frequency_hz: float,
                solver: str, combining: str, direct_dbi: np.ndarray | float = 0.0,
                peak_dbi: np.ndarray | float = 0.0) -> dict[str, float]:
    """Check traced gains (n,) [dB] against bounds by physics; return figures for the map.

    With antennas, an LoS link is at least as strong as its direct path (`direct_dbi`, both
    antennas' gain along the straight line), and at most as if all paths left and arrived at the
    antennas' peaks (`peak_dbi`, their sum). If powers are added, the median of LoS links over free
    space must lie within `MEDIAN_EXCESS_DB` and, with the solver `paths`, hardly any link below
    `MIN_EXCESS_DB`. RunFailed for a gain above 0 dB, no path at all, or LoS links out of bounds.
    """
    found = np.isfinite(gain_db)
    if not found.any():
        raise RunFailed(f"none of {gain_db.size} links has a path; check that the devices are "
                        "outdoors and that the lattice lies over the city, or trace with more "
                        "samples or depth")
    if np.nanmax(gain_db) > 0:
        worst = int(np.nanargmax(gain_db))
        raise RunFailed(f"a link of {distance_m[worst]:.3g} m has a gain of {gain_db[worst]:.1f} "
                        "dB: more power would arrive than was sent; is a receiver within a "
                        "wavelength of a device?")
    figures: dict[str, float] = {"links": int(gain_db.size), "links_with_path": int(found.sum()),
                                 "links_los": int(los.sum())}
    if not los.any():
        return figures
    above_db = np.where(found, gain_db, -np.inf) - free_space_gain_db(distance_m, frequency_hz)
    excess_db, peak_excess_db = (above_db - direct_dbi)[los], (above_db - peak_dbi)[los]
    median_db, highest_db = float(np.median(excess_db)), float(peak_excess_db.max())
    dark_share = float(np.mean(excess_db < MIN_EXCESS_DB))
    figures |= {"los_excess_median_db": median_db, "los_excess_highest_db": highest_db,
                "los_below_free_space_share": dark_share}
    adds_powers = combining == "power"
    low_db, high_db = MEDIAN_EXCESS_DB
    if adds_powers and (median_db < low_db or np.median(peak_excess_db) > high_db):
        raise RunFailed(f"LoS links lie {median_db:+.1f} dB from free space in the median; "
                        f"{low_db:+.1f} to {high_db:+.1f} dB is possible: is city.xml in metres, "
                        "and its ground below the devices?")
    if (solver == "paths" and adds_powers and dark_share > MAX_DARK_SHARE
            and dark_share * len(excess_db) > MAX_DARK_LINKS):
        raise RunFailed(f"{100 * dark_share:.1f} % of the links that have LoS by the 3D map are "
                        f"weaker than free space, {100 * MAX_DARK_SHARE:.1f} % may be: the "
                        "ray tracer and the map do not see the same city")
    return figures


def noise_figures(gain_db: np.ndarray, finer_db: np.ndarray) -> dict[str, float | str]:
    """Compare gains with those from ten times the rays, both (n,) [dB] with NaN where not detected.

    Returns attributes of the map, over links detected in both (none: NaN), and the share of all
    links that are detected in only one.
    """
    both = np.isfinite(gain_db) & np.isfinite(finer_db)
    difference_db = np.abs(gain_db - finer_db)[both] if both.any() else np.array([np.nan])
    return {
        "noise_floor_db": float(np.sqrt(np.mean(difference_db**2))),
        "noise_floor_median_db": float(np.median(difference_db)),
        "noise_floor_p90_db": float(np.quantile(difference_db, 0.9)),
        "noise_floor_detection_share": float(np.mean(np.isfinite(gain_db)
                                                     != np.isfinite(finer_db))),
        "noise_floor_links": int(gain_db.size),
        "noise_floor_method": "a sample of the links solved again with ten times the rays; "
                              "RMS difference over links detected in both",
    }


def exchange_figures(gain_db: np.ndarray, exchanged_db: np.ndarray, los: np.ndarray
                     ) -> dict[str, float]:
    """Compare gains with those traced from the other end of each link, both (n,) [dB].

    By reciprocity they are equal. A difference is an error of the traced map: paths that the rays
    of one end miss, or diffraction that is not reciprocal. NaN is not detected. Returns attributes
    of the map: RMS difference for LoS and NLoS links; for the latter also the mean of exchanged
    minus original gain, and the share that differs by more than `DOUBT_DB`.
    """
    both = np.isfinite(gain_db) & np.isfinite(exchanged_db)
    difference_db = exchanged_db - gain_db
    los_db, nlos_db = (difference_db[both & is_class] if (both & is_class).any()
                       else np.array([np.nan]) for is_class in (los, ~los))
    return {
        "exchanged_links": int(both.sum()),
        "exchanged_los_db": float(np.sqrt(np.mean(los_db**2))),
        "exchanged_nlos_db": float(np.sqrt(np.mean(nlos_db**2))),
        "exchanged_nlos_bias_db": float(np.mean(nlos_db)),
        "exchanged_nlos_doubtful_share": float(np.mean(np.abs(nlos_db) > DOUBT_DB))}


def detected(gain_db: np.ndarray, limit_db: float) -> np.ndarray:
    """Set gains [dB] below the limit of detection, and impossible ones (infinite), to NaN."""
    return np.where((gain_db < limit_db) | (gain_db == IMPOSSIBLE_DB), np.nan, gain_db)


def truth_path(scene: Scene, devices: list[str] | None = None) -> Path:
    """Return the default file of a scene's traced map: `truth.nc` in its folder.

    For chosen devices it is `truth-NAME-NAME.nc`, with a digest where that is too long.
    """
    name = "-".join(["truth", *(devices or [])])
    if len(name) > MAX_STEM:  # the digest tells apart names that are cut at the same place
        digest = hashlib.sha256(name.encode()).hexdigest()[:12]
        name = f"{name[:MAX_STEM]}-{digest}"
    return scene.folder / f"{name}.nc"


def trace_map(scene: Scene | Path | str, settings: SolverSettings | None = None,
              out_path: Path | str | None = None, devices: list[str] | None = None,
              executor: Executor | None = None) -> RadioMap:
    """Trace the radio map of a scene's lattice and write it.

    Finished batches are kept in the scene's `cache/trace-<hash>`; the hash is of everything that a
    gain depends on. After an interruption, the trace resumes after the last finished batch and
    gives the same map to the bit; a finished trace is not repeated.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver; None: those of quality `default`.
        out_path: NetCDF file or Zarr folder to write; None: `truth_path`.
        devices: Names, in the map's order; None: all devices of the scene.
        executor: Where it runs; None: in this process. The map is the same to the bit.

    Returns:
        The map: gain [dB], NaN where there is no path, the gain is below the receiver's
        sensitivity, the position is inside a building, or the tracer found more power than the
        link's paths can carry (with a warning). Attributes count each.

    Raises:
        BadInput: No device, an unknown one, a scene that cannot be read, or an output that cannot
            be written; too many links; a lattice or antennas that the solver `map` cannot handle.
        RunFailed: No usable libLLVM, or gains that physics does not allow. Nothing is written then.
    """
    scene = Scene.of(scene)
    settings = with_radius(scene, settings or SolverSettings.of_quality())
    if out_path is None:
        out_path = require_within(scene.folder, truth_path(scene, devices), str(scene.folder))
    index = device_indices(scene, devices)
    if settings.solver == "map" and scene.lattice.ground_m is not None:
        raise BadInput("the solver 'map' averages over horizontal cells, and the lattice follows "
                       "the ground; take the solver 'paths', or above = \"datum\" in [lattice] of "
                       f"{scene.folder / 'scene.toml'}")
    if settings.solver == "map" and not scene.lattice.step_m:
        raise BadInput("the solver 'map' averages over cells between positions, and the lattice of "
                       f"{scene.folder / 'scene.toml'} has one position only; take the solver "
                       "'paths', or a smaller step_m")
    MAP_VALUES.check(len(index) * math.prod(scene.lattice.shape),
                     f"{scene.folder}: lattice positions times devices")
    check_target(out_path)
    names = [scene.config.devices[i].device for i in index]
    store = open_store(scene, settings)
    finished = _finished_map(Path(out_path), store.hash, names)
    if finished is not None:
        placed = finished.with_origin(scene.config.origin)  # the origin does not change the gains
        if placed.dataset.attrs != finished.dataset.attrs:
            placed.save(out_path)
        return placed
    executor = executor or Executor()
    raw_db = solve_lattice(scene, settings, store, index, executor)

    positions_m, device_m = scene.lattice.positions_m, scene.device_m[index]
    los = np.stack([scene.city.line_of_sight(point_m[None], positions_m) for point_m in device_m])
    inside = scene.blocked.ravel()
    distance_m = np.linalg.norm(device_m[:, None, :] - positions_m[None], axis=2)
    frequency_hz = scene.config.radio.frequency_hz
    direct_dbi, peak_dbi = _antenna_gains(scene, index)

    impossible = (raw_db == IMPOSSIBLE_DB) & ~inside
    if impossible.any():
        warnings.warn(f"{impossible.sum()} of {impossible.size} links carry more power than their "
                      "paths can, with a second seed, too; they are left out of the map (NaN)",
                      stacklevel=2)
    raw_db[raw_db == IMPOSSIBLE_DB] = np.nan
    checked = ~inside & ~impossible

    def of_checked(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, raw_db.shape)[checked]

    figures: dict[str, float | str] = dict(
        check_gains(of_checked(raw_db), of_checked(los), of_checked(distance_m), frequency_hz,
                    settings.solver, settings.combining, of_checked(direct_dbi),
                    of_checked(peak_dbi)))
    limit_db = scene.config.gain_limit_db
    warn_of_terrain(scene.city, device_m, positions_m, np.isnan(raw_db) & checked)
    gain_db, counts = _censor_gains(raw_db, inside, impossible, limit_db)
    rows, columns, finer_db = solve_finer(scene, settings, store, index, executor)
    outside = ~inside[columns]
    finer_db = detected(finer_db, limit_db)
    figures |= noise_figures(gain_db[rows, columns][:, outside].ravel(),
                             finer_db[:, outside].ravel())
    if settings.solver == "paths":
        turned, exchanged_db = solve_exchanged(scene, settings, store, index, executor,
                                               columns[outside])
        figures |= exchange_figures(gain_db[:, turned], detected(exchanged_db, limit_db),
                                    los[:, turned])
    attributes = {"source": "raytrace", "frequency_hz": frequency_hz, "gain_limit_db": limit_db,
                  "scene": scene.config.name, "scene_hash": scene.content_hash(),
                  "trace_hash": store.hash, **settings.attributes(), **counts, **figures,
                  **library_versions(), "radiotwin_version": version("radiotwin")}
    radio_map = RadioMap.build(names, scene.lattice, gain_db, los, attributes=attributes)
    radio_map = radio_map.with_origin(scene.config.origin)
    radio_map.save(out_path)
    return radio_map


def warn_of_terrain(city: CityMap, device_m: np.ndarray, positions_m: np.ndarray,
                    no_path: np.ndarray) -> None:
    """Warn of links that Sionna RT cannot trace: behind terrain, or beyond the horizon.

    Behind terrain are links of `no_path`, (devices, positions) bool, that the ground blocks; for
    the horizon, all links longer than `FAR_M` count, as Sionna RT's Earth is flat.
    """
    hidden = far = 0
    for point_m, without_path in zip(device_m, no_path, strict=True):
        far += int((np.hypot(*(positions_m - point_m)[:, :2].T) > FAR_M).sum())
        hidden += int(city.hidden_by_ground(point_m[None], positions_m[without_path]).sum())
    if hidden:
        warnings.warn(f"behind terrain lie {percent(hidden / no_path.size)} of the links, and no "
                      "path was found to them: Sionna RT diffracts once, so that what rounded "
                      "hills hide comes out not detected; coverage --model paths has a loss "
                      "along terrain (ITU-R P.526)", stacklevel=3)
    if far:
        warnings.warn(f"{percent(far / no_path.size)} of the links are longer than "
                      f"{FAR_M / 1e3:g} km: Sionna RT's Earth is flat, so that gains beyond the "
                      "horizon are too high; coverage --model paths has the round Earth",
                      stacklevel=3)


def _antenna_gains(scene: Scene, index: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return both antennas' gain along links (devices, positions), and peaks (devices, 1) [dBi]."""
    link_m = scene.lattice.positions_m[None] - scene.device_m[index][:, None]
    direct_dbi, peak_dbi = np.zeros(link_m.shape[:2]), np.zeros((len(index), 1))
    for row, antenna in enumerate(scene.device_antennas[device] for device in index):
        if antenna is not None:
            direct_dbi[row] += antenna.gain_dbi(link_m[row])
            peak_dbi[row] += antenna.pattern.peak_dbi
    if scene.uav_antenna is not None:
        direct_dbi += scene.uav_antenna.gain_dbi(-link_m)
        peak_dbi += scene.uav_antenna.pattern.peak_dbi
    return direct_dbi, peak_dbi


def _finished_map(path: Path, trace_hash: str, devices: list[str]) -> RadioMap | None:
    """Load the map at `path` if it has the same hash of its inputs, and devices; else None."""
    if not path.exists():
        return None
    try:
        radio_map = RadioMap.load(path)
    except BadInput:  # something else, or damaged: to be replaced
        return None
    same = (radio_map.dataset.attrs.get("trace_hash") == trace_hash
            and radio_map.devices == devices)
    return radio_map if same else None


def device_indices(scene: Scene, devices: list[str] | None) -> list[int]:
    """Return indices in `scene.config.devices` of named devices, each once; None or empty: of all.

    BadInput if the scene has no devices, or none of that name.
    """
    names = {device.device: index for index, device in enumerate(scene.config.devices)}
    if not names:
        raise BadInput(f"{scene.folder / 'scene.toml'} declares no devices; add at least one to "
                       "trace from")
    for name in devices or []:
        if name not in names:
            raise BadInput(f"device {name!r} is not in {scene.folder / 'scene.toml'}; it has "
                           f"{', '.join(list(names)[:20])}" + ", …" * (len(names) > 20))
    return [names[name] for name in dict.fromkeys(devices or names)]


def open_store(scene: Scene, settings: SolverSettings) -> BatchStore:
    """Open the cache of finished batches for a scene's map with these settings, in its folder.

    BadInput if the folder lies outside the scene's, or cannot be written.
    """
    lattice = {name: values.tolist() for name, values in asdict(scene.lattice).items()
               if values is not None}
    return BatchStore(scene.folder, {
        "scene": scene.content_hash(), "lattice": lattice, "settings": settings.attributes(),
        "libraries": library_versions()})


def _censor_gains(raw_db: np.ndarray, inside: np.ndarray, impossible: np.ndarray, limit_db: float
                  ) -> tuple[np.ndarray, dict[str, int]]:
    """Set gains (devices, positions) not detected to NaN, and count the links by reason."""
    is_inside = np.broadcast_to(inside, raw_db.shape)
    no_path = np.isnan(raw_db) & ~is_inside & ~impossible
    below_limit = ~is_inside & (raw_db < limit_db)
    gain_db = np.where(is_inside | below_limit, np.nan, raw_db)
    return gain_db, {
        "links_detected": int(np.isfinite(gain_db).sum()),
        "links_without_path": int(no_path.sum()),
        "links_below_sensitivity": int(below_limit.sum()),
        "links_inside_building": int(is_inside.sum()),
        "links_impossible": int(impossible.sum()),
    }


def trace_gains(scene: Scene, device_m: np.ndarray, points_m: np.ndarray, settings: SolverSettings,
                antennas: list[Antenna | None] | None = None,
                executor: Executor | None = None) -> np.ndarray:
    """Trace the gains between any positions; receivers have the antenna of the scene's UAVs.

    In the context `keep_pieces`, finished batches are cached and not solved again.

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
    pieces, order = link_pieces(scene, settings, [("", *device) for device in zip(
        device_m, antennas or [None] * len(device_m))], points_m)
    scene_hash = scene.content_hash()

    def inputs(piece: LinkBatch) -> tuple:
        piece_settings = replace(settings, batch_receivers=piece.batch_receivers)
        return (scene_hash, piece_settings.attributes(), piece.device_m, piece.points_m,
                piece.antennas, *([] if piece.tile is None else [piece.tile]))

    gains = (executor or Executor()).run(
        link_job(scene, settings, "tracing"), pieces,
        ResultCache("gains", inputs, lambda found: ({"gain_db": found}, len(found)),
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
    inside, below_ground = scene.city.inside(points_m), scene.city.below_ground(points_m)
    wavelength_m = speed_of_light / scene.config.radio.frequency_hz
    antennas = [scene.device_antennas[device] for device in index]
    gain_db = trace_gains(scene, scene.device_m[index], points_m, settings, antennas,
                          executor)
    warn_of_terrain(scene.city, scene.device_m[index], points_m, np.isnan(gain_db) & ~inside)
    tables = []
    for row, device in enumerate(index):
        device_m = scene.device_m[device]
        within_wavelength = np.linalg.norm(points_m - device_m, axis=1) < wavelength_m
        reason = np.select(
            [inside & below_ground, inside, within_wavelength, np.isnan(gain_db[row]),
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
