"""Variables that a residual may depend on."""

from collections.abc import Callable

import numpy as np

from radiotwin.links.link_data import LinkData

CELL_M = 60.0  # side of the cells of ground that positions are sorted into


def residual_variables(links: LinkData, mean_db: np.ndarray) -> dict[str, np.ndarray]:
    """Return every variable that a residual may depend on, by name.

    Args:
        links: n links.
        mean_db: (n,) predicted level [dB].

    Returns:
        (n,) arrays; integers are labels without an order, NaN is unknown.
    """
    return {name: variable(links, mean_db) for name, variable in VARIABLES.items()}


def residual_variable(name: str, links: LinkData, mean_db: np.ndarray) -> np.ndarray:
    """Return one of `residual_variables`, without the time that others take."""
    return VARIABLES[name](links, mean_db)


def _cells(position_m: np.ndarray) -> np.ndarray:
    """Return the number (n,) of the square of ground that each position (n, 3) is in."""
    squares = np.floor(position_m[:, :2] / CELL_M).astype(np.int64)
    return np.unique(squares, axis=0, return_inverse=True)[1].ravel()


VARIABLES: dict[str, Callable[[LinkData, np.ndarray], np.ndarray]] = {
    "distance_m": lambda links, _: links.distance_m,
    "elevation_deg": lambda links, _: links.elevation_deg,
    "azimuth_deg": lambda links, _: links.azimuth_deg,
    "body_azimuth_deg": lambda links, _: links.body_azimuth_deg,
    "heading_deg": lambda links, _: links.heading_deg,
    "time_in_flight_s": lambda links, _: links.time_in_flight_s,
    "time_s": lambda links, _: links.absolute_time_s,
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
