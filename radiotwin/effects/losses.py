"""Upper bounds of attenuation by gas, rain (ITU-R P.676, P.838) and woodland (P.833-10).

Gas and rain: a table of published specific attenuations, so that no result depends on an optional
package. A test compares it with the package `itur`: between rows it is less than 4 % lower.

Woodland: one terminal in it, Sec. 2.1 of the recommendation, the forest measured over the widest
range of frequencies, 105.9 to 2117.5 MHz (mixed, trees of 16 m). Outside, the power laws are
extrapolated; that of the greatest loss only to half and to twice the range, because at higher
frequencies scattering and paths around the crowns bound the loss.
"""

import numpy as np

# [GHz], [dB/km], [dB/km]. Gas: ITU-R P.676-12, Annex 1, at 1013.25 hPa, the greater of 15 °C with
# 7.5 g/m³ of water vapour and 35 °C with 30 g/m³. Rain: ITU-R P.838-3, horizontal polarisation, at
# 150 mm/h, which the wettest zones of ITU-R P.837 exceed in less than 0.01 % of the time.
TABLE = np.array([
    (1.0, 0.0054, 0.0033), (1.5, 0.0064, 0.0073), (2.0, 0.0069, 0.0177), (2.5, 0.0074, 0.0363),
    (3.0, 0.0082, 0.0667), (3.5, 0.0090, 0.1413), (4.0, 0.0100, 0.3263), (4.5, 0.0111, 0.6530),
    (5.0, 0.0123, 1.0652), (6.0, 0.0152, 2.0353), (7.0, 0.0187, 3.1990), (8.0, 0.0230, 4.3681),
    (10.0, 0.0341, 6.6182), (12.0, 0.0503, 8.9289), (15.0, 0.0938, 12.467),
    (18.0, 0.2056, 15.999), (20.0, 0.3933, 18.271), (21.2, 0.5618, 19.585),
    (22.235, 0.6715, 20.685), (23.0, 0.6850, 21.477), (24.0, 0.6264, 22.485),
    (26.0, 0.4654, 24.404), (28.0, 0.3753, 26.190), (30.0, 0.3385, 27.842),
    (35.0, 0.3431, 31.395), (40.0, 0.4065, 34.182), (45.0, 0.5156, 36.308),
    (50.0, 0.7527, 37.894), (52.0, 1.1164, 38.403), (54.0, 2.6785, 38.852),
    (55.0, 4.5093, 39.055), (56.2, 7.8161, 39.282), (57.0, 10.206, 39.424),
    (58.0, 12.498, 39.591), (59.0, 13.785, 39.747), (60.0, 14.778, 39.893),
    (61.0, 15.167, 40.029), (62.0, 14.161, 40.156), (63.0, 11.001, 40.274),
    (64.0, 7.1226, 40.384), (65.0, 4.4392, 40.487), (67.0, 1.8680, 40.671),
    (70.0, 1.2344, 40.900), (80.0, 1.3129, 41.365), (100.0, 1.9933, 41.562),
    (115.0, 2.8486, 41.456), (118.75, 3.9542, 41.415), (122.0, 3.2603, 41.377),
    (150.0, 5.0354, 40.973), (175.0, 17.850, 40.551), (180.0, 50.075, 40.462),
    (182.0, 80.756, 40.426), (183.31, 92.491, 40.403), (184.3, 87.063, 40.385),
    (185.0, 77.669, 40.372), (187.0, 49.244, 40.336), (195.0, 15.667, 40.189),
    (210.0, 10.968, 39.908), (240.0, 12.876, 39.331), (280.0, 18.550, 38.564),
    (300.0, 23.435, 38.192), (318.0, 46.677, 37.869), (323.7, 119.74, 37.768),
    (325.15, 136.58, 37.743), (326.5, 122.71, 37.720), (335.0, 44.200, 37.574),
    (355.0, 49.469, 37.242), (370.0, 128.74, 37.005), (378.7, 829.46, 36.872),
    (380.2, 990.02, 36.850), (381.6, 858.97, 36.829), (383.5, 540.33, 36.800),
    (390.0, 154.63, 36.705), (410.0, 74.621, 36.423), (430.0, 111.06, 36.160),
    (448.0, 1207.7, 35.939), (450.0, 886.77, 35.915)])
MEASURED_HZ = (105.9e6, 2117.5e6)
# Specific attenuation at the lower end of that range [dB/m], and exponent of the power law to the
# upper end (0.34 dB/m), which is within 13 % of all five values of the recommendation.
LOWEST_DB_M, SLOPE = 0.04, 0.7144
# The greatest loss is A_1 f^alpha [dB], f in MHz.
A_1_DB, ALPHA = 1.37, 0.42
MAX_FACTOR = 2.0  # factor beyond the range up to which the greatest loss is extrapolated
UNKNOWN_MAX_LOSS_DB = 25.0  # greatest loss at 1 GHz, used if the frequency is unknown


def max_gas_db_km(frequency_hz: float) -> float:
    """Compute the specific attenuation of hot, humid air at sea level (ITU-R P.676) [dB/km]."""
    return _interpolated(frequency_hz, 1)


def max_rain_db_km(frequency_hz: float) -> float:
    """Compute the specific attenuation of rain of 150 mm/h (ITU-R P.838) [dB/km]."""
    return _interpolated(frequency_hz, 2)


def _interpolated(frequency_hz: float, column: int) -> float:
    """Interpolate a column of `TABLE` [dB/km] in log-log; outside, the nearest row.

    Below 1 GHz attenuation is lower than at 1 GHz, so the value is still an upper bound.
    """
    return float(np.exp(np.interp(np.log(frequency_hz / 1e9), np.log(TABLE[:, 0]),
                                  np.log(TABLE[:, column]))))


def max_loss_db(frequency_hz: float) -> float:
    """Compute the greatest loss into woodland (A_m, ITU-R P.833) [dB]; NaN frequency: at 1 GHz."""
    if not np.isfinite(frequency_hz):
        return UNKNOWN_MAX_LOSS_DB
    low_hz, high_hz = MEASURED_HZ[0] / MAX_FACTOR, MEASURED_HZ[1] * MAX_FACTOR
    return A_1_DB * float(np.clip(frequency_hz, low_hz, high_hz) / 1e6) ** ALPHA


def specific_db_m(frequency_hz: float) -> float:
    """Compute the specific attenuation of the first metres of woodland [dB/m]."""
    return LOWEST_DB_M * (frequency_hz / MEASURED_HZ[0]) ** SLOPE
