"""Write planned flights for QGroundControl, and as KML, GeoJSON and CSV.

There is a waypoint at each turn, with the time to hover. Heights are above the take-off point,
since flight controllers hold them by barometer; in KML and GeoJSON they are above the sea.
"""

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.geo import to_geographic
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path
from radiotwin.io.forms import Origin

# Commands of MAVLink (common.xml), and the frame of altitudes above the take-off point.
TAKE_OFF, WAYPOINT, RETURN, LAND, CHANGE_SPEED = 22, 16, 20, 21, 178
RELATIVE, NO_FRAME = 3, 2
PX4, MULTIROTOR = 12, 2  # in QGroundControl, which translates plans for other controllers
KML = "http://www.opengis.net/kml/2.2"


@dataclass(frozen=True, eq=False)
class Route:
    """The flight of one UAV as n waypoints.

    Attributes:
        name: of the UAV.
        position_m: (n, 3) waypoints; z is above the datum [m].
        hold_s: (n,) time to hover at each waypoint [s].
        speed_m_s: speed between waypoints [m/s].
        start_ground_m: height of the ground at the first waypoint [m].
    """

    name: str
    position_m: np.ndarray
    hold_s: np.ndarray
    speed_m_s: float
    start_ground_m: float = 0.0

    @classmethod
    def along(cls, name: str, track_m: np.ndarray, slot_s: float, speed_m_s: float,
              start_ground_m: float = 0.0) -> "Route":
        """Reduce a track to waypoints where the UAV turns or hovers.

        Args:
            name: of the UAV.
            track_m: (slots, 3) position in every slot [m]; the UAV hovers while it stays the same.
            slot_s: duration of a slot [s].
            speed_m_s: speed of a move [m/s].
            start_ground_m: see `Route`.
        """
        moves = np.linalg.norm(np.diff(track_m, axis=0), axis=1) > 0
        at = np.concatenate([[0], np.flatnonzero(moves) + 1])  # first slot at each position
        stays = np.diff(np.append(at, len(track_m)))
        points_m, hold_s = track_m[at], slot_s * (stays - 1.0)
        steps_m = np.diff(points_m, axis=0)
        turns = (np.abs(np.diff(steps_m, axis=0)) > 1e-6).any(axis=1) | (hold_s[1:-1] > 0)
        kept = np.concatenate([[True], turns, [True]])[:len(points_m)]
        return cls(name, points_m[kept], hold_s[kept], speed_m_s, start_ground_m)

    @property
    def arrival_s(self) -> np.ndarray:
        """Time of arrival at each waypoint (n,), after take-off [s]."""
        legs_m = np.linalg.norm(np.diff(self.position_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(self.hold_s[:-1] + legs_m / self.speed_m_s)])

    @property
    def above_start_m(self) -> np.ndarray:
        """Height of each waypoint (n,) above the take-off point [m]."""
        return self.position_m[:, 2] - self.start_ground_m

    def table(self, origin: Origin | None) -> pd.DataFrame:
        """Return a row for each waypoint, with longitude and latitude if there is an origin."""
        x_m, y_m, z_m = self.position_m.T
        table = pd.DataFrame({
            "uav": self.name, "waypoint": np.arange(len(x_m)), "time_s": self.arrival_s,
            "hold_s": self.hold_s, "x_m": x_m, "y_m": y_m, "z_m": z_m,
            "above_start_m": self.above_start_m})
        if origin is not None:
            longitude_deg, latitude_deg = to_geographic(origin, x_m, y_m)
            table["latitude_deg"], table["longitude_deg"] = latitude_deg, longitude_deg
            table["altitude_m"] = origin.altitude_m + z_m
        return table.round({"time_s": 3, "hold_s": 3, "x_m": 3, "y_m": 3, "z_m": 3,
                            "above_start_m": 3, "altitude_m": 3, "latitude_deg": 8,
                            "longitude_deg": 8})


def write_flight_files(routes: Iterable[Route], origin: Origin | None, folder: Path) -> list[str]:
    """Write `flights.csv`; with an origin also `flights.kml`, `.geojson` and a `.plan` a UAV.

    Returned are the names of the files.
    """
    tables = [route.table(origin) for route in routes]
    names = ["flights.csv"]
    with atomic_path(folder / names[0]) as temporary:
        write_csv(pd.concat(tables, ignore_index=True), temporary)
    if origin is None:
        return names
    texts = {"flights.geojson": json.dumps(_geojson(tables), indent=1), "flights.kml": _kml(tables)}
    for route, table in zip(routes, tables, strict=True):
        texts[f"{route.name}.plan"] = json.dumps(_plan(route, table, origin), indent=1)
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
    return names + sorted(texts)


def _plan(route: Route, table: pd.DataFrame, origin: Origin) -> dict:
    """Return a plan of QGroundControl (file format 1, mission 2): takeoff, waypoints, way home.

    If the last waypoint is not within 1 m of the first, the UAV lands there instead.
    """
    first = table.iloc[0]
    items: list[dict] = []

    def add(command: int, parameters: list[float | None], height_m: float | None = None) -> None:
        above = {} if height_m is None else {
            "AMSLAltAboveTerrain": None, "Altitude": height_m, "AltitudeMode": 1}
        items.append({"type": "SimpleItem", "autoContinue": True, "command": command,
                      "doJumpId": len(items) + 1, "params": parameters,
                      "frame": NO_FRAME if height_m is None else RELATIVE} | above)

    def place(row: pd.Series) -> list[float | None]:
        return [row["latitude_deg"], row["longitude_deg"], row["above_start_m"]]

    add(TAKE_OFF, [0, 0, 0, None, *place(first)], first["above_start_m"])
    add(CHANGE_SPEED, [1, route.speed_m_s, -1, 0, 0, 0, 0])
    for _, row in table.iterrows():
        add(WAYPOINT, [row["hold_s"], 0, 0, None, *place(row)], row["above_start_m"])
    last, home = table.iloc[-1], table.iloc[0]
    if np.hypot(last["x_m"] - home["x_m"], last["y_m"] - home["y_m"]) < 1.0:
        add(RETURN, [0, 0, 0, 0, 0, 0, 0])
    else:
        add(LAND, [0, 0, 0, None, *place(last)[:2], 0.0], 0.0)
    return {
        "fileType": "Plan", "version": 1, "groundStation": "QGroundControl",
        "geoFence": {"version": 2, "circles": [], "polygons": []},
        "rallyPoints": {"version": 2, "points": []},
        "mission": {
            "version": 2, "firmwareType": PX4, "vehicleType": MULTIROTOR,
            "globalPlanAltitudeMode": 1, "cruiseSpeed": route.speed_m_s,
            "hoverSpeed": route.speed_m_s, "items": items,
            "plannedHomePosition": [first["latitude_deg"], first["longitude_deg"],
                                    origin.altitude_m + route.start_ground_m]}}


def _coordinates(table: pd.DataFrame) -> list[list[float]]:
    """Return longitude, latitude [degrees] and altitude [m] of each waypoint."""
    return table[["longitude_deg", "latitude_deg", "altitude_m"]].to_numpy().tolist()


def _geojson(tables: list[pd.DataFrame]) -> dict:
    """Return GeoJSON (RFC 7946) with a line for each UAV, and its waypoints as points."""
    features = []
    for table in tables:
        uav, coordinates = table["uav"].iloc[0], _coordinates(table)
        line = coordinates if len(coordinates) > 1 else coordinates * 2
        features.append({"type": "Feature", "properties": {"uav": uav},
                         "geometry": {"type": "LineString", "coordinates": line}})
        features += [{"type": "Feature",
                      "properties": {"uav": uav, "waypoint": int(row["waypoint"]),
                                     "time_s": row["time_s"], "hold_s": row["hold_s"],
                                     "above_start_m": row["above_start_m"]},
                      "geometry": {"type": "Point", "coordinates": place}}
                     for (_, row), place in zip(table.iterrows(), coordinates, strict=True)]
    return {"type": "FeatureCollection", "features": features}


def _kml(tables: list[pd.DataFrame]) -> str:
    """Return a KML document (OGC KML 2.2) with a line for each UAV."""
    ET.register_namespace("", KML)
    root = ET.Element(f"{{{KML}}}kml")
    document = ET.SubElement(root, f"{{{KML}}}Document")
    for table in tables:
        mark = ET.SubElement(document, f"{{{KML}}}Placemark")
        ET.SubElement(mark, f"{{{KML}}}name").text = table["uav"].iloc[0]
        line = ET.SubElement(mark, f"{{{KML}}}LineString")
        ET.SubElement(line, f"{{{KML}}}altitudeMode").text = "absolute"
        ET.SubElement(line, f"{{{KML}}}coordinates").text = " ".join(
            ",".join(f"{value:.9g}" for value in place) for place in _coordinates(table))
    return ET.tostring(root, encoding="unicode", xml_declaration=True)
