"""What a regression that knows no physics is given of a link: where its ends are, and what is between."""

from __future__ import annotations

import numpy as np

from radiotwin.links.link_data import LinkData

MAX_LABELS = 40  # devices or receivers that get a column each; of more their positions say it
NO_MAP = -10.0  # stands for a diffraction parameter that nothing is known of: far from any edge
GEOMETRY = ("receiver_x_m", "receiver_y_m", "receiver_z_m", "device_x_m", "device_y_m",
            "device_z_m", "distance_m", "log_distance", "elevation_deg", "azimuth_sin",
            "azimuth_cos", "los", "metres_inside_m", "diffraction_parameter")


def link_features(links: LinkData, receiver: np.ndarray | None = None) -> np.ndarray:
    """Return position, geometry, angles, and which device and receiver it is, as numbers.

    Neither time nor what the receiver reports beside the level: a map has none.

    Args:
        links: n links.
        receiver: (n,) index of the receiver; None: that of the links. A negative one is none.

    Returns:
        (n, p): `GEOMETRY`, then a 0 or 1 for each device and for each receiver.
    """
    receiver = links.receiver if receiver is None else receiver
    azimuth = np.radians(links.azimuth_deg)
    columns = [*links.receiver_m.T, *links.device_m[links.device].T, links.distance_m,
               np.log10(links.distance_m), links.elevation_deg, np.sin(azimuth), np.cos(azimuth),
               links.los, links.metres_inside,
               np.nan_to_num(links.diffraction_parameter, nan=NO_MAP)]
    for label, count in ((links.device, len(links.device_names)),
                         (receiver, len(links.receiver_names))):
        if 1 < count <= MAX_LABELS:
            columns += list((label == np.arange(count)[:, None]))
    return np.column_stack(columns).astype(np.float32)
