"""What the viewer can show: levels on the lattice, residuals of links, devices, and flights over time."""

import numpy as np
import pandas as pd

from radiotwin.compare import comparable_db
from radiotwin.radiomap import RadioMap
from radiotwin.report.packing import pack, pack_db, pack_m
from radiotwin.report.run_folder import TRUTH, Run

MOST_VALUES = 2_000_000  # of all maps together, 2 bytes each
MOST_LINKS = 60_000
MOST_PLACES = 200_000  # of all flights together
LEAST_RANGE_DB, MOST_RANGE_DB = 2.0, 30.0


def map_layers(run: Run) -> list[dict]:
    """Gain, line of sight, standard deviation, and difference from the truth of each map.

    Where all values together are too many for a page, every n-th position of the lattice is taken; `run.notes` says so.
    """
    step = _thinning(run)
    truth = run.maps.get(TRUTH)
    layers = []
    for name, radio_map in run.maps.items():
        thin = radio_map.dataset.isel(y=slice(None, None, step), x=slice(None, None, step))
        fields = [_field(f"{name}: gain", "gain [dB]", thin["gain_db"].values, "gain")]
        if "sigma_db" in thin:
            fields.append(_field(f"{name}: standard deviation", "σ [dB]", thin["sigma_db"].values, "sigma"))
        fields.append({"label": f"{name}: line of sight", "kind": "los", "title": "line of sight", "low": 0, "high": 1,
                       "values": pack(thin["los"].values.astype(np.uint8))})
        if truth is not None and name != TRUTH and _same_lattice(radio_map, truth):
            error_db = _difference_db(radio_map, truth)[..., ::step, ::step]
            fields.append(_field(f"{name}: residual (model − truth)", "model − truth [dB]", error_db, "residual"))
        layers.append({"name": name, "devices": radio_map.devices, "fields": fields,
                       **{axis: thin[axis].values.astype(float).round(3).tolist() for axis in "xyz"},
                       "step_m": radio_map.lattice.step_m * step})
    return layers


def link_layer(run: Run) -> dict | None:
    """Held-out residuals of a close-loop at the place of the end that moves."""
    links = run.residuals
    if links is None or links.empty:
        return None
    if len(links) > MOST_LINKS:
        run.notes.append(f"Of {len(links):,} held-out links every {-(-len(links) // MOST_LINKS)}th is shown.")
        links = links.iloc[::-(-len(links) // MOST_LINKS)]
    ends = [links[[f"{end}_{axis}_m" for axis in "xyz"]].to_numpy(dtype=float) for end in ("receiver", "device")]
    place_m = max(ends, key=lambda end: len(np.unique(end[:, :2].round(), axis=0)))
    names = sorted(links["device"].unique())
    before_db, after_db = (links[f"{when}_db"].to_numpy(dtype=float) for when in ("before", "after"))
    return {**{axis: pack_m(np.nan_to_num(place_m[:, i])) for i, axis in enumerate("xyz")},
            "devices": names, "device": pack(pd.Index(names).get_indexer(links["device"]).astype(np.int32)),
            "los": pack(links["los"].to_numpy().astype(np.uint8)), "range_db": _residual_range_db(before_db),
            "before": pack_db(before_db), "after": pack_db(after_db)}


def device_layer(run: Run) -> list[dict]:
    """Name, role, true position as far as anybody knows it, and the twin's estimate of each device."""
    true_m = {d.device: (d.role, [d.x_m, d.y_m, d.z_m]) for d in run.scene.config.devices} if run.scene else {}
    devices: dict[str, dict] = {name: {"name": name, "role": role, "true": place_m, "estimate": None}
                                for name, (role, place_m) in true_m.items()}
    for device in run.twin.devices if run.twin else []:
        place_m = [device.x_m, device.y_m, device.z_m]
        entry = devices.setdefault(device.device, {"name": device.device, "role": device.role, "true": None,
                                                   "estimate": None})
        entry["role"] = device.role
        if not np.isfinite(place_m).all():
            continue
        if device.role == "anchor":
            entry["true"] = entry["true"] or place_m
        else:
            radius_m = device.credible_radius_m
            entry |= {"estimate": place_m, "radius_m": radius_m if np.isfinite(radius_m) else None,
                      "located": bool(device.located)}
    return list(devices.values())


def flight_layer(run: Run) -> list[dict]:
    """Each flight: when it began, and where each UAV was from then on."""
    tracks = run.tracks
    if tracks is None or tracks.empty:
        return []
    step = -(-len(tracks) // MOST_PLACES)
    if step > 1:
        run.notes.append(f"Of {len(tracks):,} places of UAVs every {step}th is shown.")
    flights = []
    for name, flight in tracks.groupby("flight", sort=False):
        start_s = float(flight["time_s"].min())
        uavs = []
        for uav, track in flight.groupby("uav", sort=False):
            track = track.sort_values("time_s").iloc[::step]
            uavs.append({"name": str(uav), "t": pack_m(track["time_s"] - start_s),
                         **{axis: pack_m(track[f"{axis}_m"].fillna(0.0)) for axis in "xyz"}})
        flights.append({"name": str(name), "start_s": start_s, "end_s": float(flight["time_s"].max()) - start_s,
                        "uavs": uavs})
    return flights


def bounds_m(run: Run) -> list[float]:
    """x_min, x_max, y_min, y_max of what is drawn [m]."""
    if run.scene is not None:
        return list(run.scene.config.extent.bounds)
    places_m = [track[["x_m", "y_m"]].to_numpy() for track in [run.tracks] if track is not None]
    places_m += [np.array([d["estimate"] or d["true"] for d in device_layer(run) if d["estimate"] or d["true"]],
                          dtype=float).reshape(-1, 3)[:, :2]]
    if run.residuals is not None:
        places_m += [run.residuals[[f"{end}_x_m", f"{end}_y_m"]].to_numpy() for end in ("receiver", "device")]
    every_m = np.concatenate(places_m)
    every_m = every_m[np.isfinite(every_m).all(axis=1)]
    if not len(every_m):
        return [0.0, 1.0, 0.0, 1.0]
    low, high = every_m.min(axis=0) - 1.0, every_m.max(axis=0) + 1.0
    return [float(low[0]), float(high[0]), float(low[1]), float(high[1])]


def _field(label: str, title: str, level_db: np.ndarray, kind: str) -> dict:
    seen = level_db[np.isfinite(level_db)]
    if kind == "residual":
        high = _residual_range_db(level_db)
        low = -high
    elif len(seen):
        low, high = (float(value) for value in np.quantile(seen, [0.01, 0.995]))
    else:
        low, high = -1.0, 0.0
    return {"label": label, "kind": kind, "title": title, "low": low, "high": max(high, low + 0.1),
            "values": pack_db(level_db)}


def _residual_range_db(residual_db: np.ndarray) -> float:
    """End of a scale of colours that nearly all values are within."""
    seen = np.abs(residual_db[np.isfinite(residual_db)])
    most_db = float(np.quantile(seen, 0.95)) if len(seen) else LEAST_RANGE_DB
    return float(np.clip(np.ceil(most_db), LEAST_RANGE_DB, MOST_RANGE_DB))


def _difference_db(radio_map: RadioMap, truth: RadioMap) -> np.ndarray:
    """(device, z, y, x) map minus truth; NaN where the truth lacks the device or nothing is detected."""
    error_db = np.full(radio_map.gain_db.shape, np.nan)
    model_db = comparable_db(radio_map, truth)
    for row, device in enumerate(radio_map.devices):
        if device in truth.devices:
            error_db[row] = model_db[row] - truth.gain_db[truth.devices.index(device)]
    return error_db


def _same_lattice(one: RadioMap, other: RadioMap) -> bool:
    return one.gain_db.shape[1:] == other.gain_db.shape[1:] and np.allclose(one.lattice.positions_m,
                                                                            other.lattice.positions_m)


def _thinning(run: Run) -> int:
    """Every how many-th position of the lattice is shown."""
    values = sum(3 * radio_map.gain_db.size for radio_map in run.maps.values())
    step = max(int(np.ceil(np.sqrt(values / MOST_VALUES))), 1)
    if step > 1:
        run.notes.append(f"Of the maps every {step}th position in x and in y is shown, so that the page stays small.")
    return step
