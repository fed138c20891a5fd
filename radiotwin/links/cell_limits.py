"""Limits of the cells of measurements and of tables of sites, in their columns' units."""

from collections.abc import Callable

import numpy as np

from radiotwin.io.forms import MAX_POSITION_M

LEVELS = ["gain_db", "rssi_dbm"]
READS = "reads_levels"  # 1: levels are read at the device, as by a gateway, of what receivers send
# Limits that no measurement exceeds: what lies beyond them is another unit or a placeholder.
MAX_LEVEL_DB = 300.0
FREQUENCIES_HZ = (1e6, 450e9)  # as of a scene; materials of ITU-R P.2040 end at 450 GHz
MAX_TIME_S = 1e11  # the year 5138; milliseconds since 1970 lie beyond
MAX_SPAN_S = 3.2e9  # a century, the longest campaign
MAX_TILT_DEG = 90.0
MAX_AZIMUTH_DEG = 720.0  # of an antenna that stands; 999 and 65535 are placeholders
MAX_ANGLE_DEG = 1e6  # thousands of turns in one direction, which some compasses count
MAX_POWER_DBM = 300.0  # as of a level
MAX_CABLE_LOSS_DB = 100.0
MAX_QUALITY = 1e15  # whole numbers are exact up to there


def refuse_limits(refuse: Callable[[np.ndarray, str], None], name: str,
                  numbers: np.ndarray) -> None:
    """Refuse numbers of a column that can only be mistakes, such as a wrong unit.

    Args:
        refuse: called with (n,) bool and the reason; raises where one is true.
        name: of the column, as in `measurements.csv` or `devices.csv`.
        numbers: (n,) in its unit; NaN where empty.
    """
    if name in LEVELS:
        refuse(np.abs(numbers) > MAX_LEVEL_DB,
               f"is no level; allowed are -{MAX_LEVEL_DB:g} to {MAX_LEVEL_DB:g}")
    if name == "gain_db":
        refuse(numbers > 0,
               "is above 0 dB, which no channel gain is; received power [dBm] goes into a column "
               "rssi_dbm, and a path loss needs a minus sign")
    if name == "frequency_hz":
        low, high = FREQUENCIES_HZ
        refuse((numbers < low) | (numbers > high),
               f"is no frequency; allowed are {low:g} to {high:g} Hz; the unit is Hz")
    if name.endswith("_m"):
        refuse(np.abs(numbers) > MAX_POSITION_M,
               f"is too far away; allowed are -{MAX_POSITION_M:g} to {MAX_POSITION_M:g} m in "
               "the scene's frame")
    if name == "time_s":
        refuse(np.abs(numbers) > MAX_TIME_S,
               f"is no time; allowed are -{MAX_TIME_S:g} to {MAX_TIME_S:g} s; the unit is s, not "
               "ms")
        if np.isfinite(numbers).any():
            refuse(numbers - np.nanmin(numbers) > MAX_SPAN_S,
                   f"is more than a century ({MAX_SPAN_S:g} s) after the first time, "
                   f"{np.nanmin(numbers):g} s; is one of them wrong, or in another unit?")
    if name == "tilt_deg":
        refuse(np.abs(numbers) > MAX_TILT_DEG,
               f"is no tilt; allowed are -{MAX_TILT_DEG:g} (down) to {MAX_TILT_DEG:g} (up)")
    if name == "azimuth_deg":
        refuse(np.abs(numbers) > MAX_AZIMUTH_DEG,
               "is no azimuth; allowed are 0 (north) to 360, clockwise; leave the cell empty where "
               "it is not known")
    if name == READS:
        refuse(~np.isin(numbers, (0, 1)) & ~np.isnan(numbers),
               "is neither 0 (levels are read at the receiver) nor 1 (at the device)")
    if name == "cable_loss_db":
        refuse((numbers < 0) | (numbers > MAX_CABLE_LOSS_DB),
               f"is no loss; allowed are 0 to {MAX_CABLE_LOSS_DB:g} dB")
    for ending, limit in (("_deg", MAX_ANGLE_DEG), ("tx_power_dbm", MAX_POWER_DBM),
                          ("eirp_dbm", MAX_POWER_DBM), ("quality", MAX_QUALITY)):
        if name.endswith(ending):
            refuse(np.abs(numbers) > limit,
                   f"is out of range; allowed are -{limit:g} to {limit:g}")
