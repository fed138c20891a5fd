"""Levels of sector antennas, which have the more in common the more of a site they share.

Radios and cables of a mast come from one installation, and sectors of one direction are carriers
that share an antenna. So levels are random effects, nested: of all, of a mast, of a direction
there, of a device. What was heard of the others then says what to expect of a sector that nobody
has measured, and how surely.
"""

import numpy as np

SAME_DIRECTION_DEG = 5.0  # azimuths within it are of one antenna, or of two side by side
GROUP_SD_DB = 3.0  # between masts, and between directions of a mast
DEVICE_SD_DB = 3.0  # between carriers of an antenna: powers and cables differ


def level_groups(device_m: np.ndarray, azimuth_deg: np.ndarray, same_m: float) -> list[list[int]]:
    """Return the devices of each mast and of each direction of a mast, by their rows.

    Args:
        device_m: (k, 3) positions [m].
        azimuth_deg: (k,) of the antennas [deg].
        same_m: distance within which devices are on one mast [m].

    Returns:
        groups of at least two devices, and fewer than all of them.
    """
    same_mast = np.linalg.norm(device_m[:, None] - device_m, axis=2) <= same_m
    apart_deg = np.abs((azimuth_deg[:, None] - azimuth_deg + 180) % 360 - 180)
    found = {tuple(np.flatnonzero(row).tolist())
             for same in (same_mast, same_mast & (apart_deg <= SAME_DIRECTION_DEG)) for row in same}
    return [list(group) for group in sorted(found) if 1 < len(group) < len(device_m)]


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
    covariance += DEVICE_SD_DB**2 * np.eye(len(devices))
    known = np.isin(devices, list(heard))
    cross = covariance[np.ix_(~known, known)]
    explained = np.einsum("ij,ji->i", cross, np.linalg.solve(covariance[np.ix_(known, known)],
                                                             cross.T))
    sd_db = np.sqrt(np.diag(covariance)[~known] - explained)
    return {device: float(sd) for device, sd in zip(np.array(devices)[~known].tolist(), sd_db,
                                                    strict=True)}
