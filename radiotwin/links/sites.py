"""Masts: devices that share one site."""

import numpy as np

from radiotwin.links.link_data import LinkData

SAME_SITE_M = 1.0  # apart at most: sectors of one mast; declared positions are good to that


def site_of(links: LinkData, device: int) -> list[int]:
    """Return the device and the anchors that share its mast, in order.

    Args:
        links: with the devices' positions.
        device: index of a device.
    """
    apart_m = np.linalg.norm(links.device_m - links.device_m[device], axis=1)
    return [int(other) for other in np.flatnonzero(apart_m <= SAME_SITE_M)
            if other == device or other in links.anchors]
