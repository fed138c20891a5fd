"""Devices of unknown position in a file, found by a corrected twin."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd

from radiotwin.closeloop.locate import Corrected, locate, whole_area
from radiotwin.closeloop.records import make_records
from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.twin import Twin


def locate_file(measurements: Measurements, twin: Twin, model: Corrected, scene: Scene | None,
                tell: Callable[[], None]) -> tuple[pd.DataFrame, list[str]]:
    """Find the devices of role unknown.

    Args:
        measurements: their links, and others.
        twin, model: of `close-loop`.
        scene: the 3D map, if the twin was made with one.
        tell: called after each device.

    Returns:
        a row a device: `device, x_m, y_m, radius_m` (of 90 % of the probability), `links`; and remarks on the data

    Raises:
        BadInput: no unknown device, links of another quantity than the twin's, or nothing that can be used.
    """
    unknown = measurements.select(~measurements.is_anchor[measurements.device_index])
    if unknown.table.empty:
        raise BadInput("no link is to a device of role unknown; set the role of those that are to be found in "
                       "devices.csv")
    if unknown.level_column != twin.level:
        raise BadInput(f"the measurements have {unknown.level_column}, the twin is of {twin.level}; both need the same")
    records = make_records(unknown, scene, to_locate=True)
    names = twin.effects["receivers"]
    strangers = [name for name in records.receiver_names if name not in names]
    remarks = list(records.remarks)
    if strangers:
        remarks.append(f"nothing is known of receivers {', '.join(strangers[:5])}"
                       f"{' and others' if len(strangers) > 5 else ''}: they are taken for faultless ones")
    every = [*names, *strangers]
    number = np.array([every.index(name) for name in records.receiver_names])
    records = replace(records, receiver=number[records.receiver], receiver_names=every,
                      device_m=np.nan_to_num(records.device_m),
                      # A few links do not tell how weak a level can be detected.
                      limit_db=records.limit_db if twin.limit_db is None else twin.limit_db)
    area_m = scene.config.extent.bounds if scene is not None else whole_area(model, records)
    found = list(locate(model, records, area_m, tell))
    table = pd.DataFrame({"device": [records.device_names[place.device] for place in found],
                          "x_m": [place.x_m for place in found], "y_m": [place.y_m for place in found],
                          "radius_m": [place.radius_m for place in found],
                          "links": [place.links for place in found]})
    return table.round(1), remarks


def off_by(places: pd.DataFrame, truth: pd.DataFrame) -> dict[str, float]:
    """How far places lie from the true ones [m]: number, median and 90 % quantile of the distance, and the share of
    devices within their radius.

    Raises:
        BadInput: no place of a device whose true position is given.
    """
    both = places.merge(truth[["device", "x_m", "y_m"]].dropna(), on="device", suffixes=("", "_true"))
    if both.empty:
        raise BadInput("the table of true positions has none of the located devices")
    apart_m = np.hypot(both["x_m"] - both["x_m_true"], both["y_m"] - both["y_m_true"])
    return {"devices": len(both), "median_m": float(apart_m.median()), "ninety_m": float(apart_m.quantile(0.9)),
            "within": float((apart_m <= both["radius_m"]).mean())}
