"""Loss of a link in woodland, by frequency (ITU-R P.833-10, Sec. 2.1, one terminal in it).

Of the forests of the recommendation the one that was measured over the widest range of frequencies,
105.9 to 2117.5 MHz (mixed, trees of 16 m). Beyond it the power laws are extrapolated; that of the
greatest loss to half and to twice that range only, because at higher frequencies scattering and
paths around the crowns bound the loss.
"""

import numpy as np

MEASURED_HZ = (105.9e6, 2117.5e6)
# Specific attenuation at the ends of that range [dB/m]; a power law between them is within 13 % of
# all five values of the recommendation.
MEASURED_DB_M, SLOPE = (0.04, 0.34), 0.7144
# The greatest loss is A_1 f^alpha [dB], f in MHz.
A_1_DB, ALPHA = 1.37, 0.42
MAX_FACTOR = 2.0  # beyond the range, that this is extrapolated


def max_loss_db(frequency_hz: float) -> float:
    """Return the greatest loss A_m of a link into woodland [dB]."""
    low_hz, high_hz = MEASURED_HZ[0] / MAX_FACTOR, MEASURED_HZ[1] * MAX_FACTOR
    return A_1_DB * float(np.clip(frequency_hz, low_hz, high_hz) / 1e6) ** ALPHA


def specific_db_m(frequency_hz: float) -> float:
    """Return the specific attenuation of the first metres of woodland [dB/m]."""
    return MEASURED_DB_M[0] * (frequency_hz / MEASURED_HZ[0]) ** SLOPE
