"""What a residual may depend on, of a link, and inputs of a regression without physics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from radiotwin.links.links import Links

CELL_M = 60.0  # side of the cells of ground that positions are sorted into
MAX_LABELS = 40  # devices or receivers that get a column each; more are told by their positions
OF_GEOMETRY, OF_BORESIGHT = 14, 2  # columns
NO_EDGE = -10.0  # stands for a diffraction parameter without a map: far from any edge


def residual_variables(links: Links, mean_db: np.ndarray) -> dict[str, np.ndarray]:
    """Return every variable (n,) that a residual may depend on, by name.

    Integers are labels without an order, NaN is unknown. Predicted levels are (n,) [dB].
    """
    return {name: variable(links, mean_db) for name, variable in VARIABLES.items()}


def residual_variable(name: str, links: Links, mean_db: np.ndarray) -> np.ndarray:
    """Return one of `residual_variables`, without the time that others take."""
    return VARIABLES[name](links, mean_db)


def _cells(position_m: np.ndarray) -> np.ndarray:
    """Return the number (n,) of the square of ground that each position (n, 3) is in."""
    squares = np.floor(position_m[:, :2] / CELL_M).astype(np.int64)
    return np.unique(squares, axis=0, return_inverse=True)[1].ravel()


VARIABLES: dict[str, Callable[[Links, np.ndarray], np.ndarray]] = {
    "distance_m": lambda links, _: links.distance_m,
    "elevation_deg": lambda links, _: links.elevation_deg,
    "azimuth_deg": lambda links, _: links.azimuth_deg,
    "body_azimuth_deg": lambda links, _: links.body_azimuth_deg,
    "heading_deg": lambda links, _: links.heading_deg,
    "time_in_flight_s": lambda links, _: links.time_in_flight_s,
    "time_s": lambda links, _: (np.full(len(links), np.nan) if links.time_restarts
                                else links.time_s),
    "flight": lambda links, _: links.flight,
    "altitude_m": lambda links, _: links.receiver_m[:, 2],
    "receiver": lambda links, _: links.receiver,
    "device": lambda links, _: links.device,
    "los": lambda links, _: links.los.astype(int),
    "predicted_level_db": lambda _, mean_db: mean_db,
    "metres_inside_m": lambda links, _: links.metres_inside,
    "diffraction_parameter": lambda links, _: links.diffraction_parameter,
    "quality": lambda links, _: (np.full(len(links), np.nan) if links.quality is None
                                 else links.quality),
    "place_of_ray": lambda links, _: _cells(
        0.5 * (links.receiver_m + links.device_m[links.device])),
    "place_of_receiver": lambda links, _: _cells(links.receiver_m),
}


def feature_count(devices: int, declared: bool) -> int:
    """Return the number of columns of `link_features` without receivers, for so many devices.

    It depends on whether the azimuth of any is declared.
    """
    labels = devices if 1 < devices <= MAX_LABELS else 0
    return OF_GEOMETRY + OF_BORESIGHT * declared + labels


def link_features(links: Links, receivers: bool = True) -> np.ndarray:
    """Return position, geometry and angles, and which device and receiver it is, as numbers.

    Neither time nor columns that the receiver reports beside the level: a map has none.

    Args:
        links: n links.
        receivers: whether to say which receiver it is; a map's is none of them.

    Returns:
        (n, p): both positions [m], distance [m], its logarithm, elevation [deg], sine and cosine of
        the azimuth at the device, line of sight, metres inside buildings, diffraction parameter;
        where azimuths of devices are declared the cosine of the angle off them and the sine's size,
        0 where one is not; then a 0 or 1 for each device and for each receiver.
    """
    azimuth = np.radians(links.azimuth_deg)
    columns = [*links.receiver_m.T, *links.device_m[links.device].T, links.distance_m,
               np.log10(links.distance_m), links.elevation_deg, np.sin(azimuth), np.cos(azimuth),
               links.los, links.metres_inside,
               np.nan_to_num(links.diffraction_parameter, nan=NO_EDGE)]
    if links.has_boresights:
        off = azimuth - np.radians(links.boresight_deg[links.device])
        columns += [np.nan_to_num(np.cos(off)), np.nan_to_num(np.abs(np.sin(off)))]
    labels = [(links.device, len(links.device_names))]
    if receivers:
        labels.append((links.receiver, len(links.receiver_names)))
    for label, count in labels:
        if 1 < count <= MAX_LABELS:
            columns += [label == each for each in range(count)]
    return np.column_stack(columns).astype(np.float32)
