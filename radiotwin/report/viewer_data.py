"""The data of the viewer, as `viewer.js` reads them.

They are the city (or blocks, where a browser could not draw all triangles), levels on the lattice,
held-out residuals of links with their paths, devices and flights. Arrays are in the page as base64
of typed arrays, which a browser reads without parsing.
"""

import base64
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from numpy.typing import ArrayLike

from radiotwin.display import level_range_db, residual_range_db
from radiotwin.io.forms import MAX_POSITION_M
from radiotwin.links.view import moving_end
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.paths.powers import paths_with_points
from radiotwin.report.closeloop_words import found_causes
from radiotwin.report.folders import TRUTH, Run
from radiotwin.report.labels import name_label
from radiotwin.report.map_figures import RESIDUAL_LABEL, tx_powers_dbm
from radiotwin.scene import Scene
from radiotwin.scene.plot import height_grid
from radiotwin.scene.surfaces import FLAT_M
from radiotwin.twin.compare import comparable_db

NOT_DETECTED = -32768
"""Stands for NaN among levels, which are kept in hundredths of a decibel."""
# More would make the page too large for a browser; then every n-th is taken, and a note is added.
MAX_VALUES = 2_000_000  # of all maps together, 2 bytes each
MAX_LINKS = 60_000
MAX_POSITIONS = 200_000  # of the UAVs on all flights together
MAX_TRACKS = 2000  # flights times UAVs
MAX_DEVICES = 20_000  # with a mark on the city
MAX_MAP_DEVICES = 1000  # with a map to choose
MAX_FACES = 80_000
MAX_PATH_LINKS = 1000  # whose paths are in the page: some milliseconds each
MAX_PATHS = 3  # of a link, the strongest ones
BLOCK_CELLS = 160  # along the longer side of a city that is drawn as blocks
SCALES = {"gain": "viridis", "sigma": "cividis", "error": "coolwarm", "link": "coolwarm_r"}
LOS_COLOURS = [[209, 73, 91], [42, 127, 158]]  # RGB of no and of line of sight


def pack(values: np.ndarray) -> dict:
    """Encode an array as type, shape and base64 of its little-endian bytes, for JSON.

    Args:
        values: array of type float32, int32, int16 or uint8, of any shape.
    """
    values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
    return {"type": values.dtype.name, "shape": list(values.shape),
            "data": base64.b64encode(values.tobytes()).decode()}


def pack_db(level_db: np.ndarray) -> dict:
    """Pack levels as int16 in 0.01 dB, clipped to ±327.67 dB; NaN as `NOT_DETECTED`."""
    hundredths = np.round(100 * np.nan_to_num(np.asarray(level_db, dtype=float), nan=0.0))
    clipped = np.clip(hundredths, -32767, 32767)
    return pack(np.where(np.isnan(level_db), NOT_DETECTED, clipped).astype(np.int16))


def pack_m(values: ArrayLike) -> dict:
    """Pack coordinates [m] or times [s] in single precision."""
    return pack(np.asarray(values).astype(np.float32))


def map_layers(run: Run) -> list[dict]:
    """Pack level, standard deviation, line of sight and error of each radio map of a run.

    Levels are received powers [dBm] if the twin was fitted to such and the map has all transmit
    powers, else gains [dB]. Errors are of maps on the truth's lattice only. Of large maps every
    n-th position is taken, and `run.notes` says so.
    """
    step = _thinning(run)
    truth = run.maps.get(TRUTH)
    if any(radio_map.lattice.ground_m is not None for radio_map in run.maps.values()):
        run.notes.append("Altitudes of the maps are above the ground; each is drawn as a plane, at "
                         "that height above z = 0.")
    layers = []
    for name, radio_map in run.maps.items():
        thin = radio_map.dataset.isel(device=slice(_map_devices(run, name)),
                                      y=slice(None, None, step), x=slice(None, None, step))
        powers_dbm = tx_powers_dbm(RadioMap(thin)) if _is_power(run) else None
        if powers_dbm is None:
            fields = [_field(f"{name}: gain", "gain", thin["gain_db"].values, "gain")]
        else:
            received_dbm = thin["gain_db"].values + powers_dbm[:, None, None, None]
            fields = [_field(f"{name}: received power", "received power", received_dbm, "gain",
                             "dBm")]
        if "sigma_db" in thin:
            fields.append(_field(f"{name}: standard deviation", "standard deviation",
                                 thin["sigma_db"].values, "sigma"))
        fields.append({"label": f"{name}: line of sight", "kind": "los", "title": "line of sight",
                       "low": 0, "high": 1, "values": pack(thin["los"].values.astype(np.uint8))})
        if truth is not None and name != TRUTH and _same_lattice(radio_map, truth):
            error_db = _error_db(RadioMap(thin), truth, step)
            fields.append(_field(f"{name}: error (model − truth)", "model − truth", error_db,
                                 "error"))
        layers.append({"name": name, "devices": RadioMap(thin).devices, "fields": fields,
                       **{axis: thin[axis].values.astype(float).round(3).tolist()
                          for axis in "xyz"}, "step_m": radio_map.lattice.step_m * step})
    return layers


def link_layer(run: Run) -> dict | None:
    """Pack the held-out links of a close-loop; None if the run has no residuals.

    A link has the position of its moving end, its residuals before and after the effects, its
    measured level and, for some, its paths. `interval_db` holds 90 % of the residuals: the interval
    without line of sight, then that with it. `run.notes` says if links are left out.
    """
    links = run.residuals
    if links is None or links.empty:
        return None
    step = -(-len(links) // MAX_LINKS)
    if step > 1:
        run.notes.append(f"Of {len(links):,} held-out links every {step}th is shown.")
        links = links.iloc[::step]
    end = moving_end(links)
    moving_m = links[[f"{end}_{axis}_m" for axis in "xyz"]].to_numpy(dtype=float)
    ends = {name: sorted(links[name].unique()) for name in ("device", "flight")}
    residuals_db = {when: links[f"{when}_db"].to_numpy(dtype=float) for when in ("before", "after")}
    high_db, los = residual_range_db(residuals_db["before"]), links["los"].to_numpy() == 1
    fields = [{"label": f"held-out residual: {when}", "title": RESIDUAL_LABEL, "kind": "link",
               "low": -high_db, "high": high_db, "values": pack_db(each_db),
               "interval_db": [_interval_db(each_db[los == sight]) for sight in (False, True)]}
              for when, each_db in residuals_db.items()]
    layer = {**{axis: pack_m(np.nan_to_num(moving_m[:, i])) for i, axis in enumerate("xyz")},
             **{f"{name}s": names for name, names in ends.items()},
             **{name: pack(pd.Index(names).get_indexer(links[name]).astype(np.int32))
                for name, names in ends.items()},
             "los": pack(los.astype(np.uint8)), "fields": fields}
    if run.scene is not None and _has_paths(run):
        layer["paths"] = path_layer(run.scene, links)
    if "time_s" in links:
        since_s = links["time_s"] - links.groupby("flight")["time_s"].transform("min")
        layer["time"] = pack_m(since_s.fillna(0.0))
    if "measured_db" in links:
        unit = "dBm" if _is_power(run) else "dB"
        layer["unit"] = unit
        fields.append(_field("held-out links: measured level", "measured level",
                             links["measured_db"].to_numpy(dtype=float), "gain", unit))
    return layer


def _has_paths(run: Run) -> bool:
    """Return whether the page has paths: it has links, and a map of up to `MAX_FACES` triangles."""
    return (run.scene is not None and len(run.scene.city.faces) <= MAX_FACES
            and run.residuals is not None and not run.residuals.empty)


def path_layer(scene: Scene, links: pd.DataFrame) -> dict:
    """Follow the `MAX_PATHS` strongest paths of the `MAX_PATH_LINKS` links of largest residual.

    Reflected and diffracted paths over the scene's map, without buildings that a close-loop found.

    Args:
        scene: 3D map and carrier frequency.
        links: held-out links, see `radiotwin.closeloop.output.residuals`.

    Returns:
        `points` (m, 3) of all paths, one path after another, from the device to the receiver [m];
        `end` (p,) row after the last point of each path; `link` (p,) row of its link in `links`.
    """
    def position_m(rows: pd.DataFrame, end: str) -> np.ndarray:
        return rows[[f"{end}_{axis}_m" for axis in "xyz"]].to_numpy(dtype=float)

    residual_db = links["before_db"].abs().fillna(links["after_db"].abs()).to_numpy()
    known = np.isfinite(np.hstack([position_m(links, "device"), position_m(links, "receiver"),
                                   residual_db[:, None]])).all(axis=1)
    rows = np.flatnonzero(known)
    rows = rows[np.argsort(-residual_db[rows], kind="stable")[:MAX_PATH_LINKS]]
    chosen = links.iloc[rows].assign(row=rows)
    found_link, found_m = [np.zeros(0, dtype=int)], [np.zeros((0, 3))]
    ends: list[int] = []
    # One search follows paths to many ends from one; paths are the same either way.
    start, end = sorted(("device", "receiver"),
                        key=lambda name: len(np.unique(position_m(chosen, name), axis=0)))
    forward = 1 if start == "device" else -1
    for _, group in chosen.groupby([f"{start}_{axis}_m" for axis in "xyz"], sort=False):
        paths = paths_with_points(scene.city, position_m(group, start)[0],
                                  position_m(group, end), scene.config.radio.frequency_hz)
        strongest = pd.DataFrame({"link": paths.receiver, "power": -paths.power}).sort_values(
            ["link", "power"]).groupby("link").head(MAX_PATHS).index
        found_link.append(group["row"].to_numpy()[paths.receiver[strongest]])
        found_m += [paths.points_m[path, :paths.points[path]][::forward] for path in strongest]
        ends += paths.points[strongest].tolist()
    return {"link": pack(np.concatenate(found_link).astype(np.int32)),
            "end": pack(np.cumsum(ends).astype(np.int32)),
            "points": pack_m(np.concatenate(found_m))}


def _is_power(run: Run) -> bool:
    """Return whether received powers were measured, not gains."""
    return run.twin is not None and run.twin.level == "rssi_dbm"


def _interval_db(residual_db: np.ndarray) -> list[float]:
    """Return the 5 % and 95 % quantiles of residuals (n,) [dB]; zeros if none is known."""
    known_db = residual_db[np.isfinite(residual_db)]
    return np.quantile(known_db, [0.05, 0.95]).tolist() if len(known_db) else [0.0, 0.0]


def device_layer(run: Run) -> list[dict]:
    """Return each device's name, role, true position and the twin's estimate; None: not known."""
    devices: dict[str, dict] = {}
    for known in run.scene.config.devices if run.scene else []:
        devices[known.device] = {"name": known.device, "role": known.role, "estimate": None,
                                 "true": [known.x_m, known.y_m, known.z_m]}
    for device in run.twin.devices if run.twin else []:
        position_m = [device.x_m, device.y_m, device.z_m]
        entry = devices.setdefault(device.device, {"name": device.device, "true": None,
                                                   "estimate": None})
        entry["role"] = device.role
        if not (np.abs(position_m) <= MAX_POSITION_M).all():  # or none
            continue
        if device.role == "anchor":
            entry["true"] = entry["true"] or position_m
        else:
            radius_m = device.credible_radius_m
            entry |= {"estimate": position_m, "located": bool(device.located),
                      "radius_m": radius_m if np.isfinite(radius_m) else None,
                      "second": list(device.second_mode) if device.second_mode else None}
    return list(devices.values())


def found_layer(run: Run) -> list[dict]:
    """Return name, place, outline and height [m] of each object that a close-loop found.

    Causes that belong to a device, such as its antenna, are no objects.
    """
    found = []
    for effect in found_causes(run.closeloop or {"effects": []}):
        height_m = (effect["parameters"].get("height_m") or {}).get("value") or 0.0
        for place in effect.get("places", []):
            if not place.get("device"):
                found.append({"text": name_label(effect["name"]), "x": place["x_m"],
                              "y": place["y_m"], "outline": place.get("outline_m"),
                              "height": height_m})
    return found


def flight_layer(run: Run) -> list[dict]:
    """Pack start and duration (`end_s`) of each flight [s], and UAVs' positions since its start.

    Unknown coordinates become 0. `run.notes` says if tracks or positions are left out.
    """
    tracks = run.tracks
    if tracks is None or tracks.empty:
        return []
    track = tracks.groupby(["flight", "uav"], sort=False).ngroup()
    if track.max() >= MAX_TRACKS:
        run.notes.append(f"Of {track.max() + 1:,} tracks of UAVs the first {MAX_TRACKS:,} are "
                         "shown.")
        tracks = tracks[track < MAX_TRACKS]
    step = -(-len(tracks) // MAX_POSITIONS)
    if step > 1:
        run.notes.append(f"Of {len(tracks):,} positions of UAVs every {step}th is shown.")
    flights = []
    for name, flight in tracks.groupby("flight", sort=False):
        start_s = float(flight["time_s"].min())
        uavs = []
        for uav, track in flight.groupby("uav", sort=False):
            track = track.sort_values("time_s").iloc[::step]
            uavs.append({"name": str(uav), "t": pack_m(track["time_s"] - start_s),
                         **{axis: pack_m(track[f"{axis}_m"].fillna(0.0)) for axis in "xyz"}})
        flights.append({"name": str(name), "start_s": start_s,
                        "end_s": float(flight["time_s"].max()) - start_s, "uavs": uavs})
    return flights


def bounds_m(run: Run) -> list[float]:
    """Return x_min, x_max, y_min, y_max [m] of the scene, else 1 m around all positions."""
    if run.scene is not None:
        return list(run.scene.config.extent.bounds)
    devices = [device["estimate"] or device["true"] for device in device_layer(run)]
    positions_m = [np.array([each for each in devices if each], dtype=float).reshape(-1, 3)[:, :2]]
    if run.tracks is not None:
        positions_m.append(run.tracks[["x_m", "y_m"]].to_numpy())
    if run.residuals is not None:
        positions_m += [run.residuals[[f"{end}_x_m", f"{end}_y_m"]].to_numpy()
                        for end in ("receiver", "device")]
    all_m = np.concatenate(positions_m)
    all_m = all_m[np.isfinite(all_m).all(axis=1)]
    if not len(all_m):
        return [0.0, 1.0, 0.0, 1.0]
    low, high = all_m.min(axis=0) - 1.0, all_m.max(axis=0) + 1.0
    return [float(low[0]), float(high[0]), float(low[1]), float(high[1])]


def _field(label: str, quantity: str, level_db: np.ndarray, kind: str, unit: str = "dB") -> dict:
    """Pack levels with unit and ends of the colour scale, a symmetric one for kind `error`."""
    if kind == "error":
        high = residual_range_db(level_db)
        low = -high
    else:
        low, high = level_range_db(level_db)
    return {"label": label, "kind": kind, "title": f"{quantity} [{unit}]", "unit": unit,
            "low": low, "high": max(high, low + 0.1), "values": pack_db(level_db)}


def _error_db(radio_map: RadioMap, truth: RadioMap, step: int) -> np.ndarray:
    """Subtract true gains from a model's [dB] (device, z, y, x); NaN for devices not in `truth`.

    `radio_map` was thinned to every `step`-th position in x and y; `truth` is thinned here. If
    only the model has `sigma_db`, its mean given detection is compared (see `comparable_db`).
    """
    error_db = np.full(radio_map.gain_db.shape, np.nan)
    model_db, true_db = comparable_db(radio_map, truth), truth.gain_db[..., ::step, ::step]
    row_of = {device: row for row, device in enumerate(truth.devices)}
    for row, device in enumerate(radio_map.devices):
        if device in row_of:
            error_db[row] = model_db[row] - true_db[row_of[device]]
    return error_db


def _map_devices(run: Run, name: str) -> int:
    """Return how many devices of a map the page shows; adds to `run.notes` if some are left out."""
    devices, altitudes = run.maps[name].gain_db.shape[:2]
    shown = min(devices, MAX_MAP_DEVICES, max(MAX_VALUES // (3 * altitudes), 1))
    if shown < devices:
        run.notes.append(f"Of the map {name} the first {shown:,} of {devices:,} devices are shown.")
    return shown


def _same_lattice(one: RadioMap, other: RadioMap) -> bool:
    """Return whether two maps are over the same positions."""
    return one.gain_db.shape[1:] == other.gain_db.shape[1:] and np.allclose(
        one.lattice.positions_m, other.lattice.positions_m)


def _thinning(run: Run) -> int:
    """Return n so that every n-th position in x and y of all maps fits into `MAX_VALUES`.

    If positions are left out, `run.notes` says so.
    """
    values = sum(3 * radio_map.gain_db.size for radio_map in run.maps.values())
    step = max(int(np.ceil(np.sqrt(values / MAX_VALUES))), 1)
    if step * run.map_step > 1:
        run.notes.append(f"Of the maps every {step * run.map_step}th position in x and in y is "
                         "shown, to keep the page small.")
    return step


def city_mesh(scene: Scene) -> tuple[dict, str]:
    """Pack the triangles of a scene's buildings, and return a note if they were simplified.

    Flat ground is left out. A city of more than `MAX_FACES` triangles becomes blocks, each as high
    as the highest surface in its cell.
    """
    city = scene.city
    keep = city.vertices[city.faces][:, :, 2].max(axis=1) > FLAT_M
    if keep.sum() <= MAX_FACES:
        used, index = np.unique(city.faces[keep], return_inverse=True)
        return _packed(city.vertices[used], index.reshape(-1, 3)), ""
    height_m, (x_min, x_max, y_min, y_max) = height_grid(scene, BLOCK_CELLS, above_datum=True)
    cell_m = max(x_max - x_min, y_max - y_min) / BLOCK_CELLS
    return _packed(*blocks(height_m, x_min, y_min, cell_m)), (
        f"The city has {keep.sum():,} triangles and is drawn as blocks of {cell_m:.1f} m.")


def street_layer(scene: Scene | None) -> dict | None:
    """Pack the streets of a scene as the ends (n, 2, 3) of straight lines on the ground [m]."""
    if scene is None or not scene.streets_m:
        return None
    ends_m = np.concatenate([np.stack([line_m[:-1], line_m[1:]], axis=1)
                             for line_m in scene.streets_m])
    ground_m = scene.city.ground_height_m(ends_m[..., 0], ends_m[..., 1])
    return pack_m(np.concatenate([ends_m, ground_m[..., None]], axis=-1))


def blocks(height_m: np.ndarray, x_m: float, y_m: float,
           cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Build a block city: a flat roof over each high cell, and walls where neighbours are lower.

    Args:
        height_m: (ny, nx) heights, south first [m]; cells up to `FLAT_M` high get no roof.
        x_m: west edge of the grid [m].
        y_m: south edge of the grid [m].
        cell_m: side of a cell [m].

    Returns:
        (v, 3) vertices [m], and (f, 3) faces
    """
    high_m = np.pad(np.where(height_m > FLAT_M, height_m, 0.0), 1)
    row, column = np.nonzero(high_m)
    west, south, top = x_m + (column - 1) * cell_m, y_m + (row - 1) * cell_m, high_m[row, column]
    east, north = west + cell_m, south + cell_m
    quads = [_quads(west, south, top, east, south, top, east, north, top, west, north, top)]
    for ny, nx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        low = high_m[row + ny, column + nx]
        wall = low < top
        x0, y0, foot, head = (values[wall] for values in (west, south, low, top))
        ax, ay = x0 + cell_m * (nx > 0), y0 + cell_m * (ny > 0)
        bx, by = ax + cell_m * (nx == 0), ay + cell_m * (ny == 0)
        quads.append(_quads(ax, ay, foot, bx, by, foot, bx, by, head, ax, ay, head))
    corners = np.concatenate(quads)
    first = 4 * np.arange(len(corners))[:, None]
    return corners.reshape(-1, 3), np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])


def _quads(*coordinates: np.ndarray) -> np.ndarray:
    """Stack twelve coordinates (n,) to corners (n, 4, 3)."""
    return np.stack(coordinates, axis=-1).reshape(-1, 4, 3)


def _packed(vertices_m: np.ndarray, faces: np.ndarray) -> dict:
    """Pack vertices (v, 3) [m] as x, y, z, and triangles (f, 3) of their indices as i, j, k."""
    return {axis: pack_m(vertices_m[:, i]) for i, axis in enumerate("xyz")} | \
        {corner: pack(faces[:, i].astype(np.int32)) for i, corner in enumerate("ijk")}


def viewer_data(run: Run) -> dict[str, Any]:
    """Collect the data of the page's 3D viewer (`viewer.js`); `run.notes` says what is left out."""
    city, note = city_mesh(run.scene) if run.scene else (None, "")
    if note:
        run.notes.append(note)
    maps = map_layers(run)
    heights_m = [z for layer in maps for z in layer["z"]]
    if run.scene:
        heights_m.append(float(run.scene.city.vertices[:, 2].max()))
    if run.tracks is not None:
        heights_m.append(float(run.tracks["z_m"].fillna(0.0).max()))
    scales = {kind: (255 * colormaps[name](np.linspace(0, 1, 101))[:, :3]).round().astype(int)
              .tolist() for kind, name in SCALES.items()} | {"los": LOS_COLOURS}
    devices = device_layer(run)
    if len(devices) > MAX_DEVICES:
        run.notes.append(f"Of {len(devices):,} devices the first {MAX_DEVICES:,} are drawn.")
    return {"scales": scales, "bounds": bounds_m(run), "top_m": max(heights_m, default=1.0),
            "city": city, "streets": street_layer(run.scene), "maps": maps,
            "links": link_layer(run), "devices": devices[:MAX_DEVICES],
            "flights": flight_layer(run), "found": found_layer(run)}


def marks(run: Run) -> list[str]:
    """Explain the marks of the viewer that are on this page, a sentence for each kind."""
    devices = device_layer(run)[:MAX_DEVICES]
    estimated = [each for each in devices if each["estimate"]]
    sentences = {
        "Diamonds: anchors.": any(each["role"] == "anchor" and each["true"] for each in devices),
        "Orange circles: true positions of unknown devices.": any(
            each["role"] != "anchor" and each["true"] for each in devices),
        "Red crosses: estimated positions, with the circle that holds the device with 90 % "
        "probability and its radius.": bool(estimated),
        "Dashed: the data do not determine the position.": any(
            not each["located"] for each in estimated),
        "Red rings: second places that explain the data as well.": any(
            each["second"] for each in estimated),
        "Purple: what the close-loop found.": bool(found_layer(run)),
        f"A click on one of the {MAX_PATH_LINKS:,} links with the largest residuals also draws its "
        f"{MAX_PATHS} strongest paths by reflection and diffraction, over the map as given.":
            _has_paths(run)}
    return [sentence for sentence, is_drawn in sentences.items() if is_drawn]
