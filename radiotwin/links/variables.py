"""Variables that a residual may depend on."""

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
    middle_m = 0.5 * (links.receiver_m + links.device_m[links.device])
    cells = [np.unique(np.floor(position_m[:, :2] / CELL_M).astype(np.int64), axis=0,
                       return_inverse=True)[1].ravel()
             for position_m in (middle_m, links.receiver_m)]
    unknown = np.full(len(links), np.nan)
    return {
        "distance_m": links.distance_m, "elevation_deg": links.elevation_deg,
        "azimuth_deg": links.azimuth_deg, "body_azimuth_deg": links.body_azimuth_deg,
        "heading_deg": links.heading_deg, "time_in_flight_s": links.time_in_flight_s,
        "time_s": links.absolute_time_s, "flight": links.flight,
        "altitude_m": links.receiver_m[:, 2], "receiver": links.receiver, "device": links.device,
        "los": links.los.astype(int),
        "predicted_level_db": mean_db, "metres_inside_m": links.metres_inside,
        "diffraction_parameter": links.diffraction_parameter,
        "quality": unknown if links.quality is None else links.quality,
        "place_of_ray": cells[0], "place_of_receiver": cells[1],
    }
