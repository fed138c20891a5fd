"""Inputs of a regression without physics: position, geometry and angles of a link."""

from __future__ import annotations

import numpy as np

from radiotwin.links.link_data import LinkData

MAX_LABELS = 40  # devices or receivers that get a column each; more are told by their positions
OF_GEOMETRY, OF_BORESIGHT = 14, 2  # columns
NO_EDGE = -10.0  # stands for a diffraction parameter without a map: far from any edge


def feature_count(devices: int, declared: bool) -> int:
    """Return the number of columns of `link_features` without receivers.

    Args:
        devices: how many there are.
        declared: whether the azimuth of any is.
    """
    labels = devices if 1 < devices <= MAX_LABELS else 0
    return OF_GEOMETRY + OF_BORESIGHT * declared + labels


def link_features(links: LinkData, receivers: bool = True) -> np.ndarray:
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
