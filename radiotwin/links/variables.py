"""Variables that a link's residual may depend on, and inputs of regressions without physics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from radiotwin.links.links import Links

CELL_M = 60.0  # side of the squares of ground
MAX_LABELS = 40  # more devices or receivers get no column each; their positions identify them
GEOMETRY_COLUMNS, BORESIGHT_COLUMNS = 14, 2  # of `link_features`
NO_EDGE = -10.0  # diffraction parameter without a map: far above any edge


def residual_variables(links: Links, mean_db: np.ndarray) -> dict[str, np.ndarray]:
    """Compute every variable (n,) on which a residual may depend: name -> values.

    `mean_db` (n,) are the predicted levels [dB]. Integers are labels without an order; NaN is
    unknown.
    """
    return {name: variable(links, mean_db) for name, variable in VARIABLES.items()}


def residual_variable(name: str, links: Links, mean_db: np.ndarray) -> np.ndarray:
    """Compute one of `residual_variables` only, which takes less time."""
    return VARIABLES[name](links, mean_db)


def ground_squares(position_m: np.ndarray, side_m: float = CELL_M) -> np.ndarray:
    """Return the index (n,) of the square of ground that each position (n, 3) [m] is in."""
    squares = np.floor(position_m[:, :2] / side_m).astype(np.int64)
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
    "place_of_ray": lambda links, _: ground_squares(
        0.5 * (links.receiver_m + links.device_m[links.device])),
    "place_of_receiver": lambda links, _: ground_squares(links.receiver_m),
}


def feature_count(devices: int, declared: bool) -> int:
    """Return how many columns `link_features(links, receivers=False)` gives.

    `declared` tells whether any azimuth is; more than `MAX_LABELS` devices get no columns.
    """
    labels = devices if 1 < devices <= MAX_LABELS else 0
    return GEOMETRY_COLUMNS + BORESIGHT_COLUMNS * declared + labels


def link_features(links: Links, receivers: bool = True) -> np.ndarray:
    """Compute the inputs (n, p) of a regression: geometry, angles, and one-hot device and receiver.

    Times, and what a receiver reports beside the level, are left out, as they are unknown where a
    map is predicted; with `receivers` False, so is the receiver.
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
