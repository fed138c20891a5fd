"""Make the campaign of docs/tutorial.md: a town that was drawn by lot, and flights over it.

    python examples/campaign/make.py FOLDER

writes `town.geojson` (the map, without one building that stands there), `nodes.csv` (the nodes, of
which two are somewhere), `log.csv` (what a drone logged) and `truth.csv` (where the two are, for
whoever wants to check). Levels are ray-traced with Sionna RT over the town as it is, with an error
of 1.5 dB, rounded to 1 dB; below -105 dBm nothing is logged.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from shapely import affinity, transform
from shapely.geometry import Point, Polygon, box, mapping

import radiotwin as rt
from radiotwin.geo import to_geographic
from radiotwin.io.forms import Origin
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.trace.run import trace_gains

ORIGIN = Origin(latitude_deg=47.05, longitude_deg=8.30, altitude_m=0.0)
SIDE_M, BLOCK_M, STREET_M = 420.0, 60.0, 16.0
NODES = {"n1": (36.0, 148.0), "n2": (200.0, 300.0), "n3": (367.0, 60.0), "n4": (300.0, 382.0),
         "n5": (128.0, 242.0), "n6": (270.0, 122.0)}  # x, y in the town [m], in streets
UNKNOWN = ("n5", "n6")
NODE_HEIGHT_M, FLIGHT_HEIGHT_M = 2.0, 40.0
NEW_BUILDING, NEW_HEIGHT_M = box(252, 192, 286, 228), 38.0  # not on the map
FREQUENCY_HZ, TX_POWER_DBM, NOISE_DB, LIMIT_DBM = 2.4e9, 14.0, 1.5, -105.0
FLIGHTS, SPEED_M_S, EVERY_S, READINGS = 5, 8.0, 2.0, 120


def main(folder: Path, seed: int = 7) -> None:
    """Write the four files.

    Args:
        folder: for the files.
        seed: of town, flights and errors.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    town = [each for each in draw_town(rng) if not each[0].intersects(NEW_BUILDING)]
    write_map(town, folder / "town.geojson")
    position_m, table = draw_flights(rng)
    node_m = np.array([[x, y, NODE_HEIGHT_M] for x, y in NODES.values()])
    with tempfile.TemporaryDirectory() as name:
        write_map([*town, (NEW_BUILDING, NEW_HEIGHT_M)], Path(name) / "truth.geojson")
        build_scene_from_map(Path(name) / "truth.geojson", Path(name) / "truth",
                             BuildOptions(frequency_hz=FREQUENCY_HZ, origin=ORIGIN))
        gain_db = trace_gains(rt.Scene.load(Path(name) / "truth"), node_m, position_m,
                              rt.SolverSettings.of_quality("default"))
    logs = []
    for node, gains_db in zip(NODES, gain_db):
        level_dbm = np.round(TX_POWER_DBM + gains_db + rng.normal(0, NOISE_DB, len(gains_db)))
        level_dbm[~(level_dbm >= LIMIT_DBM)] = np.nan
        logs.append(table.assign(node=node, rssi_dbm=pd.array(level_dbm, dtype="Int64")))
    log = pd.concat(logs).sort_values(["time_utc", "node"], kind="stable")
    log.to_csv(folder / "log.csv", index=False)
    longitude_deg, latitude_deg = to_geographic(ORIGIN, node_m[:, 0], node_m[:, 1])
    nodes = pd.DataFrame({"device": list(NODES), "latitude": latitude_deg.round(7),
                          "longitude": longitude_deg.round(7), "height_m": NODE_HEIGHT_M})
    unknown = nodes["device"].isin(UNKNOWN)
    nodes[unknown].to_csv(folder / "truth.csv", index=False)
    nodes.loc[unknown, ["latitude", "longitude"]] = np.nan
    nodes.to_csv(folder / "nodes.csv", index=False)


def draw_town(rng: np.random.Generator) -> list[tuple[Polygon, float]]:
    """Draw blocks of one or two buildings between streets, some left empty or shaped like an L."""
    town = []
    for x_m in np.arange(0, SIDE_M, BLOCK_M):
        for y_m in np.arange(0, SIDE_M, BLOCK_M):
            if rng.random() < 0.15:
                continue
            half_m = STREET_M / 2
            block = box(x_m + half_m, y_m + half_m, x_m + BLOCK_M - half_m, y_m + BLOCK_M - half_m)
            width_m, depth_m = rng.uniform(14, 30, 2)
            if rng.random() < 0.3:
                block = block.difference(box(x_m + half_m, y_m + half_m, x_m + half_m + width_m,
                                             y_m + half_m + depth_m))
            else:
                block = box(x_m + half_m, y_m + half_m, x_m + BLOCK_M - half_m - width_m / 3,
                            y_m + BLOCK_M - half_m - depth_m / 3)
            block = affinity.rotate(block, rng.uniform(-4, 4), "centroid")
            if not any(block.buffer(2).intersects(Point(each)) for each in NODES.values()):
                town.append((block, float(np.round(rng.uniform(8, 26)))))
    return town


def write_map(town: list[tuple[Polygon, float]], path: Path) -> None:
    """Write the town in longitude and latitude, as a GIS would export it."""
    def degrees(xy_m: np.ndarray) -> np.ndarray:
        return np.round(np.column_stack(to_geographic(ORIGIN, *xy_m.T)), 7)

    features = [{"type": "Feature", "properties": {"building": "yes", "height": height_m},
                 "geometry": mapping(transform(footprint, degrees))}
                for footprint, height_m in town]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}, indent=0))


def draw_flights(rng: np.random.Generator) -> tuple[np.ndarray, pd.DataFrame]:
    """Draw flights from waypoint to waypoint: positions (n, 3) [m] and their rows of the log."""
    positions, rows = [], []
    for flight in range(FLIGHTS):
        corner_m = rng.uniform(10, SIDE_M - 10, (60, 2))
        leg_m = np.linalg.norm(np.diff(corner_m, axis=0), axis=1)
        along_m = SPEED_M_S * EVERY_S * np.arange(READINGS)
        at_m = np.r_[0.0, np.cumsum(leg_m)]
        xy_m = np.column_stack([np.interp(along_m, at_m, corner_m[:, axis]) for axis in (0, 1)])
        positions.append(np.column_stack([xy_m, np.full(READINGS, FLIGHT_HEIGHT_M)]))
        longitude_deg, latitude_deg = to_geographic(ORIGIN, *xy_m.T)
        start = pd.Timestamp("2026-05-04T08:00:00Z") + pd.Timedelta(hours=flight)
        rows.append(pd.DataFrame({
            "time_utc": (start + pd.to_timedelta(EVERY_S * np.arange(READINGS), unit="s")
                         ).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "flight": f"f{flight + 1}", "lat": latitude_deg.round(7), "lon": longitude_deg.round(7),
            "height_m": FLIGHT_HEIGHT_M}))
    return np.concatenate(positions), pd.concat(rows, ignore_index=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
