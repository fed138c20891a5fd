"""Prepare the layers of the viewer: levels on the lattice, residuals of links, devices, flights."""

import numpy as np
import pandas as pd

from radiotwin.compare import comparable_db
from radiotwin.display.style import level_range_db, residual_range_db
from radiotwin.link_view import moving_end
from radiotwin.measurement_columns import MAX_COORDINATE_M
from radiotwin.radiomap import RadioMap
from radiotwin.report.packing import pack, pack_db, pack_m
from radiotwin.report.run_folder import TRUTH, Run

# More would make the page too large for a browser; then every n-th is taken, and a note is added.
MAX_VALUES = 2_000_000  # of all maps together, 2 bytes each
MAX_LINKS = 60_000
MAX_POSITIONS = 200_000  # of the UAVs on all flights together
MAX_TRACKS = 2000  # flights times UAVs
MAX_DEVICES = 20_000  # with a mark on the city
MAX_MAP_DEVICES = 1000  # with a map to choose


def map_layers(run: Run) -> list[dict]:
    """Return gain, standard deviation, line of sight and error of each map.

    Large maps are thinned to every n-th position; a note is added to the run.

    Args:
        run: with its maps; the one named `TRUTH` is the reference of the errors.
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
        fields = [_field(f"{name}: gain", "gain [dB]", thin["gain_db"].values, "gain")]
        if "sigma_db" in thin:
            fields.append(_field(f"{name}: standard deviation", "σ [dB]", thin["sigma_db"].values,
                                 "sigma"))
        fields.append({"label": f"{name}: line of sight", "kind": "los", "title": "line of sight",
                       "low": 0, "high": 1, "values": pack(thin["los"].values.astype(np.uint8))})
        if truth is not None and name != TRUTH and _same_lattice(radio_map, truth):
            error_db = _error_db(RadioMap(thin), truth, step)
            fields.append(_field(f"{name}: error (model − truth)", "model − truth [dB]", error_db,
                                 "error"))
        layers.append({"name": name, "devices": RadioMap(thin).devices, "fields": fields,
                       **{axis: thin[axis].values.astype(float).round(3).tolist()
                          for axis in "xyz"}, "step_m": radio_map.lattice.step_m * step})
    return layers


def link_layer(run: Run) -> dict | None:
    """Return held-out residuals of a close-loop at the moving end; None without residuals.

    Args:
        run: with its residuals; a note is added where links are left out.
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
    names = sorted(links["device"].unique())
    before_db, after_db = (links[f"{when}_db"].to_numpy(dtype=float)
                           for when in ("before", "after"))
    return {**{axis: pack_m(np.nan_to_num(moving_m[:, i])) for i, axis in enumerate("xyz")},
            "devices": names,
            "device": pack(pd.Index(names).get_indexer(links["device"]).astype(np.int32)),
            "los": pack(links["los"].to_numpy().astype(np.uint8)),
            "range_db": residual_range_db(before_db), "before": pack_db(before_db),
            "after": pack_db(after_db)}


def device_layer(run: Run) -> list[dict]:
    """Return name, role, true position where it is known, and the twin's estimate of each device.

    Args:
        run: with its scene and twin.
    """
    devices: dict[str, dict] = {}
    for known in run.scene.config.devices if run.scene else []:
        devices[known.device] = {"name": known.device, "role": known.role, "estimate": None,
                                 "true": [known.x_m, known.y_m, known.z_m]}
    for device in run.twin.devices if run.twin else []:
        position_m = [device.x_m, device.y_m, device.z_m]
        entry = devices.setdefault(device.device, {"name": device.device, "true": None,
                                                   "estimate": None})
        entry["role"] = device.role
        if not (np.abs(position_m) <= MAX_COORDINATE_M).all():  # or none
            continue
        if device.role == "anchor":
            entry["true"] = entry["true"] or position_m
        else:
            radius_m = device.credible_radius_m
            entry |= {"estimate": position_m, "located": bool(device.located),
                      "radius_m": radius_m if np.isfinite(radius_m) else None,
                      "second": list(device.second_mode) if device.second_mode else None}
    return list(devices.values())


def flight_layer(run: Run) -> list[dict]:
    """Return the start of each flight, and the position of each UAV from then on.

    Args:
        run: with its tracks; a note is added where positions are left out.
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
    """Return x_min, x_max, y_min, y_max of what is drawn [m]."""
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


def _field(label: str, title: str, level_db: np.ndarray, kind: str) -> dict:
    """Return levels with the ends of their colour scale."""
    if kind == "error":
        high = residual_range_db(level_db)
        low = -high
    else:
        low, high = level_range_db(level_db)
    return {"label": label, "kind": kind, "title": title, "low": low, "high": max(high, low + 0.1),
            "values": pack_db(level_db)}


def _error_db(radio_map: RadioMap, truth: RadioMap, step: int) -> np.ndarray:
    """Return (device, z, y, x) map minus truth at every n-th position; NaN where there is none."""
    error_db = np.full(radio_map.gain_db.shape, np.nan)
    model_db, true_db = comparable_db(radio_map, truth), truth.gain_db[..., ::step, ::step]
    row_of = {device: row for row, device in enumerate(truth.devices)}
    for row, device in enumerate(radio_map.devices):
        if device in row_of:
            error_db[row] = model_db[row] - true_db[row_of[device]]
    return error_db


def _map_devices(run: Run, name: str) -> int:
    """Return the number of devices of a map that are shown; adds a note where some are not."""
    devices, altitudes = run.maps[name].gain_db.shape[:2]
    shown = min(devices, MAX_MAP_DEVICES, max(MAX_VALUES // (3 * altitudes), 1))
    if shown < devices:
        run.notes.append(f"Of the map {name} the first {shown:,} of {devices:,} devices are shown.")
    return shown


def _same_lattice(one: RadioMap, other: RadioMap) -> bool:
    return one.gain_db.shape[1:] == other.gain_db.shape[1:] and np.allclose(
        one.lattice.positions_m, other.lattice.positions_m)


def _thinning(run: Run) -> int:
    """Return n where every n-th position of the lattice is shown; adds a note to the run."""
    values = sum(3 * radio_map.gain_db.size for radio_map in run.maps.values())
    step = max(int(np.ceil(np.sqrt(values / MAX_VALUES))), 1)
    if step * run.map_step > 1:
        run.notes.append(f"Of the maps every {step * run.map_step}th position in x and in y is "
                         "shown, to keep the page small.")
    return step
