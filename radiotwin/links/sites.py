"""Masts: devices that share one site, and those of them that look the same way."""

import numpy as np

from radiotwin.links.link_data import LinkData

SAME_SITE_M = 1.0  # apart at most: sectors of one mast; declared positions are good to that
SAME_DIRECTION_DEG = 5.0  # azimuths within it are of one antenna, or of two side by side
MAX_RELATIVES = 4  # more tell nothing new


def site_of(links: LinkData, device: int) -> list[int]:
    """Return the device and the anchors that share its mast, in order.

    Args:
        links: with the devices' positions.
        device: index of a device.
    """
    apart_m = np.linalg.norm(links.device_m - links.device_m[device], axis=1)
    return [int(other) for other in np.flatnonzero(apart_m <= SAME_SITE_M)
            if other == device or other in links.anchors]


def antenna_of(links: LinkData, device: int) -> list[int]:
    """Return the device and those of its mast whose declared azimuth is the same, in order.

    They are carriers through one antenna, or through antennas side by side. Arguments as of
    `site_of`.
    """
    found, mast = {device}, np.array(site_of(links, device))
    for _ in mast:  # what is near a member is one, too, so that the groups of a mast are disjoint
        apart_deg = np.abs((links.boresight_deg[mast, None] - links.boresight_deg[sorted(found)]
                            + 180) % 360 - 180)
        found |= set(mast[(apart_deg <= SAME_DIRECTION_DEG).any(axis=1)].tolist())
    return sorted(found)


def relatives_of(links: LinkData, device: int, heard: set[int]) -> list[int]:
    """Return whose signals reach a receiver on nearly the same ways as those of a device.

    The others of its antenna that were heard, or where there are none of its mast.

    Args:
        links: with the devices' positions.
        device: index of a device.
        heard: devices with a reading.

    Returns:
        at most `MAX_RELATIVES` devices.
    """
    others = ([other for other in group if other != device and other in heard]
              for group in (antenna_of(links, device), site_of(links, device)))
    return next(filter(None, others), [])[:MAX_RELATIVES]
