"""Levels of sector antennas, which have the more in common the more of a site they share.

Radios and cables of a mast come from one installation, and sectors of one direction are carriers
that share an antenna. So levels are random effects, nested: of all, of a mast, of a direction
there, of a device. What was heard of the others then says what to expect of a sector that nobody
has measured, and how surely.
"""

import numpy as np

from radiotwin.links import LinkData
from radiotwin.links.sites import antenna_of, site_of

GROUP_SD_DB = 3.0  # between masts, and between directions of a mast
DEVICE_SD_DB = 3.0  # between carriers of an antenna: powers and cables differ


def level_groups(links: LinkData, devices: list[int]) -> list[list[int]]:
    """Return those of some devices that are on one mast, and those that look one way from it.

    Groups are of at least two devices; one that is both, a mast of one direction, is in it twice.
    """
    found = [{tuple(other for other in group_of(links, device) if other in devices)
              for device in devices} for group_of in (site_of, antenna_of)]
    return [list(group) for kind in found for group in sorted(kind) if len(group) > 1]


def own_sd_db(devices: list[int], groups: list[list[int]]) -> np.ndarray:
    """Return the standard deviation of what no other device shares (k,) [dB].

    That of a device, and of a mast or a direction that it has for itself.
    """
    alone = 2 - membership(devices, groups).sum(axis=1)
    return np.sqrt(DEVICE_SD_DB**2 + GROUP_SD_DB**2 * alone)


def membership(devices: list[int], groups: list[list[int]]) -> np.ndarray:
    """Return which groups each device is in, (k, groups) of 0 and 1."""
    return np.array([[float(device in group) for group in groups] for device in devices]
                    ).reshape(len(devices), len(groups))


def unheard_sd_db(devices: list[int], groups: list[list[int]], heard: set[int],
                  common_sd_db: float) -> dict[int, float]:
    """Return the standard deviation of the level of each device without a reading [dB].

    That of a normal distribution, on condition of the levels of all others.

    Args:
        devices: all k.
        groups: of them that have a level in common.
        heard: those whose levels are known.
        common_sd_db: between networks: of the level of all [dB].
    """
    member = membership(devices, groups)
    covariance = common_sd_db**2 + GROUP_SD_DB**2 * member @ member.T
    covariance += np.diag(own_sd_db(devices, groups) ** 2)
    known = np.isin(devices, list(heard))
    cross = covariance[np.ix_(~known, known)]
    explained = np.einsum("ij,ji->i", cross, np.linalg.solve(covariance[np.ix_(known, known)],
                                                             cross.T))
    sd_db = np.sqrt(np.diag(covariance)[~known] - explained)
    return {device: float(sd) for device, sd in zip(np.array(devices)[~known].tolist(), sd_db,
                                                    strict=True)}
